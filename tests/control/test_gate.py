"""The gate, judged by formulas of motion and not by those of gate.c."""

from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.loops import PERIOD_NS, GateRig

from dxlrun.channels.cycle import Clamp, Torque
from dxlrun.channels.event_records import CommandOutside
from dxlrun.control.gate import BACK_SPEED, CLAMP_ENDS_NS
from dxlrun.plan.loop_plan import JointPlan, ServoLimit, SourcePlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS
from dxlwire.joint_unit import LINEAR, ROTARY
from dxlwire.modes import Mode

NAN, INF = np.nan, np.inf
DT = PERIOD_NS * 1e-9
LED = (Mode.POSITION, Mode.EFFORT_POSITION)
DRIVEN = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
FAR = {"lower": -9.0, "upper": 9.0}
LAG_S, BRAKING_S = 0.15, 0.1  # of a servo in velocity mode; of its approach to a limit
SIDES = pytest.mark.parametrize("side", [1, -1])


def or_inf(limit):
    return INF if limit is None else limit


class Watched:
    """A joint with random limits and commands, and the promises that its goals must keep."""

    def __init__(self, random, number):
        bounded = random.random() < 0.7
        self.plan = JointPlan(
            f"j{number}",
            random.choice([-1.0, random.uniform(-3, 0), -1.0 if bounded else -INF]),
            random.choice([1.0, random.uniform(0, 3), 1.0 if bounded else INF]),
            random.choice([None, random.uniform(0.1, 10)]),
            effort=random.choice([None, random.random()]),
            bounded=bounded,
            top_speed=random.choice([None, random.uniform(0.5, 9)]),
            top_effort=random.choice([None, 1.0]),
            acceleration=random.choice([None, random.uniform(0.5, 100), random.uniform(0.5, 100)]),
            unit=LINEAR if random.random() < 0.1 else ROTARY,
            servo_limits=random.choice([(), (ServoLimit("velocity", random.uniform(0.2, 3), "register"),)]),
        )
        self.acceleration = or_inf(self.plan.acceleration)
        self.mode, self.torque, self.limp = Mode.UNKNOWN, Torque.ON, False
        self.modes = [*Mode] if random.random() < 0.9 else [Mode.UNKNOWN, *DRIVEN]
        self.position, self.velocity = 0.0, 0.0
        self.since_ns = 0  # since its slow start began
        self.speed = 0.0  # of its goal in the last step
        self.counts = np.zeros(8, np.int64)

    def draw(self, random, goals):
        """Draw a mode, a torque, measured states and commands near the goals, now and then wild ones."""

        def some(near):
            wild = [NAN, NAN, NAN, NAN, INF, -INF, 0.0, -0.0, random.uniform(-4, 4), 1e300]
            return near + random.gauss(0, 0.05) if random.random() < 0.8 else random.choice(wild)

        before, leaves = self.mode, 0.5 if self.mode == Mode.UNKNOWN else 0.05
        self.mode = random.choice(self.modes) if random.random() < leaves else self.mode
        if random.random() < 0.1:
            self.torque = random.choice([Torque.ON, Torque.ON, Torque.OFF, Torque.RELEASED, Torque.LOST])
        place = some(self.position if np.isfinite(self.position) else 0.0)
        # a servo that was never heard is not led to positions, and what is measured is not infinite
        self.position = place if abs(place) < 100 else 0.0 if Mode.POSITION in self.modes else NAN
        self.velocity = random.gauss(0, 2)
        self.commands = [some(one if abs(one) < 100 else 0.0) for one in (goals[0], 1.0, 0.5, 0.5)]
        if before != self.mode:
            self.since_ns, self.speed = 0, 0.0

    def check(self, before, goals, clamped, dt_ns):
        """Check the goals of a cycle, which were `before` after the last one."""
        was_limp, self.limp = self.limp, self.torque in (Torque.OFF, Torque.RELEASED)
        self.since_ns = 0 if was_limp and not self.limp else self.since_ns
        self.slow = self.since_ns < SLOW_START_NS
        self.since_ns += dt_ns
        self.dt = max(dt_ns, 1) * 1e-9
        self.step_speed = (
            min(self.plan.step_speed, self.plan.slow_speed) if self.slow else self.plan.step_speed
        )
        self.counts += [int(clamped) >> bit & 1 for bit in range(8)]
        if self.mode in LED:
            self.check_led(before, goals, clamped, was_limp)
        elif self.mode in DRIVEN:
            self.check_driven(before, goals, clamped)
        own = {Mode.POSITION: {0, 1}, Mode.EFFORT_POSITION: {0, 1, 2}}.get(self.mode, {self.mode - 1})
        assert np.isnan([goals[row] for row in {0, 1, 2, 3} - own]).all()
        assert not self.limp or not clamped & ~Clamp.NOT_FINITE

    def check_led(self, before, goals, clamped, was_limp):
        plan, dt, (goal, toward) = self.plan, self.dt, goals[:2]
        command, fast = self.commands[0], abs(self.commands[1])
        if self.mode == Mode.EFFORT_POSITION:
            self.check_effort_limit(before[2], goals[2], clamped)
        at_hand = (was_limp or self.limp) and np.isfinite(self.position)
        start = self.position if at_hand else before[0]
        self.speed = 0.0 if at_hand else self.speed
        if self.limp:
            assert not at_hand or (goal == self.position and np.isnan(toward))
            self.speed = 0.0 if at_hand else (goal - start) / dt
            return
        moves, low, high = np.isfinite(command), np.fmin(plan.lower, start), np.fmax(plan.upper, start)
        kept = np.clip(command, low, high) if moves else start
        step = self.step_speed * dt
        nearest = np.clip(kept, np.fmax(start - step, low), np.fmin(start + step, high)) if moves else start
        # the goal: inside the limits or not further out, within the step, the nearest to its command
        assert np.isnan(start) or low <= goal <= high
        if np.isinf(self.acceleration):
            np.testing.assert_array_equal(goal, nearest)
        elif np.isfinite(start):
            self.check_acceleration(start, goal)
        self.speed = (goal - start) / dt if np.isfinite(start) else 0.0
        # its speed: that of the command within the limits; what holds a step back holds the servo back, too
        known = np.fmin(fast, plan.highest_speed) if moves and fast < INF else NAN if moves else before[1]
        limits = [plan.highest_speed, self.step_speed] if self.step_speed < or_inf(plan.top_speed) else []
        limits += (
            [BACK_SPEED * plan.slow_speed / SLOW_SPEED] if goal < plan.lower or goal > plan.upper else []
        )
        if not at_hand or moves:
            np.testing.assert_array_equal(toward, np.fmin(known, min(limits, default=NAN)))
        # the flags
        beyond = moves and plan.highest_speed < fast
        assert bool(clamped & Clamp.LOWER) == (moves and command < low)
        assert bool(clamped & Clamp.UPPER) == (moves and command > high)
        assert bool(clamped & Clamp.VELOCITY) == (beyond and fast < INF)
        if self.mode == Mode.POSITION:
            assert bool(clamped & Clamp.NOT_FINITE) == (np.isinf(command) or (moves and np.isinf(fast)))
        late = moves and goal != kept
        if np.isinf(self.acceleration):
            assert bool(clamped & Clamp.STEP) == (late and self.step_speed < or_inf(plan.top_speed))
        elif clamped & Clamp.STEP or goal != nearest:  # a goal that is led as fast as it may is not flagged
            assert bool(clamped & Clamp.STEP) == (late and abs(goal - kept) > 1e-9)

    def check_acceleration(self, start, goal):
        plan, dt, limit = self.plan, self.dt, self.acceleration
        speed, rounding = (goal - start) / dt, 1e-6 + 4e-16 * max(abs(goal), abs(start), 1.0) / dt
        assert abs(speed) <= self.step_speed * (1 + 1e-9) + rounding
        assert abs(speed - self.speed) <= limit * dt * (1 + 1e-6) + rounding
        rest = goal + speed * abs(speed) / (2 * limit)  # where it comes to rest if it brakes from now on
        tolerance = 1e-6 + abs(speed) * rounding / limit
        assert speed <= rounding or rest <= max(plan.upper, goal) + tolerance
        assert speed >= -rounding or rest >= min(plan.lower, goal) - tolerance

    def check_effort_limit(self, before, effort, clamped):
        highest, command = self.plan.highest_effort, abs(self.commands[2])
        np.testing.assert_equal(
            effort,
            min(command, highest)
            if command < INF
            else min(before, highest)
            if np.isfinite(before)
            else before,
        )
        if not self.limp:
            assert bool(clamped & Clamp.EFFORT) == (highest < command < INF)

    def check_driven(self, before, goals, clamped):
        plan, row = self.plan, self.mode - 1
        command, goal, last = self.commands[row], goals[row], before[row]
        own = (plan.highest_speed, min(plan.highest_effort, 1.8e308), plan.highest_pwm)[row - 1]
        highest = min(own, self.step_speed) if self.mode == Mode.VELOCITY else own
        wanted = min(max(command, -highest), highest) if np.isfinite(command) else 0.0
        assert abs(goal) <= highest or self.mode == Mode.VELOCITY
        stops = bool(clamped & Clamp.OUTWARD)
        if self.mode == Mode.VELOCITY:
            change, last = self.acceleration * self.dt, np.nan_to_num(last)
            ramped = min(max(wanted, last - change), last + change)
            self.check_velocity(goal, ramped, stops)
            wanted, held = ramped, ramped != wanted
        if self.limp:
            return
        # what is not stopped at a limit is as commanded, and what is stopped is turned away from that limit
        assert stops or goal == wanted
        assert not stops or (plan.bounded and (goal != wanted or goal == 0))  # 0 between two limits
        for side, limit in ((1, plan.upper), (-1, -plan.lower)) if plan.bounded else ():
            # an effort may brake a joint that comes back too fast
            back = (
                -self.velocity * side > BACK_SPEED * plan.slow_speed / SLOW_SPEED
                and self.mode != Mode.VELOCITY
            )
            assert side * self.position < limit or side * goal <= 0 or back
            assert np.isfinite(self.position) or goal == 0
        too_much = np.isfinite(command) and abs(command) > highest
        assert bool(clamped & Clamp.NOT_FINITE) == np.isinf(command)
        if self.mode == Mode.VELOCITY:
            assert bool(clamped & Clamp.VELOCITY) == (too_much and highest == own)
            assert bool(clamped & Clamp.STEP) == (
                (too_much and highest < own) or (held and np.isfinite(command))
            )
        else:
            assert bool(clamped & (Clamp.EFFORT, Clamp.PWM)[row - 2]) == too_much

    def check_velocity(self, goal, ramped, stops):
        """A servo that keeps its speed for its lag, and then follows the goal, comes to rest at the limit."""
        if not self.plan.bounded:
            return
        seconds = max(BRAKING_S, 2 * self.dt)
        for sign, limit in ((1, self.plan.upper), (-1, -self.plan.lower)):
            room = limit - sign * self.position - max(sign * self.velocity, 0.0) * (LAG_S + self.dt)
            way = sign * goal * seconds + goal * goal / (2 * self.acceleration)
            if sign * goal > 0:
                assert way <= room * (1 + 1e-6) + 1e-8
            if stops and sign * ramped > sign * goal:
                assert way == pytest.approx(max(room, 0.0), abs=1e-7) or np.isnan(room)


