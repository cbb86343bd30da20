"""One request at a time: which bytes answer it, which belong to others, and when the next one goes out."""

import pytest
from tests.kit.plans import ScriptedLine, make_plan

from dxlwire.exceptions import PortError
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketKind
from dxlwire.plan.line import Line, listen_transaction
from dxlwire.transaction import ProgramJob, Reply, TransactionOutcome
from dxlwire.wire import protocol1, protocol2

OK, TIMEOUT, GARBLED = (TransactionOutcome[name] for name in ("OK", "TIMEOUT", "GARBLED"))
INSTRUCTION, STATUS, LATE = PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.LATE
LINE = Line(1_000_000, 0, 500_000)
READ = LINE.read_range(7, 36, 6)
GOOD = protocol1.status_packet(7, 0, b"abcdef")
STALE = protocol1.status_packet(7, 0, b"------")
QUESTION = LINE.read_range(7, 24, 1)
"""Not read in each cycle."""
ANSWER = protocol1.status_packet(7, 0, b"a")
GOALS = LINE.unanswered(protocol1.sync_write(30, 4, {7: b"abcd"}))


class Sink:
    def __init__(self):
        self.packets = []

    def packet(self, *packet):
        self.packets.append((*packet[:5], bytes(packet[5])))

    @property
    def kinds(self):
        """Kind, ID and bytes of what came."""
        return [
            (kind, servo_id, data) for _, kind, servo_id, _, _, data in self.packets if kind != INSTRUCTION
        ]

    @property
    def received(self):
        return b"".join(data for *_, data in self.kinds)


def open_lines(line, protocol=1.0):
    plan = make_plan((7,), protocol=protocol, model="AX-12A" if protocol == 1.0 else "XM430-W350")
    line.sink = Sink()
    lines = Lines([plan], line, line.clock, line.sink)
    (line.bus,) = lines.buses
    return lines


def talk(line, *transactions, protocol=1.0):
    """Send transactions one after the other; return their replies."""
    lines = open_lines(line, protocol)

    def program():
        replies = []
        for transaction in transactions:
            replies.append((yield transaction))
        return replies

    (replies,) = lines.run_programs([program()])
    return replies


def test_a_longer_reply_in_two_pieces_is_awaited_to_its_last_byte():
    longer = protocol1.status_packet(7, 0, b"abcdefg")
    line = ScriptedLine([], [(600_000, longer[:-1]), (690_000, longer[-1:])])
    lost, reply = talk(line, LINE.read_range(7, 24, 6), LINE.read_range(7, 36, 6, spare=1))
    assert line.written[-1] == protocol1.read_range(7, 36, 7), "a reply of 6 bytes is owed"
    assert (lost.outcome, reply.outcome, reply.parameters) == (TIMEOUT, OK, b"abcdef")


def test_after_a_timeout_the_line_is_drained_until_it_is_silent():
    timeout = READ.timeout_ns
    line = ScriptedLine([(timeout - 20_000, STALE[:3]), (timeout + 100_000, STALE[3:])], [(700_000, GOOD)])
    reply, after = talk(line, READ, READ)
    assert (reply.outcome, after.parameters) == (GARBLED, b"abcdef")
    assert line.sink.received == STALE + GOOD
    assert line.clock.now_ns() == 1_000 + timeout + 100_000 + 200_000 + 700_000


def test_draining_ends_on_a_line_that_babbles():
    line = ScriptedLine([(step * 100_000, b"\x55") for step in range(1, 400)], [])
    reply, _ = talk(line, READ, listen_transaction(0))
    assert reply.outcome is GARBLED
    assert line.clock.now_ns() <= 1_000 + READ.timeout_ns + 5_000_000


def test_a_false_header_does_not_cost_the_timeout():
    line = ScriptedLine([(650_000, b"\xff\xff\x03\x60"), (700_000, GOOD)])
    (reply,) = talk(line, READ)
    assert (reply.parameters, line.clock.now_ns()) == (b"abcdef", 701_000)
    assert line.sink.received == b"\xff\xff\x03\x60" + GOOD


# Late, doubled and foreign packets


def test_a_late_reply_is_known_once_however_late_it_comes():
    late = (300_000, ANSWER)
    line = ScriptedLine([], [(700_000, GOOD)], [late, (700_000, GOOD)], [late, (700_000, GOOD)])
    question, *reads = talk(line, QUESTION, READ, READ, READ)
    assert question.outcome is TIMEOUT
    assert [(read.answered, read.strays) for read in reads] == [(True, 0), (True, 0), (True, 1)]
    assert [kind for kind, _, data in line.sink.kinds if data == ANSWER] == [LATE, STATUS]
    assert line.bus.unrequested == 1  # the second one answers no question of this host


