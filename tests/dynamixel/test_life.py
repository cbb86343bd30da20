"""A servo's life: each legal transition is reached by what a simulated servo does, the others are refused."""

import itertools

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.line_faults import truncate_next
from tests.kit.rigs import goals_in, make_plan, make_rig

from dxlrun.channels.cycle import SourceStates, States
from dxlrun.dynamixel.servo import life
from dxlrun.dynamixel.servo.life import (
    GETS_GOALS,
    TRANSITIONS,
    IllegalTransition,
    Life,
    ServoEvent,
    ServoState,
)
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.owed import OwedReplies
from dxlwire.exchange.samples import Samples
from dxlwire.modes import Mode

LEGAL = {(state, event) for state, events in TRANSITIONS.items() for event in events}


@pytest.fixture
def one():
    """The life of one servo, apart from any line."""
    plan = make_plan((1,))
    rig = make_rig(plan)
    reads = CyclicReads(
        plan,
        Samples([plan], States.empty(1), SourceStates.empty(), None).buses[0],
        OwedReplies(rig.clock.now_ns),
    )
    return Life(rig.hardware._idle[0], reads, rig.events)


def put(servo, state):
    servo.states[0] = state
    servo.losses = (
        {0: life.OfflineServo(True, True, False, False, False, 0)} if state is ServoState.OFFLINE else {}
    )
    servo.reads.away[0] = state is ServoState.OFFLINE


@pytest.mark.parametrize(("state", "event"), sorted(LEGAL, key=str))
def test_what_follows_from_a_state_is_derived_at_each_transition(one, state, event):
    put(one, state)
    after = one.on(0, event)
    assert after is TRANSITIONS[state][event] is one.states[0]
    assert one.torqued[0] == (after in GETS_GOALS)
    assert one.reads.away[0] == (after is ServoState.OFFLINE)
    slow = after in (ServoState.STOPPED, ServoState.RETURNING, ServoState.OFFLINE)
    np.testing.assert_equal(one.ceiling[0], RETURN_SPEED if slow else np.nan)


@pytest.mark.parametrize(
    ("state", "event"), sorted(set(itertools.product(ServoState, ServoEvent)) - LEGAL, key=str)
)
def test_an_event_that_a_state_does_not_have_is_refused_and_changes_nothing(one, state, event):
    put(one, state)
    with pytest.raises(IllegalTransition, match=f"main_1_joint .* is {state.value}; {event.value}"):
        one.on(0, event)
    assert one.states[0] is state
    assert one.reads.away[0] == (state is ServoState.OFFLINE)


def test_no_state_gets_goals_but_by_torque_that_was_read():
    """A goal may switch torque on: only torque enable = 1, read after the last doubt, leads to goals."""
    for (state, event), after in ((pair, TRANSITIONS[pair[0]][pair[1]]) for pair in LEGAL):
        if after in GETS_GOALS and state not in GETS_GOALS:
            assert event is ServoEvent.TORQUE_ON
            assert state in life.IN_DOUBT


def test_a_servo_that_its_watchdog_stopped_follows_no_goal_at_full_speed():
    """Its goal may have moved on meanwhile: it is limp, or returns slowly."""
    after = {TRANSITIONS[state][event] for state, event in LEGAL if event is ServoEvent.WATCHDOG}
    assert after == life.POWERLESS | {ServoState.STOPPED, ServoState.GIVEN}


def test_a_released_servo_gets_no_goals_on_any_way_but_a_return_or_a_request():
    reached, new = {ServoState.RELEASED}, {ServoState.RELEASED}
    while new:
        found = {
            TRANSITIONS[state][event]
            for state in new
            for event in TRANSITIONS[state]
            if event is not ServoEvent.REQUESTED
        }
        new = {state for state in found - reached if state is not ServoState.OFFLINE}
        reached |= found
    assert reached == {ServoState.RELEASED, ServoState.OFFLINE}


@pytest.fixture
def recorded(monkeypatch):
    """Every transition that was made, as (state, event)."""
    made = []
    on = Life.on

    def recording(self, index, event):
        made.append((self.states[index], event))
        return on(self, index, event)

    monkeypatch.setattr(Life, "on", recording)
    return made


