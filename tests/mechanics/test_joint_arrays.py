"""States and goals between servos and joints, and what moves them in the plan and in its simulation."""

import math
from itertools import pairwise

import numpy as np
import pytest

from dxlrun.channels.cycle import Commands, States, Torque
from dxlrun.compile.simulation import simulation_of
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlwire.modes import Mode

HEAD, HIP, GRIPPER, PITCH, ROLL = range(5)
FIRST, SECOND, LEFT, RIGHT = 1, 2, 4, 5  # servos of the hip, and of the wrist
BOTH, WRIST = [FIRST, SECOND], [LEFT, RIGHT]


@pytest.fixture
def arrays(plan):
    """The arrays of the robot, with all servos at 0, valid, with torque, in position control."""
    found = CoupledJointArrays(plan().mechanics, States.empty(5), Commands.empty(5))
    states = found.servo_states
    states.motion[:], states.valid[:], states.age_ns[:] = 0.0, True, 1_000
    states.torque[:], states.mode[:] = Torque.ON, Mode.POSITION
    return found


def test_random_goals_come_back_as_states(arrays):
    random = np.random.default_rng(7)
    for _ in range(200):
        goal = random.uniform(-1, 1, 5)
        arrays.goals.position[:] = goal
        arrays.fill_servo_goals()
        arrays.servo_states.position[:] = arrays.servo_states.velocity[:] = arrays.servo_goals.position
        arrays.fill_joint_states()
        assert arrays.states.position == pytest.approx(goal, abs=1e-12)
        assert arrays.states.velocity == pytest.approx(goal, abs=1e-12)
        assert np.abs(arrays.residual).max() < 1e-12


def test_power_is_the_same_on_both_sides(arrays):
    random, servos, states = np.random.default_rng(3), arrays.servo_states, arrays.states
    servos.velocity[:], servos.effort[:] = random.normal(size=6), random.normal(size=6)
    servos.velocity[SECOND] = servos.velocity[FIRST]  # they turn at one speed
    arrays.fill_joint_states()
    assert np.dot(states.velocity, states.effort) == pytest.approx(np.dot(servos.velocity, servos.effort))


def test_a_joint_is_valid_where_all_its_servos_are_and_keeps_its_values(arrays):
    arrays.fill_joint_states()
    arrays.servo_states.position[:] = 1.0
    arrays.servo_states.valid[SECOND], arrays.servo_states.age_ns[SECOND] = False, 70_000
    arrays.fill_joint_states()
    assert arrays.states.valid.tolist() == [True, False, True, True, True]
    assert arrays.states.position[[HEAD, HIP]].tolist() == [1.0, 0.0]
    assert arrays.states.age_ns[HIP] == 70_000
    arrays.servo_states.age_ns[FIRST] = -1
    arrays.fill_joint_states()
    assert arrays.states.age_ns[HIP] == -1


def test_a_joint_has_the_highest_temperature_the_lowest_voltage_and_all_errors(arrays):
    states, found = arrays.servo_states, arrays.states
    states.temperature[BOTH], states.voltage[BOTH], states.hardware_error[BOTH] = (
        (40, 60),
        (12, 11.5),
        (4, 0x20),
    )
    arrays.fill_joint_states()
    assert (found.temperature[HIP], found.voltage[HIP], found.hardware_error[HIP]) == (60, 11.5, 0x24)


def test_of_two_torques_a_joint_has_the_worse(arrays):
    order = [Torque[name] for name in ("ON", "DOUBT", "RELEASED", "OFF", "REBOOTING", "LOST", "UNKNOWN")]
    for better, worse in pairwise(order):
        for torques in ((better, worse), (worse, better)):
            arrays.servo_states.torque[BOTH] = torques
            arrays.fill_joint_states()
            assert (arrays.states.torque[HIP], arrays.states.torque[PITCH]) == (worse, Torque.ON)


def test_a_joint_has_the_mode_that_all_its_servos_have(arrays):
    arrays.servo_states.mode[FIRST] = Mode.VELOCITY
    arrays.fill_joint_states()
    assert arrays.states.mode.tolist() == [Mode.POSITION, Mode.UNKNOWN, *[Mode.POSITION] * 3]


@pytest.mark.parametrize(
    ("pitch", "roll", "both"),
    [
        (Mode.EFFORT, Mode.EFFORT, Mode.EFFORT),
        (Mode.EFFORT, Mode.VELOCITY, Mode.UNKNOWN),  # two modes for one wrist: neither
        (Mode.EFFORT, Mode.UNKNOWN, Mode.UNKNOWN),  # roll stays in position control, so pitch does too
    ],
)
def test_servos_of_a_wrist_change_their_mode_together(arrays, pitch, roll, both):
    asked = np.array([0, Mode.VELOCITY, 0, pitch, roll], dtype=np.uint8)
    found = arrays.joint_requests(asked)
    assert ({*found[BOTH]}, {*found[WRIST]}) == ({Mode.VELOCITY}, {both})


