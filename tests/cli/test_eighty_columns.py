"""Tables at 80 columns, the width of a terminal: each command's, for each robot, stays a table."""

from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest
from tests.kit.commands import Dxlrun
from tests.kit.examples import as_parameters

from dxlrun.output import terminal
from dxlrun.output.text_table import Column, Table
from dxlrun.run import run_summary
from dxlrun.testing import simulated_robot

pytestmark = pytest.mark.long

ROBOTS = sorted((Path(__file__).parents[2] / "robots").glob("*.yaml"))


def texts(lines: Iterable[terminal.Line]) -> list[str]:
    return ["".join(text for text, _ in line).rstrip() for line in lines]


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Table]]:
    """Stand for a terminal of 80 columns, and check the tables that it gets."""
    seen: list[Table] = []
    fitted = terminal.fitted

    def checked(table: Table, width: int) -> list[terminal.Line]:
        assert width == 80
        shown = fitted(table, width)
        assert max(map(len, texts(shown))) <= 80, table.title
        seen.append(table)
        return shown

    def paragraphs(table: Table, width: int) -> NoReturn:
        raise AssertionError(f"{table.title} of {table.columns} is folded into paragraphs")

    monkeypatch.setattr(terminal.out, "__defaults__", (80,))
    monkeypatch.setattr(terminal, "fitted", checked)
    monkeypatch.setattr(terminal, "_paragraphs", paragraphs)
    yield seen
    assert seen or not find_spec("mujoco")


@pytest.mark.parametrize("robot", as_parameters(ROBOTS))
def test_check(dxlrun: Dxlrun, seen: list[Table], robot: Path) -> None:
    said = dxlrun("check", robot)
    assert said.code == 0
    joints = next(table for table in seen if table.title.startswith("Joints"))
    assert len(said.out.splitlines()) < 90 + len(joints.rows)


MODELS = ("AX-12A", "MX-106", "XM430-W350", "PH54-200-S500-R", "OpenCR")


@pytest.mark.parametrize(
    "words", ["plugins", "examples", "doctor", "models", *(f"models {model}" for model in MODELS)]
)
def test_list(dxlrun: Dxlrun, seen: list[Table], words: str) -> None:
    assert dxlrun(*words.split()).code == 0


@pytest.mark.needs("logs")
@pytest.mark.parametrize("name", ["bioloid_torso", "humanoid_20", "wolfgang", "mechanics"])
def test_log(dxlrun: Dxlrun, seen: list[Table], name: str, tmp_path: Path) -> None:
    log = tmp_path / f"{name}.mcap"
    simulated_robot(ROBOTS[0].parent / f"{name}.yaml", duration_s=0.5, log=log).run()
    assert dxlrun("analyze", log).code in (0, 1)
    assert dxlrun("logs", tmp_path).code == 0


def test_line_that_changes_fits_next_to_its_spinner(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    monkeypatch.setattr(run_summary, "_REFRESH_S", -1.0)
    console = SimpleNamespace(is_terminal=True)
    loop = SimpleNamespace(period_ns=1_000_000, end_ns=86_400 * 10**9)
    for robot in ("torso", "bioloid_torso_whole_body", "n" * 90):
        plan: Any = SimpleNamespace(robot=robot, loop=loop)
        status: Any = SimpleNamespace(console=console, update=lines.append)
        for virtual in (False, True):
            run_summary.RunStatusLine(plan, status, virtual=virtual).ran(36_000_000, 1_234)
    assert len(lines) == 6
    assert max(map(len, lines)) <= 77
    assert lines[0].startswith("torso: 36001.2 of 86400.0 s, 1234 periods skipped")


def test_what_is_equal_in_all_rows_is_written_once_and_what_is_too_wide_is_cut() -> None:
    columns = [Column("name", "name"), Column("bus", "name"), Column("remark", "text"), Column("number")]
    table = Table.from_rows("", columns, [("a", "main_bus", "word " * 5, 1), ("c", "main_bus", "other", 2)])
    caption, *lines = texts(terminal.fitted(table, 44))
    assert caption == "in all rows: bus main_bus"
    assert "main_bus" not in "".join(lines)
    columns = [*(Column(name, "name") for name in "abc"), Column("d")]
    wide = Table.from_rows("", columns, [("left_shoulder_" * 3, "b" * 30, "c", 1), ("a", "b", "d", 2)])
    lines = texts(terminal.fitted(wide, 60))
    assert "left_shoulder_left_shoulde… " in "".join(lines)
    assert max(map(len, lines)) <= 60
