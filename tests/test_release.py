"""What `release/build.py` publishes: tags, contents, what the objects need of a system, the same bytes again.

These run where ziglang is installed (extra `release`), for a minute or two.
"""

import email
import http.client
import importlib
import json
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from contextlib import closing
from pathlib import Path
from platform import machine
from types import ModuleType

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.loaded import loaded

pytestmark = [pytest.mark.needs("release"), pytest.mark.timeout(600)]

ROOT = Path(__file__).parents[1]
OBJECTS = {
    "dxlrun/channels/libshared_memory.so": {
        "dxl_append",
        "dxl_commit",
        "dxl_read_next",
        "dxl_read_newest",
        "dxl_source",
    },
    "dxlrun/contract/libpolynomial.so": {"evaluate_pieces", "dxl_source"},
    "dxlrun/control/libgate.so": {"gate_apply", "dxl_source"},
    "dxlsim/motion/libmechanics.so": {"motion_step_to", "dxl_source"},
    "dxlsim/wire/libline.so": {"line_receive", "line_drain", "dxl_source"},
    "dxlwire/exchange/libkernel.so": {
        "dxl_read",
        "dxl_write",
        "dxl_abandon",
        "dxl_take",
        "dxl_source",
    },
    "dxlrun_analysis/libcounts.so": {"counts_add", "counts_merge", "dxl_source"},
    "dxlrun_analysis/joints/libmovement.so": {"movement_add", "dxl_source"},
    "dxlrun_analysis/servos/libpairing.so": {"pairing_split", "pairing_pair_replies", "dxl_source"},
}
"""The objects of a wheel, and functions of each."""
ATTEMPTS = 3
"""Demos that may be started: on a busy machine a run in real time may end before its page is served."""
PROCESSORS = {"EM_X86_64": "x86_64", "EM_AARCH64": "aarch64"}
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


@pytest.fixture(scope="module")
def release() -> ModuleType:
    return loaded(ROOT / "release/build.py")


