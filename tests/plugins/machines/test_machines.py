"""Bases, grippers and followers against closed forms; single cases are in `scripts`."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun_controllers.diff_drive_controller import AngularLimits, DiffDriveController, LinearLimits, Ramp
from dxlrun_controllers.gripper_controller import GripperController
from dxlrun_controllers.leader_follower import LeaderFollower

SEPARATION, RADIUS = 0.16, 0.033
BASE = {"left": ["l"], "right": ["r"], "separation": "160 mm", "radius": "33 mm"}
SMOOTH = {
    "linear": {"velocity": "0.3 m/s", "acceleration": "0.5 m/s^2"},
    "angular": {"velocity": "2 rad/s", "acceleration": "4 rad/s^2"},
}


def twist(robot, parameters=BASE):
    """The twist that was commanded, by the textbook's inverse of the kinematics."""
    left, right = np.split(robot.commands.velocity, 2)
    left, right = left.mean() * RADIUS, right.mean() * RADIUS
    return (left + right) / 2, (right - left) / SEPARATION


def base(parameters=BASE, **options):
    return standing(DiffDriveController, parameters, **options).activate()


def on_arc(way, angle):
    """Closed form: a point that moves `way` along a circle and turns by `angle`, from the origin along x."""
    if abs(angle) < 1e-12:
        return way, way * angle / 2
    r = way / angle
    return r * math.sin(angle), r * 2.0 * math.sin(angle / 2) ** 2


@settings(max_examples=100, deadline=None)
@given(
    asked=st.lists(
        st.tuples(st.floats(-1, 1), st.floats(-10, 10), st.integers(1, 40)), min_size=1, max_size=6
    )
)
def test_at_the_wheels_limit_it_keeps_its_curve_and_its_ramps(asked):
    robot = base(BASE | SMOOTH, limits={"velocity": 6.0})
    before = (0.0, 0.0)
    for linear, angular, steps in asked:
        robot.give("velocity", linear=linear, angular=angular)
        for _ in range(steps):
            robot.step()
            assert np.abs(robot.commands.velocity).max() <= 6.0 * (1 + 1e-9)
            now = twist(robot)
            assert abs(now[0] - before[0]) <= 0.5 * 0.02 * (1 + 1e-6)
            assert abs(now[1] - before[1]) <= 4.0 * 0.02 * (1 + 1e-6)
            before = now
    robot.give("velocity", linear=0.3, angular=2.0)  # 10.3 and ... rad/s: more than the wheels may
    for _ in range(300):
        robot.controller.on_command("velocity", np.array([0.3, 2.0]), robot.time_ns)
        robot.step()
    now = twist(robot)
    np.testing.assert_allclose(np.abs(robot.commands.velocity).max(), 6.0)
    np.testing.assert_allclose(now[0] / now[1], 0.3 / 2.0)


LIMITS = st.one_of(st.none(), st.floats(0.1, 10))


@settings(max_examples=200, deadline=None)
@given(
    acceleration=st.floats(0.1, 10),
    deceleration=LIMITS,
    jerk=st.one_of(st.none(), st.floats(0.5, 100)),
    targets=st.lists(st.tuples(st.floats(-2, 2), st.integers(1, 60)), min_size=1, max_size=5),
    dt=st.sampled_from([0.001, 0.01, 0.02]),
)
def test_a_ramp_keeps_its_limits_and_arrives(acceleration, deceleration, jerk, targets, dt):
    ramp = Ramp(LinearLimits.model_construct(acceleration=acceleration, deceleration=deceleration, jerk=jerk))
    sink = deceleration or acceleration
    velocity, slope = 0.0, 0.0
    for target, steps in [*targets, (0.7, round(60 / dt))]:
        for _ in range(steps):
            ramp.set_velocity(ramp.next(target, dt), dt)
            now = (ramp.velocity - velocity) / dt
            tolerance = 1e-7 + (
                0 if jerk is None else jerk * dt
            )  # it comes back from the other limit by jerk
            limit = max(acceleration, sink)
            assert abs(now) <= limit + tolerance
            if jerk is not None:
                assert abs(now - slope) <= jerk * dt + 1e-6
            velocity, slope = ramp.velocity, now
            if steps > 100 and abs(velocity - 0.7) < 1e-12 and abs(slope) < 1e-9:
                break
    assert velocity == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize(
    ("target", "acceleration", "jerk"), [(1.0, 0.5, 2.0), (0.2, 2.0, 3.0), (1.0, 0.7, None)]
)
def test_a_ramp_takes_the_time_of_the_closed_form_and_does_not_overshoot(target, acceleration, jerk):
    """Biagiotti and Melchiorri (2008), section 3.4: v/a + a/j, or 2 sqrt(v/j) where a is not reached."""
    if jerk is None:
        wanted = target / acceleration
    elif target >= acceleration**2 / jerk:
        wanted = target / acceleration + acceleration / jerk
    else:
        wanted = 2 * math.sqrt(target / jerk)
    ramp = Ramp(LinearLimits.model_construct(acceleration=acceleration, jerk=jerk))
    dt, speeds = 0.01, []
    while not speeds or speeds[-1] < target - 1e-12:
        ramp.set_velocity(ramp.next(target, dt), dt)
        speeds.append(ramp.velocity)
    assert max(speeds) <= target * (1 + 1e-12)
    assert len(speeds) * dt == pytest.approx(wanted, abs=2.01 * dt)


