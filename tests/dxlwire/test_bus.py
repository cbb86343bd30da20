import pytest
from tests.kit.plans import ScriptedLine, make_plan

from dxlwire.exceptions import PortError
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketKind
from dxlwire.plan.line import Line, listen_transaction
from dxlwire.transaction import ProgramJob, Reply, TransactionOutcome
from dxlwire.wire import protocol1, protocol2

LINE = Line(1_000_000, 0, 500_000)
READ = LINE.read_range(7, 36, 6)
INSTRUCTION = PacketKind.INSTRUCTION
GOOD = protocol1.status_packet(7, 0, b"abcdef")
QUESTION = LINE.read_range(7, 24, 1)
"""Not read in each cycle."""
ANSWER = protocol1.status_packet(7, 0, b"a")


def talk(line, *transactions, protocol=1.0):
    sink = []

    class Sink:
        def packet(self, *packet):
            sink.append((*packet[:5], bytes(packet[5])))

    plan = make_plan((7,), protocol=protocol, model="AX-12A" if protocol == 1.0 else "XM430-W350")
    lines = Lines([plan], line, line.clock, Sink())
    (line.bus,) = lines.buses

    def program():
        replies = []
        for transaction in transactions:
            replies.append((yield transaction))
        return replies

    (replies,) = lines.run_programs([program()])
    received = b"".join(data for _, kind, *_, data in sink if kind != PacketKind.INSTRUCTION)
    return replies, sink, received


def test_a_reply_in_two_pieces():
    line = ScriptedLine([(600_000, GOOD[:5]), (690_000, GOOD[5:])])
    ((reply,), sink, _) = talk(line, READ)
    assert reply.outcome is TransactionOutcome.OK
    assert reply.parameters == b"abcdef"
    assert reply.last_ns == 691_000
    assert sink == [
        (0, PacketKind.INSTRUCTION, 7, 1_000, 1_000, READ.packet),
        (0, PacketKind.STATUS, 7, 601_000, 691_000, GOOD),
    ]


def test_a_longer_reply_in_two_pieces_is_awaited_to_its_last_byte():
    longer = protocol1.status_packet(7, 0, b"abcdefg")
    line = ScriptedLine([], [(600_000, longer[:-1]), (690_000, longer[-1:])])
    (lost, reply), _, _ = talk(line, LINE.read_range(7, 24, 6), LINE.read_range(7, 36, 6, spare=1))
    assert lost.outcome is TransactionOutcome.TIMEOUT
    assert line.written[-1] == protocol1.read_range(7, 36, 7), "a reply of 6 bytes is owed"
    assert (reply.outcome, reply.parameters) == (TransactionOutcome.OK, b"abcdef")


def test_silence():
    ((reply, after), _, _) = talk(line := ScriptedLine([], [(700_000, GOOD)]), READ, READ)
    assert reply.outcome is TransactionOutcome.TIMEOUT
    assert after.answered
    assert line.clock.now_ns() == 1_000 + READ.timeout_ns + 700_000


@pytest.mark.parametrize(
    "wrong",
    [
        protocol1.status_packet(8, 0, b"abcdef"),
        protocol1.status_packet(7, 0, b"abcde"),
        protocol1.status_packet(7, 0, b"abcdefg"),
        protocol1.status_packet(7, 0, b""),
        GOOD[:-1] + b"\x00",
        GOOD[:6],
    ],
)
def test_only_the_right_id_the_right_length_and_checksum_count(wrong):
    ((reply, after), _, received) = talk(ScriptedLine([(700_000, wrong)], [(700_000, GOOD)]), READ, READ)
    assert reply.outcome is TransactionOutcome.GARBLED
    assert after.parameters == b"abcdef"
    assert received == wrong + GOOD


