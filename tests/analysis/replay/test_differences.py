"""A replay can fail: whatever is not the same is named, down to one bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.errors import ControllerFault, InputError
from dxlrun.log.reader import read_log
from dxlrun_analysis.replay import ReplayReport, replay_log
from dxlrun_analysis.replay.changes import Setting

Change = Callable[..., Path]
JOINTS = ("pan", "tilt", "nod")
OWNERS = ("head", "all_inputs", "all_inputs")


def flip(field: str, cycle: int, row: int, bit: int) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        row_of_bits = content.cycles[field][cycle].view(np.uint64)
        row_of_bits[row] ^= np.uint64(1 << bit)

    return change


@pytest.mark.parametrize(
    ("field", "what"),
    [
        ("command_position", "command of the position"),
        ("command_velocity", "command of the velocity"),
        ("goal_position", "goal of the position, after the last gate"),
        ("goal_velocity", "goal of the velocity, after the last gate"),
    ],
)
@pytest.mark.parametrize("bit", [0, 31, 52, 63])
def test_one_bit_of_one_value_is_named(
    pair_log: Path, changed: Change, field: str, what: str, bit: int
) -> None:
    row, cycle = bit % 3, 7 + bit % 40
    report = replay_log(changed(pair_log, flip(field, cycle, row, bit)))
    assert (report.compared, report.different) == (50, 1)
    first = report.first
    assert first is not None
    assert (first.cycle, first.joint, first.controller, first.what) == (
        cycle,
        JOINTS[row],
        OWNERS[row],
        what,
    )
    assert first.time_s == pytest.approx(cycle * 0.02)
    assert first.recorded != first.replayed
    (joint,) = report.joints
    assert (joint.joint, joint.commands, joint.goals) == (
        JOINTS[row],
        int("command" in field),
        int("goal" in field),
    )


def test_the_bits_of_nan_and_of_zero_count(pair_log: Path, changed: Change) -> None:
    # tilt never gets a speed: what all_inputs left at NaN
    report = replay_log(changed(pair_log, flip("command_velocity", 12, 1, 63)))
    assert report.first is not None
    assert (report.first.recorded, report.first.replayed) == (
        "nan (bits 0xfff8000000000000)",
        "nan (bits 0x7ff8000000000000)",
    )
    # the trajectory begins at 0 rad, or near it; a recorded -0.0 is not 0.0
    cycles = read_log(pair_log).cycles

    def zero(content: Any) -> None:
        content.cycles["command_position"][3, 0] = -0.0

    assert cycles["command_position"][3, 0] != 0.0 or not np.signbit(cycles["command_position"][3, 0])
    report = replay_log(changed(pair_log, zero))
    assert report.first is not None
    assert (report.first.cycle, report.first.recorded) == (3, "-0.0")


@pytest.mark.parametrize("state", ["position", "velocity", "effort", "valid", "age_ns"])
def test_every_recorded_state_is_an_input(pair_log: Path, changed: Change, state: str) -> None:
    def change(content: Any) -> None:
        values = content.cycles[state][20]
        values[2] = ~values[2] if state == "valid" else values[2] + 1000

    report = replay_log(changed(pair_log, change))
    assert report.first is not None
    assert (report.first.cycle, report.first.joint) == (20, "nod")
    assert report.different >= 10


@pytest.mark.parametrize("values", ["position", "velocity", "effort", "goal_position", "goal_velocity"])
def test_what_the_controllers_began_with_is_an_input(pair_log: Path, changed: Change, values: str) -> None:
    def change(content: Any) -> None:
        content.activation[values][0, 2] = 1.25

    report = replay_log(changed(pair_log, change))
    assert report.first is not None
    # what the controller published when it was activated
    assert (report.first.cycle, report.first.what) == (-1, "message of /all_inputs/state: sum[1]")
    assert [joint.joint for joint in report.joints] == ["nod"]


def test_active_controllers_are_compared(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        content.cycles["active"][9] = 0b110

    report = replay_log(changed(pair_log, change))
    first = report.first
    assert first is not None
    assert (first.cycle, first.what, first.joint, first.controller) == (9, "active", None, "states")
    assert (first.recorded, first.replayed) == ("not active", "active")
    assert (report.different, report.joints) == (1, ())


def changed_by(log: Path, *settings: str) -> ReplayReport:
    return replay_log(log, [Setting.parse(text) for text in settings])


def test_another_parameter_is_seen_at_its_first_cycle(pair_log: Path) -> None:
    report = changed_by(pair_log, "all_inputs.gain=0.5")
    first = report.first
    assert first is not None
    assert (first.cycle, first.joint, first.controller) == (0, "tilt", "all_inputs")
    assert [(one.joint, one.commands) for one in report.joints] == [("tilt", 50), ("nod", 50)]
    assert report.sentence == "pair: 50 of 50 replayed cycles differ"


def test_a_trajectory_without_speeds_differs_when_it_begins(pair_log: Path) -> None:
    report = changed_by(pair_log, "head.command_interface=position")
    first = report.first
    assert first is not None
    assert (first.cycle, first.joint, first.controller) == (10, "pan", "head")
    assert first.what == "command of the velocity"
    assert first.replayed.startswith("nan")


def test_a_parameter_that_ends_the_replay_early(pair_log: Path) -> None:
    report = changed_by(pair_log, "all_inputs.give_up_after=0.31")
    assert report.compared == 17
    assert not report.same
    assert "all_inputs raised in update: RuntimeError: out of ideas" in report.fault
    assert report.first is not None
    assert report.first.cycle == 16


def test_a_limit_of_the_gate_from_an_argument(pair_log: Path) -> None:
    report = replay_log(pair_log, (), {"speed": "0.8 rad/s"})
    first = report.first
    assert first is not None
    assert (first.joint, first.controller) == ("pan", "head")
    assert first.what.startswith("goal of the")
    assert [(one.joint, one.commands) for one in report.joints if one.commands] == []


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("neck.gain=1", "no such controller; known: all_inputs, head, states"),
        ("haed.gain=1", "did you mean head?"),
        ("all_inputs.gian=1", "all_inputs has an unknown key 'gian'; did you mean gain?"),
        ("all_inputs.gain=much", "all_inputs.gain is the text 'much', but must be a number"),
        ("all_inputs.gain.low=1", "all_inputs.gain "),
        ("all_inputs.joints.low=1", "joints has no parts"),
        ("all_inputs.joints=[tail]", "want joint tail"),
        ("all_inputs.joints=[nod, nod]", "want a joint twice"),
        ("all_inputs.gain=[", "is no YAML"),
        ("all_inputs.gain", "sets nothing"),
        ("gain=1", "sets nothing"),
    ],
)
def test_a_setting_that_does_not_fit_is_one_sentence(pair_log: Path, setting: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        changed_by(pair_log, setting)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_setting_that_claims_a_joint_of_another_controller(pair_log: Path) -> None:
    with pytest.raises(ControllerFault, match="pan"):
        changed_by(pair_log, "all_inputs.joints=[pan, nod]")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"rate": "100"}, "change the loop's period from 20000000 ns to 10000000 ns"),
        ({"sped": "1 rad/s"}, "sped"),
        ({"speed": "fast"}, "pair.yaml:"),
    ],
)
def test_arguments_that_do_not_fit(pair_log: Path, arguments: dict[str, str], says: str) -> None:
    with pytest.raises(InputError) as error:
        replay_log(pair_log, (), arguments)
    assert says in str(error.value)
    assert "replay-" not in str(error.value)
