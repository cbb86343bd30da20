"""Files of other programs: texts in this folder have the files, the commands, and what they print."""

import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit.commands import Case, Dxlrun, cases, play
from tests.kit.packages import installing
from tests.kit.pages import page_commands

import dxlrun
from dxlrun.contract.hookspecs import HookSpecs
from dxlrun.description.other_files import file_formats
from dxlrun_import.registry import FORMATS

pytestmark = pytest.mark.long

TEXTS = [f"../import/{path.name}" for path in sorted(Path(__file__).parent.glob("*.txt"))]


@pytest.mark.usefixtures("working_folder")
@pytest.mark.parametrize("case", [case for name in TEXTS for case in cases(name)])
def test_file_of_another_program_is_converted_or_refused(dxlrun: Dxlrun, case: Case) -> None:
    play(case, dxlrun)


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def test_action_file_is_named_by_its_checksums(working_folder: Path, dxlrun: Dxlrun) -> None:
    page = bytearray(512)
    page[31] = 0xFF  # the checksum makes the sum of a page 255
    (working_folder / "motion.bin").write_bytes(bytes(page) * 256)
    assert "this is an action file of ROBOTIS" in dxlrun("import", "motion.bin").err
    (working_folder / "motion.bin").write_bytes(bytes(512) + bytes(page) * 255)
    assert "this is an action file of ROBOTIS" in dxlrun("import", "motion.bin").err
    (working_folder / "motion.bin").write_bytes(bytes(page) * 128 + bytes(512) * 128)
    assert "the format of this file is not known" in dxlrun("import", "motion.bin").err


def test_mcap_files_are_told_apart_by_their_header(working_folder: Path, dxlrun: Dxlrun) -> None:
    named = {
        (b"ros2", b"dxlrun 0.1"): "a log of dxlrun; `dxlrun analyze",
        (b"ros2", b"libmcap 1.4"): "a recording of ROS 2 in MCAP; `dxlrun convert a.mcap motion.yaml",
        (b"", b"mcap go"): "a recording of another program in MCAP; write one episode as CSV",
    }
    for (profile, library), expected in named.items():
        body = b"".join(len(text).to_bytes(4, "little") + text for text in (profile, library))
        start = b"\x89MCAP0\r\n\x01" + len(body).to_bytes(8, "little")
        (working_folder / "a.mcap").write_bytes(start + body + bytes(99))
        assert f"a.mcap:1:1: this is {expected}" in dxlrun("import", "a.mcap").err


def test_motion_of_another_windows_is_read(working_folder: Path, dxlrun: Dxlrun) -> None:
    """Names are in its encoding, numbers have its decimal comma, and bytes follow the last page."""
    step = b"step=512 480 0,100 0,400\r\n"
    page = b"page_begin\r\nname=ma\xf1ana\r\ncompliance=5 5\r\nplay_param=0 0 1 1,5 32\r\n" + step
    text = b"type=motion\r\nversion=1,01\r\nenable=0 1\r\n" + page + b"page_end\r\n\x99\xdc"
    (working_folder / "old.mtn").write_bytes(text)
    said = dxlrun("import", "old.mtn")
    assert (said.code, "speed: 1.5" in said.out, "time: 0.4 s, pause: 0.1 s" in said.out) == (0, True, True)


def test_recordings_are_named_by_their_first_bytes(working_folder: Path, dxlrun: Dxlrun) -> None:
    starts = {
        "a.bag": b"#ROSBAG V2.0\n",
        "a.db3": b"SQLite format 3\0",
        "a.parquet": b"PAR1",
        "a.mcap": b"\x89MCAP0\r\n",
    }
    for name, start in starts.items():
        (working_folder / name).write_bytes(start + bytes(99))
        said = dxlrun("import", name)
        assert (said.code, said.err.count("\n"), ": this is a " in said.err) == (2, 1, True), said.err
    assert len(starts) == 4
    (line,) = {
        dxlrun(*words).err.partition("this is")[2]
        for words in (("import", "a.bag"), ("replay", "a.bag"), ("check", "a.bag"))
    }
    assert "a ROS 1 bag; `rosbags-convert" in line


def test_directory_of_a_dataset_or_bag_is_named(working_folder: Path, dxlrun: Dxlrun) -> None:
    (working_folder / "set" / "meta").mkdir(parents=True)
    (working_folder / "set" / "meta" / "info.json").write_text('{"codebase_version": "v3.0", "features": {}}')
    assert "dataset of LeRobot" in dxlrun("import", "set").err
    (working_folder / "bag").mkdir()
    (working_folder / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    assert "this is a ROS 2 bag; `dxlrun convert bag" in dxlrun("import", "bag").err


def test_file_above_the_limit_is_not_parsed(working_folder: Path, dxlrun: Dxlrun) -> None:
    (working_folder / "a.json").write_text(
        '{"motors": {}, "motorgroups": {}, "x": "' + "x" * (17 << 20) + '"}'
    )
    assert "the format of this file is not known" in dxlrun("import", "a.json").err


def test_good_robot_file_loads_no_format(working_folder: Path) -> None:
    robot = Path(dxlrun.__file__).parents[2] / "robots/single_joint.yaml"
    main = "import sys; from dxlrun.cli import main; main(sys.argv[1:])"
    script = f"{main}; print('dxlrun_import.registry' in sys.modules)"
    ran = subprocess.run(
        [sys.executable, "-c", script, "check", robot], capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines()[-1] == "False"


def test_a_package_adds_a_format(
    working_folder: Path, monkeypatch: pytest.MonkeyPatch, dxlrun: Dxlrun
) -> None:
    lines = str(HookSpecs.dxlrun_formats.__doc__).splitlines()
    source = "\n".join(line[12:] for line in lines if line.startswith(" " * 12))
    contract = "\n\n@hookimpl\ndef dxlrun_contract():\n    return 4\n"
    (working_folder / "a.bvh").write_text("HIERARCHY\nROOT hips\n")
    file_formats.cache_clear()
    with installing(working_folder, monkeypatch) as install:
        install("motion-capture", "motion_capture", source + contract)
        assert "this is a motion capture; retarget it" in dxlrun("import", "a.bvh").err
        assert "this is a motion capture; retarget it" in dxlrun("check", "a.bvh").err
    file_formats.cache_clear()


def test_commands_of_the_page_are_valid(working_folder: Path, dxlrun: Dxlrun) -> None:
    (case,) = cases("../import/pypot.txt")[:1]
    (working_folder / "tower.json").write_text(case.values[0].files["tower.json"])
    for words in page_commands("import.md"):
        virtual = ["--virtual", "--duration", "0.1"] if words[0].endswith(".yaml") else []
        assert dxlrun(*words, *virtual).code == 0, words


def test_each_format_has_a_name_and_a_converter_or_advice() -> None:
    assert len(FORMATS) > 15
    for one in FORMATS:
        assert one.name.startswith(("a ", "an ", "the ", "XML")), one.name
        assert one.convert or one.advice, one.name