def test_a_refusal_is_not_waited_out():
    refusal = protocol1.status_packet(7, 0x08)
    line = ScriptedLine([(700_000, refusal)])
    ((reply,), _, _) = talk(line, READ)
    assert (reply.outcome, reply.error) == (TransactionOutcome.REFUSED, 8)
    assert line.clock.now_ns() == 701_000
    assert not reply.answered


def test_an_answer_that_comes_sooner_than_the_wire_allows_is_an_older_one():
    stale = protocol1.status_packet(7, 0, b"------")
    ((reply,), _, _) = talk(ScriptedLine([(150_000, stale), (700_000, GOOD)]), READ)
    assert reply.parameters == b"abcdef"
    assert reply.strays == 1


def test_after_a_timeout_the_line_is_drained_until_it_is_silent():
    late = protocol1.status_packet(7, 0, b"------")
    timeout = READ.timeout_ns
    line = ScriptedLine([(timeout - 20_000, late[:3]), (timeout + 100_000, late[3:])], [(700_000, GOOD)])
    ((reply, after), _, received) = talk(line, READ, READ)
    assert reply.outcome is TransactionOutcome.GARBLED
    assert after.parameters == b"abcdef"
    assert received == late + GOOD
    assert line.clock.now_ns() == 1_000 + timeout + 100_000 + 200_000 + 700_000


def kinds(sink):
    """Return the kind, the ID and the bytes of what came."""
    return [(kind, servo_id, data) for _, kind, servo_id, _, _, data in sink if kind != INSTRUCTION]


def test_a_late_reply_is_known_once_however_late_it_comes():
    late = (300_000, ANSWER)
    line = ScriptedLine([], [(700_000, GOOD)], [late, (700_000, GOOD)], [late, (700_000, GOOD)])
    (question, *reads), sink, _ = talk(line, QUESTION, READ, READ, READ)
    assert question.outcome is TransactionOutcome.TIMEOUT
    assert [(read.answered, read.strays) for read in reads] == [(True, 0), (True, 0), (True, 1)]
    late, second = [kind for kind, _, data in kinds(sink) if data == ANSWER]
    assert (late, second) == (PacketKind.LATE, PacketKind.STATUS)
    assert line.bus.unrequested == 1  # the second one answers no question of this host


@pytest.mark.parametrize("after_ns", [30_000, 60_000_000], ids=["while drained", "with the next read"])
def test_a_reply_that_comes_too_late_is_neither_garbled_nor_the_next_ones(after_ns):
    stale = protocol1.status_packet(7, 0, b"------")
    at_ns = READ.timeout_ns + after_ns
    line = ScriptedLine([(at_ns, stale)], [], [])
    silence = [listen_transaction(at_ns)] if after_ns > 1_000_000 else []
    (lost, *_, again), sink, _ = talk(line, READ, *silence, READ)
    assert [lost.outcome, again.outcome] == [TransactionOutcome.TIMEOUT, TransactionOutcome.TIMEOUT]
    assert kinds(sink) == [(PacketKind.LATE, 7, stale)]
    assert line.bus.unrequested == line.bus.noise_bytes == 0


def test_a_late_refusal_of_a_request_of_another_length_refuses_nothing_else():
    refusal = protocol1.status_packet(7, 0x08)
    line = ScriptedLine([], [(300_000, refusal), (700_000, ANSWER)])
    (lost, reply), _, _ = talk(line, READ, QUESTION)
    assert lost.outcome is TransactionOutcome.TIMEOUT
    assert (reply.outcome, reply.parameters) == (TransactionOutcome.OK, b"a")


def test_a_late_reply_that_comes_before_the_awaited_one_can_is_not_garbled():
    stale = protocol1.status_packet(7, 0, b"------")
    (lost, reply), sink, _ = talk(ScriptedLine([], [(150_000, stale), (700_000, GOOD)]), READ, READ)
    assert lost.outcome is TransactionOutcome.TIMEOUT
    assert (reply.parameters, reply.strays) == (b"abcdef", 0)
    assert kinds(sink) == [(PacketKind.LATE, 7, stale), (PacketKind.STATUS, 7, GOOD)]


