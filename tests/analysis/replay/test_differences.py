"""A replay can fail: whatever is not the same is named, down to one bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.kit.anew import add, flip, plan, put
from tests.kit.stories import differing

from dxlrun.errors import ControllerFault, InputError
from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import Setting, replay_log

Changed = Callable[..., Path]
JOINTS = ("pan", "tilt", "nod")
OWNERS = ("head", "all_inputs", "all_inputs")
ROBOTS = Path(__file__).parents[3] / "robots"


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
    pair_log: Path, changed: Changed, field: str, what: str, bit: int
) -> None:
    row, cycle = bit % 3, 7 + bit % 40
    report, first = differing(changed(pair_log, flip(field, cycle, row, bit)))
    assert (report.compared, report.different) == (50, 1)
    assert (first.cycle, first.joint, first.controller, first.what) == (cycle, JOINTS[row], OWNERS[row], what)
    assert first.time_s == pytest.approx(cycle * 0.02)
    assert first.recorded != first.replayed
    (joint,) = report.joints
    assert (joint.joint, joint.commands, joint.goals) == (
        JOINTS[row],
        int("command" in field),
        int("goal" in field),
    )


def test_the_bits_of_nan_and_of_zero_count(pair_log: Path, changed: Changed) -> None:
    # tilt never gets a speed: what all_inputs left at NaN
    _, first = differing(changed(pair_log, flip("command_velocity", 12, 1, 63)))
    assert (first.recorded, first.replayed) == (
        "nan (bits 0xfff8000000000000)",
        "nan (bits 0x7ff8000000000000)",
    )
    # the trajectory begins at 0 rad, or near it; a recorded -0.0 is not 0.0
    at_first = read_log(pair_log).cycles["command_position"][3, 0]
    assert at_first != 0.0 or not np.signbit(at_first)
    _, first = differing(changed(pair_log, put("command_position", (3, 0), -0.0)))
    assert (first.cycle, first.recorded) == (3, "-0.0")


@pytest.mark.parametrize("state", ["position", "velocity", "effort", "valid", "age_ns"])
def test_every_recorded_state_is_an_input(pair_log: Path, changed: Changed, state: str) -> None:
    otherwise = put("valid", (20, 2), False) if state == "valid" else add(state, (20, 2), 1000)
    report, first = differing(changed(pair_log, otherwise))
    assert (first.cycle, first.joint) == (20, "nod")
    assert report.different >= 10


@pytest.mark.parametrize("values", ["position", "velocity", "effort", "goal_position", "goal_velocity"])
def test_what_the_controllers_began_with_is_an_input(pair_log: Path, changed: Changed, values: str) -> None:
    report, first = differing(changed(pair_log, put(values, (0, 2), 1.25, of="activation")))
    # what the controller published when it was activated
    assert (first.cycle, first.what) == (-1, "message of /all_inputs/state: sum[1]")
    assert [joint.joint for joint in report.joints] == ["nod"]


def test_active_controllers_are_compared(pair_log: Path, changed: Changed) -> None:
    report, first = differing(changed(pair_log, put("active", 9, 0b110)))
    assert (first.cycle, first.what, first.joint, first.controller) == (9, "active", None, "states")
    assert (first.recorded, first.replayed) == ("not active", "active")
    assert (report.different, report.joints) == (1, ())


# Other parameters and arguments


def test_another_parameter_is_seen_at_its_first_cycle(pair_log: Path) -> None:
    report, first = differing(pair_log, "all_inputs.gain=0.5")
    assert (first.cycle, first.joint, first.controller) == (0, "tilt", "all_inputs")
    assert [(one.joint, one.commands) for one in report.joints] == [("tilt", 50), ("nod", 50)]
    assert report.sentence == "pair: 50 of 50 replayed cycles differ"
    assert report.different_messages  # its own goals are an input of the next cycle


def test_a_trajectory_without_speeds_differs_when_it_begins(pair_log: Path) -> None:
    report, first = differing(pair_log, "head.command_interface=position")
    assert (first.cycle, first.joint, first.controller) == (10, "pan", "head")
    assert first.what == "command of the velocity"
    assert first.replayed.startswith("nan")
    assert report.prepared == 1  # whether they differ is the controller's own matter


def test_a_parameter_that_ends_the_replay_early(pair_log: Path) -> None:
    report, first = differing(pair_log, "all_inputs.give_up_after=0.31")
    assert (report.compared, first.cycle) == (17, 16)
    assert "all_inputs raised in update: RuntimeError: out of ideas" in report.fault


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("neck.gain=1", "no such controller; known: all_inputs, head, states"),
        ("haed.gain=1", "did you mean head?"),
        ("all_inputs.gian=1", "all_inputs has an unknown key 'gian'; did you mean gain?"),
        ("all_inputs.gain=much", "all_inputs.gain is the text 'much', but must be a number"),
        ("all_inputs.gain.low=1", "all_inputs.gain "),
        ("all_inputs.joints.low=1", "joints is not a mapping"),
        ("all_inputs.joints=[tail]", "joint tail of all_inputs is not defined"),
        ("all_inputs.joints=[nod, nod]", "names joint nod twice"),
        ("all_inputs.gain=[", "is not YAML"),
        ("all_inputs.gain", "sets nothing"),
        ("gain=1", "sets nothing"),
    ],
)
def test_a_setting_that_does_not_fit_is_one_sentence(pair_log: Path, setting: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        replay_log(pair_log, [Setting.parse(setting)])
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_setting_that_claims_a_joint_of_another_controller(pair_log: Path) -> None:
    with pytest.raises(ControllerFault, match="pan"):
        replay_log(pair_log, [Setting.parse("all_inputs.joints=[pan, nod]")])


def test_a_limit_of_the_gate_from_an_argument(pair_log: Path) -> None:
    report = replay_log(pair_log, (), {"speed": "0.8 rad/s"})
    first = report.first
    assert first is not None
    assert (first.joint, first.controller) == ("pan", "head")
    assert first.what.startswith("goal of the")
    assert [(one.joint, one.commands) for one in report.joints if one.commands] == []


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


@pytest.fixture
def log_with_include(robot_file: Path, tmp_path: Path) -> Path:
    """The robot's log, whose controllers stood in a file above the robot's directory."""
    head, tail = robot_file.read_text().split("controllers:\n")
    robot, controllers, log = (
        tmp_path / name for name in ("robots/pair.yaml", "controllers.yaml", "run.mcap")
    )
    robot.parent.mkdir()
    robot.write_text(f"include: [../controllers.yaml]\n{head}")
    controllers.write_text(f"controllers:\n{tail}")
    simulated_robot(robot, duration_s=0.5, log=log).run()
    controllers.unlink()
    robot.unlink()
    return log


def test_included_files_and_the_urdf_come_from_the_log(log_with_include: Path, tmp_path: Path) -> None:
    assert replay_log(log_with_include, (), {"speed": "5 rad/s"}).compared == 25
    torso = tmp_path / "torso.mcap"
    simulated_robot(ROBOTS / "bioloid_torso.yaml", duration_s=0.2, log=torso).run()
    assert replay_log(torso, (), {"rate": "50"}).same


def test_a_file_outside_of_the_robots_directory_is_not_written(
    log_with_include: Path, changed: Changed, tmp_path: Path
) -> None:
    target = tmp_path / "written.yaml"
    outside = "/".join([".."] * 40) + str(target)
    log = changed(log_with_include, plan(lambda content: content["included"].update({outside: "name: x"})))
    with pytest.raises(InputError, match="outside of the robot's directory"):
        replay_log(log, (), {"speed": "5 rad/s"})
    assert not target.exists()


def test_a_plan_that_the_file_no_longer_gives(pair_log: Path, changed: Changed) -> None:
    log = changed(pair_log, plan(lambda content: content["loop"]["joints"][1].update(upper=0.5)))
    with pytest.raises(InputError, match="now compiles to a different plan"):
        replay_log(log, (), {"speed": "5 rad/s"})