@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 1 << 32), count=st.integers(1, 3), cycles=st.integers(1, 60))
def test_goals_keep_their_promises(seed, count, cycles):
    random = Random(seed)
    joints = [Watched(random, number) for number in range(count)]
    rig = GateRig(Mode.UNKNOWN, joints=0, more=[joint.plan for joint in joints], eased=False)
    for _ in range(cycles):
        for row, joint in enumerate(joints):
            joint.draw(random, rig.goals.values[:, row])
        states = rig.states
        for name in ("mode", "torque", "position", "velocity"):
            getattr(states, name)[:] = [getattr(joint, name) for joint in joints]
        if states.mode.tobytes() != rig.gate.modes:
            rig.gate.enter_modes()
        before, dt_ns = rig.goals.values.copy(), random.choice((1_000_000, *[10_000_000] * 3, 600_000_000, 0))
        rig.record.reset_counts()
        rig.cycle(dt_ns, np.array([joint.commands for joint in joints]).T)
        for row, joint in enumerate(joints):
            clamped = Clamp(int(rig.record.clamped[row]))
            joint.check(before[:, row], rig.goals.values[:, row], clamped, dt_ns)
        assert rig.gate.counts.tolist() == [joint.counts.tolist() for joint in joints]


def rig_of(mode=Mode.POSITION, **joint):
    """Return the gate of a joint of at most 6 rad/s, 10 rad/s^2 and an effort of 0.5, at 100 Hz."""
    limits = {"acceleration": 10.0, "velocity": 6.0, "effort": 0.5, "top_speed": 8.0}
    return GateRig(mode, dt_ns=10_000_000, **limits | joint)


