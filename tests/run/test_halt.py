"""Halt on virtual time: joints in every mode come to a stop within their limits, by the ledger."""

import numpy as np
import pytest
from tests.kit.sampled_run import SampledRun
from tests.kit.stories import ask, send

from dxlrun.channels.answers import Code, Completion, Halted, Refusal
from dxlrun.control.halt import HALT_NS, STILL_NS, STILL_SPEEDS
from dxlrun.log.log_reader import Log
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
RAMPED, SLOW = range(2)
GOAL_POSITION, GOAL_VELOCITY = 116, 104
RAD_PER_TICK, RAD_S_PER_TICK = 2 * np.pi / 4096, 0.229 * 2 * np.pi / 60
DT = 0.01
HALTED_S = 1.56
GO = [
    send("a", "positions", 1.9),
    send("b", "posvel", 1.2, 0.8),
    send("c", "velocities", 4.0),
    send("d", "efforts", 0.15),
]
HALT = ask("halt")


class Halts(SampledRun):
    """A run whose clients ask something at some times, s."""

    def __init__(self, folder, steps, *, seconds=3.0, text=ROBOT):
        super().__init__(folder, text, seconds)
        self.numbers = {at: self.ask(at * 1000, *commands) for at, commands in steps.items()}

    def halted(self, at: float) -> Halted:
        """Return how the halt ended that was asked for at a time."""
        answer = self.answer(self.numbers[at])
        assert isinstance(answer, Completion)
        assert answer.halted is not None
        return answer.halted


def wheel_speeds(run: SampledRun) -> list[float]:
    """Return the velocities that the wheel was sent, rad/s."""
    return [value * RAD_S_PER_TICK for at, value in run.goals("wheel", GOAL_VELOCITY, 4) if at > 1200]


def at(log: Log, seconds: float) -> int:
    """Return the row of the cycle that began so long after the first one."""
    return int(np.searchsorted(log.cycles["woken_ns"] - log.cycles["woken_ns"][0], seconds * 1e9))


@pytest.fixture(scope="module")
def halted(tmp_path_factory):
    run = Halts(tmp_path_factory.mktemp("halt"), {1.2: GO, HALTED_S: [HALT]})
    return run, run.run()


def test_joints_in_every_mode_come_to_rest_and_hold(halted):
    run, log = halted
    during = log.cycles["velocity"][at(log, HALTED_S) - 2]
    assert (np.abs(during) > 2 * STILL_SPEEDS[ROTARY]).tolist() == [True, True, True, True], during
    result = run.halted(HALTED_S)
    assert STILL_NS * 1e-9 < result.seconds < 2.0
    assert result.velocity <= STILL_SPEEDS[ROTARY]
    after = log.cycles[at(log, HALTED_S + result.seconds) + 2 :]
    assert np.abs(after["velocity"]).max() <= STILL_SPEEDS[ROTARY]
    assert np.ptp(after["position"], axis=0).max() < 0.03
    assert not np.any(after["active"] & 0b11110)
    assert np.all(after["active"] & 1), "the broadcaster goes on"


def test_goals_of_a_halt_stay_within_the_limits_of_acceleration(halted):
    run, log = halted
    ticks = np.array([value for at, value in run.goals("ramped", GOAL_POSITION, 4) if at > 1200], dtype=float)
    speeds = np.diff(ticks) * RAD_PER_TICK / DT
    assert speeds.max() > 3.0
    assert np.abs(np.diff(speeds)).max() <= 10.0 * DT + 2.1 * RAD_PER_TICK / DT  # and two roundings
    assert ticks[-1] * RAD_PER_TICK - np.pi < 1.6, "it came to rest on its way"
    goals = log.cycles["goal_position"][:, RAMPED]
    assert np.abs(np.diff(goals, 2)).max() <= 10.0 * DT * DT * (1 + 1e-6)
    wheel = wheel_speeds(run)
    assert max(wheel) == pytest.approx(8.0 * (HALTED_S - 1.2), abs=0.15)
    assert np.abs(np.diff(wheel)).max() <= 8.0 * DT + 1.1 * RAD_S_PER_TICK
    assert wheel[-1] == 0.0


