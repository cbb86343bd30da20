"""A replay can fail: whatever is not the same is named, down to one bit; also messages, prepared arrays."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from tests.kit.changed_logs import Change, add, flip, messages, plan, put
from tests.kit.virtual_run import VirtualRun, differing

from dxlrun.channels.commands import CommandMessage, encode_command
from dxlrun.channels.tagged import decode
from dxlrun.description.motion import read_motion
from dxlrun.errors import InputError
from dxlrun.remote.motion_requests import RunSnapshot, schedule_motion
from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.replay import replay_log
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController

JOINTS = ("pan", "tilt", "nod")
OWNERS = ("head", "all_inputs", "all_inputs")
ROBOTS = Path(__file__).parents[3] / "robots"
STATE = "/all_inputs/state"
COMMAND, GOAL = "command of the {}", "goal of the {}, after the last gate"


@pytest.mark.parametrize("field", ["command_position", "command_velocity", "goal_position", "goal_velocity"])
@pytest.mark.parametrize("bit", [0, 31, 52, 63])
def test_one_bit_of_one_value_is_named(pair_log, changed, field, bit):
    row, cycle, (kind, quantity) = bit % 3, 7 + bit % 40, field.split("_")
    report, first = differing(changed(pair_log, flip(field, cycle, row, bit)))
    assert (report.compared, report.different) == (50, 1)
    what = (COMMAND if kind == "command" else GOAL).format(quantity)
    assert (first.cycle, first.joint, first.controller, first.what) == (cycle, JOINTS[row], OWNERS[row], what)
    assert first.time_s == pytest.approx(cycle * 0.02)
    assert first.recorded != first.replayed
    (joint,) = report.joints
    assert (joint.joint, joint.commands, joint.goals) == (JOINTS[row], kind == "command", kind == "goal")


def test_bits_of_nan_and_of_zero_count(pair_log, changed):
    # tilt never gets a speed: what all_inputs left at NaN
    _, first = differing(changed(pair_log, flip("command_velocity", 12, 1, 63)))
    bits = "nan (bits 0xfff8000000000000)", "nan (bits 0x7ff8000000000000)"
    assert (first.recorded, first.replayed) == bits
    # the trajectory begins at 0 rad, or near it; a recorded -0.0 is not 0.0
    at_first = read_log(pair_log).cycles["command_position"][3, 0]
    assert at_first != 0.0 or not np.signbit(at_first)
    _, first = differing(changed(pair_log, put("command_position", (3, 0), -0.0)))
    assert (first.cycle, first.recorded) == (3, "-0.0")


@pytest.mark.parametrize("state", ["position", "velocity", "effort", "valid", "age_ns"])
def test_every_recorded_state_is_an_input(pair_log, changed, state):
    otherwise = put("valid", (20, 2), False) if state == "valid" else add(state, (20, 2), 1000)
    report, first = differing(changed(pair_log, otherwise))
    assert (first.cycle, first.joint) == (20, "nod")
    assert report.different >= 10


@pytest.mark.parametrize("values", ["position", "velocity", "effort", "goal_position", "goal_velocity"])
def test_what_the_controllers_began_with_is_an_input(pair_log, changed, values):
    report, first = differing(changed(pair_log, put(values, (0, 2), 1.25, of="activation")))
    # what the controller published when it was activated
    assert (first.cycle, first.what) == (-1, f"message of {STATE}: sum[1]")
    assert [joint.joint for joint in report.joints] == ["nod"]


def test_active_controllers_are_compared(pair_log, changed):
    report, first = differing(changed(pair_log, put("active", 9, 0b110)))
    assert (first.cycle, first.what, first.joint, first.controller) == (9, "active", None, "states")
    assert (first.recorded, first.replayed) == ("not active", "active")
    assert (report.different, report.joints) == (1, ())


# Other parameters and arguments


def test_another_parameter_is_seen_at_its_first_cycle(pair_log):
    report, first = differing(pair_log, "all_inputs.gain=0.5")
    assert (first.cycle, first.joint, first.controller) == (0, "tilt", "all_inputs")
    assert [(one.joint, one.commands) for one in report.joints] == [("tilt", 50), ("nod", 50)]
    assert report.sentence == "pair: 50 of 50 replayed cycles differ"
    assert report.different_messages  # its own goals are an input of the next cycle

    report, first = differing(pair_log, "head.command_interface=position")
    assert (first.cycle, first.joint, first.controller) == (10, "pan", "head")
    assert first.what == "command of the velocity"
    assert first.replayed.startswith("nan")
    assert report.prepared == 1  # whether they differ is the controller's own matter

    report, first = differing(pair_log, "all_inputs.give_up_after=0.31")
    assert (report.compared, first.cycle) == (17, 16)
    assert "all_inputs raised in update: RuntimeError: out of ideas" in report.fault


def test_limit_of_the_gate_from_an_argument(pair_log):
    report = replay_log(pair_log, (), {"speed": "0.8 rad/s"})
    first = report.first
    assert first is not None
    assert (first.joint, first.controller) == ("pan", "head")
    assert first.what.startswith("goal of the")
    assert [(one.joint, one.commands) for one in report.joints if one.commands] == []


@pytest.fixture
def log_with_include(robot_file, tmp_path):
    """The robot's log, whose controllers stood in a file above the robot's directory."""
    head, tail = robot_file.read_text().split("controllers:\n")
    robot, controllers, log = (tmp_path / n for n in ("robots/pair.yaml", "controllers.yaml", "run.mcap"))
    robot.parent.mkdir()
    robot.write_text(f"include: [../controllers.yaml]\n{head}")
    controllers.write_text(f"controllers:\n{tail}")
    simulated_robot(robot, arguments={"rate": "100"}, duration_s=0.5, log=log).run()
    controllers.unlink()
    robot.unlink()
    return log


def test_included_files_and_the_urdf_come_from_the_log(log_with_include, tmp_path):
    assert replay_log(log_with_include, (), {"speed": "5 rad/s"}).compared == 50
    torso = tmp_path / "torso.mcap"
    simulated_robot(ROBOTS / "bioloid_torso.yaml", duration_s=0.2, log=torso).run()
    assert replay_log(torso, (), {"rate": "50"}).same


def test_file_outside_of_the_robots_directory_is_not_written(log_with_include, changed, tmp_path):
    target = tmp_path / "written.yaml"
    outside = "/".join([".."] * 40) + str(target)
    log = changed(log_with_include, plan(lambda content: content["included"].update({outside: "name: x"})))
    with pytest.raises(InputError, match="outside of the robot's directory"):
        replay_log(log, (), {"speed": "5 rad/s"})
    assert not target.exists()


def test_plan_that_the_file_no_longer_gives(pair_log, changed):
    log = changed(pair_log, plan(lambda content: content["loop"]["joints"][1].update(upper=0.5)))
    with pytest.raises(InputError, match="now compiles to a different plan"):
        replay_log(log, (), {"speed": "5 rad/s"})


def flip_message(index: int, at: int, bit: int = 0) -> Change:
    def edit(found: list[tuple[int, bytes]]) -> None:
        t_ns, data = found[index][0], bytearray(found[index][1])
        data[at] ^= 1 << bit
        found[index] = (t_ns, bytes(data))

    return messages(STATE, edit)


def test_messages_from_activation_to_deactivation_are_the_same(pair_log, changed):
    assert len(read_log(pair_log).topics[STATE].data) == 52
    report = replay_log(pair_log)
    assert report.same
    assert report.messages >= 52
    assert report.sentence == "pair: 50 cycles replayed, 0 differences"
    without = replay_log(changed(pair_log, lambda log: replace(log, topics={})))
    assert (without.same, without.messages) == (True, 0)


@pytest.mark.parametrize(
    ("index", "at", "cycle", "field"),
    [(0, 4, -1, "header.stamp.sec"), (1, 20, 0, "number"), (30, -8, 29, "sum[1]"), (51, -16, 49, "sum[0]")],
)
def test_one_bit_of_one_message_is_named(pair_log, changed, index, at, cycle, field):  # noqa: PLR0917
    report, first = differing(changed(pair_log, flip_message(index, at)))
    assert (report.different, report.different_messages) == (0, 1)
    assert (first.cycle, first.what) == (cycle, f"message of {STATE}: {field}")
    assert first.recorded != first.replayed
    assert report.sentence == f"pair: 50 cycles replayed, 1 of {report.messages} messages differs"


def test_first_of_two_and_the_command_of_its_cycle_count(pair_log, changed):
    changes = flip_message(21, -8), flip_message(11, -8), add("command_position", (10, 1), 1.0)
    report, first = differing(changed(pair_log, *changes))
    assert (first.cycle, first.what) == (10, "command of the position")
    assert report.different_messages == 2


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda found: found.pop(7), (6, "no message", "a message")),
        (lambda found: found.insert(7, found[7]), (6, "a message", "no message")),
        (lambda found: found.append(found[-1]), (49, "a message", "no message")),
    ],
    ids=["one less", "one more", "one more at the end"],
)
def test_message_in_one_of_the_two_only_is_a_difference(pair_log, changed, change, expected):
    report, first = differing(changed(pair_log, messages(STATE, change)))
    assert report.different_messages == 1
    assert (first.cycle, first.recorded, first.replayed) == expected


def test_messages_that_the_recorder_lost_are_a_remark(pair_log, changed):
    lost = messages(STATE, lambda found: found.__delitem__(slice(4, 8)))
    report = replay_log(changed(pair_log, lost, gaps=[("loop/messages", 4)]))
    assert report.same
    assert "the log lacks 4 messages of topics" in report.remarks


# Prepared arrays: a `prepare` that makes something else of the same request is found out


def prepare_otherwise(monkeypatch: pytest.MonkeyPatch, change: Callable[[Any], Any]) -> None:
    """Let `prepare` of the trajectory controller return what `change` makes of its array."""
    prepare = JointTrajectoryController.prepare
    monkeypatch.setattr(
        JointTrajectoryController, "prepare", staticmethod(lambda *of_it: change(prepare(*of_it)))
    )


def ask_often(run: VirtualRun) -> None:
    """Hand over a command of a client every fifth cycle, and play the motion again at the end."""
    for cycle in range(3, 30, 5):
        points = [{"time": 0.1, "positions": [0.01 * cycle]}]
        run.command(20 * cycle, "head", "trajectory", {"points": points})
    (head,) = (one for one in run.plan.loop.controllers if one.name == "head")
    compiled = {"head": run.door.compiled(structs.replace(head, active=True))}
    motion = read_motion(Path(run.plan.source_file).with_name("look.yaml"))

    def play() -> None:
        played = schedule_motion(motion, RunSnapshot(compiled, run.door.joints, run.record), 1.0)
        run.post(CommandMessage(0, "", "play", played.data, "anna", request=played.request))

    run.at(805, play)


def test_commands_of_clients_and_motions_are_prepared_again(run, monkeypatch):
    log = run(ask_often)
    report = replay_log(log)
    assert report.same
    assert (report.prepared, report.different_prepared, report.unprepared) == (8, 0, 0)

    prepare_otherwise(monkeypatch, lambda array: np.append(array, 1.0))
    report, first = differing(log)
    assert (report.prepared, report.different_prepared) == (8, 8)
    count = len(read_log(log).commands[0].numbers)
    assert (first.cycle, first.recorded, first.replayed) == (3, f"{count} numbers", f"{count + 1} numbers")


def refuse(array: object) -> None:
    raise ValueError("no such motion any more")


def test_another_array_of_the_plan_is_named(pair_log, monkeypatch):
    assert replay_log(pair_log).prepared == 1
    with monkeypatch.context() as patch:
        prepare_otherwise(patch, lambda array: array * 2)
        report, first = differing(pair_log)
        assert (report.prepared, report.different_prepared) == (1, 1)
        assert (first.cycle, first.controller) == (10, "head")
        assert first.time_s == pytest.approx(0.2)
        assert first.what.startswith("prepared array of command trajectory, element ")
        assert float(first.replayed) == 2 * float(first.recorded)
    with monkeypatch.context() as patch:  # the last bit of one number far in the array: no goal need show it
        prepare_otherwise(patch, lambda array: np.append(array[:-1], np.nextafter(array[-1:], np.inf)))
        report, _ = differing(pair_log)
        assert report.different_prepared == 1
        assert report.different or "1 of 1 prepared command differs" in report.sentence
    with monkeypatch.context() as patch:
        prepare_otherwise(patch, refuse)
        report, first = differing(pair_log)
        assert (report.different_prepared, report.different) == (1, 0)  # the recorded array is handed on
        assert first.replayed == "no array (ValueError: no such motion any more)"


def test_request_that_the_log_does_not_have_is_reported(pair_log, changed):
    forget = plan(lambda content: [command.pop("request") for command in content["loop"]["commands"]])
    report = replay_log(changed(pair_log, forget))
    assert (report.same, report.prepared, report.unprepared) == (True, 0, 1)


def test_request_is_left_out_where_there_is_no_room():
    command = CommandMessage(7, "head", "positions", bytes(800), "anna", 5, b'{"positions":[1.0]}')
    assert decode(encode_command(command)) == command
    whole = len(encode_command(command))
    assert decode(encode_command(command, whole - 1)) == structs.replace(command, request=b"")
