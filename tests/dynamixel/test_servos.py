"""What cases of text cannot say of servos: times, packets, watchdogs, slow registers, torque and life."""

import itertools
import math
from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.line_faults import truncate_next
from tests.kit.rigs import every_servo, goals_in, make_plan, make_rig, make_x, start_rig

from dxlrun.channels.cycle import SourceStates, States, Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo import life, watchdog
from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.life import (
    GETS_GOALS,
    TRANSITIONS,
    IllegalTransition,
    Life,
    ServoEvent,
    ServoState,
)
from dxlrun.dynamixel.servo.reboots import RebootCount, TickReading
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlwire.control_table import find_table
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.owed import OwedReplies
from dxlwire.exchange.samples import Samples
from dxlwire.modes import Mode
from dxlwire.plan.reads import slow_items
from dxlwire.transaction import Reply, TransactionOutcome
from dxlwire.wire import protocol2


@pytest.fixture
def rig():
    return start_rig(make_x((11, 12, 13, 14)))


def test_a_lost_servo_leaves_the_exchange_and_is_asked_once_a_second(rig):
    rig.servo(13).silence()
    rig.cycles(10)
    count = len(rig.into_bus())
    rig.cycles(500)  # ten seconds
    sent = rig.into_bus()[count:]
    to_it = [packet for packet in sent if packet[4] == 13]
    assert set(to_it) == {protocol2.ping(13)}
    assert 9 <= len(to_it) <= 11
    reads = [packet for packet in sent if packet[7] in (0x82, 0x8A)]
    assert len(reads) == 500
    assert all(13 not in packet[12:-2] for packet in reads)
    assert rig.events.sources(EventCode.SERVO_LOST) == ["arm_13_joint"]


def test_a_bus_that_stands_still_for_a_moment_loses_no_servo_at_any_rate(rig):
    """Three cycles at 500 Hz are less than a USB adapter, or a machine, stands still for now and then."""
    begun = rig.clock.now_ns()
    for servo in rig.buses[0].servos:
        servo.silence()
        rig.buses[0].at(begun + 40_000_000, partial(servo.silence, False))
        rig.buses[0].at(begun + 200_000_000, servo.silence)
    missed = 0
    while not (lost := rig.events.of(EventCode.SERVO_LOST)):
        rig.hardware.read_states()
        rig.hardware.write_goals()
        missed += not rig.states.valid.any()
        rig.clock.wait_until(rig.clock.now_ns() + 1_000_000)
    assert 250_000_000 <= rig.clock.now_ns() - begun < 280_000_000
    assert missed > 2 * 3
    assert len(lost) >= 1
    assert len(rig.events.of(EventCode.READ_BACK)) == 4


def test_a_servo_that_is_lost_at_a_high_rate_is_reported_with_all_that_it_missed(rig):
    rig.period_ns = 4_000_000
    rig.servo(13).silence()
    misses = 0
    while not (lost := rig.events.texts(EventCode.SERVO_LOST)):
        rig.cycle(idle=False)
        misses += 1
    assert misses > 5
    assert f"missed {misses} replies in a row" in lost[0]


@pytest.mark.parametrize(
    ("times_s", "latched"),
    [
        ((0.0, 60.0), (False, True)),
        ((0.0, 60.1), (False, False)),
        ((0.0, 61.0, 90.0, 95.0), (False, False, True, False)),  # it is told once
    ],
)
def test_two_reboots_latch_a_servo_only_within_a_minute(times_s, latched):
    count = RebootCount()
    assert tuple(count.count_reboot(round(at_s * 1e9)) for at_s in times_s) == latched
    assert count.exhausted == any(latched)


@pytest.mark.parametrize("plan", [make_plan((1, 3, 5)), make_x((11, 12, 13, 14))], ids=["1.0", "2.0"])
def test_servos_of_a_bus_that_is_back_are_looked_at_again_before_they_get_a_goal(plan):
    rig = start_rig(plan)
    rig.restless = 0.002  # each goal is sent in every cycle
    rig.cycles(3)
    rig.buses[0].unplug()
    rig.cycles(1)  # too short for any servo to be lost
    rig.buses[0].plug_in()
    count = len(rig.into_bus())
    rig.cycles(30)
    since = rig.into_bus()[count:]
    assert all(rig.torque())
    for servo in plan.servos:
        one = servo.servo_id
        asks_model = bytes((one, 4, 2, 0)) if plan.protocol == 1.0 else bytes((one, 7, 0, 2, 0, 0))
        looks = [asks_model in packet for packet in since]
        goals = [one in (goals_in(packet, plan.protocol) or (0, []))[1] for packet in since]
        assert any(looks[: goals.index(True)]), "it got a goal before its model was read"