def test_late_replies_to_a_repeated_request_are_recognized_up_to_a_bound():
    late = [(300_000 + number * 100_000, ANSWER) for number in range(10)]
    line = ScriptedLine(*[()] * 50, late)
    _, sink, _ = talk(
        line, *[QUESTION] * 50, LINE.unanswered(b"\xff\xff\xfe\x02\x05\xfa"), listen_transaction(2_000_000)
    )
    assert [kind for kind, *_ in kinds(sink)] == [PacketKind.LATE] * 8 + [PacketKind.STATUS] * 2


OTHERS = {
    "read": (protocol1, protocol1.read_range(9, 36, 2)),
    "read of a servo of this run": (protocol1, protocol1.read_range(7, 24, 1)),
    "ping": (protocol1, protocol1.ping(7)),
    "write": (protocol1, protocol1.write_range(7, 25, b"\x01")),
    "goals": (protocol1, protocol1.sync_write(30, 2, {7: b"ab", 8: b"cd"})),
    "broadcast ping": (protocol1, protocol1.ping(254)),
    "bulk read": (protocol1, protocol1.bulk_read([(7, 36, 6), (8, 36, 6)])),
    "read 2": (protocol2, protocol2.read_range(7, 126, 10)),
    "ping 2": (protocol2, protocol2.ping(7)),
    "goals 2": (protocol2, protocol2.sync_write(116, 4, {7: b"abcd"})),
}


@pytest.mark.parametrize("name", OTHERS)
def test_an_instruction_that_this_host_did_not_send_is_another_hosts(name):
    dialect, foreign = OTHERS[name]
    line = Line(1_000_000, 0, 500_000, dialect)
    read, good = line.read_range(7, 36, 6), dialect.status_packet(7, 0, b"abcdef")
    script = ScriptedLine([(150_000, foreign), (600_000, foreign), (800_000, good)], [(600_000, foreign)])
    (reply, lost), sink, _ = talk(script, read, read, protocol=dialect.PROTOCOL)
    assert (reply.outcome, reply.parameters, reply.strays) == (TransactionOutcome.OK, b"abcdef", 0)
    assert lost.outcome is TransactionOutcome.TIMEOUT
    kind = PacketKind.OTHER_HOST, foreign[dialect.ID_AT], foreign
    assert kinds(sink) == [kind, kind, (PacketKind.STATUS, 7, good), kind]
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
    (_, sink, _) = talk(line := ScriptedLine([(700_000, odd)]), READ)
    assert kinds(sink) == [(PacketKind.STATUS, odd[2], odd)]
    assert line.bus.unrequested == 1


def test_a_doubled_reply_is_explained_by_the_transaction_before():
    doubled = (300_000, ANSWER)
    line = ScriptedLine([(700_000, ANSWER)], [doubled, (700_000, GOOD)], [doubled, (700_000, GOOD)])
    (question, *reads), _, _ = talk(line, QUESTION, READ, READ)
    assert question.answered
    assert [(read.answered, read.strays) for read in reads] == [(True, 1), (True, 1)]
    assert line.bus.unrequested == 1  # the one that came after another transaction


def test_draining_ends_on_a_line_that_babbles():
    babble = [(step * 100_000, b"\x55") for step in range(1, 400)]
    line = ScriptedLine(babble, [])
    ((reply, _), _, _) = talk(line, READ, listen_transaction(0))
    assert reply.outcome is TransactionOutcome.GARBLED
    assert line.clock.now_ns() <= 1_000 + READ.timeout_ns + 5_000_000


def test_a_false_header_does_not_cost_the_timeout():
    line = ScriptedLine([(650_000, b"\xff\xff\x03\x60"), (700_000, GOOD)])
    ((reply,), _, received) = talk(line, READ)
    assert reply.parameters == b"abcdef"
    assert line.clock.now_ns() == 701_000
    assert received == b"\xff\xff\x03\x60" + GOOD


