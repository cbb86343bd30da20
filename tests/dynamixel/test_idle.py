import pytest
from tests.kit.rigs import make_rig, make_x

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.wire_reports import WireReports
from dxlwire.exchange.idle import STARVED, STARVED_AGAIN, IdleScheduler, Urgency
from dxlwire.plan.line import listen_transaction
from dxlwire.plan.planning import plan_line
from dxlwire.transaction import TransactionOutcome
from dxlwire.wire import protocol2

READ_NS = 270_000
"""14 bytes there, 13 back, 1 Mbit/s, no return delay: what one of the reads below takes."""


class Rounds:
    """One bus whose idle times come one after the other, each a millisecond after the one before."""

    def __init__(self):
        self.rig = make_rig(make_x((11, 12)))
        self.lines = self.rig.lines
        (self.bus,) = self.lines.buses
        self.idle = IdleScheduler(self.bus, WireReports(self.rig.events))

    def gap(self, length_ns):
        until = self.rig.clock.now_ns() + length_ns
        count = len(self.rig.into_bus())
        if self.idle.begin_idle(until):
            self.bus.load_job(self.idle)
            self.lines.pump()
        self.over_ns = self.rig.clock.now_ns() - until
        self.rig.clock.wait_until(until + 1_000_000)
        return self.rig.into_bus()[count:]

    def add(self, program, done, *others, **more):
        def ended():
            done((yield from program))

        self.idle.add(ended(), *others, **more)

    def read(self, servo_id, address, size=1):
        return plan_line(self.rig.plans[0]).read_range(servo_id, address, size)


@pytest.fixture
def rounds():
    return Rounds()


def reading(rounds, servo_id, *addresses):
    found = []
    for address in addresses:
        reply = yield rounds.read(servo_id, address)
        found.append(reply.parameters[0] if reply.answered else reply.outcome)
    return found


def test_a_program_goes_on_from_gap_to_gap(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7, 11, 64), found.append, Urgency.SLOW, "three reads")
    sent = [rounds.gap(READ_NS + 150_000) for _ in range(4)]
    assert sent == [[protocol2.read_range(11, address, 1)] for address in (7, 11, 64)] + [[]]
    assert found == [[11, 3, 0]]
    assert rounds.idle.waiting == 0


def test_the_more_urgent_goes_first_even_between_two_transactions(rounds):
    ended = []
    for urgency in (Urgency.SLOW, Urgency.STEERED, Urgency.REPAIR):
        rounds.add(reading(rounds, 11, 7, 11), lambda _, u=urgency: ended.append(u), urgency, "two")
    rounds.gap(READ_NS + 150_000)
    rounds.add(reading(rounds, 12, 7), lambda _: ended.append(Urgency.MODE), Urgency.MODE, "one")
    for _ in range(8):
        rounds.gap(READ_NS + 150_000)
    assert ended == [Urgency.MODE, Urgency.REPAIR, Urgency.STEERED, Urgency.SLOW]


def test_of_one_servo_the_program_that_began_ends_first(rounds):
    ended = []
    for name, urgency, servo in (("a", Urgency.REPAIR, 0), ("b", Urgency.MODE, 0), ("c", Urgency.MODE, 1)):
        servo_id = rounds.rig.plans[0].servos[servo].servo_id
        program = reading(rounds, servo_id, 7, 11, 64)
        rounds.add(program, lambda _, name=name: ended.append(name), urgency, name, servo)
        rounds.gap(READ_NS + 150_000)
    for _ in range(9):
        rounds.gap(READ_NS + 150_000)
    assert ended == ["a", "b", "c"]


def test_a_pause_of_one_program_leaves_the_line_to_the_others(rounds):
    ended = []

    def pausing():
        yield rounds.read(11, 7)
        before = rounds.rig.clock.now_ns()
        reply = yield listen_transaction(5_000_000)
        assert reply.outcome is TransactionOutcome.SENT
        return rounds.rig.clock.now_ns() - before

    rounds.add(pausing(), ended.append, Urgency.MODE, "pausing")
    rounds.add(reading(rounds, 12, 7), ended.append, Urgency.SLOW, "reading")
    for _ in range(8):
        rounds.gap(1_000_000)
    assert ended[0] == [12]
    assert 5_000_000 <= ended[1] <= 7_000_000


