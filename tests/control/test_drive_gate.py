"""The last gate for joints that are not led to positions: velocities, efforts, PWM, and a change of mode."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels.cycle import Clamp, CycleLayout, CycleRecord
from dxlrun.control.gate import BRAKING_S, LAG_S, Gate
from dxlrun.description.modes import COMMAND_INTERFACES, Mode
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, LoopPlan, SchedulerPlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS

DT_NS = 20_000_000
DRIVEN = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}


class Rig:
    """One joint of -1..1 rad, at 0, in a mode."""

    def __init__(self, mode, *, position=0.0, eased=True, **joint):
        self.joint = JointPlan("j", **{"lower": -1.0, "upper": 1.0, "velocity": 2.0, "effort": 0.5} | joint)
        controller = ControllerPlan(
            "a", "t", "d 1", "{}", ("j",), (DRIVEN.get(mode, "position"),), (), True, 1
        )
        plan = LoopPlan(DT_NS, SchedulerPlan("other", 31, False), (self.joint,), (controller,), (), None)
        self.record = CycleRecord(CycleLayout(("j",), ("a",)))
        self.record.active = 1
        self.record.states.mode[:] = mode
        self.record.states.position[:] = position
        self.told = []
        self.gate = Gate(plan, self.record, self)
        if mode == Mode.POSITION:
            self.record.goals.position[:] = position
        if eased:
            self.gate.apply(self.record.commands, self.record.goals, SLOW_START_NS)

    def emit(self, code, severity, source, text, data=b""):
        self.told.append(text)

    def apply(self, **commands):
        self.record.commands.clear()
        for name, value in commands.items():
            getattr(self.record.commands, name)[:] = value
        self.gate.enter_modes()
        self.gate.apply(self.record.commands, self.record.goals, DT_NS)
        return {name: float(getattr(self.record.goals, name)[0]) for name in COMMAND_INTERFACES}

    @property
    def clamped(self):
        return Clamp(int(self.record.clamped[0]))


any_float = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=150, deadline=None)
@given(mode=st.sampled_from(list(DRIVEN)), position=st.floats(-2, 2) | st.just(np.nan), value=any_float)
def test_a_drive_is_finite_within_its_limit_and_never_leads_out(mode, position, value):
    rig = Rig(mode, position=position)
    goals = rig.apply(**{DRIVEN[mode]: value})
    goal = goals.pop(DRIVEN[mode])
    most = {Mode.VELOCITY: 2.0, Mode.EFFORT: 0.5, Mode.PWM: 1.0}[mode]
    assert abs(goal) <= most
    assert not goal > 0 or position < 1
    assert not goal < 0 or position > -1
    assert all(np.isnan(other) for other in goals.values())
    if abs(value) <= min(most, 1.0) and abs(position) <= 0.5:
        assert goal == value


@pytest.mark.parametrize(
    ("mode", "value", "goal", "clamp", "what"),
    [
        (Mode.VELOCITY, -9.0, -2.0, Clamp.VELOCITY, "held to the velocity limit"),
        (Mode.VELOCITY, np.inf, 0.0, Clamp.NOT_FINITE, "was not finite"),
        (Mode.EFFORT, 0.7, 0.5, Clamp.EFFORT, "held to the effort limit"),
        (Mode.PWM, -1.5, -1.0, Clamp.PWM, "held to the full voltage"),
    ],
)
def test_what_goes_too_far_is_cut_and_told(mode, value, goal, clamp, what):
    rig = Rig(mode)
    assert rig.apply(**{DRIVEN[mode]: value})[DRIVEN[mode]] == goal
    assert rig.clamped == clamp
    by = "" if clamp == Clamp.NOT_FINITE else ", controller a"
    assert rig.told[-1].startswith(f"j{by}: {what}")


@pytest.mark.parametrize("mode", DRIVEN)
def test_a_drive_that_nobody_commands_any_more_is_zero(mode):
    rig = Rig(mode)
    assert rig.apply(**{DRIVEN[mode]: 0.3})[DRIVEN[mode]] == 0.3
    assert rig.apply()[DRIVEN[mode]] == 0.0
    assert rig.clamped == Clamp(0)


def test_a_velocity_ends_at_the_position_limit():
    rig = Rig(Mode.VELOCITY)
    for _ in range(200):
        speed = rig.apply(velocity=2.0)["velocity"]
        rig.record.states.position[:] += speed * DT_NS * 1e-9
        assert rig.record.states.position[0] <= 1.0
    assert rig.record.states.position[0] == pytest.approx(1.0, abs=1e-3)
    assert rig.clamped == Clamp.OUTWARD
    assert speed == pytest.approx((1.0 - rig.record.states.position[0]) / BRAKING_S, rel=0.3)
    assert rig.apply(velocity=-2.0)["velocity"] == -2.0


@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_coasts_toward_a_limit_is_stopped_earlier(side):
    rig = Rig(Mode.VELOCITY, position=side * (1.0 - 2.0 * LAG_S))
    rig.record.states.velocity[:] = side * 2.0
    assert rig.apply(velocity=side * 2.0)["velocity"] == 0.0
    rig.record.states.velocity[:] = -side * 2.0
    assert rig.apply(velocity=side * 2.0)["velocity"] == side * 2.0


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("mode", [Mode.EFFORT, Mode.PWM])
def test_beyond_a_limit_only_what_leads_back_is_let_through(mode, side):
    rig = Rig(mode, position=side * 1.01)
    assert rig.apply(**{DRIVEN[mode]: side * 0.3})[DRIVEN[mode]] == 0.0
    assert rig.clamped == Clamp.OUTWARD
    assert rig.apply(**{DRIVEN[mode]: side * -0.3})[DRIVEN[mode]] == side * -0.3


@pytest.mark.parametrize(("dt_ns", "most"), [(DT_NS, 0.05 / BRAKING_S), (200_000_000, 0.05 / 0.4)])
def test_a_slow_loop_leaves_a_joint_two_periods_to_its_limit(dt_ns, most):
    rig = Rig(Mode.VELOCITY, position=0.95)
    rig.record.commands.velocity[:] = 2.0
    rig.gate.apply(rig.record.commands, rig.record.goals, dt_ns)
    assert rig.record.goals.velocity[0] == pytest.approx(most)


def test_a_wheel_turns_for_ever():
    rig = Rig(Mode.VELOCITY, position=5000.0, continuous=True, bounded=False)
    assert rig.apply(velocity=1.7)["velocity"] == 1.7


def test_a_joint_in_velocity_mode_begins_slowly():
    rig = Rig(Mode.VELOCITY, eased=False)
    assert rig.apply(velocity=2.0)["velocity"] == SLOW_SPEED
    assert rig.clamped == Clamp.STEP


@pytest.mark.parametrize("side", [1, -1])
def test_the_first_velocity_is_within_the_acceleration_limit(side):
    rig = Rig(Mode.VELOCITY, eased=False, acceleration=5.0)
    assert rig.apply(velocity=side * 1.0)["velocity"] == pytest.approx(side * 5.0 * DT_NS * 1e-9)


def test_an_effort_beside_a_position_is_a_limit_and_is_kept():
    rig = Rig(Mode.EFFORT_POSITION)
    rig.record.goals.position[:] = 0.0
    assert rig.apply(position=0.01, effort=-0.2)["effort"] == 0.2
    assert rig.apply(position=0.01)["effort"] == 0.2
    assert rig.apply(position=0.01, effort=0.8)["effort"] == 0.5
    assert rig.clamped == Clamp.EFFORT
    assert rig.apply(effort=np.inf)["effort"] == 0.5
    assert rig.clamped == Clamp.NOT_FINITE


@pytest.mark.parametrize("mode", [*DRIVEN, Mode.UNKNOWN])
def test_commands_of_another_mode_are_not_let_through(mode):
    rig = Rig(mode)
    values = dict.fromkeys(COMMAND_INTERFACES, 0.4)
    values.pop(DRIVEN.get(mode, ""), None)
    goals = rig.apply(**values)
    drive = goals.pop(DRIVEN[mode], 0.0) if mode in DRIVEN else 0.0
    assert drive == 0.0
    assert all(np.isnan(goal) for goal in goals.values())


def test_a_joint_that_comes_back_to_position_mode_holds_where_it_is_and_goes_slowly():
    rig = Rig(Mode.VELOCITY, velocity=None)
    rig.apply(velocity=1.0)
    rig.record.states.mode[:] = Mode.UNKNOWN
    assert all(np.isnan(goal) for goal in rig.apply(velocity=1.0, position=0.9).values())
    rig.record.states.mode[:] = Mode.POSITION
    rig.record.states.position[:] = 0.4
    assert rig.apply()["position"] == 0.4
    assert rig.apply(position=0.9)["position"] == pytest.approx(0.4 + SLOW_SPEED * DT_NS * 1e-9)


def test_a_joint_that_leaves_position_mode_does_not_move_by_itself():
    rig = Rig(Mode.POSITION)
    rig.apply(position=0.01)
    rig.record.states.mode[:] = Mode.EFFORT
    assert rig.apply(position=0.5)["effort"] == 0.0
    assert np.isnan(rig.record.goals.position[0])


@pytest.mark.parametrize(("mode", "clamp"), [(Mode.VELOCITY, Clamp.VELOCITY), (Mode.EFFORT, Clamp.EFFORT)])
@pytest.mark.parametrize(("limit", "goal"), [(None, 3.0), (2.0, 2.0), (4.0, 3.0)])
def test_without_a_limit_of_the_file_a_drive_has_that_of_the_servo(mode, clamp, limit, goal):
    limits = {"velocity": limit, "effort": limit, "top_speed": 3.0, "top_effort": 3.0, "bounded": False}
    rig = Rig(mode, **limits)
    assert rig.apply(**{DRIVEN[mode]: -1e300})[DRIVEN[mode]] == -goal
    assert rig.clamped == clamp
