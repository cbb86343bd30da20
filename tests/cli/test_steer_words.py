"""Commands for a running robot when none runs, and how their words are read."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console
from tests.kit.answers import result_of

from dxlrun.cli.steering.steer import command, controllers, headline, state
from dxlrun.cli.steering.written import WrittenEntry
from dxlrun.errors import InputError, Refused
from dxlrun.output.terminal import show_parts

NO_ROBOT = "dxlrun: no running robot found; start one by `dxlrun ROBOT.yaml`"


@pytest.fixture
def no_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer on which no robot runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


# No robot runs


def test_a_list_of_no_robots_is_no_failure(dxlrun, no_robot: None) -> None:
    assert dxlrun("list") == (0, NO_ROBOT.removeprefix("dxlrun: ") + "\n", "")
    said = dxlrun("list", "--json")
    assert (said.code, result_of(said.out), said.err) == (0, [], "")


def test_a_wrong_file_is_refused_with_its_places(dxlrun, no_robot: None, tmp_path: Path) -> None:
    file = tmp_path / "look.yaml"
    file.write_text("positions: [1 deg]\npositions: [2 deg]\n")
    said = dxlrun("send", "head", "posvel", "--file", file)
    assert (said.code, said.errors) == (
        2, [f"{file}:2:1: positions is already defined in line 1; keep one of the two"],
    )  # fmt: skip
    said = dxlrun("load", "spare", "--file", tmp_path / "none.yaml")
    assert (said.code, said.errors) == (
        2, [f"{tmp_path}/none.yaml:1:1: file not found; check the path, relative to the current directory"],
    )  # fmt: skip


# What is written


WRONG = {
    "paths": ["/positions/0", "/velocities/0"],
    "problems": ["positions[0]: no unit; add it", "v: no; b"],
}


def test_a_wrong_quantity_is_reported_at_its_place_in_the_file(tmp_path: Path) -> None:
    file = tmp_path / "step.yaml"
    file.write_text("positions:\n  - 30\nvelocities: [true]\n")
    refused = Refused("...", code="wrong_quantity", fields=WRONG, wrong_input=True)
    located = WrittenEntry.from_words((), file).located(refused)
    assert isinstance(located, InputError)
    assert str(located).splitlines() == [
        f"{file}:2:5: positions[0]: no unit; add it",
        f"{file}:3:14: v: no; b",
    ]


def test_wrong_quantities_of_the_command_line_are_a_line_each_and_keep_their_code() -> None:
    refused = Refused("...", code="wrong_quantity", fields=WRONG, wrong_input=True)
    located = WrittenEntry.from_words(["positions=[30]", "velocities=[true]"], None).located(refused)
    assert isinstance(located, Refused)
    assert (str(located).splitlines(), located.code, located.exit_code) == (
        WRONG["problems"], "wrong_quantity", 2,
    )  # fmt: skip
    other = Refused("no", code="not_active")
    assert WrittenEntry.from_words((), None).located(other) is other


# What is listed


def test_a_list_shows_the_state_of_a_robot() -> None:
    info = {"name": "arm", "rate": 320.0, "paused": True, "cycles": 7, "skipped": 1, "log": "logs/arm.mcap"}
    assert headline(info) == "arm: 320 Hz, paused, 7 cycles, 1 period skipped, log logs/arm.mcap"
    info |= {"paused": False, "skipped": 0, "log": None}
    assert headline(info) == "arm: 320 Hz, 7 cycles, 0 periods skipped, no log"
    assert [state({"active": a, "held": h}) for a, h in ((True, False), (True, True), (False, False))] == [
        "active", "held", "inactive",
    ]  # fmt: skip
    assert command("go", {"properties": {"a": {}, "b": {}}, "required": ["a"]}) == "go: a, [b]"
    assert command("reset", {}) == "reset"


@pytest.mark.parametrize("width", [20, 60, 90, 200])
def test_no_name_is_broken_on_a_narrow_terminal(width: int) -> None:
    joints = [f"a_rather_long_name_of_joint_{number}" for number in range(8)]
    arm = {"name": "arm", "active": True, "held": False, "rate": 50.0, "takes": {}, "joints": joints}
    head = {**arm, "name": "head", "command": (), "takes": {"go": {}, "stop": {}}}
    console = Console(file=io.StringIO(), width=width)
    show_parts(controllers({"controllers": [arm | {"command": ("position",)}, head]}), console=console)
    words = console.file.getvalue().split()  # type: ignore[attr-defined]  # a StringIO, given above
    assert {f"{joint}," for joint in joints[:-1]} | {joints[-1]} <= set(words)
    assert {"arm", "head", "active", "go;", "stop"} <= {word.strip(":,") for word in words}
