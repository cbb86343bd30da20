"""The trajectories inside simulated servos, against the manual's trapezoids worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlsim.motion.control_law import ServoCommand
from dxlsim.motion.mechanics import STEP_NS, Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.simulation_plan import NO_LOAD

MOTOR = Motor(stall_torque=2.0, damping=1 / 3, torque_per_ampere=2.0, voltage=12.0, inertia=0.003)
DT = 0.002


def profile(command: ServoCommand, start: float = 0.0) -> Mechanics:
    """A servo with a command, whose torque nobody asks for."""
    mechanics = Mechanics(0)
    mechanics.add_servo(MOTOR, NO_LOAD, start)
    mechanics.command_servo(0, command._replace(limit=1.0))
    return mechanics


def run(mechanics: Mechanics, seconds: float) -> list[tuple[float, float]]:
    """Return setpoint and its velocity after each step."""
    seen = []
    for _ in range(round(seconds / DT)):
        mechanics.step_to(mechanics.grid_ns + STEP_NS)
        seen.append(mechanics.servos[["setpoint", "setpoint_velocity"]][0].item())
    return seen


@settings(max_examples=25, deadline=None)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(1, 10), st.floats(5, 200))
def test_from_rest_it_reaches_the_goal_within_its_bounds_and_never_passes_it(
    start, goal, speed, acceleration
):
    mechanics = profile(ServoCommand(goal=goal, speed=speed, acceleration=acceleration), start)
    distance = abs(goal - start)
    seen = run(
        mechanics, distance / speed + speed / acceleration + 2 * (distance / acceleration) ** 0.5 + 0.1
    )
    low, high = min(start, goal) - 1e-9, max(start, goal) + 1e-9
    assert all(low <= position <= high for position, _ in seen)
    assert max(abs(velocity) for _, velocity in seen) <= speed + 1e-9
    steps = np.abs(np.diff([0.0, *(velocity for _, velocity in seen)]))
    assert steps.max() <= acceleration * DT + 1e-9
    assert seen[-1] == pytest.approx((goal, 0.0), abs=1e-9)


def test_a_long_way_takes_the_time_of_a_trapezoid():
    # 0.2 s up to 2 rad/s, 0.2 s down, 0.4 rad in both: 2.6 rad at 2 rad/s between
    seen = run(profile(ServoCommand(goal=3.0, speed=2.0, acceleration=10.0)), 2.0)
    arrived = next(index for index, (position, _) in enumerate(seen) if position > 3.0 - 1e-6)
    assert arrived * DT == pytest.approx(0.2 + 1.3 + 0.2, abs=3 * DT)
    assert seen[round(0.85 / DT)] == pytest.approx((1.5, 2.0), abs=2 * 2.0 * DT)


def test_without_acceleration_it_is_a_rectangle_and_without_speed_a_step():
    assert run(profile(ServoCommand(goal=1.0, speed=2.0)), 0.3)[-1] == pytest.approx((0.6, 2.0))
    assert run(profile(ServoCommand(goal=1.0)), DT)[0][0] == pytest.approx(1.0)


def test_another_goal_on_the_way_is_taken_up_with_the_velocity_that_it_has():
    mechanics = profile(ServoCommand(goal=3.0, speed=2.0, acceleration=10.0))
    before = run(mechanics, 0.5)[-1]
    mechanics.aim(0, -1.0, 2.0, 10.0)
    after = run(mechanics, 3.0)
    assert after[0][1] == pytest.approx(before[1] - 10.0 * DT)
    assert max(position for position, _ in after) == pytest.approx(before[0] + 2.0**2 / 20, abs=0.01)
    assert after[-1][0] == pytest.approx(-1.0)


def test_turning_continues_for_ever_and_never_arrives():
    mechanics = profile(ServoCommand(speed=-2.0, acceleration=10.0, turning=1.0))
    seen = run(mechanics, 1.2)
    assert seen[round(0.1 / DT) - 1][1] == pytest.approx(-1.0)
    assert seen[-1] == pytest.approx((-0.2 - 2.0, -2.0), abs=0.01)
    assert not mechanics.still


def test_it_arrives_exactly_and_then_costs_nothing():
    mechanics = profile(ServoCommand(goal=0.1 + 0.2, speed=1.0, acceleration=7.0))
    assert run(mechanics, 1.0)[-1] == (0.1 + 0.2, 0.0)
    assert mechanics.still