@pytest.fixture(scope="module")
def clone(release: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the sdist has of this tree, without what CI puts into the tree."""
    unpacked: Path
    _, unpacked = release.build_sdist(ROOT, *map(tmp_path_factory.mktemp, ("sdist", "clone")))
    return unpacked


@pytest.fixture(scope="module")
def built(release: ModuleType, clone: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    files: list[Path] = release.build(clone, tmp_path_factory.mktemp("dist"))
    return files


def copy_for_owner(source: str, target: str) -> None:
    """Copy a file that others may not read then; a program stays one."""
    shutil.copyfile(source, target)
    Path(target).chmod(Path(source).stat().st_mode & 0o700)


def test_each_platform_has_a_wheel_with_its_tag_and_the_version(
    release: ModuleType, built: list[Path]
) -> None:
    names = [f"dxlrun-{VERSION}-py3-none-{platform}.whl" for platform in release.PLATFORMS]
    page = f"dxlrun_view-{VERSION}-py3-none-any.whl"
    assert [path.name for path in built] == [f"dxlrun-{VERSION}.tar.gz", *names, page]
    for path, platform in zip(built[1:-1], release.PLATFORMS, strict=True):
        with zipfile.ZipFile(path) as wheel:
            assert wheel.testzip() is None
            facts = email.message_from_bytes(wheel.read(f"dxlrun-{VERSION}.dist-info/WHEEL"))
            about = email.message_from_bytes(wheel.read(f"dxlrun-{VERSION}.dist-info/METADATA"))
        assert (facts["Tag"], facts["Root-Is-Purelib"]) == (f"py3-none-{platform}", "false")
        assert (about["Name"], about["Version"]) == ("dxlrun", VERSION)


def test_a_wheel_has_the_package_with_objects_for_its_processor(built: list[Path]) -> None:
    elffile = importlib.import_module("elftools.elf.elffile")
    sources = {
        str(path.relative_to(ROOT / "runtime"))
        for path in (ROOT / "runtime/dxlrun").rglob("*.py*")
        if path.suffix in {".py", ".pyi"}
    }
    for path in built[1:-1]:
        with zipfile.ZipFile(path) as wheel:
            assert sources - {*wheel.namelist()} == set()
            assert {name for name in wheel.namelist() if name.endswith(".so")} == OBJECTS.keys()
            for name, functions in OBJECTS.items():
                with wheel.open(name) as stream:
                    elf = elffile.ELFFile(stream)
                    assert path.stem.endswith(PROCESSORS[elf["e_machine"]])
                    symbols = {one.name for one in elf.get_section_by_name(".dynsym").iter_symbols()}
                    assert functions - symbols == set()


def test_no_object_needs_a_newer_system_than_its_tag_names(built: list[Path]) -> None:
    elffile = importlib.import_module("elftools.elf.elffile")
    for path in built[1:-1]:
        with zipfile.ZipFile(path) as wheel:
            for name in OBJECTS:
                with wheel.open(name) as stream:
                    elf = elffile.ELFFile(stream)
                    dynamic = elf.get_section_by_name(".dynamic").iter_tags()
                    needed = {tag.needed for tag in dynamic if tag.entry.d_tag == "DT_NEEDED"}
                    section = elf.get_section_by_name(".gnu.version_r")
                    versions = [
                        auxiliary.name
                        for _, all_of_it in (section.iter_versions() if section else ())
                        for auxiliary in all_of_it
                    ]
                if "manylinux" in path.name:
                    assert needed <= {"libc.so.6", "libm.so.6"}
                    newest = [
                        tuple(map(int, version.removeprefix("GLIBC_").split("."))) for version in versions
                    ]
                    assert newest or not needed
                    assert max(newest, default=(2, 0)) <= (2, 17)
                else:  # no library has one name in all systems with musl
                    assert (needed, versions) == (set(), [])


def test_the_same_tree_gives_the_same_bytes(
    release: ModuleType, clone: Path, built: list[Path], tmp_path: Path
) -> None:
    """In another folder, with other permissions, and with a cache of zig's own that is empty."""
    root = shutil.copytree(clone, tmp_path / "another" / "folder", copy_function=copy_for_owner)
    again = release.build(root, tmp_path / "dist", ["manylinux_2_17_x86_64", "musllinux_1_2_aarch64"])
    first = {path.name: path.read_bytes() for path in built}
    assert len(again) == 4
    assert [path.name for path in again if path.read_bytes() != first[path.name]] == []


def test_an_index_takes_all_of_it(release: ModuleType, built: list[Path]) -> None:
    release.judge(built)


def test_a_wheel_that_promises_too_much_is_refused(
    release: ModuleType, built: list[Path], tmp_path: Path
) -> None:
    wrong = tmp_path / built[1].name.replace("2_17", "2_5")
    shutil.copy(built[1], wrong)
    with pytest.raises(RuntimeError, match="need another platform"):
        release.judge([wrong])
    with zipfile.ZipFile(built[1]) as old, zipfile.ZipFile(tmp_path / built[1].name, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(
                name,
                re.sub(rb"Metadata-Version: \S+", b"Metadata-Version: 9.9", data)
                if "METADATA" in name
                else data,
            )
    with pytest.raises(RuntimeError, match="twine check"):
        release.judge([tmp_path / built[1].name])


def test_the_sdist_can_be_built_without_a_clone(built: list[Path]) -> None:
    with tarfile.open(built[0]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"hatch_build.py", "release/build.py", "pyproject.toml", "LICENSE"} <= names
    assert not any(name.endswith(".so") for name in names)


def test_demo_runs_from_the_wheels_in_an_empty_environment(
    built: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a clone: the motion with dxlrun alone, then the page with dxlrun-view."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("PYTHONPATH", raising=False)
    python = tmp_path / "environment/bin/python"
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "environment"], check=True)
    (core,) = [path for path in built if path.stem.endswith(f"manylinux_2_17_{machine()}")]

    def install(wheel: Path) -> None:
        subprocess.run([python, "-m", "pip", "install", "--quiet", wheel], check=True, timeout=DEADLINE_S)

    def demo(*words: str) -> subprocess.Popen[str]:
        command = [python.with_name("dxlrun"), "demo", *words]
        return subprocess.Popen(
            command, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    install(core)
    said, _ = demo("--virtual").communicate(timeout=DEADLINE_S)
    assert "3 of 3 goals reached" in said, said

    install(built[-1])
    for _ in range(ATTEMPTS):
        with demo() as running:
            said = []
            for line in iter(running.stdout.readline if running.stdout else str, ""):
                said.append(line)
                if found := re.search(r"http://(\S+)/\?token=(\S+)", line):
                    check_page(*found.groups())
                    running.send_signal(signal.SIGINT)
                    return
    raise AssertionError("".join(said))


def check_page(host: str, token: str) -> None:
    """Request the page of a demo, and its newest values."""
    headers = {"X-Dxlrun-Token": token, "Content-Type": "application/json"}

    def ask(path: str, body: str | None = None) -> bytes:
        with closing(http.client.HTTPConnection(host, timeout=DEADLINE_S)) as connection:
            connection.request("GET" if body is None else "POST", path, body, headers)
            answer = connection.getresponse()
            assert answer.status == 200, path
            return answer.read()

    assert min(len(ask(path)) for path in ("/", "/page.js", "/page.css")) > 1000
    until(lambda: json.loads(ask("/look", "{}"))["moment"]["values"])
    assert json.loads(ask("/look", '{"shown": true}'))["shown"]["info"]["robot"] == "bioloid_torso"


def test_what_cannot_be_built_is_one_message(release: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="hatchling build -t sdist"):
        release.build(tmp_path, tmp_path / "dist")
