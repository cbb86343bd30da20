"""The last gate: whatever comes in, what goes out is finite, inside the limits and near the last goal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels.cycle import Clamp, CycleLayout, CycleRecord, Torque
from dxlrun.channels.events import EventCode
from dxlrun.control.gate import BACK_SPEED, Gate
from dxlrun.description.modes import Mode
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, LoopPlan, SchedulerPlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS

DT_NS = 20_000_000
DT = DT_NS * 1e-9


class Rig:
    def __init__(
        self, lower=-1.0, upper=1.0, velocity=None, *, start=0.0, joints=1, eased=True, top_speed=None
    ):
        names = tuple(f"j{row}" for row in range(joints))
        controllers = tuple(
            ControllerPlan(name, "t", "d 1", "{}", names, ("position",), (), True, 1) for name in ("a", "b")
        )
        plan = LoopPlan(
            DT_NS,
            SchedulerPlan("other", 31, False),
            tuple(JointPlan(name, lower, upper, velocity, top_speed=top_speed) for name in names),
            controllers,
            (),
            None,
        )
        self.record = CycleRecord(CycleLayout(names, ("a", "b")))
        self.record.states.mode[:] = Mode.POSITION
        self.record.active = 2
        self.record.goals.position[:] = start
        self.events = []
        self.gate = Gate(plan, self.record, self)
        if eased:
            self.wait(SLOW_START_NS)

    def emit(self, code, severity, source, text, data=b""):
        assert code == EventCode.GATE
        self.events.append((source, text))

    def wait(self, duration_ns):
        self.record.commands.position[:] = np.nan
        self.gate.apply(self.record.commands, self.record.goals, duration_ns)

    def apply(self, position, velocity=np.nan):
        self.record.commands.position[:] = position
        self.record.commands.velocity[:] = velocity
        self.gate.apply(self.record.commands, self.record.goals, DT_NS)
        return (
            self.record.goals.position[0],
            self.record.goals.velocity[0],
            Clamp(int(self.record.clamped[0])),
        )


@pytest.mark.parametrize("wanted", [np.inf, -np.inf])
def test_infinity_is_no_goal_of_a_joint_without_limits_that_follows_its_commands(wanted):
    rig = Rig(lower=-np.inf, upper=np.inf)
    for position in (0.5, 0.6):
        assert rig.apply(position)[0] == position
    assert rig.apply(wanted)[::2] == (0.6, Clamp.NOT_FINITE)


@pytest.mark.parametrize(("limit", "goal"), [(None, 8.0), (2.0, 2.0), (9.0, 8.0)])
def test_a_speed_above_the_servos_own_is_held_to_it_and_counted_also_without_a_limit(limit, goal):
    rig = Rig(velocity=limit, top_speed=8.0)
    assert rig.apply(0.001, velocity=1e300)[1:] == (goal, Clamp.VELOCITY)
    assert rig.gate.counts[0].sum() == 1
    assert rig.apply(0.001, velocity=goal)[1:] == (goal, 0)


def test_the_servos_own_speed_does_not_limit_the_step():
    rig = Rig(top_speed=8.0)
    assert rig.apply(1.0)[::2] == (1.0, 0)


any_float = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=150, deadline=None)
@given(
    limits=st.tuples(st.floats(-4, 0), st.floats(0.001, 4)),
    velocity=st.none() | st.floats(0.01, 20),
    start=st.floats(0, 1),
    commands=st.lists(st.tuples(any_float, any_float), min_size=1, max_size=12),
    eased=st.booleans(),
)
def test_goals_are_finite_inside_the_limits_and_near_the_last_goal(limits, velocity, start, commands, eased):
    lower, upper = limits
    last = min(max(lower + start * (upper - lower), lower), upper)
    rig = Rig(lower, upper, velocity, start=last, eased=eased)
    speed = min(velocity or np.inf, np.inf if eased else SLOW_SPEED)
    for position, wanted in commands:
        goal, goal_velocity, _ = rig.apply(position, wanted)
        assert lower <= goal <= upper
        assert abs(goal - last) <= speed * DT * (1 + 1e-9) + 1e-15
        assert np.isnan(goal_velocity) or 0 <= goal_velocity <= (velocity or np.inf)
        assert not np.isinf(goal_velocity)
        last = goal


@settings(max_examples=100, deadline=None)
@given(start=st.floats(-6, 6), commands=st.lists(any_float, min_size=1, max_size=12))
def test_a_goal_that_starts_outside_never_moves_further_out(start, commands):
    rig = Rig(start=start)
    outside = max(0.0, abs(start) - 1.0)
    for position in commands:
        goal, _, _ = rig.apply(position)
        assert abs(goal) - 1.0 <= outside
        outside = max(0.0, abs(goal) - 1.0)


@settings(max_examples=100, deadline=None)
@given(position=st.floats(-1, 1), velocity=st.floats(-5, 5) | st.just(np.nan))
def test_what_is_inside_all_limits_passes_unchanged(position, velocity):
    rig = Rig(velocity=None)
    goal, goal_velocity, clamped = rig.apply(position, velocity)
    assert (goal, clamped) == (position, Clamp(0))
    np.testing.assert_equal(goal_velocity, abs(velocity))
    assert rig.events == []


@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_hangs_outside_its_limits_may_be_held_there(side):
    rig = Rig(start=side * 1.2)
    assert rig.apply(side * 1.2) == (side * 1.2, BACK_SPEED, Clamp(0))
    assert rig.apply(side * 1.1)[0] == side * 1.1
    assert rig.apply(side * 1.2)[0] == side * 1.1
    assert rig.apply(side * 0.5)[0] == side * 0.5
    assert rig.apply(side * 1.1)[0] == side * 1.0


@pytest.mark.parametrize(
    ("command", "goal", "clamp", "words"),
    [
        ((-3.0, 0.5), (-1.0, 0.5), Clamp.LOWER, "raised to the lower position limit"),
        ((3.0, 0.5), (1.0, 0.5), Clamp.UPPER, "lowered to the upper position limit"),
        ((0.01, 9.0), (0.01, 200.0 / 25), Clamp.VELOCITY, "held to the velocity limit"),
        ((np.inf, 0.5), (0.0, SLOW_SPEED), Clamp.NOT_FINITE, "was not finite, the last goal is kept"),
        ((0.01, np.inf), (0.01, np.nan), Clamp.NOT_FINITE, "was not finite, the last goal is kept"),
    ],
)
def test_each_clamping_is_flagged_told_and_counted(command, goal, clamp, words):
    rig = Rig(velocity=8.0 if clamp == Clamp.VELOCITY else None)
    *found, flags = rig.apply(*command)
    np.testing.assert_allclose(found, goal)
    assert flags == clamp
    # what is not finite may be of a controller that another one stands in for now
    by = "" if clamp == Clamp.NOT_FINITE else ", controller b"
    assert rig.events == [("j0", f"j0{by}: {words}")]
    assert rig.gate.counts.sum() == 1


def test_a_step_beyond_the_velocity_limit_is_walked_in_steps():
    rig = Rig(velocity=2.0)
    goals = [rig.apply(0.1) for _ in range(4)]
    np.testing.assert_allclose([goal for goal, _, _ in goals], [0.04, 0.08, 0.1, 0.1])
    assert [flags for *_, flags in goals] == [Clamp.STEP, Clamp.STEP, Clamp(0), Clamp(0)]
    assert rig.events == [("j0", "j0, controller b: held to the step or acceleration limit")]


def test_each_beginning_of_a_clamping_is_told_once():
    rig = Rig()
    for position in (3.0, 3.0, 0.0, 3.0, -3.0):
        rig.apply(position)
    assert [text.split()[3] for _, text in rig.events] == ["lowered", "lowered", "raised"]
    assert rig.gate.counts[0].tolist() == [1, 3, 0, 0, 0, 0, 0, 0]


def test_the_first_second_is_slow_even_without_a_velocity_limit():
    rig = Rig(eased=False)
    for number in range(1, 51):
        goal, _, _ = rig.apply(1.0)
        np.testing.assert_allclose(goal, min(1.0, number * SLOW_SPEED * DT))
    rig = Rig(eased=False)
    rig.wait(SLOW_START_NS)
    assert rig.apply(1.0)[0] == 1.0
    rig.gate.ease_in()
    assert rig.apply(-1.0)[0] == pytest.approx(1.0 - SLOW_SPEED * DT)


def test_a_position_only_command_inherits_no_speed():
    rig = Rig()
    assert rig.apply(0.1, 0.5)[1] == 0.5
    assert np.isnan(rig.apply(0.2)[1])


def test_an_uncommanded_joint_keeps_position_and_speed():
    rig = Rig()
    rig.apply(0.1, 0.5)
    assert rig.apply(np.nan, 0.9) == (0.1, 0.5, Clamp(0))


def test_a_speed_that_was_commanded_before_any_position_comes_with_the_first_one():
    rig = Rig()
    assert rig.apply(np.nan, 0.5)[1] == SLOW_SPEED
    assert rig.apply(0.1, 0.5) == (0.1, 0.5, Clamp(0))


def test_the_step_limit_is_the_speed_toward_the_goal_too_where_it_holds_the_servo_back():
    """A servo takes a step as fast as it may, so at a low rate a step alone is no limit."""
    rig = Rig(velocity=2.0, top_speed=6.0)
    assert rig.apply(0.1)[1] == 2.0
    assert rig.apply(0.1, 0.5)[1] == 0.5
    assert rig.apply(0.1)[1] == 2.0
    rig = Rig(velocity=6.0, top_speed=6.0, eased=False)
    assert rig.apply(0.1)[1] == SLOW_SPEED
    assert rig.apply(0.1, 3.0)[1] == SLOW_SPEED
    rig.record.states.torque[:] = Torque.OFF
    rig.record.states.position[:] = 0.3
    assert np.isnan(rig.apply(0.1)[1]), "its goal is where it stands"
    rig = Rig(velocity=6.0, top_speed=6.0)
    assert np.isnan(rig.apply(0.1)[1])


def test_what_the_manager_found_not_finite_stays_flagged():
    rig = Rig(joints=2)
    rig.record.clamped[1] = Clamp.NOT_FINITE | Clamp.STEP
    rig.apply(np.nan)
    assert rig.record.clamped.tolist() == [0, Clamp.NOT_FINITE]


one_of_few = st.sampled_from([0.0, 0.05, 0.1, 0.3, 0.9, 1.0, 1.5, -2.0, np.nan, np.inf])


def goal_of_one(rig, last, command, speed):
    """Return goal, speed and flags of one joint; one outside of its limits is slow."""
    goal, toward, flags = led_goal_of_one(rig, last, command, speed)
    return goal, toward if -1.0 <= goal <= 1.0 else np.fmin(toward, BACK_SPEED), flags


def led_goal_of_one(rig, last, command, speed):
    """Return goal, speed and flags of one joint, step by step, as the gate's docstring has it."""
    lower, upper, velocity = rig.limits
    goal, last_speed = last
    flags = Clamp(0)
    ceiling = velocity if velocity is not None and velocity < rig.top_speed else np.nan
    last_speed = np.fmin(last_speed, ceiling)
    if np.isnan(command):
        return goal, last_speed, flags
    if np.isinf(command):
        return goal, last_speed, Clamp.NOT_FINITE
    low, high = min(lower, goal), max(upper, goal)
    flags |= Clamp.LOWER if command < low else Clamp.UPPER if command > high else Clamp(0)
    inside = min(max(command, low), high)
    step = (np.inf if velocity is None else velocity) * (DT_NS * 1e-9)
    if not goal - step <= inside <= goal + step:
        if velocity < rig.top_speed:  # a goal as fast as the servo is not held back
            flags |= Clamp.STEP
        inside = min(max(inside, goal - step), goal + step)
    speed = abs(speed)
    if np.isinf(speed):
        return inside, ceiling, flags | Clamp.NOT_FINITE
    most = rig.gate._most[1, 0]
    if speed > most:
        flags |= Clamp.VELOCITY
    return inside, np.fmin(speed if np.isnan(speed) else min(speed, most), ceiling), flags


@settings(max_examples=300, deadline=None)
@given(
    velocity=st.none() | st.floats(1, 30),
    start=st.floats(-2, 2),
    commands=st.lists(st.lists(st.tuples(one_of_few, one_of_few), min_size=2, max_size=2), max_size=12),
)
def test_goals_speeds_and_flags_are_those_of_the_rules_applied_joint_by_joint(velocity, start, commands):
    rig = Rig(velocity=velocity, joints=2, start=start, top_speed=6.0)
    rig.limits, rig.top_speed = (-1.0, 1.0, velocity), 6.0
    record = rig.record
    for both in commands:
        last = list(zip(record.goals.position.tolist(), record.goals.velocity.tolist(), strict=True))
        expected = [goal_of_one(rig, *one) for one in zip(last, *zip(*both, strict=True), strict=True)]
        record.clamped[:] = 0
        rig.apply(*zip(*both, strict=True))
        found = zip(record.goals.position, record.goals.velocity, record.clamped, strict=True)
        for (goal, speed, flags), one in zip(found, expected, strict=True):
            np.testing.assert_equal((goal, speed, Clamp(int(flags))), one)
