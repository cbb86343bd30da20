import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.rigs import make_plan, position_tick, speed_tick

from dxlrun.channels.cycle import Commands
from dxlrun.dynamixel.exchange.goals import GoalArrays
from dxlrun.dynamixel.wire import protocol1

PLAN8 = make_plan()

angles = st.floats(-10, 10) | st.just(float("nan"))
speeds = st.floats(-100, 100) | st.sampled_from([float("nan"), 0.0, -0.0])


@given(
    positions=st.lists(angles, min_size=8, max_size=8), velocities=st.lists(speeds, min_size=8, max_size=8)
)
@settings(max_examples=100, deadline=None)
def test_the_sync_write_is_what_the_units_of_one_servo_say(positions, velocities):
    goals = Commands(np.array([positions, velocities, [np.nan] * 8, [np.nan] * 8]))
    included = np.array([True, False] + [True] * 6)
    packets = list(GoalArrays(PLAN8).packets(goals, included))
    expected = {
        servo.servo_id: position_tick(servo, positions[servo.row]).to_bytes(2, "little")
        + speed_tick(servo, velocities[servo.row]).to_bytes(2, "little")
        for index, servo in enumerate(PLAN8.servos)
        if included[index] and positions[servo.row] == positions[servo.row]
    }
    assert packets == ([protocol1.sync_write(30, 4, expected)] if expected else [])


def test_a_smaller_packet_after_a_bigger_one_is_whole():
    arrays, goals = GoalArrays(PLAN8), Commands(np.array([[0.0] * 8, [1.0] * 8, [0.0] * 8, [0.0] * 8]))
    (everybody,) = arrays.packets(goals, np.ones(8, dtype=bool))
    (one,) = arrays.packets(goals, np.arange(8) == 7)
    goals.position[:] = 0.1
    list(arrays.packets(goals, np.ones(8, dtype=bool)))
    goals.position[:] = 0.0
    (again,) = arrays.packets(goals, np.ones(8, dtype=bool))
    assert protocol1.parse_status(one).parameters[:3] == bytes((30, 4, 21))
    assert len(one) == 13
    assert again == everybody