@pytest.mark.parametrize(("urgency", "done"), [(Urgency.REPAIR, True), (Urgency.SLOW, False)])
def test_what_is_urgent_is_done_at_last_in_a_gap_too_short_and_what_is_slow_never(rounds, urgency, done):
    found = []
    name = "torque enable of arm_11_joint"
    rounds.add(reading(rounds, 11, 7, 7, 7), found.append, urgency, name, servo=0)
    sent = [len(rounds.gap(READ_NS)) for _ in range(STARVED + 3 * STARVED_AGAIN)]
    assert sum(sent[:STARVED]) == 0
    assert found == ([[11, 11, 11]] if done else [])
    told = rounds.rig.events.of(EventCode.OVERRUN)
    assert len(told) == done
    if done:
        ((source, text),) = told
        assert source == rounds.rig.plans[0].servos[0].joint
        assert text.startswith(f"{name} needs up to 0.4 ms of idle time, but a cycle leaves only 0.3 ms")


def test_what_is_urgent_waits_no_longer_for_a_slow_program_of_its_servo(rounds):
    ended = []
    for name, urgency, addresses in (("slow", Urgency.SLOW, (7, 11)), ("urgent", Urgency.REPAIR, (7,))):
        program = reading(rounds, 11, *addresses)
        rounds.add(program, lambda _, name=name: ended.append(name), urgency, name, 0)
        rounds.gap(READ_NS + 150_000 * (name == "slow"))
    for _ in range(2 * STARVED + STARVED_AGAIN):
        rounds.gap(READ_NS)
    assert ended == ["slow", "urgent"]


def test_every_program_of_a_line_that_is_gone_ends_with_time_outs(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7, 11), found.append, Urgency.MODE, "begun")
    rounds.gap(READ_NS + 150_000)

    def adding(result):
        found.append(result)
        rounds.add(reading(rounds, 12, 7), found.append, Urgency.SLOW, "added")

    rounds.add(reading(rounds, 12, 7), adding, Urgency.SLOW, "not begun")
    rounds.idle.abandon()
    assert found == [[11, TransactionOutcome.TIMEOUT], [TransactionOutcome.TIMEOUT]]
    assert rounds.idle.waiting == 1


def test_a_transaction_that_a_cycle_cut_off_is_asked_again(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.MODE, "one")
    assert rounds.idle.begin_idle(rounds.rig.clock.now_ns() + 5_000_000)
    rounds.bus.load_job(rounds.idle)
    rounds.bus.process_due(rounds.rig.clock.now_ns())  # sent, and nothing waits for the reply
    rounds.rig.clock.wait_until(rounds.rig.clock.now_ns() + 5_000_000)
    assert rounds.gap(1_000_000) == [protocol2.read_range(11, 7, 1)]
    assert found == [[11]]


def test_a_gap_begins_nothing_on_a_line_that_was_late_until_that_is_forgotten(rounds):
    found = []
    rounds.bus._note_lateness(400_000)  # of its cyclic reply
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.SLOW, "a read")
    assert rounds.gap(READ_NS + 150_000) == []
    assert rounds.bus.late_ns == 400_000
    for _ in range(200):
        rounds.bus._note_lateness(0)
    assert rounds.bus.late_ns < 50_000
    assert len(rounds.gap(READ_NS + 150_000)) == 1
    assert found == [[11]]


def test_one_reply_that_came_a_second_late_does_not_close_the_idle_time_of_the_next_seconds(rounds):
    found = []
    rounds.bus._note_lateness(1_000_000_000)  # the process was not running
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.MODE, "the mode of a servo")
    assert len(rounds.gap(5_000_000)) == 1
    assert found == [[11]]