def test_through_zero_a_ramp_brakes_with_one_limit_and_accelerates_with_the_other():
    ramp = Ramp(AngularLimits.model_construct(acceleration=1.0, deceleration=4.0))
    ramp.velocity = 0.2
    speeds = []
    for _ in range(30):
        ramp.set_velocity(ramp.next(-0.2, 0.02), 0.02)
        speeds.append(ramp.velocity)
    expected = [max(-0.2, 0.2 - 4 * t if t < 0.05 else -(t - 0.05)) for t in 0.02 * np.arange(1, 31)]
    np.testing.assert_allclose(speeds, expected, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(
    arcs=st.lists(
        st.tuples(
            st.floats(-0.5, 0.5),
            st.one_of(st.just(0.0), st.floats(-1e-3, 1e-3), st.floats(-3, 3)),
            st.integers(1, 40),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_odometry_is_the_exact_arc_of_exact_wheel_angles(arcs):
    """Each arc is one closed form, however many cycles it takes."""
    robot = base(BASE, limits={"velocity": 50.0})
    robot.step()
    position, pose = np.zeros(2), np.zeros(3)
    for way, angle, cycles in arcs:
        across = angle * SEPARATION / 2
        wheels = np.array([way - across, way + across]) / RADIUS
        steps = max(cycles, math.ceil(np.abs(wheels).max() / 2.5))  # less than half a turn in a cycle
        for n in range(1, steps + 1):
            robot.states.position[:] = position + wheels * n / steps
            robot.step()
        position += wheels
        x, y = on_arc(way, angle)
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        pose += [cos * x - sin * y, sin * x + cos * y, angle]
    found = robot.controller._pose
    np.testing.assert_allclose([found.x, found.y, found.heading], pose, rtol=0, atol=1e-9)


def test_a_position_that_begins_anew_after_a_turn_is_followed():
    robot = base(BASE, limits={"velocity": 6.0})
    angle = 0.0
    for _ in range(400):
        angle += 5.0 * 0.02
        robot.states.position[:] = [angle % math.tau, -math.tau + angle % math.tau]
        robot.step()
    np.testing.assert_allclose(robot.controller._pose.x, 399 * 5.0 * 0.02 * RADIUS)
    np.testing.assert_allclose([robot.controller._pose.y, robot.controller._pose.heading], 0.0, atol=1e-9)


@pytest.mark.parametrize("source", ["velocity", "command"])
def test_odometry_of_velocities_is_the_arc_too(source):
    robot = base(BASE | {"odometry": source})
    if source == "velocity":
        robot.states.position[:] = np.nan  # an AX-12 in wheel mode has none between 300 and 360 deg
    robot.give("velocity", linear=0.2, angular=0.5)
    for _ in range(100):
        robot.give("velocity", linear=0.2, angular=0.5)
        robot.step()
        robot.states.velocity[:] = robot.commands.velocity
    x, y = on_arc(0.2 * 99 * 0.02, 0.5 * 99 * 0.02)
    found = robot.controller._pose
    np.testing.assert_allclose([found.x, found.y, found.heading], [x, y, 0.99], atol=1e-9)


GRIPPER = {"joint": "gripper", "effort": 0.4, "speed": "2 rad/s"}


def test_progress_never_decreases():
    robot = standing(GripperController, GRIPPER).activate()
    goal = robot.ask("grip", position=-0.6)
    for _ in range(40):
        robot.states.position[0] = max(-0.6, robot.states.position[0] - 0.04)
        robot.step()
    assert len(goal.steps) > 3
    assert goal.steps == sorted(goal.steps)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), lost=st.floats(0, 0.4))
def test_an_object_is_felt_under_noise_and_lost_replies(seed, lost):
    robot = standing(GripperController, GRIPPER).activate()
    goal, noise = robot.ask("grip", position=0.6), np.random.default_rng(seed)
    for _ in range(60):
        robot.states.position[0] = min(robot.time_ns * 2e-9, 0.3) + 0.0015 * noise.integers(-1, 2)
        robot.states.velocity[0] = noise.normal(scale=0.2)  # four times the speed of a stall
        robot.states.valid[0] = noise.random() >= lost
        robot.step()
        if goal.outcome is not None:
            break
    assert goal.text.startswith("stalled, holds something at ")
    assert 0.33 <= robot.time_ns * 1e-9 <= 0.65


@settings(max_examples=100, deadline=None)
@given(width=st.floats(0.02, 0.078), shrinking=st.booleans())
def test_a_width_is_the_inverse_of_its_angle(width, shrinking):
    sign = -1 if shrinking else 1
    points = ((-1.0, 0.02), (0.1, 0.03), (0.4, 0.078))
    table = [{"angle": f"{sign * angle} rad", "width": f"{wide} m"} for angle, wide in points]
    robot = standing(GripperController, GRIPPER | {"widths": table})
    angle, effort = robot.prepare("grip", width=width)
    assert robot.controller._width(angle) == pytest.approx(width, abs=1e-12)
    assert effort == 0.4


TWO = {
    "pairs": [
        {"joint": "f", "leader": "l", "scale": -0.5, "offset": "0.2 rad"},
        {"joint": "g", "leader": "m"},
    ]
}


@settings(max_examples=50, deadline=None)
@given(path=st.lists(st.floats(-3, 3), min_size=2, max_size=60))
def test_in_step_a_command_is_made_of_the_state_of_its_own_cycle(path):
    robot = standing(LeaderFollower, TWO).activate()
    followed = 0
    for position in [0.4, *path]:
        robot.context.reads[:] = position, 0.1, 0.0, 0.0, 0.0, 0.0
        robot.step()
        if robot.controller._in_step.all():
            np.testing.assert_allclose(robot.commands.position, [-0.5 * position + 0.2, 0.1])
            followed += 1
    assert followed >= len(path) - 5