# Positions


@SIDES
@pytest.mark.parametrize(
    "commanded",
    [
        lambda t: (3.0, NAN),  # a step beyond the limit
        lambda t: (-0.9 + 4.0 * t, NAN),  # a velocity, over the limit
        lambda t: (3.0, 4.0),  # a step with a speed
        lambda t: (1.3 - 1.3 * np.cos(1.8 * t), NAN),  # a sinusoid that is followed, over the limit
        lambda t: (1.05 * np.sin(12.0 * t), NAN),  # one that it cannot follow
        lambda t: (0.7 + 0.4 * np.sin(7.0 * t), 2.0 + np.sin(5.0 * t)),
    ],
)
def test_goals_brake_before_either_limit_whatever_is_commanded(commanded, side):
    rig, joint = rig_of(acceleration=6.0, velocity=4.0), Watched(Random(0), 0)
    joint.plan, joint.acceleration, joint.dt, joint.step_speed = rig.plan.joints[0], 6.0, 0.01, 4.0
    before, highest = 0.0, -1.0
    for number in range(300):
        position, velocity = commanded(number * 0.01)
        sent = rig.apply(position=side * position, velocity=velocity)
        joint.check_acceleration(before, sent.position)
        joint.speed, before, highest = sent.moved, sent.position, max(highest, side * sent.position)
    assert 0.3 < highest <= 1.0


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