class Story:
    """Servo 12 of a bus of three, which lives through something."""

    def __init__(self, protocol=2.0):
        model = {} if protocol == 1.0 else {"protocol": 2.0, "model": "XM430-W350"}
        plan = make_plan((11, 12, 13), name="arm", return_delay_ns=0, **model)
        self.plan = replace(plan, watchdog_ticks=10 if protocol == 2.0 else 0)
        self.rig = make_rig(self.plan)
        self.servo = self.rig.servo(12)
        self.life = self.rig.hardware._servos[0].life

    @property
    def state(self):
        return self.life.states[1]

    def until(self, *states, most=200):
        for _ in range(most):
            if self.state in states:
                return
            self.rig.cycle()
        raise AssertionError(f"it is {self.state}")

    def lose(self):
        self.servo.silence()
        self.until(ServoState.OFFLINE)

    def reset(self):
        """Let it start anew while it is away, and come back limp."""
        self.lose()
        self.returned_limp()

    def come_to(self, state):
        """Bring the servo into a state by what happens to a real one."""
        if state is ServoState.LIMP and self.plan.protocol == 2.0:
            return  # not started yet
        self.rig.hardware.start()
        if state is ServoState.LIMP:
            self.reset()
        elif state is ServoState.RELEASED:
            self.rig.hardware.switch_torque(1, False)
            self.rig.cycles(5)
        elif state is ServoState.OFFLINE:
            self.lose()
        elif state is ServoState.GIVEN:
            self.reset()
            self.rig.anchors = False
            self.rig.hardware.switch_torque(1, True)
        elif state in (ServoState.RETURNING, ServoState.STOPPED):
            self.rig.goals.position[1] += 1.0
            self.lose()
            self.servo.silence(False)
            self.until(ServoState.RETURNING)
        if state in (ServoState.HOLDING, ServoState.STOPPED):
            self.miss()
        self.until(state)

    def miss(self):
        self.servo.silence()
        self.rig.cycle()

    # What happens

    def engaged(self):
        self.rig.hardware.start()

    def torque_on(self):
        self.servo.silence(False)
        self.until(ServoState.TORQUED, ServoState.RETURNING)

    def torque_off(self):
        """A servo of Protocol 1.0 shuts down: its torque enable stays 1, its Torque Limit is 0."""
        self.servo.trigger_overload()
        self.servo.silence(False)
        self.rig.cycles(10)

    def doubt(self):
        if self.state is not ServoState.OFFLINE:
            for _ in range(30):
                self.miss()
            return
        self.rig.hardware.stop()

    def watchdog(self):
        if self.state is ServoState.LIMP:
            self.rig.hardware.start()
            self.reset()
        self.rig.clock.wait_until(self.rig.clock.now_ns() + 300_000_000)
        self.rig.cycle(idle=False)

    def caught_up(self):
        self.until(ServoState.TORQUED)

    def lost(self):
        if self.state is ServoState.LIMP:
            self.come_to(ServoState.TORQUED)
            self.reset()
        self.rig.buses[0].unplug()
        self.rig.goals.position[0] += 0.1
        self.rig.hardware.write_goals()
        self.rig.buses[0].plug_in()
        self.rig.hardware.idle(self.rig.clock.now_ns() + 10_000_000)

    def torque_given(self):
        if self.state is ServoState.LIMP:
            self.requested()
        elif self.state is ServoState.OFFLINE:
            self.lost()
        else:
            self.rig.set_modes(0, Mode.VELOCITY, 0)
        self.servo.silence(False)
        for _ in range(60):
            self.rig.cycle()
            if self.state is ServoState.GIVEN and self.rig.states.mode[1] != Mode.UNKNOWN:
                return

    def anchored(self):
        self.rig.anchors = True
        self.rig.cycle()

    def returned(self):
        self.servo.silence(False)
        self.until(ServoState.RETURNING)

    def returned_limp(self):
        self.servo.power_cycle()
        self.servo.silence(False)
        self.until(ServoState.LIMP)

    def release(self):
        self.rig.hardware.switch_torque(1, False)

    def requested(self):
        if self.state is ServoState.LIMP:
            self.rig.hardware.start()
            self.reset()
        self.rig.hardware.switch_torque(1, True)


