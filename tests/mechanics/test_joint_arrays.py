"""States and goals between servos and joints: there and back, validity, torque, efforts and speeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from dxlrun.channels.cycle import Commands, States, Torque
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun.plan.robot_plan import Plan
from dxlwire.modes import Mode

HEAD, HIP, GRIPPER, PITCH, ROLL = range(5)


@pytest.fixture
def arrays(plan: Callable[..., Plan]) -> CoupledJointArrays:
    """The arrays of the robot, with all servos at 0, valid, with torque, in position control."""
    found = CoupledJointArrays(plan().mechanics, States.empty(5), Commands.empty(5))
    states = found.servo_states
    states.motion[:], states.valid[:], states.age_ns[:] = 0.0, True, 1_000
    states.torque[:], states.mode[:] = Torque.ON, Mode.POSITION
    return found


def test_random_goals_come_back_as_states(arrays: CoupledJointArrays) -> None:
    random = np.random.default_rng(7)
    for _ in range(200):
        goal = random.uniform(-1, 1, 5)
        arrays.goals.position[:] = goal
        arrays.fill_servo_goals()
        arrays.servo_states.position[:] = arrays.servo_goals.position
        arrays.servo_states.velocity[:] = arrays.servo_goals.position
        arrays.fill_joint_states()
        assert arrays.states.position == pytest.approx(goal, abs=1e-12)
        assert arrays.states.velocity == pytest.approx(goal, abs=1e-12)
        assert np.abs(arrays.residual).max() < 1e-12


def test_a_differential_moves_both_by_sum_and_difference(
    arrays: CoupledJointArrays, plan: Callable[..., Plan]
) -> None:
    mechanics = plan().mechanics
    left, right = mechanics.servo_rows(PITCH)
    assert mechanics.servos[left] == "wrist/left"
    arrays.goals.position[:] = [0, 0, 0, 0.5, 0.2]
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[[left, right]] == pytest.approx([0.7, 0.3])
    arrays.servo_states.effort[[left, right]] = 0.7, 0.3
    arrays.fill_joint_states()
    assert arrays.states.effort[[PITCH, ROLL]] == pytest.approx([1.0, 0.4])


def test_power_is_the_same_on_both_sides(arrays: CoupledJointArrays) -> None:
    random = np.random.default_rng(3)
    arrays.servo_states.velocity[:] = random.normal(size=6)
    arrays.servo_states.effort[:] = random.normal(size=6)
    first, second = 1, 2  # the servos of the hip turn at one speed
    arrays.servo_states.velocity[second] = arrays.servo_states.velocity[first]
    arrays.fill_joint_states()
    states, servos = arrays.states, arrays.servo_states
    assert np.dot(states.velocity, states.effort) == pytest.approx(np.dot(servos.velocity, servos.effort))


def test_a_joint_is_valid_where_all_its_servos_are_and_keeps_its_values(arrays: CoupledJointArrays) -> None:
    arrays.fill_joint_states()
    arrays.servo_states.position[:] = 1.0
    arrays.servo_states.valid[2] = False  # the hip's second
    arrays.servo_states.age_ns[2] = 70_000
    arrays.fill_joint_states()
    assert arrays.states.valid.tolist() == [True, False, True, True, True]
    assert arrays.states.position[[HEAD, HIP]].tolist() == [1.0, 0.0]
    assert arrays.states.age_ns[HIP] == 70_000
    arrays.servo_states.age_ns[1] = -1
    arrays.fill_joint_states()
    assert arrays.states.age_ns[HIP] == -1


@pytest.mark.parametrize("worst", [Torque.DOUBT, Torque.OFF, Torque.RELEASED, Torque.LOST, Torque.REBOOTING])
def test_a_joint_has_the_worst_torque_the_highest_temperature_and_all_errors(
    arrays: CoupledJointArrays, worst: Torque
) -> None:
    states = arrays.servo_states
    states.torque[1] = worst
    states.temperature[1:3] = 40, 60
    states.voltage[1:3] = 12.0, 11.5
    states.hardware_error[1:3] = 0x04, 0x20
    arrays.fill_joint_states()
    found = arrays.states
    assert (found.torque[HIP], found.temperature[HIP], found.voltage[HIP]) == (worst, 60, 11.5)
    assert (found.hardware_error[HIP], found.torque[PITCH]) == (0x24, Torque.ON)


def test_of_two_torques_a_joint_has_the_worse(arrays: CoupledJointArrays) -> None:
    names = ("ON", "DOUBT", "RELEASED", "OFF", "REBOOTING", "LOST", "UNKNOWN")
    for better, worse in pairwise(Torque[name] for name in names):
        arrays.servo_states.torque[1:3] = better, worse
        arrays.fill_joint_states()
        assert arrays.states.torque[HIP] == worse


def test_a_joint_has_the_mode_that_all_its_servos_have(arrays: CoupledJointArrays) -> None:
    arrays.servo_states.mode[1] = Mode.VELOCITY
    arrays.fill_joint_states()
    assert arrays.states.mode.tolist() == [
        Mode.POSITION if joint != HIP else Mode.UNKNOWN for joint in range(5)
    ]
    asked = np.array([0, Mode.VELOCITY, 0, Mode.EFFORT, Mode.EFFORT], dtype=np.uint8)
    assert set(arrays.joint_requests(asked)[1:3]) == {Mode.VELOCITY}
    assert set(arrays.joint_requests(asked)[-2:]) == {Mode.EFFORT}
    asked[ROLL] = Mode.VELOCITY  # two modes for one wrist: neither
    assert set(arrays.joint_requests(asked)[-2:]) == {Mode.UNKNOWN}
    asked[ROLL] = Mode.UNKNOWN  # it stays in position control, so the other does too
    assert set(arrays.joint_requests(asked)[-2:]) == {Mode.UNKNOWN}


def test_a_joint_without_a_goal_leaves_its_servos_without(arrays: CoupledJointArrays) -> None:
    arrays.goals.position[:] = [0.1, np.nan, 0.1, 0.1, np.nan]
    arrays.fill_servo_goals()
    assert np.isnan(arrays.servo_goals.position).tolist() == [False, True, True, False, True, True]


def test_velocities_and_efforts_have_their_signs_in_modes_of_their_own(arrays: CoupledJointArrays) -> None:
    arrays.servo_states.mode[:] = Mode.VELOCITY
    arrays.goals.velocity[:] = [0, -2.0, 0, -1.0, 0.5]
    arrays.fill_servo_goals()
    assert arrays.servo_goals.velocity[1:3].tolist() == [-2.0, -2.0]
    assert arrays.servo_goals.velocity[-2:] == pytest.approx([-0.5, -1.5])
    arrays.servo_states.mode[:] = Mode.EFFORT
    arrays.goals.effort[:] = [0, -0.8, 0, -0.4, 0.2]
    arrays.fill_servo_goals()
    assert arrays.servo_goals.effort[1:3].tolist() == [-0.4, -0.4]  # each half of it
    assert arrays.servo_goals.effort[-2:] == pytest.approx([-0.1, -0.3])


def test_the_most_effort_beside_a_position_is_a_sum_of_magnitudes(arrays: CoupledJointArrays) -> None:
    arrays.servo_states.mode[:] = Mode.EFFORT_POSITION
    arrays.goals.position[:] = 0.1
    arrays.goals.effort[:] = [0.5, -0.8, 0.5, 0.6, -0.2]
    arrays.fill_servo_goals()
    # of a difference of the two the right one would have a quarter of what its joints may take
    assert arrays.servo_goals.effort[-2:] == pytest.approx([0.4, 0.4])
    assert arrays.servo_goals.effort[1:3] == pytest.approx([0.4, 0.4])


def test_servos_of_a_wrist_arrive_together_at_the_speed_of_its_slowest_joint(
    arrays: CoupledJointArrays,
) -> None:
    arrays.fill_joint_states()
    arrays.goals.position[:] = [0, 0.5, 0, 0.4, 0.2]
    arrays.goals.velocity[:] = [1, 1.5, 1, 1.0, 0.25]
    arrays.fill_servo_goals()
    left, right = arrays.servo_goals.velocity[-2:]
    # roll needs 0.2 / 0.25 = 0.8 s, pitch could in 0.4 s; the servos go 0.6 and 0.2 rad in 0.8 s
    assert (left, right) == pytest.approx((0.75, 0.25))
    assert arrays.servo_goals.velocity[1:3].tolist() == [1.5, 1.5]
    arrays.servo_states.position[-2:] = 0.3, 0.1
    arrays.fill_joint_states()
    arrays.fill_servo_goals()  # nothing new is asked for: the speeds stay, and cost no time on the wire
    assert arrays.servo_goals.velocity[-2:].tolist() == [left, right]
    arrays.goals.velocity[PITCH] = math.nan
    arrays.fill_servo_goals()  # pitch goes as fast as roll lets it, whose limit counts still
    assert np.isfinite(arrays.servo_goals.velocity[-2:]).all()
    arrays.goals.velocity[-2:] = math.nan
    arrays.fill_servo_goals()
    assert np.isnan(arrays.servo_goals.velocity[-2:]).all()  # as fast as the servos can


@pytest.mark.parametrize("pitch", [-0.8, 0.8])
@pytest.mark.parametrize("roll", [-0.05, 0.05])
def test_the_slowest_joint_of_a_wrist_decides_its_speed_in_either_direction(
    arrays: CoupledJointArrays, pitch: float, roll: float
) -> None:
    arrays.fill_joint_states()
    arrays.goals.position[[PITCH, ROLL]] = pitch, roll
    arrays.goals.velocity[[PITCH, ROLL]] = 1.0, 0.25
    arrays.fill_servo_goals()  # pitch takes 0.8 s
    expected = abs(pitch + roll) / 0.8, abs(pitch - roll) / 0.8
    assert arrays.servo_goals.velocity[-2:] == pytest.approx(expected)


def test_a_servo_of_a_wrist_that_need_not_move_is_slow_and_not_as_fast_as_it_can(
    arrays: CoupledJointArrays,
) -> None:
    arrays.fill_joint_states()
    arrays.goals.position[[PITCH, ROLL]] = 0.3
    arrays.goals.velocity[[PITCH, ROLL]] = 1.0
    arrays.fill_servo_goals()
    left, right = arrays.servo_goals.velocity[4:6]
    assert left == pytest.approx(2.0)
    assert right == pytest.approx(0.05 * 2.0)  # 0 would be no limit


def test_nothing_moves_at_the_start_and_servos_that_disagree_a_little_are_brought_together(
    arrays: CoupledJointArrays,
) -> None:
    arrays.servo_goals.position[:] = [0.1, 0.20, 0.24, 0.01, 0.7, 0.3]
    arrays.fill_joint_goals()
    assert arrays.goals.position == pytest.approx([0.1, 0.22, 0.01, 0.5, 0.2])
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position == pytest.approx([0.1, 0.20, 0.24, 0.01, 0.7, 0.3], abs=1e-12)
    arrays.fade(0.5)
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[1:3] == pytest.approx([0.21, 0.23])
    arrays.fade(0.6)
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[1:3] == pytest.approx([0.22, 0.22])


def test_servos_that_are_anchored_where_they_disagree_do_not_move_before_they_are_brought_together(
    arrays: CoupledJointArrays, plan: Callable[..., Plan]
) -> None:
    arrays.servo_goals.position[:] = 0.0
    arrays.fill_joint_goals()
    arrays.fade(1.0)
    hip = plan().mechanics.servo_rows(HIP)
    found = arrays.servo_states.position
    found[:] = [0.1, 0.20, 0.24, 0.01, 0.7, 0.3]
    arrays.fill_joint_states()
    arrays.goals.position[:] = arrays.states.position
    for index in range(len(plan().mechanics.couplings)):
        arrays.anchor(index)
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position == pytest.approx(found, abs=1e-12)
    for share, apart in ((0.25, 0.03), (0.25, 0.02), (0.6, 0.0)):
        arrays.fade(share)
        arrays.fill_servo_goals()
        first, second = arrays.servo_goals.position[list(hip)]
        assert (second - first, first + second) == pytest.approx((apart, 0.44))
    assert arrays.servo_goals.position[[4, 5]] == pytest.approx([0.7, 0.3])


def test_only_the_coupling_that_is_anchored_takes_a_new_offset(
    arrays: CoupledJointArrays, plan: Callable[..., Plan]
) -> None:
    arrays.fill_joint_goals()
    arrays.servo_states.position[:] = [0.0, 0.20, 0.24, 0.0, 0.0, 0.0]
    arrays.fill_joint_states()
    couplings = plan().mechanics.couplings
    other = next(index for index, one in enumerate(couplings) if HIP not in one.joints)
    arrays.goals.position[:] = arrays.states.position
    arrays.anchor(other)
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[1:3] == pytest.approx([0.22, 0.22])


def test_servo_that_was_never_read_is_anchored_without_an_offset(arrays: CoupledJointArrays) -> None:
    arrays.servo_states.position[1:3] = math.nan
    arrays.fill_joint_states()
    for index in range(2):
        arrays.anchor(index)
    arrays.goals.position[:] = 0.1
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[1:3] == pytest.approx([0.1, 0.1])


def test_wrist_that_was_limp_at_the_start_gets_the_goal_of_its_joints(arrays: CoupledJointArrays) -> None:
    arrays.servo_goals.position[:] = [0.1, 0.2, 0.2, 0.0, math.nan, math.nan]
    arrays.fill_joint_goals()
    assert np.isnan(arrays.goals.position[[PITCH, ROLL]]).all()
    arrays.goals.position[[PITCH, ROLL]] = 0.5, 0.2
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[4:6] == pytest.approx([0.7, 0.3])


def test_three_servos_on_one_joint_disagree_by_the_largest_difference() -> None:
    third = 1 / 3
    coupling = CouplingPlan(
        "waist", (0,), (0, 1, 2), ((third,) * 3,), ((1.0,),) * 3, tolerance=0.05
    )  # fmt: skip
    plan = MechanicsPlan((coupling,), (), ("waist/1", "waist/2", "waist/3"))
    arrays = CoupledJointArrays(plan, States.empty(1), Commands.empty(1))
    arrays.servo_states.position[:], arrays.servo_states.valid[:] = (0.3, 0.3, 0.36), True
    arrays.fill_joint_states()
    assert arrays.states.position[0] == pytest.approx(0.32)
    assert np.ptp(arrays.residual) == pytest.approx(0.06)