def test_a_doubled_reply_is_explained_by_the_transaction_before():
    doubled = (300_000, ANSWER)
    line = ScriptedLine([(700_000, ANSWER)], [doubled, (700_000, GOOD)], [doubled, (700_000, GOOD)])
    replies = talk(line, QUESTION, READ, READ)
    assert [(reply.answered, reply.strays) for reply in replies] == [(True, 0), (True, 1), (True, 1)]
    assert line.bus.unrequested == 1  # the one that came after another transaction


@pytest.mark.parametrize("after_ns", [30_000, 60_000_000], ids=["while drained", "with the next read"])
def test_a_reply_that_comes_too_late_is_neither_garbled_nor_the_next_ones(after_ns):
    at_ns = READ.timeout_ns + after_ns
    line = ScriptedLine([(at_ns, STALE)], [], [])
    silence = [listen_transaction(at_ns)] if after_ns > 1_000_000 else []
    lost, *_, again = talk(line, READ, *silence, READ)
    assert (lost.outcome, again.outcome) == (TIMEOUT, TIMEOUT)
    assert line.sink.kinds == [(LATE, 7, STALE)]
    assert line.bus.unrequested == line.bus.noise_bytes == 0


def test_a_late_refusal_of_a_request_of_another_length_refuses_nothing_else():
    line = ScriptedLine([], [(300_000, protocol1.status_packet(7, 0x08)), (700_000, ANSWER)])
    lost, reply = talk(line, READ, QUESTION)
    assert (lost.outcome, reply.outcome, reply.parameters) == (TIMEOUT, OK, b"a")


def test_a_late_reply_that_comes_before_the_awaited_one_can_is_not_garbled():
    line = ScriptedLine([], [(150_000, STALE), (700_000, GOOD)])
    lost, reply = talk(line, READ, READ)
    assert (lost.outcome, reply.parameters, reply.strays) == (TIMEOUT, b"abcdef", 0)
    assert line.sink.kinds == [(LATE, 7, STALE), (STATUS, 7, GOOD)]


def test_late_replies_to_a_repeated_request_are_recognized_up_to_a_bound():
    late = [(300_000 + number * 100_000, ANSWER) for number in range(10)]
    line = ScriptedLine(*[()] * 50, late)
    talk(line, *[QUESTION] * 50, LINE.unanswered(protocol1.ping(254)), listen_transaction(2_000_000))
    assert [kind for kind, *_ in line.sink.kinds] == [LATE] * 8 + [STATUS] * 2


OTHERS = {
    "read": protocol1.read_range(9, 36, 2),
    "read of a servo of this run": protocol1.read_range(7, 24, 1),
    "ping": protocol1.ping(7),
    "write": protocol1.write_range(7, 25, b"\x01"),
    "goals": protocol1.sync_write(30, 2, {7: b"ab", 8: b"cd"}),
    "broadcast ping": protocol1.ping(254),
    "bulk read": protocol1.bulk_read([(7, 36, 6), (8, 36, 6)]),
    "read 2": protocol2.read_range(7, 126, 10),
    "ping 2": protocol2.ping(7),
    "goals 2": protocol2.sync_write(116, 4, {7: b"abcd"}),
}


@pytest.mark.parametrize("name", OTHERS)
def test_an_instruction_that_this_host_did_not_send_is_another_hosts(name):
    dialect, foreign = (protocol2 if name.endswith("2") else protocol1), OTHERS[name]
    line = Line(1_000_000, 0, 500_000, dialect)
    read, good = line.read_range(7, 36, 6), dialect.status_packet(7, 0, b"abcdef")
    script = ScriptedLine([(150_000, foreign), (600_000, foreign), (800_000, good)], [(600_000, foreign)])
    reply, lost = talk(script, read, read, protocol=dialect.PROTOCOL)
    assert (reply.outcome, reply.parameters, reply.strays) == (OK, b"abcdef", 0)
    assert lost.outcome is TIMEOUT
    kind = PacketKind.OTHER_HOST, foreign[dialect.ID_AT], foreign
    assert script.sink.kinds == [kind, kind, (STATUS, 7, good), kind]
    assert script.bus.unrequested == 3


