"""A servo's life: what follows from each transition, and that no fault causes another one."""

import itertools

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.line_faults import truncate_next
from tests.kit.rigs import goals_in, make_plan, make_rig, start_rig

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

RELEASED, OFFLINE, GIVEN = ServoState.RELEASED, ServoState.OFFLINE, ServoState.GIVEN
RETURNING, STOPPED = ServoState.RETURNING, ServoState.STOPPED
LEGAL = {(state, event) for state, events in TRANSITIONS.items() for event in events}


@pytest.mark.parametrize(("state", "event"), sorted(itertools.product(ServoState, ServoEvent), key=str))
def test_what_follows_from_a_state_is_derived_at_each_transition_and_no_other_is_made(state, event):
    plan = make_plan((1,))
    rig = make_rig(plan)
    samples = Samples([plan], States.empty(1), SourceStates.empty(), None)
    reads = CyclicReads(plan, samples.buses[0], OwedReplies(rig.clock.now_ns))
    one = Life(rig.hardware._idle[0], reads, rig.events)
    one.states[0], reads.away[0] = state, state is OFFLINE
    if state is OFFLINE:
        one.losses = {0: life.OfflineServo(True, True, False, False, False, 0)}
    if (state, event) not in LEGAL:
        with pytest.raises(IllegalTransition, match=f"main_1_joint .* is {state.value}; {event.value}"):
            one.on(0, event)
        assert (one.states[0], reads.away[0]) == (state, state is OFFLINE)
        return
    after = one.on(0, event)
    assert after is TRANSITIONS[state][event] is one.states[0]
    assert one.torqued[0] == (after in GETS_GOALS)
    assert reads.away[0] == (after is OFFLINE)
    np.testing.assert_equal(
        one.ceiling[0], RETURN_SPEED if after in {STOPPED, RETURNING, OFFLINE} else np.nan
    )


def test_no_state_gets_goals_but_by_torque_that_was_read():
    """A goal may switch torque on: only torque enable = 1, read after the last doubt, leads to goals."""
    leading = [(state, event) for state, event in LEGAL if TRANSITIONS[state][event] in GETS_GOALS]
    found = [(state, event) for state, event in leading if state not in GETS_GOALS]
    assert {event for _, event in found} == {ServoEvent.TORQUE_ON}
    assert {state for state, _ in found} <= life.IN_DOUBT


def test_a_servo_that_its_watchdog_stopped_follows_no_goal_at_full_speed():
    """Its goal may have moved on meanwhile: it is limp, or returns slowly."""
    after = {TRANSITIONS[state][event] for state, event in LEGAL if event is ServoEvent.WATCHDOG}
    assert after == life.POWERLESS | {STOPPED, GIVEN}


def test_a_released_servo_gets_no_goals_on_any_way_but_a_return_or_a_request():
    reached, new = {RELEASED}, {RELEASED}
    while new:
        ways = [
            (state, event) for state, event in LEGAL if state in new and event is not ServoEvent.REQUESTED
        ]
        found = {TRANSITIONS[state][event] for state, event in ways}
        new = found - reached - {OFFLINE}
        reached |= found
    assert reached == {RELEASED, OFFLINE}


def three_servos(protocol):
    """Return hardware that holds three servos."""
    model = {} if protocol == 1.0 else {"protocol": 2.0, "model": "XM430-W350"}
    plan = make_plan((11, 12, 13), name="arm", return_delay_ns=0, **model)
    return start_rig(replace(plan, watchdog_ticks=10 if protocol == 2.0 else 0))


def test_torque_that_was_read_before_a_servo_was_let_go_gives_it_no_goals():
    """Its torque enable is still being read when the policy comes: the late 1 must not count."""
    rig = three_servos(1.0)
    rig.restless = 0.02
    servo, life = rig.servo(12), rig.hardware._servos[0].life
    servo.silence()
    rig.cycle()
    assert life.states[1] is ServoState.HOLDING
    servo.silence(False)
    rig.cycle(idle=False)
    rig.hardware._servos[0].schedule_reads(0)  # the read is due, and waits for idle time
    rig.hardware.switch_torque(1, False)
    since = len(rig.into_bus())
    rig.cycles(20)
    assert life.states[1] is RELEASED
    goals = rig.goals_sent(since)
    assert goals
    assert not any(12 in ids for _, ids in goals)
    assert rig.torque() == [True, False, True]


@campaign(ci=3, night=40, release=300)
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_faults_in_random_order_cause_only_legal_transitions(number, protocol, chance):
    """And no goal goes to a servo whose torque was not read as on since the last doubt."""
    rig = three_servos(protocol)
    line, life = rig.buses[0], rig.hardware._servos[0].life
    rig.restless = 0.002  # a goal to each in every cycle
    let_go: set[int] = set()
    answers: list[list[str]] = []

    def pull():
        line.unplug()
        if chance.random() < 0.7:
            rig.cycle(idle=chance.random() < 0.5)
        line.plug_in()

    def let_one_go():
        let_go.add(chance.randrange(3))
        for row in let_go:
            rig.hardware.switch_torque(row, False)

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
            servos = zip(rig.plans[0].servos, life.torqued, strict=True)
            gets = {servo.servo_id for servo, on in servos if on}
            for packet in rig.into_bus()[begun:]:
                address, named = goals_in(packet, protocol) or (0, [])
                assert address == 98 or gets.issuperset(named)  # 98 is the Bus Watchdog
            rig.hardware.idle(rig.clock.now_ns() + 15_000_000)
            rig.clock.wait_until(rig.clock.now_ns() + 5_000_000)
            for index in let_go:
                assert life.states[index] in {RELEASED, OFFLINE}
    line.plug_in()
    for servo in line.servos:
        servo.silence(False)
    rig.cycles(800)
    assert all(len(answer) == 1 for answer in answers), "each request is answered once"