def test_a_motion_within_all_limits_passes_as_it_is():
    wanted = 0.9 * np.sin(np.arange(300) * 0.02 - np.pi / 2)  # at most 3.6 rad/s^2
    rig = rig_of(start=wanted[0])
    sent = [rig.apply(position=one) for one in wanted]
    assert [(one.position, one.clamped) for one in sent] == [(one, Clamp(0)) for one in wanted]
    assert rig.texts == []


def test_commands_that_move_are_caught_up_with_and_followed_without_a_lag():
    rig = rig_of(**FAR)
    commands = 0.02 * np.arange(1, 150)
    assert [rig.apply(position=one).position for one in commands][-1] == commands[-1]


def test_withdrawn_commands_let_the_goal_come_to_rest_and_hold():
    rig = rig_of(**FAR)
    moving = [rig.apply(position=8.0).moved for _ in range(30)][-1]
    sent = [rig.apply() for _ in range(60)]
    speeds = [one.moved for one in sent]
    assert moving == pytest.approx(3.0)
    assert np.diff([moving, *speeds[:29]]) == pytest.approx(-0.1)
    assert speeds[31:] == [0.0] * 29
    assert sent[-1].clamped == Clamp(0)


@pytest.mark.parametrize("dt_ns", [10_000_000, 50_000_000, 100_000_000])
def test_a_goal_whose_commands_are_withdrawn_neither_speeds_up_nor_turns_back(dt_ns):
    random, moving = Random(1), 0
    for _ in range(300):
        rig = rig_of(**FAR)
        before = 0.0
        for _ in range(random.randint(1, 4)):
            command = random.uniform(-1.0, 1.0) * random.choice([0.01, 0.1, 1.0])
            before = [rig.apply(dt_ns, position=command).moved for _ in range(random.randint(1, 5))][-1]
        moving += before != 0.0
        for after in [rig.apply(dt_ns).moved for _ in range(3)]:
            assert after * before >= 0.0
            assert abs(after) <= abs(before) + 1e-9
            before = after
    assert moving > 100


