"""The end of a run whose joints are not in position mode: they rest before a pose, and never turn on."""

from typing import Any

import numpy as np
import pytest

from dxlrun.control.safe_motion import ARRIVED, MODES_NS, SETTLE_NS, STAND_NS
from dxlrun.control.steering import PAUSE_LEASE_NS, PAUSED_CYCLE_NS
from dxlrun.plan.policy_plan import HOLD, LIMP, SLOW_SPEED, Policy, PolicyPlan, PolicyStepPlan
from dxlwire.joint_unit import ROTARY
from dxlwire.modes import Mode

NEAR = ARRIVED[ROTARY]

PERIOD_NS = 20_000_000
POSE = Policy((PolicyStepPlan("pose home at 60 deg/s", 10**9, (0.3, None), 1.0),), "limp")


def drives(self: Any, step: str, time_ns: int, _: object) -> None:
    if step == "update":
        self.context.commands.velocity[:] = 0.5
        self.context.commands.effort[:] = self.context.commands.pwm[:] = 0.2


def ended(robot: Any, command: str, policy: Policy, slow: bool = False) -> list[list[float]]:
    """Return velocity and effort goals of the cycles after the last one of the controllers."""
    robot.script("drive", drives, command=(command,))
    robot.build(end_ns=10 * PERIOD_NS, policies=PolicyPlan(on_exit=policy))
    robot.record.states.mode[:] = Mode[command.upper()]
    if slow:
        robot.hardware.set_modes = lambda modes: robot.hardware.asked.append(modes.tolist())
    seen: list[list[float]] = []
    write = robot.hardware.write_goals

    def watched() -> None:
        write()
        if not robot.record.active:
            goals = robot.record.goals
            seen.append([*goals.velocity, *goals.effort, *goals.position])

    robot.hardware.write_goals = watched
    assert robot.loop.run().reason == "ended"
    return seen


def test_a_run_that_ends_limp_sends_nothing_more(robot):
    assert ended(robot, "velocity", LIMP) == []


def test_wheels_stand_before_they_are_left_with_torque_on(robot):
    seen = ended(robot, "velocity", HOLD)
    assert len(seen) == STAND_NS // PERIOD_NS + 1
    assert np.array(seen)[:, :2].tolist() == [[0.0, 0.0]] * len(seen)
    assert robot.hardware.asked == []


@pytest.mark.parametrize("command", ["effort", "pwm"])
def test_joints_that_would_give_way_hold_before_they_are_left_with_torque_on(robot, command):
    seen = ended(robot, command, HOLD)
    assert robot.hardware.asked == [[Mode.POSITION, Mode.POSITION]]
    assert np.array(seen)[:, :2].tolist() == [[SLOW_SPEED] * 2] * len(seen)
    assert np.isnan(np.array(seen)[:, 2:4]).all()
    assert seen[-1][4:] == robot.record.states.position.tolist()


def test_a_pose_begins_when_all_joints_that_it_moves_are_in_position_mode(robot):
    seen = ended(robot, "velocity", POSE)
    assert robot.hardware.asked == [[Mode.POSITION, 0]]
    assert seen[-1][4] == pytest.approx(0.3)
    assert seen[-1][0] == 1.0  # the speed of the pose, no velocity
    assert seen[-1][1] == 0.0


def test_a_policy_does_not_wait_for_modes_for_ever(robot):
    seen = ended(robot, "effort", HOLD, slow=True)
    assert len(seen) == MODES_NS // PERIOD_NS + 1
    assert np.array(seen)[:, 2:4].tolist() == [[0.0, 0.0]] * len(seen)


@pytest.mark.parametrize(
    ("off", "valid_after_ns", "lasts_ns"),
    [
        (0.0, 0, STAND_NS),
        (0.9 * NEAR, 0, STAND_NS),
        (-0.9 * NEAR, 0, STAND_NS),
        (1.1 * NEAR, 0, SETTLE_NS),
        (-1.1 * NEAR, 0, SETTLE_NS),
        (0.0, 1 << 60, SETTLE_NS),  # an old position is none
        (0.0, 200_000_000, 200_000_000),
    ],
)
def test_a_pose_lasts_until_its_joints_are_there_or_settle_time_is_over(robot, off, valid_after_ns, lasts_ns):
    robot.build(end_ns=PERIOD_NS, policies=PolicyPlan(on_exit=POSE))
    record, there = robot.record, []

    def read():
        goal = record.goals.position[0]
        if goal == pytest.approx(0.3, abs=1e-12):
            there.append(record.woken_ns)
        record.states.position[0] = goal + off
        record.states.valid[0] = not there or record.woken_ns - there[0] >= valid_after_ns

    robot.hardware.read_states = read
    assert robot.loop.run().last == "limp"
    assert there[-1] - there[0] == lasts_ns


def test_the_second_of_two_poses_is_reached_as_the_first_one_was(robot):
    poses = tuple(PolicyStepPlan(f"pose {end}", 10**9, (end, None), 1.0) for end in (0.3, 0.35))
    robot.build(end_ns=PERIOD_NS, policies=PolicyPlan(on_exit=Policy(poses, "limp")))
    seen: list[tuple[int, float]] = []
    robot.hardware.write_goals = lambda: seen.append((robot.record.woken_ns, robot.record.goals.position[0]))
    robot.loop.run()
    for end in (0.3, 0.35):
        times = [t_ns for t_ns, goal in seen if goal == pytest.approx(end, abs=1e-9)]
        assert times[-1] - times[0] >= STAND_NS - PERIOD_NS


def test_less_torque_lasts_its_time_at_each_of_its_steps(robot):
    step = PolicyStepPlan("torque down", 300_000_000, fraction=0.4, levels=3)
    robot.build(end_ns=PERIOD_NS, policies=PolicyPlan(on_exit=Policy((step,), "limp")))
    record, limits = robot.record, []
    robot.hardware.limit_torque = lambda fraction: limits.append((record.woken_ns, round(fraction, 6)))
    assert robot.loop.run().last == "limp"
    assert [fraction for _, fraction in limits] == [0.8, 0.6, 0.4]
    assert [t_ns - limits[0][0] for t_ns, _ in limits] == [0, 100_000_000, 200_000_000]
    assert record.woken_ns - limits[0][0] == 300_000_000


@pytest.mark.parametrize("ends_ns", [3 * PERIOD_NS, PAUSE_LEASE_NS + 10 * PERIOD_NS])
def test_a_pause_that_ends_with_the_run_or_its_lease_leaves_the_guardian_its_usual_patience(robot, ends_ns):
    robot.build(policies=PolicyPlan(on_exit=POSE))
    robot.ask("pause")
    seen, begun_ns = [], robot.clock.now_ns()

    def stop(*_):
        if robot.record.woken_ns - begun_ns >= ends_ns:
            seen[:] = robot.patience
            robot.stop.request()

    robot.hardware.idle = stop
    robot.loop.run()
    assert robot.patience == [PAUSED_CYCLE_NS, PERIOD_NS]
    assert seen == robot.patience or ends_ns < PAUSE_LEASE_NS