@pytest.mark.parametrize("hears_stop", [True, False])
def test_returned_wheel_is_given_torque_at_rest(hears_stop):
    """It must not resume its speed before the loop has anchored it, whether it received the stop or not."""
    rig = start_rig(make_x((11,), continuous=True, start_mode=Mode.VELOCITY))
    rig.anchors = False
    rig.goals.velocity[:] = 0.5
    rig.cycles(20)
    servo = rig.servo(11)
    assert servo.registers["goal_velocity"] != 0
    with rig.away(11, cycles=10):
        if hears_stop:
            servo.poke("goal_velocity", 0)
    rig.cycles(20)
    assert servo.registers["goal_velocity"] == 0
    assert rig.states.torque.tolist() == [Torque.GIVEN]
    ((_, text),) = rig.events.of(EventCode.SERVO_BACK)
    assert text.endswith("and holds its position")


def tick(value, sent_ns, last_ns=None):
    data = (value % 32768).to_bytes(2, "little")
    return TickReading.from_reply(
        Reply(TransactionOutcome.OK, 0, data, last_ns or sent_ns, 0, False, sent_ns, sent_ns)
    )


@pytest.mark.parametrize(
    ("value", "after_ms", "rebooted"),
    [
        (31_000, 1_000, False),  # in step
        (31_039, 1_000, False),  # 2 % and 20 ms fast
        (30_961, 1_000, False),
        (31_041, 1_000, True),
        (400, 1_000, True),  # back at 0 before
        (30_000 + 15_000, 15_000, False),  # across the turn
        (100, 15_000, True),
        (100, 17_000, None),  # unseen for too long
    ],
)
def test_a_tick_shows_a_reboot(value, after_ms, rebooted):
    before = tick(30_000, 0)
    assert before.rebooted(None) is None
    assert tick(value, after_ms * 1_000_000).rebooted(before) is rebooted


def test_a_reply_that_was_long_under_way_is_no_reboot():
    assert tick(1_000, 1_000_000_000, 1_150_000_000).rebooted(tick(0, 0)) is False


def start_slow(plan=None, *, slow_period_ns=1_000_000_000):
    plan = plan or make_x((11, 12))
    slow = slow_items(find_table(plan.servos[0].model, plan.protocol))
    plan = replace(plan, slow_period_ns=slow_period_ns)
    return start_rig(every_servo(plan, slow=slow))


@pytest.mark.parametrize(
    "plan",
    [
        make_x((11, 12)),
        make_plan((11, 12)),
        make_x((11, 12), model="XL-320", reference=2.6, lower=-2.0, upper=2.0),
    ],
    ids=["XM430-W350", "AX-12A", "XL-320"],
)
def test_temperature_and_voltage_come_into_the_states_at_their_own_rate(plan):
    rig = start_slow(plan)
    servo = rig.buses[0].servos[1]
    rig.cycles(60)
    assert rig.states.temperature[1] == pytest.approx(servo.temperature, abs=0.6)
    assert rig.states.voltage[1] == pytest.approx(servo.voltage, abs=0.2)
    count = len(rig.into_bus())
    rig.cycles(500)
    reading = [packet for packet in rig.into_bus()[count:] if packet[4] == servo.servo_id]
    blocks = set(reading)
    assert len(blocks) <= 3
    assert all(9 <= reading.count(block) <= 11 for block in blocks)  # once a second


def test_values_of_a_second_bus_are_shown_at_its_joints():
    slow = slow_items(find_table("XM430-W350", 2.0))
    plans = [make_x((11,)), make_x((21,), name="leg", first_row=1)]
    rig = start_rig(*(every_servo(replace(plan, slow_period_ns=SECOND_NS), slow=slow) for plan in plans))
    rig.servo(21, bus=1).set_voltage(11.0)
    rig.cycles(60)
    assert rig.states.voltage.tolist() == pytest.approx([12.0, 11.0])