def test_a_goal_that_was_put_where_its_joint_is_begins_from_rest():
    rig = rig_of(**FAR)
    for number in range(60):
        rig.apply(position=0.02 * number)
    rig.states.position[:] = rig.goals.position
    rig.gate.anchor(np.array([True]))
    assert rig.apply(position=8.0).moved == pytest.approx(0.1)
    rig = rig_of(**FAR)
    for torque, command in ((Torque.OFF, 0.001), (Torque.ON, 0.002)):
        rig.states.torque[:] = torque
        sent = rig.apply(position=command)
    assert sent.position == pytest.approx(0.001), "the command of a limp joint is not a speed"
    assert rig_of(Mode.VELOCITY, eased=False).apply(velocity=0.05).velocity == 0.05


def test_a_speed_toward_the_position_holds_for_the_goal_too():
    rig = rig_of()
    sent = [rig.apply(position=1.0, velocity=0.5) for _ in range(100)]
    assert max(one.moved for one in sent) == pytest.approx(0.5)
    assert rig.apply().velocity == 0.5, "no command: the speed stays, too"
    rig = rig_of()
    assert [rig.apply(position=1.0, velocity=0.0).moved for _ in range(9)][-1] == pytest.approx(0.01)


def test_a_goal_that_another_has_set_begins_at_rest():
    rig = rig_of(**FAR)
    for _ in range(30):
        rig.apply(position=8.0)
    rig.goals.position[:] = -1.0  # torque was off, the joint was moved by hand
    assert rig.apply(position=8.0).moved == pytest.approx(0.1)
    rig.states.position[:] = goal = rig.goals.position[0]
    for mode in (Mode.UNKNOWN, Mode.POSITION):
        rig.states.mode[:] = mode
        sent = rig.apply()
    assert sent.position == goal
    assert rig.apply()[::4] == (goal, 0.0)


def test_a_joint_follows_exactly_only_if_all_joints_can():
    """Else joints that have one path would leave it; a joint without the limit is never held back."""
    fast = JointPlan("fast", -1, 1, None, top_speed=8.0)
    rig = rig_of(joints=2, more=[fast])
    rig.cycle(10_000_000, np.array([[1e-4, 0.9, 0.7], [NAN] * 3, [NAN] * 3, [NAN] * 3]))
    assert rig.record.clamped.tolist() == [0, Clamp.STEP, 0]
    assert rig.goals.position.tolist()[1:] == [pytest.approx(1e-3), 0.7]
    rig.cycle(10_000_000, np.array([[2e-4, 0.9, NAN], [NAN] * 3, [NAN] * 3, [NAN] * 3]))
    assert rig.goals.position.tolist()[::2] == [pytest.approx(2e-4, abs=5e-5), 0.7]


@SIDES
def test_a_joint_at_its_limit_has_the_speed_that_is_commanded(side):
    assert GateRig().apply(position=side, velocity=3.0)[:2] == (side, 3.0)


# Slow starts


def test_the_first_second_is_slow_even_without_a_velocity_limit():
    rig = GateRig(eased=False)
    goals = [rig.apply(position=1.0)[:2] for _ in range(50)]
    expected = [(min(1.0, number * SLOW_SPEED * DT), SLOW_SPEED) for number in range(1, 51)]
    np.testing.assert_allclose(goals, expected)
    rig.gate.ease_in()
    assert rig.apply(position=-1.0).moved == pytest.approx(-SLOW_SPEED)
    rig.apply(SLOW_START_NS)
    assert rig.apply(position=-1.0).position == -1.0


@pytest.mark.parametrize(("mode", "small"), [(Mode.POSITION, 0.2), (Mode.VELOCITY, 0.002)])
def test_the_slow_second_of_an_anchored_joint_begins_when_its_goal_leaves_the_anchor(mode, small):
    rig, name = GateRig(mode, start=0.2, lower=-40.0, upper=40.0), mode.name.lower()
    rig.gate.anchor(np.array([True]))
    for _ in range(3):
        rig.apply(SLOW_START_NS, **{name: small})
    for _ in range(50):
        sent = rig.apply(**{name: -5.0})
        assert abs(sent.moved if mode == Mode.POSITION else sent.velocity) <= SLOW_SPEED + 1e-9
    assert sent.clamped == Clamp.STEP
    assert rig.apply(**{name: -5.0})[mode == Mode.VELOCITY] == -5.0