def test_a_goal_far_ahead_of_a_slow_joint_comes_back_to_it(halted):
    _, log = halted
    goals, states = (log.cycles[name][:, SLOW] for name in ("goal_position", "position"))
    row = at(log, HALTED_S)
    assert goals[row - 2] - states[row - 2] > 0.5
    assert goals[-1] == pytest.approx(states[row], abs=0.05)


def test_a_joint_that_cannot_stop_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("dxlrun.control.halt.STILL_SPEEDS", dict.fromkeys(STILL_SPEEDS, -1.0))
    run = Halts(tmp_path, {1.2: [*GO, HALT]}, seconds=1.4 + HALT_NS * 1e-9)
    run.run()
    answer = run.answer(run.numbers[1.2])
    assert isinstance(answer, Refusal)
    assert answer.code == Code.STILL_MOVING
    assert "but after 5.0 s ramped, slow, wheel, grip still mov" in answer.text


def test_a_joint_that_does_not_answer_is_not_taken_for_one_that_stands(tmp_path):
    """A joint that is silent now and then is never lost, and never known to stand."""
    run = Halts(tmp_path, {1.2: [HALT]}, seconds=1.4 + HALT_NS * 1e-9)
    servo = run.servos["slow"]
    for at_ms in range(1150, 8000, 20):
        run.at(at_ms, servo.silence)
        run.at(at_ms + 10, lambda: servo.silence(False))
    run.run()
    answer = run.answer(run.numbers[1.2])
    assert isinstance(answer, Refusal)
    assert answer.code == Code.STILL_MOVING
    assert "slow" in answer.fields["joint"]


def test_goals_that_still_decelerate_are_waited_for_also_where_the_joint_is_slow(tmp_path):
    text = ROBOT.replace("{acceleration: 10 rad/s^2}", "{velocity: 1 rad/s, acceleration: 0.2 rad/s^2}")
    run = Halts(tmp_path, {1.2: [send("a", "positions", 1.0)], 1.6: [HALT]}, text=text)
    log = run.run()
    seconds = run.halted(1.6).seconds
    assert seconds == pytest.approx(0.4 + STILL_NS * 1e-9, abs=0.05)
    row = at(log, 1.6 + seconds)
    assert np.ptp(log.cycles["goal_position"][row:, RAMPED]) == 0


HOME = ROBOT.replace("loop: {rate: 100}", "loop: {rate: 100}\nposes: {home: {ramped: 0 deg}}")


@pytest.mark.parametrize(
    ("text", "end"), [(HOME, "[{pose: home, speed: 90 deg/s}, hold]"), (ROBOT, "hold")], ids=["pose", "hold"]
)
def test_a_run_that_ends_holding_brakes_within_the_limits_and_waits_until_its_joints_rest(
    tmp_path, text, end
):
    text += f"policies: {{on_exit: {end}, exit_timeout: 6 s}}\n"
    run = Halts(tmp_path, {1.2: GO}, seconds=1.5, text=text)
    goals = run.run().cycles["goal_position"][:, RAMPED]
    assert goals.max() > 0.4
    assert np.ptp(goals[-5:]) == 0.0
    assert np.abs(np.diff(goals, 2)).max() <= 10.0 * DT * DT * (1 + 1e-6)
    if end != "hold":
        assert goals[-1] == pytest.approx(0.0, abs=1e-6)
        assert goals.min() > -1e-6, "the pose was overshot"
    speeds = wheel_speeds(run)
    assert np.abs(np.diff(speeds)).max() <= 8.0 * DT + 1.1 * RAD_S_PER_TICK
    assert (max(speeds) > 2.0, speeds[-1]) == (True, 0.0)
