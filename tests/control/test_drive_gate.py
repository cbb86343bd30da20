"""The last gate for joints that are not led to positions: velocities, efforts, PWM, and a change of mode."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.control.gate_law import BRAKING_S, LAG_S
from tests.kit.loops import PERIOD_NS, GateRig

from dxlrun.channels.cycle import Clamp
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlwire.modes import COMMAND_INTERFACES, Mode

DT = PERIOD_NS * 1e-9
DRIVEN = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
SIDES = pytest.mark.parametrize("side", [1, -1])


def rig_in(mode, **joint):
    """Return the gate of a joint in a mode, of at most 2 rad/s and an effort of 0.5."""
    return GateRig(mode, **{"velocity": 2.0, "effort": 0.5} | joint)


def driven(rig, mode, value):
    """Command a drive; return its goal."""
    return getattr(rig.apply(**{DRIVEN[mode]: value}), DRIVEN[mode])


def goals(sent):
    """Return what was sent, by interface, but for what is NaN."""
    found = {name: getattr(sent, name) for name in COMMAND_INTERFACES}
    return {name: value for name, value in found.items() if not np.isnan(value)}


any_float = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=150, deadline=None)
@given(mode=st.sampled_from(list(DRIVEN)), position=st.floats(-2, 2) | st.just(np.nan), value=any_float)
def test_a_drive_is_finite_within_its_limit_and_never_leads_out(mode, position, value):
    ((name, goal),) = goals(rig_in(mode, start=position).apply(**{DRIVEN[mode]: value})).items()
    most = {Mode.VELOCITY: 2.0, Mode.EFFORT: 0.5, Mode.PWM: 1.0}[mode]
    assert name == DRIVEN[mode]
    assert abs(goal) <= most
    assert not goal > 0 or position < 1
    assert not goal < 0 or position > -1
    if abs(value) <= min(most, 1.0) and abs(position) <= 0.5:
        assert goal == value


@pytest.mark.parametrize(
    ("mode", "value", "goal", "clamp", "what"),
    [
        (Mode.VELOCITY, -9.0, -2.0, Clamp.VELOCITY, "goal held to the velocity limit"),
        (Mode.VELOCITY, np.inf, 0.0, Clamp.NOT_FINITE, "goal not finite"),
        (Mode.EFFORT, 0.7, 0.5, Clamp.EFFORT, "goal held to the effort limit"),
        (Mode.PWM, -1.5, -1.0, Clamp.PWM, "goal held to the full voltage"),
    ],
)
def test_what_goes_too_far_is_cut_and_told(mode, value, goal, clamp, what):
    rig = rig_in(mode)
    sent = rig.apply(**{DRIVEN[mode]: value})
    assert (getattr(sent, DRIVEN[mode]), sent.clamped) == (goal, clamp)
    by = "" if clamp == Clamp.NOT_FINITE else ", controller b"
    assert rig.texts[-1].startswith(f"j0{by}: {what}")


@pytest.mark.parametrize("mode", DRIVEN)
def test_a_drive_that_is_not_commanded_any_more_is_zero(mode):
    rig = rig_in(mode)
    assert driven(rig, mode, 0.3) == 0.3
    sent = rig.apply()
    assert (goals(sent), sent.clamped) == ({DRIVEN[mode]: 0.0}, Clamp(0))


def test_a_velocity_ends_at_the_position_limit():
    rig = rig_in(Mode.VELOCITY)
    for _ in range(200):
        sent = rig.apply(velocity=2.0)
        rig.states.position[:] += sent.velocity * DT
        assert rig.states.position[0] <= 1.0
    assert rig.states.position[0] == pytest.approx(1.0, abs=1e-3)
    assert sent.clamped == Clamp.OUTWARD
    assert sent.velocity == pytest.approx((1.0 - rig.states.position[0]) / BRAKING_S, rel=0.3)
    assert driven(rig, Mode.VELOCITY, -2.0) == -2.0


@SIDES
def test_a_joint_that_coasts_toward_a_limit_is_stopped_earlier(side):
    rig = rig_in(Mode.VELOCITY, start=side * (1.0 - 2.0 * LAG_S))
    for coasts, goal in ((2.0, 0.0), (-2.0, 2.0)):
        rig.states.velocity[:] = side * coasts
        assert driven(rig, Mode.VELOCITY, side * 2.0) == side * goal


@SIDES
@pytest.mark.parametrize("mode", [Mode.EFFORT, Mode.PWM])
def test_beyond_a_limit_only_what_leads_back_is_let_through(mode, side):
    rig = rig_in(mode, start=side * 1.01)
    assert driven(rig, mode, side * 0.3) == 0.0
    assert Clamp(int(rig.record.clamped[0])) == Clamp.OUTWARD
    assert driven(rig, mode, side * -0.3) == side * -0.3


@pytest.mark.parametrize(("dt_ns", "most"), [(PERIOD_NS, 0.05 / BRAKING_S), (200_000_000, 0.05 / 0.4)])
def test_a_slow_loop_leaves_a_joint_two_periods_to_its_limit(dt_ns, most):
    assert rig_in(Mode.VELOCITY, start=0.95).apply(dt_ns, velocity=2.0).velocity == pytest.approx(most)


def test_a_wheel_turns_for_ever():
    rig = rig_in(Mode.VELOCITY, start=5000.0, continuous=True, bounded=False)
    assert driven(rig, Mode.VELOCITY, 1.7) == 1.7


@SIDES
def test_the_first_velocity_is_slow_and_within_the_acceleration_limit(side):
    sent = rig_in(Mode.VELOCITY, eased=False).apply(velocity=side * 2.0)
    assert (sent.velocity, sent.clamped) == (side * SLOW_SPEED, Clamp.STEP)
    rig = rig_in(Mode.VELOCITY, eased=False, acceleration=5.0)
    assert driven(rig, Mode.VELOCITY, side * 1.0) == pytest.approx(side * 5.0 * DT)


def test_an_effort_beside_a_position_is_a_limit_and_is_kept():
    rig = rig_in(Mode.EFFORT_POSITION)
    assert rig.apply(position=0.01, effort=-0.2).effort == 0.2
    assert rig.apply(position=0.01).effort == 0.2
    for effort, clamp in ((0.8, Clamp.EFFORT), (np.inf, Clamp.NOT_FINITE)):
        sent = rig.apply(position=0.01, effort=effort)
        assert (sent.effort, sent.clamped) == (0.5, clamp)


@pytest.mark.parametrize("mode", [*DRIVEN, Mode.UNKNOWN])
def test_commands_of_another_mode_are_not_let_through(mode):
    own = DRIVEN.get(mode, "")
    values = {name: 0.4 for name in COMMAND_INTERFACES if name != own}
    assert goals(rig_in(mode).apply(**values)) == ({own: 0.0} if own else {})


def test_a_joint_that_comes_back_to_position_mode_holds_where_it_is_and_goes_slowly():
    rig = rig_in(Mode.VELOCITY, velocity=None)
    rig.apply(velocity=1.0)
    rig.states.mode[:] = Mode.UNKNOWN
    assert goals(rig.apply(velocity=1.0, position=0.9)) == {}
    rig.states.mode[:] = Mode.POSITION
    rig.states.position[:] = 0.4
    assert rig.apply().position == 0.4
    assert rig.apply(position=0.9).position == pytest.approx(0.4 + SLOW_SPEED * DT)


def test_a_joint_that_leaves_position_mode_does_not_move_by_itself():
    rig = rig_in(Mode.POSITION)
    rig.apply(position=0.01)
    rig.states.mode[:] = Mode.EFFORT
    assert goals(rig.apply(position=0.5)) == {"effort": 0.0}


@pytest.mark.parametrize(("mode", "clamp"), [(Mode.VELOCITY, Clamp.VELOCITY), (Mode.EFFORT, Clamp.EFFORT)])
@pytest.mark.parametrize(("limit", "goal"), [(None, 3.0), (2.0, 2.0), (4.0, 3.0)])
def test_without_a_limit_of_the_file_a_drive_has_that_of_the_servo(mode, clamp, limit, goal):
    limits = {"velocity": limit, "effort": limit, "top_speed": 3.0, "top_effort": 3.0, "bounded": False}
    sent = rig_in(mode, **limits).apply(**{DRIVEN[mode]: -1e300})
    assert (getattr(sent, DRIVEN[mode]), sent.clamped) == (-goal, clamp)