@pytest.mark.parametrize(
    "odd",
    [
        protocol1.status_packet(9, 0, b"ab"),
        protocol1.status_packet(7, 0x20, b"abc"),
        protocol1.status_packet(7, 0x02, b"abc"),  # no read has three parameters
        protocol1.status_packet(7, 0x01, b"a"),  # no ping has one
        protocol1.status_packet(7, 0x03, b"a"),  # no write has one
    ],
)
def test_a_reply_to_another_host_is_a_reply(odd):
    line = ScriptedLine([(700_000, odd)])
    talk(line, READ)
    assert line.sink.kinds == [(STATUS, odd[2], odd)]
    assert line.bus.unrequested == 1


@pytest.mark.parametrize(
    ("sent", "after_ns", "then"),
    [(READ, 80_000, [(700_000, GOOD)]), (GOALS, 130_000, [])],
    ids=["request", "goals"],
)
def test_an_echo_is_reported_and_is_no_other_host(sent, after_ns, then):
    line = ScriptedLine([(after_ns, sent.packet), *then])
    reply, _ = talk(line, sent, listen_transaction(1_000_000))
    if then:
        assert (reply.answered, reply.echoed, reply.strays) == (True, True, 0)
    servo_id = sent.packet[protocol1.ID_AT]
    assert line.sink.kinds == [(PacketKind.ECHO, servo_id, sent.packet), *[(STATUS, 7, GOOD)] * len(then)]
    assert line.bus.unrequested == 0


# Requests


def test_the_next_instruction_waits_for_the_wire():
    line = ScriptedLine([], [(700_000, GOOD)])
    first, second = talk(line, GOALS, READ)
    assert (first.outcome, second.outcome) == (TransactionOutcome.SENT, OK)
    assert [packet[3] for packet in line.sink.packets[:2]] == [1_000, 1_000 + 130_000]


def test_a_program_keeps_a_reply_whatever_comes_next():
    """A bus has one buffer for all its replies."""

    def program():
        first = yield READ
        second = yield READ
        return first.parameters, second.parameters

    buffer = bytearray(b"\1\2")
    job = ProgramJob(program())
    job.next_transaction(None)
    for data in (b"\1\2", b"\3\4"):
        buffer[:] = data
        job.next_transaction(Reply(OK, 0, memoryview(buffer), 0, 0, False))
    buffer[:] = b"\5\6"
    assert job.result == (b"\1\2", b"\3\4")


def program_of(transaction):
    return (yield transaction).parameters


def ask(lines, **kind):
    """Read the state of servo 7, by a job of a kind: of a cycle, of idle time, or one that has time."""
    job = ProgramJob(program_of(READ))
    lines.buses[0].load_job(job, **kind)
    lines.discard_input(lines.buses)
    lines.pump()
    return job.result


@pytest.mark.parametrize("kind", [{"cyclic": True}, {}, {"waits": True}], ids=["cycle", "idle", "waits"])
@pytest.mark.parametrize("renewed", [False, True], ids=["on the same line", "on a line that came back"])
def test_rest_of_a_reply_to_a_dropped_request_does_not_answer_the_next(renewed, kind):
    line = ScriptedLine([(600_000, STALE[:7])], [(600_000, STALE[7:]), (800_000, GOOD)])
    lines = open_lines(line)
    line.bus.load_job(ProgramJob(program_of(READ)))
    line.bus.process_due(line.clock.now_ns())
    line.clock.wait_until(line.clock.now_ns() + 650_000)
    line.bus.read_and_process()
    if renewed:
        line.bus.mark_lost(PortError("it is gone"))
        line.bus.replace_port(line)
    assert ask(lines, **kind) == b"abcdef"


def test_reply_is_awaited_from_when_the_host_had_sent_its_request():
    line = ScriptedLine([(50_700_000, GOOD)])
    write = line.write_packet

    def slow_write(data):
        write(data)
        line.clock.wait_until(line.clock.now_ns() + 50_000_000)

    line.write_packet = slow_write
    assert ask(open_lines(line)) == b"abcdef"


def test_reply_is_awaited_from_when_its_request_left_behind_the_bytes_before_it():
    line = ScriptedLine([], [(9_000_000, STALE), (10_700_000, GOOD)])
    lines = open_lines(line)
    line.bus.send(bytes(1000))  # takes 10 ms at 1 Mbit/s
    assert ask(lines) == b"abcdef"