def test_an_echo_is_told():
    ((reply,), sink, _) = talk(ScriptedLine([(80_000, READ.packet), (700_000, GOOD)]), READ)
    assert reply.answered
    assert (reply.echoed, reply.strays) == (True, 0)
    assert kinds(sink) == [(PacketKind.ECHO, 7, READ.packet), (PacketKind.STATUS, 7, GOOD)]


def test_the_echo_of_what_awaits_no_reply_is_no_other_host():
    goals = LINE.unanswered(protocol1.sync_write(30, 4, {7: b"abcd"}))
    _, sink, _ = talk(line := ScriptedLine([(130_000, goals.packet)]), goals, listen_transaction(1_000_000))
    assert kinds(sink) == [(PacketKind.ECHO, 254, goals.packet)]
    assert line.bus.unrequested == 0


def test_the_next_instruction_waits_for_the_wire():
    goals = LINE.unanswered(protocol1.sync_write(30, 4, {7: b"abcd"}))
    line = ScriptedLine([], [(700_000, GOOD)])
    ((first, second), sink, _) = talk(line, goals, READ)
    assert first.outcome is TransactionOutcome.SENT
    assert second.answered
    assert [packet[3] for packet in sink[:2]] == [1_000, 1_000 + 130_000]


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
        job.next_transaction(Reply(TransactionOutcome.OK, 0, memoryview(buffer), 0, 0, False))
    buffer[:] = b"\5\6"
    assert job.result == (b"\1\2", b"\3\4")


class Quiet:
    """Drops the packets of the log."""

    def packet(self, *_):
        pass


def begin(line):
    """Return the lines and the bus of servo 7."""
    lines = Lines([make_plan((7,))], line, line.clock, Quiet())
    return lines, lines.buses[0]


def ask(lines, **kind):
    """Read the state of servo 7, by a job of a kind: of a cycle, of idle time, or one that has time."""

    def program():
        return (yield READ).parameters

    job = ProgramJob(program())
    lines.buses[0].load_job(job, **kind)
    lines.discard_input(lines.buses)
    lines.pump()
    return job.result


@pytest.mark.parametrize("kind", [{"cyclic": True}, {}, {"waits": True}], ids=["cycle", "idle", "waits"])
@pytest.mark.parametrize("renewed", [False, True], ids=["on the same line", "on a line that came back"])
def test_rest_of_a_reply_to_a_dropped_request_does_not_answer_the_next(renewed, kind):
    stale = protocol1.status_packet(7, 0, b"------")
    line = ScriptedLine([(600_000, stale[:7])], [(600_000, stale[7:]), (800_000, GOOD)])
    lines, bus = begin(line)
    bus.load_job(ProgramJob(listen_to(READ)))
    bus.process_due(line.clock.now_ns())
    line.clock.wait_until(line.clock.now_ns() + 650_000)
    bus.read_and_process()
    if renewed:
        bus.mark_lost(PortError("it is gone"))
        bus.replace_port(line)
    assert ask(lines, **kind) == b"abcdef"


def listen_to(transaction):
    yield transaction


def test_reply_is_awaited_from_when_the_host_had_sent_its_request():
    line = ScriptedLine([(50_700_000, GOOD)])
    write = line.write_packet

    def slow_write(data):
        write(data)
        line.clock.wait_until(line.clock.now_ns() + 50_000_000)

    line.write_packet = slow_write
    assert ask(begin(line)[0]) == b"abcdef"


def test_reply_is_awaited_from_when_its_request_left_behind_the_bytes_before_it():
    stale = protocol1.status_packet(7, 0, b"------")
    queued = bytes(1000)  # takes 10 ms at 1 Mbit/s
    line = ScriptedLine([], [(9_000_000, stale), (10_700_000, GOOD)])
    lines, bus = begin(line)
    bus.send(queued)
    assert ask(lines) == b"abcdef"