def test_a_joint_without_a_goal_leaves_its_servos_without(arrays):
    arrays.goals.position[:] = [0.1, np.nan, 0.1, 0.1, np.nan]
    arrays.fill_servo_goals()
    assert np.isnan(arrays.servo_goals.position).tolist() == [False, True, True, False, True, True]


@pytest.mark.parametrize(
    ("mode", "goal", "hip", "wrist"),
    [
        (Mode.VELOCITY, [0, -2.0, 0, -1.0, 0.5], [-2.0, -2.0], [-0.5, -1.5]),
        (Mode.EFFORT, [0, -0.8, 0, -0.4, 0.2], [-0.4, -0.4], [-0.1, -0.3]),  # each half of it
        # of a difference of the two the right one would have a quarter of what its joints may take
        (Mode.EFFORT_POSITION, [0.5, -0.8, 0.5, 0.6, -0.2], [0.4, 0.4], [0.4, 0.4]),
    ],
)
def test_velocities_and_efforts_have_their_signs_and_the_most_effort_is_a_magnitude(
    arrays, mode, goal, hip, wrist
):
    kind = "velocity" if mode is Mode.VELOCITY else "effort"
    arrays.servo_states.mode[:], arrays.goals.position[:] = mode, 0.1
    getattr(arrays.goals, kind)[:] = goal
    arrays.fill_servo_goals()
    found = getattr(arrays.servo_goals, kind)
    assert (found[BOTH].tolist(), found[WRIST]) == (pytest.approx(hip), pytest.approx(wrist))


def command_wrist(arrays, position, velocity):
    """Give pitch and roll goals and speeds; return the speeds of their servos."""
    arrays.goals.position[[PITCH, ROLL]] = position
    arrays.goals.velocity[[PITCH, ROLL]] = velocity
    arrays.fill_servo_goals()
    return arrays.servo_goals.velocity[WRIST].tolist()


def test_servos_of_a_wrist_arrive_together_at_the_speed_of_its_slowest_joint(arrays):
    arrays.fill_joint_states()
    arrays.goals.position[HIP], arrays.goals.velocity[HIP] = 0.5, 1.5
    # roll needs 0.2 / 0.25 = 0.8 s, pitch could in 0.4 s; the servos go 0.6 and 0.2 rad in 0.8 s
    speeds = command_wrist(arrays, (0.4, 0.2), (1.0, 0.25))
    assert speeds == pytest.approx((0.75, 0.25))
    assert arrays.servo_goals.velocity[BOTH].tolist() == [1.5, 1.5]
    arrays.servo_states.position[WRIST] = 0.3, 0.1
    arrays.fill_joint_states()
    # nothing new is asked for: the speeds stay, and cost no time on the wire
    assert command_wrist(arrays, (0.4, 0.2), (1.0, 0.25)) == speeds
    # pitch goes as fast as roll lets it, whose limit counts still
    assert np.isfinite(command_wrist(arrays, (0.4, 0.2), (math.nan, 0.25))).all()
    # as fast as the servos can
    assert np.isnan(command_wrist(arrays, (0.4, 0.2), math.nan)).all()


@pytest.mark.parametrize("pitch", [-0.8, 0.8])
@pytest.mark.parametrize("roll", [-0.05, 0.05])
def test_the_slowest_joint_of_a_wrist_decides_its_speed_in_either_direction(arrays, pitch, roll):
    arrays.fill_joint_states()
    expected = abs(pitch + roll) / 0.8, abs(pitch - roll) / 0.8  # pitch takes 0.8 s
    assert command_wrist(arrays, (pitch, roll), (1.0, 0.25)) == pytest.approx(expected)


def test_a_servo_of_a_wrist_that_need_not_move_is_slow_and_not_as_fast_as_it_can(arrays):
    arrays.fill_joint_states()
    assert command_wrist(arrays, 0.3, 1.0) == pytest.approx((2.0, 0.05 * 2.0))  # 0 would be no limit


def faded(arrays, share):
    """Bring servos together by a share; return where those of the hip go."""
    arrays.fade(share)
    arrays.fill_servo_goals()
    return arrays.servo_goals.position[BOTH].tolist()


PLACES = [0.1, 0.20, 0.24, 0.01, 0.7, 0.3]


def test_nothing_moves_at_the_start_and_servos_that_disagree_a_little_are_brought_together(arrays):
    arrays.servo_goals.position[:] = PLACES
    arrays.fill_joint_goals()
    assert arrays.goals.position == pytest.approx([0.1, 0.22, 0.01, 0.5, 0.2])
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position == pytest.approx(PLACES, abs=1e-12)
    assert faded(arrays, 0.5) == pytest.approx([0.21, 0.23])
    assert faded(arrays, 0.6) == pytest.approx([0.22, 0.22])


