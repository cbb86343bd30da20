"""The last gate: whatever comes in, what goes out is finite, inside the limits and near the last goal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.loops import PERIOD_NS, GateRig

from dxlrun.channels.cycle import Clamp, Torque
from dxlrun.control.gate import BACK_SPEED, CLAMP_ENDS_NS
from dxlrun.plan.loop_plan import SourcePlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS

DT = PERIOD_NS * 1e-9
NONE = Clamp(0)


def led(rig, position=np.nan, velocity=np.nan):
    """Command a cycle; return position and speed of the goal, and what was done."""
    sent = rig.apply(position=position, velocity=velocity)
    return sent.position, sent.velocity, sent.clamped


@pytest.mark.parametrize("wanted", [np.inf, -np.inf])
def test_infinity_is_no_goal_of_a_joint_without_limits_that_follows_its_commands(wanted):
    rig = GateRig(lower=-np.inf, upper=np.inf)
    for position in (0.5, 0.6):
        assert led(rig, position)[0] == position
    assert led(rig, wanted)[::2] == (0.6, Clamp.NOT_FINITE)


@pytest.mark.parametrize(("limit", "goal"), [(None, 8.0), (2.0, 2.0), (9.0, 8.0)])
def test_a_speed_above_the_servos_own_is_held_to_it_also_without_a_limit(limit, goal):
    rig = GateRig(velocity=limit, top_speed=8.0)
    assert led(rig, 0.001, 1e300)[1:] == (goal, Clamp.VELOCITY)
    assert rig.gate.counts[0].sum() == 1
    assert led(rig, 0.001, goal)[1:] == (goal, 0)
    if limit != 2.0:  # the servo's own speed does not limit the step
        assert led(rig, 0.9)[::2] == ((0.9, 0) if limit is None else (0.001 + 9 * DT, 0))


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
    rig = GateRig(lower=lower, upper=upper, velocity=velocity, start=last, eased=eased)
    speed = min(velocity or np.inf, np.inf if eased else SLOW_SPEED)
    for command in commands:
        goal, toward, _ = led(rig, *command)
        assert lower <= goal <= upper
        assert abs(goal - last) <= speed * DT * (1 + 1e-9) + 1e-15
        assert np.isnan(toward) or 0 <= toward <= (velocity or np.inf)
        assert not np.isinf(toward)
        last = goal


@settings(max_examples=100, deadline=None)
@given(start=st.floats(-6, 6), commands=st.lists(any_float, min_size=1, max_size=12))
def test_a_goal_that_starts_outside_never_moves_further_out(start, commands):
    rig = GateRig(start=start)
    outside = max(0.0, abs(start) - 1.0)
    for position in commands:
        goal = led(rig, position)[0]
        assert abs(goal) - 1.0 <= outside
        outside = max(0.0, abs(goal) - 1.0)


@settings(max_examples=100, deadline=None)
@given(position=st.floats(-1, 1), velocity=st.floats(-5, 5) | st.just(np.nan))
def test_what_is_inside_all_limits_passes_unchanged(position, velocity):
    rig = GateRig()
    np.testing.assert_equal(led(rig, position, velocity), (position, abs(velocity), NONE))
    assert rig.texts == []


@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_hangs_outside_its_limits_may_be_held_there(side):
    rig = GateRig(start=side * 1.2)
    assert led(rig, side * 1.2) == (side * 1.2, BACK_SPEED, NONE)
    for commanded, goal in ((1.1, 1.1), (1.2, 1.1), (0.5, 0.5), (1.1, 1.0)):
        assert led(rig, side * commanded)[0] == side * goal


@pytest.mark.parametrize(
    ("command", "goal", "clamp", "words"),
    [
        ((-3.0, 0.5), (-1.0, 0.5), Clamp.LOWER, "raised to the lower position limit"),
        ((3.0, 0.5), (1.0, 0.5), Clamp.UPPER, "lowered to the upper position limit"),
        ((0.01, 9.0), (0.01, 8.0), Clamp.VELOCITY, "held to the velocity limit"),
        ((np.inf, 0.5), (0.0, SLOW_SPEED), Clamp.NOT_FINITE, "not finite; the last goal is kept"),
        ((0.01, np.inf), (0.01, np.nan), Clamp.NOT_FINITE, "not finite; the last goal is kept"),
    ],
)
def test_each_clamping_is_flagged_told_and_counted(command, goal, clamp, words):
    rig = GateRig(velocity=8.0 if clamp == Clamp.VELOCITY else None)
    *found, flags = led(rig, *command)
    np.testing.assert_allclose(found, goal)
    assert flags == clamp
    # what is not finite may be of a controller that another one stands in for now
    by = "" if clamp == Clamp.NOT_FINITE else ", controller b"
    assert rig.texts == [f"j0{by}: goal {words}"]
    assert rig.gate.counts.sum() == 1


def test_a_step_beyond_the_velocity_limit_is_walked_in_steps():
    rig = GateRig(velocity=2.0)
    goals = [led(rig, 0.1) for _ in range(4)]
    np.testing.assert_allclose([goal for goal, _, _ in goals], [0.04, 0.08, 0.1, 0.1])
    assert [flags for *_, flags in goals] == [Clamp.STEP, Clamp.STEP, NONE, NONE]
    assert rig.texts == ["j0, controller b: goal held to the step or acceleration limit"]


def test_a_clamp_has_one_event_at_its_beginning_and_one_after_its_end():
    rig = GateRig()
    for position in (3.0, 3.0, 0.0, 3.0, -3.0):
        led(rig, position)
    assert [text.split()[4] for text in rig.texts] == ["lowered", "raised"]
    assert rig.gate.counts[0].tolist() == [1, 3, 0, 0, 0, 0, 0, 0]
    cycles = CLAMP_ENDS_NS // PERIOD_NS
    for _ in range(cycles - 2):
        led(rig, 0.0)
    assert len(rig.texts) == 2
    for _ in range(2):
        led(rig, 0.0)
    assert rig.texts[2:] == [
        "j0: goal lowered to the upper position limit; this ended after 0.1 s",
        "j0: goal raised to the lower position limit; this ended after 0.0 s",
    ]
    led(rig, 3.0)
    assert len(rig.texts) == 5


def test_the_first_second_is_slow_even_without_a_velocity_limit():
    rig = GateRig(eased=False)
    for number in range(1, 51):
        np.testing.assert_allclose(led(rig, 1.0)[0], min(1.0, number * SLOW_SPEED * DT))
    rig = GateRig(eased=False)
    rig.apply(SLOW_START_NS)
    assert led(rig, 1.0)[0] == 1.0
    rig.gate.ease_in()
    assert led(rig, -1.0)[0] == pytest.approx(1.0 - SLOW_SPEED * DT)


def test_a_speed_counts_for_the_position_that_it_comes_with():
    rig = GateRig()
    assert led(rig, np.nan, 0.5)[1] == SLOW_SPEED
    assert led(rig, 0.1, 0.5) == (0.1, 0.5, NONE)
    assert led(rig, np.nan, 0.9) == (0.1, 0.5, NONE), "a joint that is not commanded keeps both"
    assert np.isnan(led(rig, 0.2)[1]), "a position alone inherits no speed"


def test_the_step_limit_is_the_speed_toward_the_goal_too_where_it_holds_the_servo_back():
    """A servo takes a step as fast as it may, so at a low rate a step alone is no limit."""
    rig = GateRig(velocity=2.0, top_speed=6.0)
    assert [led(rig, 0.1, speed)[1] for speed in (np.nan, 0.5, np.nan)] == [2.0, 0.5, 2.0]
    rig = GateRig(velocity=6.0, top_speed=6.0, eased=False)
    assert [led(rig, 0.1, speed)[1] for speed in (np.nan, 3.0)] == [SLOW_SPEED] * 2
    rig.states.torque[:] = Torque.OFF
    rig.states.position[:] = 0.3
    assert np.isnan(led(rig, 0.1)[1]), "its goal is where it stands"
    rig = GateRig(velocity=6.0, top_speed=6.0)
    assert np.isnan(led(rig, 0.1)[1])


def test_what_the_manager_found_not_finite_stays_flagged():
    rig = GateRig(joints=2)
    rig.record.clamped[1] = Clamp.NOT_FINITE | Clamp.STEP
    rig.apply()
    assert rig.record.clamped.tolist() == [0, Clamp.NOT_FINITE]


LIGHT = SourcePlan(
    "light",
    "device",
    ("voltage",),
    ("lamp", "level"),
    label="light (ID 102 on bus main)",
    ranges=((0.0, 1.0), (-2.0, 2.5)),
)


def test_a_command_of_a_device_beyond_its_range_is_held_at_the_end_and_told_once():
    rig = GateRig(sources=(LIGHT,))

    def lit(*commands):
        rig.record.source_commands[:] = commands
        rig.apply()
        return rig.record.source_commands.tolist()

    assert lit(1.0, -2.0) == [1.0, -2.0]
    assert lit(np.nan, 1.0) == [pytest.approx(np.nan, nan_ok=True), 1.0], "what is not commanded stays so"
    assert rig.texts == []
    assert lit(3.0, -7.0) == [1.0, -2.0]
    expected = [
        "light (ID 102 on bus main): lamp = 3 is clamped to its range 0..1",
        "light (ID 102 on bus main): level = -7 is clamped to its range -2..2.5",
    ]
    assert rig.texts == expected
    lit(4.0, 2.0)
    rig.apply()  # nothing was commanded anew
    lit(5.0, 9.0)
    assert rig.texts == [*expected, "light (ID 102 on bus main): level = 9 is clamped to its range -2..2.5"]