def test_slow_registers_make_no_cycle_late_and_wait_for_ever_where_there_is_no_time():
    for period_ns, known in ((2_000_000, True), (1_000_000, False)):  # the exchange takes 0.85 ms
        rig = start_slow(slow_period_ns=20_000_000)
        rig.period_ns = period_ns
        rig.cycles(200)  # `cycle` asserts that it ends in time
        assert np.isfinite(rig.states.voltage).tolist() == [known] * 2
    assert rig.events.of(EventCode.OVERRUN) == []
    rig.period_ns = 2_000_000
    rig.cycles(200)
    assert np.isfinite(rig.states.voltage).all()


TRIPPED = 0xFF
MS = 1_000_000
SECOND_NS = 1_000 * MS


def arm(ids=(11, 12, 13, 14), ticks=10, **change):
    return replace(make_x(ids, **change), watchdog_ticks=ticks)


@pytest.fixture
def started():
    return start_rig(arm())


def armed(rig):
    return rig.registers("bus_watchdog")


def fastest(rig, servo, count):
    """Return the highest speed of a servo in the next cycles, rad/s."""
    speeds = []
    for _ in range(count):
        rig.cycle()
        speeds.append(abs(servo.velocity))
    return max(speeds)


def test_no_servo_is_taken_for_tripped_before_it_was_armed():
    """The first states are read again after a pause that is longer than the watchdogs.

    Arming takes an exchange a servo, in which those that are armed hear nothing of a cycle.
    """
    rig = make_rig(arm(ticks=2))
    read = rig.hardware.read_states

    def spoilt():
        truncate_next(rig.buses[0], 11, 4)
        rig.hardware.read_states = read
        read()

    rig.hardware.read_states = spoilt
    rig.hardware.start()
    assert rig.events.of(EventCode.READ_LOST)
    assert rig.events.of(EventCode.WATCHDOG) == []
    # goals are followed as fast as they say
    assert all(map(math.isnan, rig.hardware._servos[0].life.ceiling))


def test_a_process_that_stands_still_again_and_again_before_a_read_shows_no_older_states(started):
    """Each time behind what was done about the one before, and before the read."""
    started.cycles(5)
    prepare, left = started.hardware._prepare_read, [SECOND_NS] * 2

    def prepared():
        prepare()
        if left:
            started.wait(left.pop())

    started.hardware._prepare_read = prepared
    started.wait(SECOND_NS)
    started.hardware.read_states()
    assert not left
    assert started.states.valid.all()
    assert max(started.states.age_ns) < started.period_ns
    started.cycles(100)
    assert armed(started) == [10] * 4


def test_many_are_disarmed_where_torque_stays_on_although_that_takes_longer_than_a_watchdog():
    rig = start_rig(arm(range(1, 25), ticks=2, return_delay_ns=500_000))
    rig.period_ns = 25 * MS
    rig.cycles(5)
    assert armed(rig) == [2] * 24
    rig.hardware.leave_torque_on()
    rig.wait(SECOND_NS)
    assert all(rig.torque())
    assert rig.events.of(EventCode.WATCHDOG) == []
    assert armed(rig) == [0] * 24


def test_a_servo_that_is_revived_goes_on_slowly_though_its_profile_was_reset(started):
    servo = started.servo(12)
    started.goals.position[:], started.goals.velocity[:] = 2.0, 0.2
    started.cycles(5)
    assert 0.1 < abs(servo.velocity) < 0.25
    started.wait(300 * MS)
    assert (servo.registers["bus_watchdog"], servo.registers["profile_velocity"]) == (TRIPPED, 0)
    started.goals.velocity[:] = 10.0
    assert 0.5 < fastest(started, servo, 50) < 1.1 * RETURN_SPEED
    assert servo.registers["bus_watchdog"] == 10


@pytest.mark.parametrize("ratio", [1.0, 0.25, 3.0])
def test_shaft_of_a_lost_servo_returns_slowly_whatever_its_gear_though_its_profile_was_reset(ratio):
    rig = start_rig(arm(ratio=ratio, lower=-2.5 * ratio, upper=2.5 * ratio))
    servo = rig.servo(12)
    rig.goals.position[:], rig.goals.velocity[:] = 2.0 * ratio, 0.2 * ratio
    rig.cycles(5)
    servo.silence()
    rig.cycles(5)
    # as the reset of a watchdog that heard nothing leaves it
    for name, value in (("profile_velocity", 0), ("profile_acceleration", 0), ("bus_watchdog", -1)):
        servo.poke(name, value)
    servo.silence(False)
    rig.goals.velocity[:] = 10.0 * ratio
    assert fastest(rig, servo, 100) == pytest.approx(RETURN_SPEED, rel=0.1)
    assert servo.registers["bus_watchdog"] == 10


