"""Owed replies: which late replies count as an answer, and how long one is awaited."""

import pytest
from tests.kit.line_faults import delay_next, truncate_next
from tests.kit.rigs import Rig, make_plan, make_x, start_rig

from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.torque_off import limp
from dxlwire.exchange.bus_engine import Lines
from dxlwire.exchange.owed import LEAST_WINDOW_NS, SLOW_MEMORY_NS, OwedReplies
from dxlwire.plan.line import MOST_SPARE
from dxlwire.plan.retry import ReplyLateness, extend_timeouts, retry
from dxlwire.transaction import Program, Reply, Transaction
from dxlwire.wire import protocol2

READ = 2  # Instruction of Protocol 1.0
MILLISECOND_NS = 1_000_000
PLAN = make_x((11,))
ONE = access_servo(PLAN, PLAN.servos[0])


def read_once(request: Transaction) -> Program[Reply]:
    return (yield request)


def delay_torque_reads(rig: Rig) -> Lines:
    """Send one read of Torque Enable of each length, whose replies come 40 ms late; return the lines."""
    lines, one = rig.lines, access_servo(rig.plans[0], rig.plans[0].servos[0])
    for length in range(1, 2 + MOST_SPARE):
        delay_next(rig.buses[0], 1, 40 * MILLISECOND_NS)
        lines.run_programs([read_once(one.line.read_range(1, one.servo.torque_address, length))])
    return lines


def test_old_reading_does_not_confirm_torque_off():
    rig = start_rig(make_plan((1,)))
    servo = rig.servo(1)
    servo.poke("torque_enable", 0)
    lines = delay_torque_reads(rig)
    rig.stick(1, "torque_enable", 1)
    servo.poke("torque_enable", 1)
    rig.when(lambda data: data[4] == READ, lambda: truncate_next(rig.buses[0], 1, 0))
    (outcome,) = limp(lines)
    assert not outcome.confirmed, "an old reply says 0, and the read-backs are lost"


def test_torque_off_is_confirmed_while_older_readings_are_owed():
    rig = start_rig(make_plan((1,)))
    lines = delay_torque_reads(rig)
    (outcome,) = limp(lines)
    assert outcome.confirmed
    assert not rig.servo(1).registers["torque_enable"]


class Owed:
    """Owed replies of one line with a clock that the test sets."""

    def __init__(self) -> None:
        self.at_ns = 0
        self.replies = OwedReplies(lambda: self.at_ns)

    def miss(self, request: Transaction, at_ns: int) -> None:
        self.at_ns = at_ns
        self.replies.add(request, 0, at_ns)

    def write(self, request: Transaction, at_ns: int) -> None:
        self.at_ns = at_ns
        self.replies.note_change(request, at_ns)

    def confuses(self, request: Transaction, at_ns: int) -> bool:
        self.at_ns = at_ns
        return self.replies.confuses(request, request.awaited[0], refusal=False, any_age=False)


def test_retried_write_keeps_the_readings_after_its_first_attempt():
    owed, write, read = Owed(), ONE.writing(64, b"\0"), ONE.reading(64, 1)
    owed.write(write, 1)
    owed.miss(read, 2)
    owed.write(write, 3)
    assert not owed.confuses(read, 4)


def test_write_repeated_later_invalidates_older_readings():
    owed, write, read = Owed(), ONE.writing(64, b"\0"), ONE.reading(64, 1)
    owed.write(write, 1)
    owed.miss(read, LEAST_WINDOW_NS)
    owed.write(write, LEAST_WINDOW_NS + 1)
    assert owed.confuses(read, LEAST_WINDOW_NS + 2)


def test_reading_from_before_a_write_is_no_answer_however_often_it_was_repeated():
    owed, write, read = Owed(), ONE.writing(64, b"\0"), ONE.reading(64, 1)
    owed.miss(read, 1)
    owed.write(write, 2)
    owed.miss(read, 3)
    assert owed.confuses(read, 4)


def test_write_to_all_servos_invalidates_older_readings():
    owed, read = Owed(), ONE.reading(64, 1)
    owed.miss(read, 1)
    owed.write(ONE.line.unanswered(protocol2.sync_write(64, 1, {ONE.servo.servo_id: b"\0"})), 2)
    assert owed.confuses(read, 3)


@pytest.mark.parametrize(("between", "confuses"), [(None, False), (ONE.writing(64, b"\1"), True)])
def test_late_acknowledgement_counts_for_the_repetition_of_its_write(between, confuses):
    owed, write = Owed(), ONE.writing(64, b"\0")
    owed.write(write, 1)
    owed.miss(write, 1)
    if between is not None:
        owed.write(between, 2)
    owed.write(write, 3)
    assert owed.confuses(write, 4) is confuses


def test_slow_reply_widens_the_window_for_a_minute():
    owed, read = Owed(), ONE.reading(64, 1)
    owed.miss(read, 0)
    owed.at_ns = slow_ns = 700 * MILLISECOND_NS
    owed.replies.charge_reply(11, 1, 0)
    assert owed.replies.window_ns == slow_ns * 5 // 4
    owed.at_ns += SLOW_MEMORY_NS
    assert owed.replies.window_ns == slow_ns * 5 // 4
    owed.at_ns += 1
    assert owed.replies.window_ns == LEAST_WINDOW_NS


@pytest.mark.parametrize("register", [64, 65])
def test_lost_reply_is_not_lateness_of_the_next_one(register):
    """Neither the repetition of the lost read nor a read of another register of as many bytes is late."""
    rig = start_rig(PLAN)
    times = ReplyLateness()

    def program() -> Program[Reply]:
        yield ONE.reading(64, 1)
        return (yield from retry(ONE.reading(register, 1)))

    truncate_next(rig.buses[0], 11, 0)
    (reply,) = rig.lines.run_programs([extend_timeouts(program(), times=times)])
    assert reply is not None
    assert reply.answered
    assert all(each < MILLISECOND_NS for each in times.late_ns)
    assert times.missing == 1


def test_a_bus_without_power_is_given_up_within_two_seconds():
    rig = start_rig(PLAN)
    rig.servo(11).silence()

    def program() -> Program[None]:
        for _ in range(30):
            yield from retry(ONE.reading(64, 1))

    begun_ns = rig.clock.now_ns()
    rig.lines.run_programs([extend_timeouts(program())])
    assert rig.clock.now_ns() - begun_ns < 2_000 * MILLISECOND_NS
