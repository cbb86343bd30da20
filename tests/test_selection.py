"""Selection: long tests run where they are named, where all are asked for, or where a change needs them."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.kit import selection, skips
from tests.kit.nested import Ran, run_pytest

ROOT = Path(__file__).parents[1]
SHORT = "def test_short():\n    pass\n"
LONG = "import pytest\npytestmark = pytest.mark.long\ndef test_long():\n    pass\n"
FILES = {"test_short.py": SHORT, "test_long.py": LONG}


def run(folder: Path, *words: str, files: dict[str, str] = FILES) -> Ran:
    return run_pytest(folder, files, *words)


@pytest.mark.parametrize("workers", ["0", "2"])
def test_change_runs_its_long_tests_and_the_rest_is_left_out_and_reported_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: str
) -> None:
    monkeypatch.setattr(selection, "affected_files", lambda paths: paths)
    skipped = 'import pytest\ndef test_skip():\n    pytest.skip("it is Sunday")\n'
    files = FILES | {"test_other.py": LONG, "test_skip.py": skipped, "changed.txt": "test_long.py\n"}
    ran = run(tmp_path, "-n", workers, "--changed=changed.txt", "--strict-skips", files=files)
    assert ran.code == 1
    assert "not allowed to skip: test_skip.py::test_skip: Skipped: it is Sunday\n" in ran.out
    assert "\n2 passed, 1 skipped" in ran.out
    assert ran.last == "left out: 1 long tests that no given change needs (--all runs them)"


def test_options_are_known_where_the_whole_suite_runs(tmp_path: Path) -> None:
    """Without paths, pytest finds tests/conftest.py below the root, unless another word is a path."""
    (tmp_path / "changed.txt").write_text("README.md\n")
    options = (f"--changed={tmp_path}/changed.txt", "--strict-skips", "--campaigns", "--help")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ran.returncode, "unrecognized" in ran.stderr) == (0, False), ran.stderr
    assert "--strict-skips" in ran.stdout


@pytest.mark.parametrize("words", [("--all",), ("test_long.py", "test_short.py"), (".",)])
def test_all_and_named_paths_run_as_a_whole(tmp_path: Path, words: tuple[str, ...]) -> None:
    assert run(tmp_path, "-n", "0", *words).last.startswith("2 passed")


def test_files_with_time_limits_and_long_tests_are_first(tmp_path: Path) -> None:
    limited = SHORT.replace("def", "@__import__('pytest').mark.timeout(9)\ndef")
    files = {"test_a.py": SHORT, "test_b.py": LONG, "test_c.py": SHORT + limited.replace("short", "limited")}
    said = run(tmp_path, "-n", "0", "--all", "--collect-only", files=files).out.splitlines()
    assert [line.partition("::")[0] for line in said[:4]] == [*["test_c.py"] * 2, "test_b.py", "test_a.py"]


def test_each_worker_begins_with_slow_files_and_ends_with_short_tests() -> None:
    """The 12 tests are named by folder and number, with L in a slow file, M in one with an own time limit."""
    names = ["a/L1", "a/2", "b/L1", "b/L2", "b/3", "b/4", "c/M1", "c/2", "c/3", "c/4", "c/5", "c/6"]
    marks = {"long": "L", "timeout": "M"}
    items = [
        SimpleNamespace(
            path=Path(name),
            get_closest_marker=lambda mark, name=name: marks[mark] in name and SimpleNamespace(args=(9,)),
        )
        for name in names
    ]
    dealt = [[item.path.name for item in selection.deal_tests(items, workers)] for workers in (1, 3)]
    assert " ".join(dealt[0]) == "M1 L1 L1 L2 2 3 4 2 3 4 5 6"
    assert " ".join(dealt[1]) == "M1 2 3 4 L1 2 3 4 L1 L2 5 6"


def test_what_passed_is_left_out_of_the_next_run(tmp_path: Path) -> None:
    torn = "def teardown_module():\n    assert False\ndef test_torn():\n    pass\n"
    less = f"def test_less(record_property):\n    record_property({selection.CHECKED_LESS!r}, 'all')\n"
    wrong = "def test_wrong():\n    assert False\n"
    files = FILES | {"test_torn.py": torn, "test_wrong.py": wrong, "test_less.py": less}
    for words, left_out in (
        ((), "long tests that no given change needs (--all"),
        (("--all",), "tests that have"),
    ):
        ran = run(tmp_path, "-n", "2", "--passed=passed.txt", *words, files=files)
        assert ran.last.startswith(f"left out: 1 {left_out}"), ran.out
    passed = (tmp_path / "passed.txt").read_text().split()
    assert passed == ["test_long.py::test_long", "test_short.py::test_short"]


@pytest.mark.parametrize(
    ("words", "reason", "code"),
    [
        ((), "it is Sunday", 0),
        (("--strict-skips",), "moto[server,s3]", 0),
        (("--strict-skips", "--all"), "moto[server,s3]", 1),
        (("--strict-skips", "--all"), "no IPv6", 0),
    ],
)
def test_skips_are_counted_where_they_are_strict(
    tmp_path: Path, words: tuple[str, ...], reason: str, code: int
) -> None:
    files = {"test_skip.py": f"import pytest\ndef test_skip():\n    pytest.skip({reason!r})\n"}
    ran = run(tmp_path, "-n", "0", *words, files=files)
    assert (ran.code, "not allowed to skip: test_skip.py::test_skip" in ran.out) == (code, bool(code))


def test_each_allowed_skip_is_one_of_the_tests() -> None:
    paths = [path for path in ROOT.glob("tests/**/*.py") if path.name != "skips.py"]
    source = "".join(path.read_text("utf-8") for path in paths)
    marked = " ".join(f"needs dxlrun[{extra}]" for extra in re.findall(r"mark\.needs\(\"(\w+)\"\)", source))
    assert [
        one
        for one in (*skips.ALLOWED, *skips.ALLOWED_BUT_FOR_ALL)
        if not re.search(one, f"{source} {marked}")
    ] == []


@pytest.mark.parametrize(
    ("path", "rooms"),
    [
        ("runtime/dxlrun/control/loop.py", {"dxlrun.control", "dxlrun.run"}),
        ("plugins/dxlrun_lab/stress.py", {"dxlrun_lab"}),
        ("plugins/dxlrun_view/src/dxlrun_view/web/page.js", {"dxlrun_view"}),
        ("robots/bioloid_torso.yaml", {"robots"}),
        ("robots/robot.schema.json", set()),
        ("docs/index.md", set()),
        ("bench/cycle_trace.py", {"bench"}),
        ("README.md", set()),
    ],
)
def test_change_affects_its_room_and_its_importers(path: str, rooms: set[str]) -> None:
    found = selection.affected_rooms([path])
    assert rooms <= found
    assert bool(found) == bool(rooms)


def test_importers_through_a_face_are_affected() -> None:
    assert "dxlrun_analysis" in selection.affected_rooms(["runtime/dxlrun/channels/event_records.py"])


def test_changed_test_and_users_of_changed_kit_run() -> None:
    assert [*selection.affected_files(["tests/hand/test_terminal.py"])] == ["tests/hand/test_terminal.py"]
    assert "tests/hand/test_terminal.py" in {*selection.affected_files(["tests/kit/hands.py"])}


@pytest.mark.parametrize(
    ("path", "files"),
    [
        ("docs/how-to/teleoperation.md", {"tests/teleop/test_terminal.py"}),
        ("docs/examples/stand_up.py", {"tests/robots/test_stand_up.py"}),
        ("docs/changes/+teleop.fixed.md", set()),
        ("pyproject.toml", set()),
    ],
)
def test_page_or_example_runs_the_long_tests_that_name_it(path: str, files: set[str]) -> None:
    assert {*selection.affected_files([path])} == files


def test_each_room_has_its_long_tests() -> None:
    files = [path for path, _ in selection.long_files()]
    assert {selection.folder_of(path) for path in files} <= set(selection.TESTED)
    assert len(files) > 50


def test_each_folder_of_tests_is_about_rooms_that_exist() -> None:
    folders = {one.name for one in (ROOT / "tests").iterdir() if any(one.glob("**/test_*.py"))} - {"faults"}
    assert folders <= set(selection.TESTED)
    product = {
        one.relative_to(ROOT).as_posix()
        for base in ("runtime", "plugins")
        for one in (ROOT / base).rglob("*.py")
    }
    rooms = {selection.room_of(selection.module_of(path)) for path in product} | {"dxlrun.features"}
    named = {room for rooms_of_folder in selection.TESTED.values() for room in rooms_of_folder}
    assert named - rooms <= {"robots", "bench", "example"}