def test_a_servo_that_its_watchdog_stopped_gets_no_goal_before_its_torque_was_read(started):
    started.restless = 0.002
    started.cycles(5)
    started.wait(300 * MS)
    count = len(started.into_bus())
    started.cycles(30)
    since = started.into_bus()[count:]
    for servo_id in (11, 12, 13, 14):
        asked = since.index(protocol2.read_range(servo_id, 64, 1))
        named = [at for at, p in enumerate(since) if p[7] == 0x83 and p[8] != 98 and servo_id in p[12:-2:9]]
        assert named
        assert named[0] > asked


def disarm(answer):
    """Disarm the watchdog of a servo that answers each packet; return what was written, and the problem."""
    plan, found = arm(), {}
    program = watchdog.disarm(access_servo(plan, plan.servos[0]))
    request = next(program)
    try:
        while True:
            packet = request.packet
            address = int.from_bytes(packet[8:10], "little")
            if packet[7] == 3:
                found[address] = packet[10:-2]
            request = program.send(answer(packet, address, found))
    except StopIteration as end:
        return found, end.value


def reply(data=b"", *, timeout=False):
    return Reply(TransactionOutcome.TIMEOUT if timeout else TransactionOutcome.OK, 0, data, 0, 0, False)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (reply(timeout=True), "did not answer when Bus Watchdog (98) was read back"),
        (reply(b"\x0a"), "has Bus Watchdog (98) = 10 after 0 was written"),
    ],
)
def test_a_watchdog_that_is_not_read_as_0_is_written_and_is_not_cleared(answer, said):
    written, problem = disarm(lambda *_: answer)
    assert written[98] == b"\0"
    assert said in problem


@pytest.mark.parametrize(
    ("silent", "written", "said"),
    [
        (None, {112, 98, 104}, ""),
        (11, {112}, "did not answer when its Operating Mode (11) was read"),
        (104, {112, 98, 104, 64}, "did not acknowledge Goal Velocity (104) = 0"),
    ],
)
def test_a_servo_that_follows_velocities_is_freed_of_its_watchdog_only_to_stand(silent, written, said):
    def answer(packet, address, found):
        data = b"" if packet[7] == 3 else b"\1\xff" if address == 11 else found.get(98, b"\xff")
        return reply(data, timeout=address == silent)

    found, problem = disarm(answer)
    assert said in problem
    assert bool(problem) == bool(said)
    assert found.keys() == written
    assert not any(any(data) for address, data in found.items() if address != 112)


IDS = (11, 12, 13)


def answer_of(rig, on):
    """Switch the torque of the second servo; run cycles until there is an answer, and return it."""
    answers = []
    rig.hardware.switch_torque(1, on, answers.append)
    while not answers:
        rig.cycle()
    return answers[0]


def test_a_servo_that_reboots_while_it_is_checked_gets_no_torque():
    """At any packet from the first reading of its clock, before the check, to the second, before torque."""

    def let_go():
        rig = start_rig(every_servo(make_x(IDS), torque_on_return=True))
        assert answer_of(rig, on=False) == ""
        return rig, len(rig.into_bus())

    rig, begun = let_go()
    assert answer_of(rig, on=True) == ""
    tick = protocol2.read_range(12, 120, 2)
    first, last = (number for number, packet in enumerate(rig.into_bus()[begun:]) if packet == tick)
    assert last - first > 5
    for packets in range(first + 1, last + 1):
        rig, begun = let_go()
        given = rig.torque_given(12)
        rig.buses[0].after(packets, rig.servo(12).power_cycle)
        assert "rebooted during the check" in answer_of(rig, on=True), packets
        rig.cycles(100)
        assert not any(given)


@pytest.mark.parametrize("returning", [False, True])
@pytest.mark.parametrize("after", range(1, 14))
def test_a_servo_that_reboots_while_its_mode_changes_gets_torque_by_the_policy_alone(returning, after):
    rig = start_rig(every_servo(make_x(IDS), torque_on_return=returning))
    rig.set_modes(0, Mode.VELOCITY, 0)
    rig.buses[0].after(after + 2, rig.servo(12).power_cycle)
    rig.cycles(150)
    assert rig.torque() == [True, returning, True]
    assert rig.states.mode[1] == Mode.VELOCITY


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
