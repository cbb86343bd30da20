"""Halt on virtual time: joints in every mode come to a stop within their limits, by the ledger."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.kit.wire import all_writes

from dxlrun.channels.answers import Code, Completion, Refusal
from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.control.halt import HALT_NS, STILL_NS, STILL_SPEEDS
from dxlrun.log.log_reader import Log, read_log
from dxlrun.remote.preparation import Preparation
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import replay_log
from dxlwire.joint_unit import ROTARY

ROBOT = """\
name: halting
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}
loop: {rate: 100}
joints:
  ramped: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
           limits: {acceleration: 10 rad/s^2}}
  slow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: -1}
  wheel: {bus: main, id: 3, model: XL430-W250, reference: 0 deg, direction: 1, continuous: true,
          limits: {acceleration: 8 rad/s^2}}
  grip: {bus: main, id: 4, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
  a: {type: joint_group_position_controller, joints: [ramped]}
  b: {type: joint_group_posvel_controller, joints: [slow]}
  c: {type: joint_group_velocity_controller, joints: [wheel]}
  d: {type: joint_group_effort_controller, joints: [grip]}
"""
RAMPED, SLOW, WHEEL, GRIP = range(4)
GOAL_POSITION, GOAL_VELOCITY = 116, 104
RAD_PER_TICK, RAD_S_PER_TICK = 2 * np.pi / 4096, 0.229 * 2 * np.pi / 60
DT = 0.01
HALTED_S = 1.56
NUMBERS = itertools.count(1)


def send(controller: str, kind: str, *values: float) -> CommandMessage:
    return CommandMessage(next(NUMBERS), controller, kind, np.array(values).tobytes(), "anna")


def loop(kind: str, data: bytes = b"") -> CommandMessage:
    return CommandMessage(next(NUMBERS), LOOP, kind, data, "anna")


def ran(folder, steps, *, seconds=3.0, text=ROBOT, before=lambda robot: None):
    (folder / "robot.yaml").write_text(text)
    robot = simulated_robot(folder / "robot.yaml", duration_s=seconds, log=folder / "run.mcap")

    def steer(commands: list[CommandMessage]) -> Callable[[], None]:
        return lambda: robot.inbox.waiting.extend(commands)

    for at, commands in steps.items():
        robot.buses[0].at(round(at * 1e9), steer(commands))
    before(robot)
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    return robot, read_log(folder / "run.mcap")


def written(robot: VirtualRobot, servo_id: int, address: int) -> list[tuple[float, int]]:
    """Return times, s, and signed values of the last four bytes that goals had for a servo."""
    return [
        (t_ns * 1e-9, int.from_bytes(data[address - first :][:4], "little", signed=True))
        for t_ns, one, first, data in all_writes(robot.ledger.entries, robot.plan.buses[0])
        if one == servo_id and first <= address <= first + len(data) - 4
    ]


GO = [
    send("a", "positions", 1.9),
    send("b", "posvel", 1.2, 0.8),
    send("c", "velocities", 4.0),
    send("d", "efforts", 0.15),
]


def at(log: Log, seconds: float) -> int:
    """Return the row of the cycle that began at this time of the buses' clock."""
    return int(np.searchsorted(log.cycles["woken_ns"], seconds * 1e9))


@pytest.fixture(scope="module")
def halted(tmp_path_factory):
    command = loop("halt")
    return *ran(tmp_path_factory.mktemp("halt"), {1.2: GO, HALTED_S: [command]}), command


def test_joints_in_every_mode_come_to_rest_and_hold(halted):
    robot, log, command = halted
    cycles = log.cycles
    during = cycles["velocity"][at(log, HALTED_S) - 2]
    assert (np.abs(during) > 2 * STILL_SPEEDS[ROTARY]).tolist() == [True, True, True, True], during
    answer = robot.inbox.answers[command.number]
    assert isinstance(answer, Completion)
    assert answer.halted is not None
    assert STILL_NS * 1e-9 < answer.halted.seconds < 2.0
    assert answer.halted.velocity <= STILL_SPEEDS[ROTARY]
    after = cycles[at(log, HALTED_S + answer.halted.seconds) + 2 :]
    assert np.abs(after["velocity"]).max() <= STILL_SPEEDS[ROTARY]
    assert np.ptp(after["position"], axis=0).max() < 0.03
    assert not np.any(after["active"] & 0b11110)
    assert np.all(after["active"] & 1), "the broadcaster goes on"


def test_goal_ticks_decelerate_within_the_limit_and_then_stand(halted):
    robot, log, _ = halted
    ticks = np.array([value for at, value in written(robot, 1, GOAL_POSITION) if at > 1.2], dtype=float)
    speeds = np.diff(ticks) * RAD_PER_TICK / DT
    assert speeds.max() > 3.0
    assert np.abs(np.diff(speeds)).max() <= 10.0 * DT + 2.1 * RAD_PER_TICK / DT  # and two roundings
    assert ticks[-1] * RAD_PER_TICK - np.pi < 1.6, "it came to rest on its way"
    goals = log.cycles["goal_position"][:, RAMPED]
    assert np.abs(np.diff(goals, 2)).max() <= 10.0 * DT * DT * (1 + 1e-6)


def test_the_velocity_of_a_wheel_becomes_zero_within_the_limit(halted):
    speeds = [value * RAD_S_PER_TICK for at, value in written(halted[0], 3, GOAL_VELOCITY) if at > 1.2]
    assert max(speeds) == pytest.approx(8.0 * (HALTED_S - 1.2), abs=0.15)
    assert np.abs(np.diff(speeds)).max() <= 8.0 * DT + 1.1 * RAD_S_PER_TICK
    assert speeds[-1] == 0.0


def test_a_goal_far_ahead_of_a_slow_joint_comes_back_to_it(halted):
    goals, states = (halted[1].cycles[name][:, SLOW] for name in ("goal_position", "position"))
    row = at(halted[1], HALTED_S)
    assert goals[row - 2] - states[row - 2] > 0.5
    assert goals[-1] == pytest.approx(states[row], abs=0.05)


def test_a_halted_robot_goes_on_when_a_controller_is_activated(tmp_path):
    steps = {
        1.2: GO,
        1.6: [loop("halt")],
        2.4: [loop("switch", b'{"activate":["a"]}'), send("a", "positions", -0.5)],
    }
    robot, log = ran(tmp_path, steps, seconds=4.0)
    assert all(isinstance(one, Completion) for one in robot.inbox.answers.values())
    assert log.cycles["position"][-1, RAMPED] == pytest.approx(-0.5, abs=0.05)
    assert "halt from anna" in [event.text for event in log.events if event.code == EventCode.STEERED]


def test_a_halt_is_replayed_without_a_difference(halted, tmp_path):
    report = replay_log(Path(halted[1].path))
    assert report.sentence.endswith("0 differences"), report


def test_two_halts_are_answered_and_one_of_a_standing_robot_at_once(tmp_path):
    both = [loop("halt"), loop("halt")]
    robot, _ = ran(tmp_path, {1.5: both})
    for command in both:
        answer = robot.inbox.answers[command.number]
        assert isinstance(answer, Completion)
        assert answer.halted is not None


def test_a_joint_that_cannot_stop_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("dxlrun.control.halt.STILL_SPEEDS", dict.fromkeys(STILL_SPEEDS, -1.0))
    command = loop("halt")
    robot, _ = ran(tmp_path, {1.2: [*GO, command]}, seconds=1.4 + HALT_NS * 1e-9)
    answer = robot.inbox.answers[command.number]
    assert isinstance(answer, Refusal)
    assert answer.code == Code.STILL_MOVING
    assert "but after 5.0 s ramped, slow, wheel, grip still mov" in answer.text


def test_a_joint_that_does_not_answer_is_not_taken_for_one_that_stands(tmp_path):
    """A joint that is silent now and then is never lost, and never known to stand."""
    command = loop("halt")

    def silence(robot):
        servo = robot.buses[0].servo(2)
        for at_ms in range(1150, 8000, 20):
            robot.buses[0].at(at_ms * 1_000_000, servo.silence)
            robot.buses[0].at((at_ms + 10) * 1_000_000, lambda: servo.silence(False))

    robot, _ = ran(tmp_path, {1.0: [], 1.2: [command]}, seconds=1.4 + HALT_NS * 1e-9, before=silence)
    answer = robot.inbox.answers[command.number]
    assert isinstance(answer, Refusal)
    assert answer.code == Code.STILL_MOVING
    assert "slow" in answer.fields["joint"]


def test_a_halt_that_the_end_of_the_run_interrupts_is_refused(tmp_path):
    command = loop("halt")
    robot, _ = ran(tmp_path, {1.2: GO, 1.48: [command]}, seconds=1.5)
    assert robot.inbox.answers[command.number] == Refusal(Code.RUN_ENDING)


def test_goals_that_still_decelerate_are_waited_for_also_where_the_joint_is_slow(tmp_path):
    text = ROBOT.replace("{acceleration: 10 rad/s^2}", "{velocity: 1 rad/s, acceleration: 0.2 rad/s^2}")
    command = loop("halt")
    robot, log = ran(tmp_path, {1.2: [send("a", "positions", 1.0)], 1.6: [command]}, text=text)
    answer = robot.inbox.answers[command.number]
    assert isinstance(answer, Completion)
    assert answer.halted is not None
    assert answer.halted.seconds == pytest.approx(0.4 + STILL_NS * 1e-9, abs=0.05)
    assert np.ptp(log.cycles["goal_position"][at(log, 1.6 + answer.halted.seconds) :, RAMPED]) == 0


ENDING = (
    ROBOT.replace("loop: {rate: 100}", "loop: {rate: 100}\nposes: {home: {ramped: 0 deg}}")
    + "policies: {on_exit: [{pose: home, speed: 90 deg/s}, hold], exit_timeout: 6 s}\n"
)


def test_a_run_that_ends_holding_brakes_within_the_limits_on_its_way_to_a_pose(tmp_path):
    robot, log = ran(tmp_path, {1.2: GO}, seconds=1.5, text=ENDING)
    goals = log.cycles["goal_position"][:, RAMPED]
    assert goals.max() > 0.4
    assert goals[-1] == pytest.approx(0.0, abs=1e-6)
    assert goals.min() > -1e-6, "the pose was overshot"
    assert np.abs(np.diff(goals, 2)).max() <= 10.0 * DT * DT * (1 + 1e-6)
    speeds = [value * RAD_S_PER_TICK for when, value in written(robot, 3, GOAL_VELOCITY) if when > 1.2]
    assert np.abs(np.diff(speeds)).max() <= 8.0 * DT + 1.1 * RAD_S_PER_TICK
    assert (max(speeds) > 2.0, speeds[-1]) == (True, 0.0)


def test_a_run_that_ends_holding_waits_until_its_joints_have_come_to_rest(tmp_path):
    text = ROBOT + "policies: {on_exit: hold, exit_timeout: 6 s}\n"
    robot, log = ran(tmp_path, {1.2: GO}, seconds=1.5, text=text)
    goals = log.cycles["goal_position"][:, RAMPED]
    assert np.ptp(goals[-5:]) == 0.0
    assert np.abs(np.diff(goals, 2)).max() <= 10.0 * DT * DT * (1 + 1e-6)
    speeds = [value * RAD_S_PER_TICK for when, value in written(robot, 3, GOAL_VELOCITY) if when > 1.2]
    assert np.abs(np.diff(speeds)).max() <= 8.0 * DT + 1.1 * RAD_S_PER_TICK
    assert (max(speeds) > 2.0, speeds[-1]) == (True, 0.0)


CHAIN = """\
name: chain
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}
loop: {rate: 100}
joints:
  arm: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
        limits: {acceleration: 10 rad/s^2}}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
  pid: {type: pid_controller, joints: [arm], reference: position, command_interface: velocity,
        gains: {p: 5.0}}
  arm: {type: joint_trajectory_controller, joints: [arm], into: [pid]}
"""


def test_a_chain_is_halted_whole_and_its_goal_ends_as_aborted(tmp_path):
    (tmp_path / "robot.yaml").write_text(CHAIN)
    robot = simulated_robot(tmp_path / "robot.yaml", duration_s=3.0, log=tmp_path / "run.mcap")
    plan = next(one for one in robot.plan.loop.controllers if one.name == "arm")
    point = b'{"points": [{"time": 2.0, "positions": [1.0]}]}'
    prepared = Preparation({joint.name: joint for joint in robot.plan.loop.joints}, load_plugins()).command(
        plan, "trajectory", point, units=False
    )
    move, stop = CommandMessage(next(NUMBERS), "arm", "trajectory", prepared.data, "anna"), loop("halt")
    robot.buses[0].at(1_200_000_000, lambda: robot.inbox.waiting.append(move))
    robot.buses[0].at(1_900_000_000, lambda: robot.inbox.waiting.append(stop))
    assert robot.run().detail == ""
    answer = robot.inbox.answers[stop.number]
    assert isinstance(answer, Completion)
    assert answer.halted is not None
    log = read_log(tmp_path / "run.mcap")
    events = [(event.code, event.source) for event in log.events]
    assert events.index((EventCode.CONTROLLER_DEACTIVATED, "arm")) < events.index(
        (EventCode.CONTROLLER_DEACTIVATED, "pid")
    )
    (ended,) = [event.text for event in log.events if event.code == EventCode.GOAL_ENDED]
    assert "aborted" in ended
    halted_at = at(log, 1.9 + answer.halted.seconds)
    assert not np.any(log.cycles["active"][halted_at:] & 0b110)
    assert 0.05 < log.cycles["position"][-1, 0] < 0.9
    speeds = [value * RAD_S_PER_TICK for when, value in written(robot, 1, GOAL_VELOCITY) if when > 1.2]
    assert np.abs(np.diff(speeds)).max() <= 10.0 * DT + 1.1 * RAD_S_PER_TICK
    assert replay_log(tmp_path / "run.mcap").sentence.endswith("0 differences")