def test_servos_that_are_anchored_where_they_disagree_do_not_move_before_they_are_brought_together(
    arrays, plan
):
    arrays.servo_goals.position[:] = 0.0
    arrays.fill_joint_goals()
    arrays.fade(1.0)
    arrays.servo_states.position[:] = PLACES
    arrays.fill_joint_states()
    arrays.goals.position[:] = arrays.states.position
    for index in range(len(plan().mechanics.couplings)):
        arrays.anchor(index)
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position == pytest.approx(PLACES, abs=1e-12)
    for share, hip in ((0.25, (0.205, 0.235)), (0.25, (0.21, 0.23)), (0.6, (0.22, 0.22))):
        assert faded(arrays, share) == pytest.approx(hip)
    assert arrays.servo_goals.position[WRIST] == pytest.approx([0.7, 0.3])


def test_only_the_coupling_that_is_anchored_takes_a_new_offset(arrays, plan):
    arrays.fill_joint_goals()
    arrays.servo_states.position[BOTH] = 0.20, 0.24
    arrays.fill_joint_states()
    arrays.goals.position[:] = arrays.states.position
    couplings = enumerate(plan().mechanics.couplings)
    arrays.anchor(next(index for index, one in couplings if HIP not in one.joints))
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[BOTH] == pytest.approx([0.22, 0.22])


def test_servo_that_was_never_read_is_anchored_without_an_offset(arrays):
    arrays.servo_states.position[BOTH] = math.nan
    arrays.fill_joint_states()
    for index in range(2):
        arrays.anchor(index)
    arrays.goals.position[:] = 0.1
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[BOTH] == pytest.approx([0.1, 0.1])


def test_wrist_that_was_limp_at_the_start_gets_the_goal_of_its_joints(arrays):
    arrays.servo_goals.position[:] = [0.1, 0.2, 0.2, 0.0, math.nan, math.nan]
    arrays.fill_joint_goals()
    assert np.isnan(arrays.goals.position[[PITCH, ROLL]]).all()
    arrays.goals.position[[PITCH, ROLL]] = 0.5, 0.2
    arrays.fill_servo_goals()
    assert arrays.servo_goals.position[WRIST] == pytest.approx([0.7, 0.3])


def test_three_servos_on_one_joint_disagree_by_the_largest_difference():
    coupling = CouplingPlan("waist", (0,), (0, 1, 2), ((1 / 3,) * 3,), ((1.0,),) * 3, tolerance=0.05)
    plan = MechanicsPlan((coupling,), (), ("waist/1", "waist/2", "waist/3"))
    arrays = CoupledJointArrays(plan, States.empty(1), Commands.empty(1))
    arrays.servo_states.position[:], arrays.servo_states.valid[:] = (0.3, 0.3, 0.36), True
    arrays.fill_joint_states()
    assert arrays.states.position[0] == pytest.approx(0.32)
    assert np.ptp(arrays.residual) == pytest.approx(0.06)


def test_every_servo_is_in_one_mechanism_and_every_joint_too(plan):
    compiled = plan()
    names = [joint.name for joint in compiled.loop.joints]
    found = compiled.mechanics.mechanisms(len(names))
    assert sorted(row for one in found for row in one.servos) == list(range(6))
    assert sorted(row for one in found for row in one.joints) == list(range(len(names)))
    own = {names[one.joints[0]]: (one.matrix, one.inverse) for one in found if one.own}
    assert own == dict.fromkeys(("head", "gripper"), (((1.0,),), ((1.0,),)))
    assert {one.name for one in found if not one.own} == {"hip", "wrist"}


def test_the_simulation_has_the_mechanisms_of_the_plan(plan):
    simulated = simulation_of(plan()).mechanisms
    assert [(one.joints, len(one.servos), one.is_single) for one in simulated] == [
        (("head",), 1, True),
        (("gripper",), 1, True),
        (("hip",), 2, False),
        (("pitch", "roll"), 2, False),
    ]


def test_servo_of_a_transmission_reaches_all_corners_of_its_joints(plan):
    (bus,) = plan().buses
    left, right = (servo for servo in bus.servos if servo.joint.startswith("wrist"))
    for servo in (left, right):
        ends = [(tick - 2048) * servo.rad_per_tick for tick in (servo.lower_tick, servo.upper_tick)]
        assert [round(math.degrees(end)) for end in ends] == [-105, 105], "45 deg of pitch and 60 of roll"
    (head,) = (servo for servo in bus.servos if servo.joint == "head")
    assert math.degrees((head.upper_tick - 2048) * head.rad_per_tick) == pytest.approx(80, abs=0.1)
