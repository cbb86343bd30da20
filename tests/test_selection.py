"""Selection: long tests run where they are named, where all are asked for, or where a change needs them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit import selection, skips

ROOT = Path(__file__).parents[1]
SHORT = "def test_short():\n    pass\n"
LONG = "import pytest\npytestmark = pytest.mark.long\ndef test_long():\n    pass\n"


@pytest.fixture(name="run")
def _run(tmp_path: Path):
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["long", "campaign"]\n')
    (tmp_path / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text())
    for name, text in (("test_short", SHORT), ("test_long", LONG)):
        (tmp_path / f"{name}.py").write_text(text)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "COV_"))}
    environment = inherited | {"PYTHONPATH": str(ROOT)}

    def run(*words: str, code: int = 0) -> list[str]:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
        ran = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert ran.returncode == code, ran.stdout + ran.stderr
        return ran.stdout.splitlines()

    return run


@pytest.mark.parametrize("workers", ["0", "2"])
def test_whole_suite_leaves_out_long_tests_and_reports_it_last(run, workers: str) -> None:
    *_, passed, last = run("-n", workers)
    assert passed.startswith("1 passed")
    assert last == "left out: 1 long tests that no given change needs (--all runs them)"


def test_options_are_known_where_the_whole_suite_runs(tmp_path: Path) -> None:
    """Without paths, pytest finds tests/conftest.py below the root, unless another word is a path."""
    (tmp_path / "changed.txt").write_text("README.md\n")
    options = (
        f"--changed={tmp_path}/changed.txt",
        "--strict-skips",
        "--campaigns",
        "-k",
        "no_test_has_this_name",
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "unrecognized" not in ran.stderr
    assert "release  test" in ran.stdout


@pytest.mark.parametrize("words", [("--all",), ("test_long.py", "test_short.py"), (".",)])
def test_all_and_named_paths_run_as_a_whole(run, words: tuple[str, ...]) -> None:
    assert run("-n", "0", *words)[-1].startswith("2 passed")


@pytest.mark.parametrize("workers", ["0", "2"])
def test_changed_files_run_their_long_tests_in_every_process(run, tmp_path: Path, workers: str) -> None:
    (tmp_path / "changed.txt").write_text("test_long.py\n")
    conftest = (tmp_path / "conftest.py").read_text()
    stub = "selection.affected_files = lambda paths: paths\n"
    (tmp_path / "conftest.py").write_text(conftest + stub)
    assert run("-n", workers, "--changed=changed.txt")[-1].startswith("2 passed")


@pytest.mark.parametrize(
    ("words", "reason", "code"),
    [
        ((), "moto[server,s3]", 0),
        (("--all",), "moto[server,s3]", 1),
        (("--all",), "no IPv6", 0),
        ((), "it is Sunday", 1),
    ],
)
def test_other_skip_than_those_allowed_fails_the_run(
    run, tmp_path: Path, words: tuple[str, ...], reason: str, code: int
) -> None:
    (tmp_path / "test_short.py").write_text(f"import pytest\ndef test_skip():\n    pytest.skip({reason!r})\n")
    for workers in ("0", "2"):
        run("-n", workers)
        lines = run("-n", workers, "--strict-skips", *words, code=code)
        assert any("not allowed to skip: test_short.py::test_skip" in line for line in lines) == bool(code)


@pytest.mark.parametrize("pattern", [*skips.ALLOWED, *skips.ALLOWED_BUT_FOR_ALL])
def test_allowed_skip_is_one_of_the_tests(pattern: str) -> None:
    source = "".join(
        path.read_text("utf-8") for path in ROOT.glob("tests/**/*.py") if path.name != "skips.py"
    )
    marked = " ".join(f"needs dxlrun[{extra}]" for extra in re.findall(r"mark\.needs\(\"(\w+)\"\)", source))
    assert re.search(pattern, f"{source} {marked}")


@pytest.mark.parametrize(
    ("path", "rooms"),
    [
        ("runtime/dxlrun/control/loop.py", {"dxlrun.control", "dxlrun.run"}),
        ("plugins/dxlrun_lab/stress.py", {"dxlrun_lab"}),
        ("plugins/dxlrun_view/src/dxlrun_view/web/page.js", {"dxlrun_view"}),
        ("robots/bioloid_torso.yaml", {"robots"}),
        ("docs/index.md", {"docs"}),
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
    assert named - rooms <= {"docs", "robots", "bench", "example"}
