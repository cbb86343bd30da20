"""Words: commands for a running robot when none runs, how they are read, and those of states."""

import io
import json
import re
from pathlib import Path

import pytest
from rich.console import Console

from dxlrun.channels.cycle import Torque
from dxlrun.cli.steering.steer import command, controllers, headline, state
from dxlrun.cli.steering.written import WrittenEntry
from dxlrun.errors import InputError, Refused
from dxlrun.output.terminal import show_parts

WRONG = {
    "paths": ["/positions/0", "/velocities/0"],
    "problems": ["positions[0]: no unit", "v: no"],
    "fixes": ["add it", "b"],
}
REFUSED = Refused("...", code="wrong_quantity", fields=WRONG, wrong_input=True)


def test_wrong_quantity_is_reported_at_its_place_in_the_file(tmp_path: Path) -> None:
    file = tmp_path / "step.yaml"
    file.write_text("positions:\n  - 30\nvelocities: [true]\n")
    located = WrittenEntry.from_words((), file).located(REFUSED)
    assert isinstance(located, InputError)
    lines = [f"{file}:2:5: positions[0]: no unit; add it", f"{file}:3:14: v: no; b"]
    assert str(located).splitlines() == lines


def test_wrong_quantities_of_the_command_line_are_a_line_each_and_keep_their_code() -> None:
    located = WrittenEntry.from_words(["positions=[30]", "velocities=[true]"], None).located(REFUSED)
    assert isinstance(located, Refused)
    assert str(located).splitlines() == ["positions[0]: no unit; add it", "v: no; b"]
    assert (located.code, located.exit_code) == ("wrong_quantity", 2)
    other = Refused("no", code="not_active")
    assert WrittenEntry.from_words((), None).located(other) is other


def test_a_quoted_word_can_have_several_pairs() -> None:
    written = WrittenEntry.from_words(["x=0.2 y=-3 cm  rpy=0, 90 deg, 0", "frame=base"], None)
    assert written.data == {"x": 0.2, "y": "-3 cm", "rpy": "0, 90 deg, 0", "frame": "base"}


def test_the_first_word_may_begin_with_a_name() -> None:
    written = WrittenEntry.from_words(["above seconds=2"], None, named=True)
    assert written.with_key("pose") == {"pose": "above", "seconds": 2}
    with pytest.raises(InputError, match="'above' and seconds=2 exclude each other; remove one of them"):
        written.with_key("seconds")
    with pytest.raises(InputError, match="'above' is not key=value"):
        WrittenEntry.from_words(["above seconds=2"], None)


def test_list_shows_the_state_of_a_robot() -> None:
    info = {"name": "arm", "rate": 320.0, "paused": True, "cycles": 7, "skipped": 1, "log": "logs/arm.mcap"}
    assert headline(info) == "arm: 320 Hz, paused, 7 cycles, 1 period skipped, log logs/arm.mcap"
    info |= {"paused": False, "skipped": 0, "log": None}
    assert headline(info) == "arm: 320 Hz, 7 cycles, 0 periods skipped, no log"
    pairs = ((True, False), (True, True), (False, False))
    states = [state({"active": active, "held": held}) for active, held in pairs]
    assert states == ["active", "held", "inactive"]
    assert command("go", {"properties": {"a": {}, "b": {}}, "required": ["a"]}) == "go: a, [b]"
    assert command("reset", {}) == "reset"


@pytest.mark.parametrize("width", [20, 60, 90, 200])
def test_no_name_is_broken_on_a_narrow_terminal(width: int) -> None:
    joints = [f"a_rather_long_name_of_joint_{number}" for number in range(8)]
    arm = {"name": "arm", "active": True, "held": False, "rate": 50.0, "takes": {}, "joints": joints}
    head = {**arm, "name": "head", "command": (), "takes": {"go": {}, "stop": {}}}
    file = io.StringIO()
    listed = controllers({"controllers": [arm | {"command": ("position",)}, head]})
    show_parts(listed, console=Console(file=file, width=width))
    words = file.getvalue().split()
    assert {f"{joint}," for joint in joints[:-1]} | {joints[-1]} <= set(words)
    assert {"arm", "head", "active", "go;", "stop"} <= {word.strip(":,") for word in words}


ROOT = Path(__file__).parents[2]


def test_page_has_the_words_of_the_states() -> None:
    text = (ROOT / "plugins/dxlrun_view/page/state.js").read_text()
    (words,) = re.findall(r"const TORQUE = (\[.+?\]);", text)
    assert json.loads(words) == [torque.word for torque in Torque]
    assert json.loads(words)[3:5] == ["limp", "limp"], "whatever the reason"