@pytest.mark.parametrize(("state", "event"), sorted(LEGAL, key=str))
def test_each_legal_transition_is_reached_by_what_a_servo_does(recorded, state, event):
    story = Story(protocol=1.0 if event is ServoEvent.TORQUE_OFF else 2.0)
    story.come_to(state)
    recorded.clear()
    getattr(story, event.name.lower())()
    assert (state, event) in recorded


def test_a_servo_that_is_lost_after_it_was_let_go_is_released_again_when_it_is_back():
    story = Story()
    story.come_to(ServoState.RELEASED)
    story.lose()
    story.servo.silence(False)
    story.until(ServoState.RELEASED, ServoState.LIMP, ServoState.RETURNING)
    assert story.state is ServoState.RELEASED
    assert story.rig.torque() == [True, False, True]


def test_torque_that_was_read_before_a_servo_was_let_go_gives_it_no_goals():
    """Its torque enable is still being read when the policy comes: the late 1 must not count."""
    story = Story(protocol=1.0)
    story.come_to(ServoState.HOLDING)
    rig = story.rig
    rig.restless = 0.02
    story.servo.silence(False)
    rig.cycle(idle=False)
    rig.hardware._servos[0].schedule_reads(0)  # the read is due, and waits for idle time
    rig.hardware.switch_torque(1, False)
    since = len(rig.into_bus())
    rig.cycles(20)
    assert story.state is ServoState.RELEASED
    goals = [packet for packet in rig.into_bus()[since:] if packet[4] == 0x83]
    assert goals
    assert not any(12 in packet[7:-1:5] for packet in goals)
    assert rig.torque() == [True, False, True]


@campaign(ci=6, night=40, release=300)
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_faults_in_random_order_cause_only_legal_transitions(number, protocol, chance):
    """And no goal goes to a servo whose torque was not read as on since the last doubt."""
    story = Story(protocol)
    rig, line = story.rig, story.rig.buses[0]
    rig.hardware.start()
    rig.restless = 0.002  # a goal to each in every cycle
    let_go: set[int] = set()

    def pull():
        line.unplug()
        if chance.random() < 0.7:
            rig.cycle(idle=chance.random() < 0.5)
        line.plug_in()

    def let_one_go():
        let_go.add(chance.randrange(3))
        for row in let_go:
            rig.hardware.switch_torque(row, False)

    answers: list[list[str]] = []

    def request():
        row = chance.randrange(3)
        answers.append([])
        if chance.random() < 0.7:
            let_go.discard(row)
            rig.hardware.switch_torque(row, True, answers[-1].append)
        else:
            rig.hardware.reboot_servo(row, answers[-1].append)

    happenings = (
        lambda: chance.choice(line.servos).silence(chance.random() < 0.5),
        lambda: chance.choice(line.servos).power_cycle(),
        lambda: chance.choice(line.servos).poke("torque_enable", 0),
        lambda: chance.choice(line.servos).trigger_overload(),
        lambda: truncate_next(line, chance.choice((11, 12, 13)), chance.randrange(6)),
        lambda: rig.set_modes(*(chance.choice((0, 1, 2)) for _ in range(3))),
        lambda: rig.clock.wait_until(rig.clock.now_ns() + 300_000_000),
        pull,
        let_one_go,
        request,
    )
    for _ in range(60):
        # the rarer, the worse
        chance.choices(happenings, (9, 2, 2, 1, 6, 3, 2, 2, 1, 3))[0]()
        for _ in range(chance.randrange(1, 12)):
            begun = len(rig.into_bus())
            rig.hardware.read_states()
            rig.hardware.write_goals()
            gets = [
                servo.servo_id for servo, on in zip(story.plan.servos, story.life.torqued, strict=True) if on
            ]
            for packet in rig.into_bus()[begun:]:
                address, named = goals_in(packet, protocol) or (0, [])
                assert address == 98 or set(named) <= set(gets)  # 98 is the Bus Watchdog
            rig.hardware.idle(rig.clock.now_ns() + 15_000_000)
            rig.clock.wait_until(rig.clock.now_ns() + 5_000_000)
            for index in let_go:
                assert story.life.states[index] in (ServoState.RELEASED, ServoState.OFFLINE)
    line.plug_in()
    for servo in line.servos:
        servo.silence(False)
    rig.cycles(800)
    assert all(len(answer) == 1 for answer in answers), "each request is answered once"