# Velocities, efforts and PWM


@settings(max_examples=100, deadline=None)
@given(
    acceleration=st.floats(1, 500),
    start=st.floats(-1, 1),
    cycles=st.lists(st.tuples(st.floats(-9, 9) | st.just(NAN), st.integers(1, 20)), min_size=1, max_size=12),
    uneven=st.lists(st.integers(1, round(BRAKING_S * 1e9)), min_size=1, max_size=7),
)
def test_a_joint_that_follows_its_velocity_never_passes_a_limit_nor_brakes_harder_than_it_may(
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
            # a cycle longer than half of BRAKING_S counts twice: the limit of the position goes first then
            if 2 * max(uneven) <= BRAKING_S * 1e9:
                assert abs(now - before) <= acceleration * dt_ns * 1e-9 * (1 + 1e-6) + 1e-9
            before = now


@SIDES
def test_a_servo_that_lags_its_velocity_rests_at_the_limit_without_overshoot(side):
    rig = GateRig(Mode.VELOCITY, velocity=2.0, dt_ns=1_000_000)
    place = speed = 0.0
    for _ in range(4000):
        sent = rig.apply(velocity=side * 9.0)
        speed += (sent.velocity - speed) * 0.001 / LAG_S
        place += speed * 0.001
        rig.states.position[:], rig.states.velocity[:] = place, speed
        assert side * place <= 1.0
    assert side * place == pytest.approx(1.0, abs=0.002)


@SIDES
@pytest.mark.parametrize("mode", [Mode.EFFORT, Mode.PWM])
@pytest.mark.parametrize("power", [30.0, 300.0], ids=["heavy", "light"])
def test_a_joint_that_is_driven_against_its_limit_stops_there_and_comes_back(mode, side, power):
    """`power`: rad/s^2 of the full effort; the joint is without friction, as the worst one is."""
    rig, name = GateRig(mode, dt_ns=2_000_000, effort=1.0), DRIVEN[mode]
    rig.states.position[:] = place = -0.5 * side
    speed, places = 0.0, []
    for _ in range(4000):
        sent = getattr(rig.apply(**{name: side * 1.0}), name)
        assert abs(sent) <= 1.0
        speed += sent * power * 0.002
        place += speed * 0.002
        places.append(side * place)
        rig.states.position[:], rig.states.velocity[:] = place, speed
    assert max(places) <= 1.0 + 0.6 / power
    assert min(places[-1000:]) > 0.98
    assert abs(speed) < 0.02
    assert getattr(rig.apply(**{name: side * -1.0}), name) == side * -1.0


@SIDES
def test_a_joint_beyond_its_limit_is_let_back_slowly_and_not_pulled(side):
    rig = GateRig(Mode.EFFORT, start=side * 1.3)
    for speed in (0.0, 0.3):
        rig.states.velocity[:] = -side * speed
        assert rig.apply(effort=side * 0.3)[2::3] == (0.0, Clamp.OUTWARD)
    rig.states.velocity[:] = 0.0
    assert rig.apply(effort=side * -0.3).effort == side * -0.3
    rig.states.position[:] = side * 1.2  # it has come nearer, which it keeps
    rig.apply()
    rig.states.position[:] = side * 1.3
    pulled = [rig.apply(effort=0.0).effort for _ in range(3)]
    assert all(side * one < 0 for one in pulled)
    rig.states.velocity[:] = -side * (BACK_SPEED + 0.1)
    assert [rig.apply(effort=0.0).effort for _ in range(40)][-1] == 0.0, "fast enough"
    rig.states.torque[:] = Torque.OFF
    rig.apply()
    rig.states.torque[:], rig.states.velocity[:] = Torque.ON, 0.0
    assert rig.apply(effort=0.0).effort == 0.0, "it was moved by hand, and is not pulled back"


def test_a_far_joint_takes_the_full_effort_when_a_kick_is_forgotten():
    rig = GateRig(Mode.EFFORT, effort=0.5, lower=-3.0, upper=3.0)
    assert rig.apply(effort=-0.5)[2::3] == (-0.5, Clamp(0))
    rig.states.velocity[:] = -4.0
    efforts = [rig.apply(effort=-0.5).effort for _ in range(40)]
    assert efforts[0] > -0.5
    assert efforts[-1] == -0.5


# Reports


@pytest.mark.parametrize(
    ("mode", "command", "clamp", "words"),
    [
        (Mode.POSITION, {"position": -3.0}, Clamp.LOWER, "raised to the lower position limit"),
        (Mode.POSITION, {"position": 3.0}, Clamp.UPPER, "lowered to the upper position limit"),
        (Mode.POSITION, {"position": 0.9}, Clamp.STEP, "held to the step or acceleration limit"),
        (Mode.POSITION, {"position": 0, "velocity": 9}, Clamp.VELOCITY, "held to the velocity limit"),
        (Mode.POSITION, {"position": INF}, Clamp.NOT_FINITE, "not finite; the last goal is kept"),
        (Mode.VELOCITY, {"velocity": -9.0}, Clamp.VELOCITY, "held to the velocity limit"),
        (Mode.EFFORT, {"effort": 0.7}, Clamp.EFFORT, "held to the effort limit"),
        (Mode.PWM, {"pwm": -1.5}, Clamp.PWM, "held to the full voltage"),
    ],
)
def test_each_clamp_is_reported_with_the_controller_that_commands_the_joint(mode, command, clamp, words):
    rig = GateRig(mode, velocity=None if clamp in (Clamp.LOWER, Clamp.UPPER) else 2.0, effort=0.5)
    sent = [rig.apply(**command) for _ in range(2)][-1]
    assert clamp in sent.clamped
    # what is not finite may be of a controller that another one stands in for now
    by = "" if clamp == Clamp.NOT_FINITE else ", controller b"
    assert rig.texts == [f"j0{by}: goal {words}"]


def test_a_clamp_has_one_event_at_its_beginning_and_one_after_its_end():
    rig = GateRig()
    assert [rig.apply(position=limit).clamped for limit in (1.0, -1.0)] == [Clamp(0)] * 2
    for position in (3.0, 3.0, 0.0, 3.0, -3.0):
        rig.apply(position=position)
    assert [text.split()[4] for text in rig.texts] == ["lowered", "raised"]
    for _ in range(CLAMP_ENDS_NS // PERIOD_NS - 2):
        rig.apply(position=0.0)
    assert len(rig.texts) == 2
    for _ in range(2):
        rig.apply(position=0.0)
    assert rig.texts[2:] == [
        "j0: goal lowered to the upper position limit; this ended after 0.1 s",
        "j0: goal raised to the lower position limit; this ended after 0.0 s",
    ]
    for position in (3.0, -4.0, 3.5):
        rig.apply(position=position)
    assert len(rig.texts) == 6
    assert rig.gate.outside == (CommandOutside(0, -4.0, 7),)


LIGHT = SourcePlan(
    "light",
    "device",
    ("voltage",),
    ("lamp", "level"),
    label="light (ID 102 on bus main)",
    ranges=((0.0, 1.0), (-2.0, 2.5)),
)


def test_a_command_of_a_device_beyond_its_range_is_clamped_and_reported_once():
    rig = GateRig(sources=(LIGHT,))

    def lit(*commands):
        rig.record.source_commands[:] = commands
        rig.apply()
        return rig.record.source_commands.tolist()

    assert lit(1.0, -2.0) == [1.0, -2.0]
    assert lit(NAN, 1.0) == [pytest.approx(NAN, nan_ok=True), 1.0], "what is not commanded stays so"
    assert rig.texts == []
    assert lit(3.0, -7.0) == [1.0, -2.0]
    expected = [
        "light (ID 102 on bus main): lamp = 3 is clamped to its range 0..1",
        "light (ID 102 on bus main): level = -7 is clamped to its range -2..2.5",
    ]
    assert rig.texts == expected
    lit(4.0, 2.0)
    rig.apply()  # the clamped value stays until the next command
    lit(5.0, 9.0)
    assert rig.texts == [*expected, "light (ID 102 on bus main): level = 9 is clamped to its range -2..2.5"]
