"""Acceleration limits of the gate: goals in every mode, by exact simulation, with times that are not even."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.control.gate_law import BRAKING_S
from tests.kit.loops import GateRig

from dxlrun.channels.cycle import Clamp
from dxlrun.plan.loop_plan import JointPlan
from dxlwire.modes import Mode

DT_NS = 10_000_000
DT = DT_NS * 1e-9
FAR = {"lower": -9.0, "upper": 9.0}
NOT_HELD = Clamp(0)


def rig_of(mode=Mode.POSITION, **joint):
    """Return the gate of a joint of at most 10 rad/s^2 and 6 rad/s."""
    return GateRig(mode, dt_ns=DT_NS, **{"acceleration": 10.0, "velocity": 6.0, "top_speed": 8.0} | joint)


any_command = st.floats(-3, 3) | st.just(np.nan) | st.just(np.inf)
uneven = st.integers(DT_NS // 4, 4 * DT_NS)


@settings(max_examples=100, deadline=None)
@given(
    mode=st.sampled_from((Mode.POSITION, Mode.EFFORT_POSITION)),
    acceleration=st.floats(1, 500),
    velocity=st.floats(0.5, 8),
    start=st.floats(-1, 1),
    cycles=st.lists(st.tuples(any_command, st.integers(1, 15), uneven), min_size=1, max_size=12),
)
@example(Mode.POSITION, 10.0, 6.0, 0.0, [(3.0, 15, DT_NS), (3.0, 15, 4 * DT_NS), (-3.0, 15, DT_NS)])
def test_goals_change_their_speed_within_the_limit_and_never_leave_the_position_limits(
    mode, acceleration, velocity, start, cycles
):
    rig = rig_of(mode, acceleration=acceleration, velocity=velocity, start=start)
    before = 0.0
    for position, count, dt_ns in cycles:
        for number in range(count):
            dt = dt_ns * (1 + number % 3)
            sent = rig.apply(dt, position=position)
            assert -1.0 <= sent.position <= 1.0
            assert abs(sent.moved - before) <= acceleration * dt * 1e-9 * (1 + 1e-6) + 1e-9
            assert abs(sent.moved) <= velocity * (1 + 1e-6) + 1e-9
            before = sent.moved


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "commanded",
    [
        lambda t: (3.0, np.nan),  # a step beyond the limit
        lambda t: (-0.9 + 4.0 * t, np.nan),  # a velocity, over the limit
        lambda t: (3.0, 4.0),  # a step with a speed
        lambda t: (1.3 - 1.3 * np.cos(1.8 * t), np.nan),  # a sinusoid that is followed, over the limit
        lambda t: (1.05 * np.sin(12.0 * t), np.nan),  # one that it cannot
        lambda t: (0.7 + 0.4 * np.sin(7.0 * t), 2.0 + np.sin(5.0 * t)),
    ],
)
def test_goals_brake_before_either_limit_whatever_is_commanded(commanded, sign):
    rig = rig_of(acceleration=6.0, velocity=4.0)
    before, highest = 0.0, -1.0
    for number in range(300):
        position, velocity = commanded(number * DT)
        sent = rig.apply(position=sign * position, velocity=velocity)
        goal, now = sent.position, sent.moved
        assert -1.0 <= goal <= 1.0
        assert abs(now - before) <= 6.0 * DT * (1 + 1e-6) + 1e-9
        # it comes to rest at the limit if it brakes from now on
        assert abs(goal + now * abs(now) / 12.0) <= 1.0 + 1e-6
        before, highest = now, max(highest, sign * goal)
    assert highest > 0.3, "it moves"


@pytest.mark.parametrize("dt_ns", [1_000_000, 7_000_000, 20_000_000])
@pytest.mark.parametrize("target", [0.9, 1.0, -0.5, 0.0003])
def test_a_step_ends_at_its_target_without_overshoot_in_the_time_that_it_needs(dt_ns, target):
    rig, goals = rig_of(), []
    while len(goals) < 3 or goals[-1] != goals[-3]:
        goals.append(rig.apply(dt_ns, position=target).position)
        assert len(goals) * dt_ns < 3e9
    assert goals[-1] == pytest.approx(target, abs=1e-9)
    assert max(np.abs(goals)) <= abs(target) + 1e-9
    arrived_s = int(np.argmax(np.abs(np.array(goals) - target) < 1e-3)) * dt_ns * 1e-9
    assert arrived_s <= 2 * np.sqrt(abs(target) / 10.0) + 5 * dt_ns * 1e-9  # bang-bang


def test_a_motion_within_the_limit_passes_as_it_is():
    wanted = 0.9 * np.sin(np.arange(300) * DT * 2.0 - np.pi / 2)  # at most 3.6 rad/s^2
    rig = rig_of(start=wanted[0])
    for one in wanted:
        sent = rig.apply(position=one)
        assert (sent.position, sent.clamped) == (one, NOT_HELD)
    assert rig.texts == []


def test_withdrawn_commands_let_the_goal_come_to_rest_and_hold():
    rig = rig_of(**FAR)
    moving = [rig.apply(position=8.0).moved for _ in range(30)][-1]
    sent = [rig.apply() for _ in range(60)]
    speeds = [one.moved for one in sent]
    assert moving == pytest.approx(10.0 * 30 * DT)
    assert np.diff([moving, *speeds[:29]]) == pytest.approx(-10.0 * DT)
    assert speeds[31:] == [0.0] * 29
    assert sent[-1].clamped == NOT_HELD


def test_another_command_on_the_way_turns_the_goal_round_within_the_limit():
    rig = rig_of(**FAR)
    speeds = [rig.apply(position=8.0 if number < 40 else -8.0).moved for number in range(100)]
    assert np.abs(np.diff(speeds)).max() == pytest.approx(10.0 * DT)
    assert speeds[-1] < -1


def test_a_speed_toward_the_position_holds_for_the_goal_too():
    rig = rig_of()
    sent = [rig.apply(position=1.0, velocity=0.5) for _ in range(100)]
    assert max(one.moved for one in sent) == pytest.approx(0.5)
    assert sent[-1].velocity == 0.5
    assert rig.apply().velocity == 0.5, "no command: the speed stays, too"


def test_what_is_held_back_is_flagged_once():
    rig = rig_of()
    assert [rig.apply(position=0.5).clamped for _ in range(2)] == [Clamp.STEP] * 2
    assert rig.texts == ["j0, controller b: goal held to the step or acceleration limit"]


def test_a_goal_outside_of_the_limits_may_go_in_and_never_further_out():
    rig = rig_of(start=1.3)
    assert rig.apply(position=2.0).position == 1.3
    goals = [rig.apply(position=0.9).position for _ in range(100)]
    assert max(goals) <= 1.3
    assert goals[-1] == pytest.approx(0.9)


def test_goals_that_were_set_anew_begin_at_rest():
    rig = rig_of(**FAR)
    for _ in range(30):
        rig.apply(position=8.0)
    rig.goals.position[:] = -1.0  # torque was off, the joint was moved by hand
    sent = rig.apply(position=8.0)
    assert (sent.position, sent.moved) == (pytest.approx(-1.0 + 10.0 * DT * DT), pytest.approx(10.0 * DT))


def test_a_change_of_mode_begins_at_rest():
    rig = rig_of(Mode.VELOCITY, bounded=False)
    rig.apply(velocity=1.0)
    rig.states.mode[:] = Mode.POSITION
    rig.states.position[:] = 0.2
    assert rig.apply().position == 0.2
    sent = rig.apply(position=0.9)
    assert (sent.position, sent.moved) == (pytest.approx(0.201), pytest.approx(0.1))


def test_a_mode_that_comes_back_where_the_goal_was_begins_at_rest():
    rig = rig_of(**FAR)
    goal = [rig.apply(position=8.0).position for _ in range(20)][-1]
    rig.states.position[:] = goal
    for mode in (Mode.UNKNOWN, Mode.POSITION):
        rig.states.mode[:] = mode
        sent = rig.apply()
    assert sent.position == goal
    assert rig.apply()[::4] == (goal, 0.0)


def test_a_joint_without_the_limit_beside_one_with_it_is_as_before():
    fast = JointPlan("fast", -1, 1, None, top_speed=8.0)
    rig = rig_of(more=[fast])
    rig.goals.position[:] = 0.0
    rig.apply(position=0.7, velocity=0.3)
    assert rig.goals.position.tolist() == [pytest.approx(10.0 * DT * DT), 0.7]
    assert rig.goals.velocity.tolist() == [0.3, 0.3]
    rig.apply()
    assert rig.goals.position[1] == 0.7
    assert rig.record.clamped.tolist() == [0, 0]


@settings(max_examples=100, deadline=None)
@given(
    acceleration=st.floats(1, 500),
    start=st.floats(-1, 1),
    cycles=st.lists(
        st.tuples(st.floats(-9, 9) | st.just(np.nan), st.integers(1, 20)), min_size=1, max_size=12
    ),
    uneven=st.lists(st.integers(1, round(BRAKING_S * 1e9)), min_size=1, max_size=7),
)
def test_a_joint_that_follows_its_velocity_never_passes_a_limit_nor_brakes_harder_than_the_limit(
    acceleration, start, cycles, uneven
):
    rig = rig_of(Mode.VELOCITY, acceleration=acceleration, start=start)
    place, before, number = start, 0.0, 0
    for velocity, count in cycles:
        for _ in range(count):
            dt_ns = uneven[number % len(uneven)]
            number += 1
            place += before * dt_ns * 1e-9  # what was sent acts until this cycle
            assert -1 - 1e-9 <= place <= 1 + 1e-9
            rig.states.position[:] = place
            now = rig.apply(dt_ns, velocity=velocity).velocity
            assert abs(now) <= 6.0
            # a cycle longer than half of BRAKING_S counts twice: the limit of the position goes first then
            if 2 * max(uneven) <= BRAKING_S * 1e9:
                assert abs(now - before) <= acceleration * dt_ns * 1e-9 * (1 + 1e-6) + 1e-9
            before = now


def test_a_velocity_that_is_withdrawn_becomes_zero_within_the_limit():
    rig = rig_of(Mode.VELOCITY, bounded=False)
    for _ in range(40):
        rig.apply(velocity=2.0)
    sent = [rig.apply() for _ in range(40)]
    assert np.diff([2.0, *(one.velocity for one in sent[:20])]) == pytest.approx(-0.1)
    assert [one.velocity for one in sent[20:]] == [0.0] * 20
    assert sent[-1].clamped == NOT_HELD


def test_an_unfollowing_joint_is_stopped_at_its_limit_at_once():
    rig = rig_of(Mode.VELOCITY)
    for _ in range(40):
        rig.apply(velocity=3.0)
    rig.states.position[:] = 1.0
    sent = rig.apply(velocity=3.0)
    assert (sent.velocity, sent.clamped) == (0.0, Clamp.OUTWARD)


@pytest.mark.parametrize("name", ["effort", "pwm"])
def test_effort_and_pwm_know_no_acceleration(name):
    assert getattr(rig_of(Mode[name.upper()]).apply(**{name: 0.4}), name) == 0.4


def test_a_joint_that_is_driven_toward_its_limit_brakes_within_the_acceleration():
    rig = rig_of(Mode.VELOCITY, acceleration=5.0)
    place, speeds = 0.0, [0.0]
    for _ in range(400):
        place += speeds[-1] * DT
        rig.states.position[:] = place
        speeds.append(rig.apply(velocity=9.0).velocity)
    assert np.abs(np.diff(speeds)).max() == pytest.approx(5.0 * DT)
    assert place == pytest.approx(1.0, abs=1e-6)
    assert max(speeds) > 1.5


def test_commands_that_move_are_caught_up_with_and_followed_without_a_lag():
    rig = rig_of(**FAR)
    commands = 2.0 * DT * np.arange(1, 150)
    assert [rig.apply(position=one).position for one in commands][-1] == commands[-1]
