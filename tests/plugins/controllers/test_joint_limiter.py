"""joint_limiter: the least time by the closed form of the trapezoid, and never beyond a limit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import Stage

from dxlrun_controllers.joint_limiter import JointLimiter
from dxlrun_controllers.laws.limiting import Limiter

LIMITS = {"acceleration": "8 rad/s^2", "velocity": "2 rad/s"}
ONE = {"joints": ["a"], "limits": LIMITS}
TWO = {"joints": ["a", "b"], "limits": LIMITS}


def limiter(position=0.0, velocity=0.0, *, speed=2.0, acceleration=8.0, lower=-np.inf, upper=np.inf):
    law = Limiter(1)
    law.begin(np.array([position]))
    law.velocity[:] = velocity
    law.speed[:], law.acceleration[:], law.lower[:], law.upper[:] = speed, acceleration, lower, upper
    return law


def stepped(law, reference, period, rate=0.0):
    law.update(np.array([reference], dtype=float), np.array([rate], dtype=float), period)
    return float(law.position[0]), float(law.velocity[0])


def least_time(way, speed, acceleration):
    """Rest to rest: D / V + V / A, or 2 sqrt(D / A) where V is not reached."""
    if way >= speed**2 / acceleration:
        return way / speed + speed / acceleration
    return 2 * np.sqrt(way / acceleration)


@settings(max_examples=100, deadline=None)
@given(
    way=st.floats(-5, 5).filter(lambda way: abs(way) > 1e-3),
    speed=st.floats(0.2, 10),
    acceleration=st.floats(0.5, 50),
    share=st.floats(0.01, 0.99),
)
def test_from_rest_to_rest_it_is_the_trapezoid_of_least_time_to_the_digit(way, speed, acceleration, share):
    total = least_time(abs(way), speed, acceleration)
    law = limiter(0.3, speed=speed, acceleration=acceleration)
    t = share * total
    found = stepped(law, 0.3 + way, t)
    ramp = min(speed / acceleration, total / 2)
    peak, left = acceleration * ramp, total - t
    if t < ramp:
        expected = acceleration * t**2 / 2, acceleration * t
    elif left < ramp:
        expected = abs(way) - acceleration * left**2 / 2, acceleration * left
    else:
        expected = acceleration * ramp**2 / 2 + peak * (t - ramp), peak
    sign = np.sign(way)
    assert found == pytest.approx((0.3 + sign * expected[0], sign * expected[1]), abs=1e-9)
    assert stepped(law, 0.3 + way, left * (1 + 1e-9) + 1e-12) == (0.3 + way, 0.0)


@settings(max_examples=30, deadline=None)
@given(
    way=st.floats(-3, 3).filter(lambda way: abs(way) > 1e-3),
    periods=st.lists(st.floats(0.001, 0.05), min_size=1, max_size=20),
)
def test_however_long_its_periods_are_it_ends_exactly_at_the_target_after_the_least_time(way, periods):
    law, time, end = limiter(), 0.0, least_time(abs(way), 2.0, 8.0)
    while time + periods[0] < end - 1e-6:
        period = periods[0]
        periods.append(periods.pop(0))
        if time + period >= end - 1e-6:
            break
        assert stepped(law, way, period) != (way, 0.0)
        time += period
    for _ in range(3):
        assert stepped(law, way, end - time + 1e-6) == (way, 0.0)


@pytest.mark.parametrize("velocity", [-2.0, -0.5, 1.0, 2.0])
def test_it_turns_round_when_it_is_too_fast_to_stop_before_the_target(velocity):
    law, period = limiter(0.0, velocity), 0.001
    path = [(0.0, velocity)] + [stepped(law, 0.05, period) for _ in range(2000)]
    accelerations = np.diff([state[1] for state in path]) / period
    assert np.abs(accelerations).max() <= 8.0 * (1 + 1e-6)
    assert path[-1] == (0.05, 0.0)
    stop = velocity * abs(velocity) / 16
    side = max(state[0] for state in path) if stop > 0.05 else min(state[0] for state in path)
    assert side == pytest.approx(max(stop, 0.05) if stop > 0.05 else min(stop, 0.0), abs=1e-4)


@settings(max_examples=30, deadline=None)
@given(
    references=st.lists(
        st.tuples(st.floats(-4, 4), st.floats(-6, 6), st.integers(1, 30), st.floats(0.001, 0.05)),
        min_size=1,
        max_size=12,
    )
)
def test_whatever_is_asked_of_it_it_stays_within_all_its_limits(references):
    law = limiter(lower=-1.0, upper=1.5)
    position, velocity = 0.0, 0.0
    for reference, rate, count, period in references:
        for index in range(count):
            moved = reference + index * period * rate
            found = stepped(law, moved, period, rate)
            assert -1.0 - 1e-9 <= found[0] <= 1.5 + 1e-9
            assert abs(found[1]) <= 2.0 + 1e-9
            assert abs(found[1] - velocity) <= 8.0 * period * (1 + 1e-6) + 1e-9
            mean = (found[0] - position) / period
            assert min(velocity, found[1]) - 8 * period <= mean <= max(velocity, found[1]) + 8 * period
            position, velocity = found
    for _ in range(40):
        found = stepped(law, 9.0, 0.1)
    assert found == (1.5, 0.0)


def test_a_reference_within_the_limits_is_passed_on_as_it_is():
    """A sine with the highest acceleration and velocity that are allowed, from its turning point on."""
    frequency = 4.0
    amplitude = 8.0 / frequency**2 * 0.999
    law = limiter(-amplitude)
    for index in range(1, 1000):
        t = index * 0.004
        reference = -amplitude * np.cos(frequency * t), amplitude * frequency * np.sin(frequency * t)
        assert stepped(law, reference[0], 0.004, reference[1]) == reference


def test_a_moving_reference_is_caught_up_with():
    law = limiter()
    lag = [
        abs(stepped(law, 1.0 + 1.2 * index * 0.01, 0.01, 1.2)[0] - (1.0 + 1.2 * index * 0.01))
        for index in range(400)
    ]
    assert lag[0] > 0.9
    assert lag[-1] == pytest.approx(0.0, abs=1e-12)
    still = limiter()
    for index in range(400):
        found = stepped(still, 1.0 + 1.2 * index * 0.01, 0.01)
    behind = 1.0 + 1.2 * 3.99 - found[0]
    assert behind == pytest.approx(1.2**2 / 16, rel=0.15)  # it could stop there at any time


# The controller


def started(parameters=TWO, **options):
    return Stage(JointLimiter, parameters, **options).activate()


def test_it_holds_what_was_last_sent_and_goes_to_a_command_in_the_least_time():
    robot = started()
    np.testing.assert_array_equal(robot.update(0.0), [0.3, -0.2])
    robot.send(0.0, "positions", positions=[0.3, 0.8])
    time = 0
    while robot.commands.position[1] != 0.8:
        robot.update(time := time + 0.02)
    assert time == pytest.approx(least_time(1.0, 2.0, 8.0), abs=0.0201)
    np.testing.assert_array_equal(robot.update(time), [0.3, 0.8])


def test_references_go_before_commands_and_when_they_end_the_joint_comes_to_rest():
    robot = started(TWO | {"command_interface": "posvel"}, into=("lower",))
    robot.context.references.position[0] = 9.0
    for step in range(50):
        robot.update(step * 0.02)
    assert robot.commands.velocity[0] == 2.0
    robot.context.references.position[0] = np.nan
    at = robot.commands.position[0]
    for step in range(50):
        robot.update(1 + step * 0.02)
    assert robot.commands.position[0] == pytest.approx(at + 2.0**2 / 16)
    assert robot.commands.velocity.tolist() == [0.0, 0.0]
    assert robot.commands.position[1] == -0.2


def test_a_reference_beyond_a_limit_does_not_move_the_limit():
    law = limiter(1.4, upper=1.5)
    assert stepped(law, 1.52, 0.1, 1.0)[0] <= 1.5
    for _ in range(9):
        found = stepped(law, 1.7, 0.1, 1.0)
    assert found == (1.5, 0.0)
    assert stepped(law, 1.6, 0.1, -1.0) == (1.5, 0.0)  # it comes back, and is not there yet


def test_beside_a_servos_position_the_velocity_is_a_magnitude_and_the_highest_at_rest():
    robot = started(TWO | {"command_interface": "posvel"})
    robot.send(0.0, "positions", positions=[-1.7, -0.2])
    for step in range(25):
        robot.update(step * 0.02)
    assert robot.commands.velocity.tolist() == [2.0, 2.0]
    assert robot.controller._limiter.velocity.tolist() == [-2.0, 0.0]


def test_limits_of_the_joints_and_of_the_file_are_both_kept():
    limits = {"lower": -0.5, "upper": 0.4, "velocity": 1.0}
    written = {
        "acceleration": {"a": "8 rad/s^2", "b": "2 rad/s^2"},
        "velocity": "1.5 rad/s",
        "upper": {"b": "0.1 rad"},
    }
    robot = started(TWO | {"limits": written}, limits=limits)
    robot.send(0.0, "positions", positions=[9.0, 9.0])
    path = np.array([robot.update(step * 0.02) for step in range(150)])
    np.testing.assert_array_equal(path[-1], [0.4, 0.1])
    speed = np.abs(np.diff(path, axis=0)).max(axis=0) / 0.02
    assert speed[0] <= 1.0 + 1e-9
    assert speed[1] <= np.sqrt(2.0 * 0.3) + 1e-9


def test_a_joint_that_was_not_heard_begins_where_it_is_heard():
    robot = Stage(JointLimiter, TWO)
    robot.sent.position[1] = robot.states.position[1] = np.nan
    robot.activate()
    np.testing.assert_array_equal(robot.update(0.0, follow=False), [0.3, np.nan])
    robot.states.position[1] = 0.7
    np.testing.assert_array_equal(robot.update(0.02, follow=False), [0.3, 0.7])


def test_without_a_limit_of_the_acceleration_it_is_refused():
    with pytest.raises(ValueError, match="b has no limit of the acceleration: add limits"):
        Stage(JointLimiter, TWO | {"limits": {"acceleration": {"a": "8 rad/s^2"}}})


def test_the_acceleration_limit_of_the_joint_is_kept_too():
    assert JointLimiter.Parameters.model_validate({"joints": ["a", "b"]}).limits.acceleration is None
    for written, expected in (({}, [3.0, 3.0]), ({"limits": {"acceleration": "2 rad/s^2"}}, [2.0, 2.0])):
        robot = started({"joints": ["a", "b"], **written}, limits={"acceleration": 3.0})
        assert robot.controller._limiter.acceleration.tolist() == expected


def test_a_velocity_without_a_position_is_no_reference():
    robot = started()
    robot.context.references.velocity[:] = 1.0
    for step in range(5):
        np.testing.assert_array_equal(robot.update(step * 0.02), [0.3, -0.2])
