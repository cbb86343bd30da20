import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.dynamixel import protocol1
from dxlrun.dynamixel.goal_arrays import GoalArrays
from dxlrun.dynamixel.state_arrays import StateArrays
from dxlrun.dynamixel.units import goal_ticks, joint_position, speed_ticks
from dxlrun.interfaces import Commands, States

angles = st.floats(-10, 10) | st.just(float("nan"))
speeds = st.floats(-100, 100) | st.sampled_from([float("nan"), 0.0, -0.0])


@given(
    positions=st.lists(angles, min_size=8, max_size=8), velocities=st.lists(speeds, min_size=8, max_size=8)
)
@settings(max_examples=100, deadline=None)
def test_the_sync_write_is_what_the_units_of_one_servo_say(plan8, positions, velocities):
    goals = Commands(np.array(positions), np.array(velocities), np.full(8, np.nan), np.full(8, np.nan))
    included = np.array([True, False] + [True] * 6)
    packets = GoalArrays(plan8).packets(goals, included)
    expected = {
        servo.servo_id: goal_ticks(servo, positions[servo.row]).to_bytes(2, "little")
        + speed_ticks(servo, velocities[servo.row]).to_bytes(2, "little")
        for index, servo in enumerate(plan8.servos)
        if included[index] and positions[servo.row] == positions[servo.row]
    }
    assert packets == ([protocol1.sync_write(30, 4, expected)] if expected else [])


@pytest.fixture(scope="module")
def plan8(module_plan):
    return module_plan


def test_a_smaller_packet_after_a_bigger_one_is_whole(plan8):
    arrays, goals = GoalArrays(plan8), Commands(np.zeros(8), np.ones(8), np.zeros(8), np.zeros(8))
    (everybody,) = arrays.packets(goals, np.ones(8, dtype=bool))
    (one,) = arrays.packets(goals, np.arange(8) == 7)
    goals.position[:] = 0.1
    arrays.packets(goals, np.ones(8, dtype=bool))
    goals.position[:] = 0.0
    (again,) = arrays.packets(goals, np.ones(8, dtype=bool))
    assert protocol1.parse_status(one).parameters[:3] == bytes((30, 4, 21))
    assert len(one) == 13
    assert again == everybody


def test_signs_follow_the_joints_direction(plan8):
    arrays, states = StateArrays(plan8), States.empty(8)
    for reply in arrays.replies:
        # 512; counter-clockwise 100; clockwise 200
        reply[:] = bytes.fromhex("00 02 64 00 c8 04")
    fresh, arrived = np.ones(8, dtype=bool), np.full(8, 70)
    arrays.decode(states, fresh, arrived, 100)
    servo = plan8.servos[0]
    direction = np.array([s.direction for s in plan8.servos])
    assert states.position == pytest.approx([joint_position(s, 512) for s in plan8.servos])
    assert states.velocity == pytest.approx(direction * 100 * servo.rad_s_per_tick)
    assert states.effort == pytest.approx(direction * -200 / 1023)
    assert states.age_ns.tolist() == [30] * 8


def test_a_lost_row_keeps_its_own_values_and_ages(plan8):
    arrays, states = StateArrays(plan8), States.empty(8)
    everybody = np.ones(8, dtype=bool)
    for number, reply in enumerate(arrays.replies):
        reply[:] = (100 + number).to_bytes(2, "little") + bytes(4)
    arrays.decode(states, np.arange(8) != 3, np.full(8, 10), 10)
    assert np.isnan(states.position[3])
    assert states.age_ns[3] == -1
    arrays.decode(states, everybody, np.full(8, 20), 20)
    kept = states.position.copy()
    for reply in arrays.replies:
        reply[:] = bytes(6)
    arrays.decode(states, np.arange(8) != 5, np.full(8, 30), 30)
    assert states.position[5] == kept[5]
    assert not states.valid[5]
    assert states.age_ns[5] == 10
    assert (states.position != kept).sum() == 7
