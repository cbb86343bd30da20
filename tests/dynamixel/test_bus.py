import pytest

from dxlrun.clock import VirtualClock
from dxlrun.dynamixel.exchange.bus import Bus, run
from dxlrun.dynamixel.plan.line import Line, listen
from dxlrun.dynamixel.wire import protocol1
from dxlrun.dynamixel.wire.transaction import Outcome
from dxlrun.run.channels.packets import PacketKind

LINE = Line(1_000_000, 0, 500_000)
READ = LINE.read(7, 36, 6)
GOOD = protocol1.status_packet(7, 0, b"abcdef")
QUESTION = LINE.read(7, 24, 1)
"""Not read in each cycle."""
ANSWER = protocol1.status_packet(7, 0, b"a")


class ScriptedLine:
    """Port and Ports in one: after the n-th write it says what the script has, at times since that write."""

    def __init__(self, *script):
        self.clock = VirtualClock(1_000)
        self.script = list(script)
        self.coming = []
        self.written = []

    polling = None

    @property
    def ports(self):
        return [self]

    def write(self, data):
        self.written.append(bytes(data))
        for delay_ns, said in self.script.pop(0) if self.script else ():
            self.coming.append((self.clock.now_ns() + delay_ns, said))
        self.coming.sort()

    def read_into(self, buffer):
        count = 0
        while self.coming and self.coming[0][0] <= self.clock.now_ns():
            _, said = self.coming.pop(0)
            buffer[count : count + len(said)] = said
            count += len(said)
        return count

    def wait(self, deadline_ns):
        due = self.coming[0][0] if self.coming else deadline_ns
        self.clock.wait_until(min(due, deadline_ns))
        return [0] if self.coming and due <= self.clock.now_ns() else []


@pytest.fixture
def talk(make_plan):
    def execute(line, *transactions):
        sink = []

        class Sink:
            def packet(self, *packet):
                sink.append((*packet[:5], bytes(packet[5])))

        line.bus = bus = Bus(0, make_plan((7,)), line, line.clock, Sink())

        def program():
            replies = []
            for transaction in transactions:
                replies.append((yield transaction))
            return replies

        (replies,) = run([program()], [bus], line, line.clock)
        received = b"".join(data for _, kind, *_, data in sink if kind != PacketKind.INSTRUCTION)
        return replies, sink, received

    return execute


def test_a_reply_in_two_pieces(talk):
    line = ScriptedLine([(600_000, GOOD[:5]), (690_000, GOOD[5:])])
    ((reply,), sink, _) = talk(line, READ)
    assert reply.outcome is Outcome.OK
    assert reply.parameters == b"abcdef"
    assert reply.last_ns == 691_000
    assert sink == [
        (0, PacketKind.INSTRUCTION, 7, 1_000, 1_000, READ.packet),
        (0, PacketKind.STATUS, 7, 601_000, 691_000, GOOD),
    ]


def test_silence(talk):
    ((reply, after), _, _) = talk(line := ScriptedLine([], [(700_000, GOOD)]), READ, READ)
    assert reply.outcome is Outcome.TIMEOUT
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
def test_only_the_right_id_the_right_length_and_checksum_count(talk, wrong):
    ((reply, after), _, received) = talk(ScriptedLine([(700_000, wrong)], [(700_000, GOOD)]), READ, READ)
    assert reply.outcome is Outcome.GARBLED
    assert after.parameters == b"abcdef"
    assert received == wrong + GOOD


def test_a_refusal_is_not_waited_out(talk):
    refusal = protocol1.status_packet(7, 0x08)
    line = ScriptedLine([(700_000, refusal)])
    ((reply,), _, _) = talk(line, READ)
    assert (reply.outcome, reply.error) == (Outcome.REFUSED, 8)
    assert line.clock.now_ns() == 701_000


def test_an_answer_that_comes_sooner_than_the_wire_allows_is_an_older_one(talk):
    stale = protocol1.status_packet(7, 0, b"------")
    ((reply,), _, _) = talk(ScriptedLine([(150_000, stale), (700_000, GOOD)]), READ)
    assert reply.parameters == b"abcdef"
    assert reply.strays == 1


def test_after_a_timeout_the_line_is_drained_until_it_is_silent(talk):
    late = protocol1.status_packet(7, 0, b"------")
    timeout = READ.timeout_ns
    line = ScriptedLine([(timeout - 20_000, late[:3]), (timeout + 100_000, late[3:])], [(700_000, GOOD)])
    ((reply, after), _, received) = talk(line, READ, READ)
    assert reply.outcome is Outcome.GARBLED
    assert after.parameters == b"abcdef"
    assert received == late + GOOD
    assert line.clock.now_ns() == 1_000 + timeout + 100_000 + 200_000 + 700_000


def test_a_late_reply_is_explained_once_however_late_it_comes(talk):
    late = (300_000, ANSWER)
    line = ScriptedLine([], [(700_000, GOOD)], [late, (700_000, GOOD)], [late, (700_000, GOOD)])
    (question, *reads), _, _ = talk(line, QUESTION, READ, READ, READ)
    assert question.outcome is Outcome.TIMEOUT
    assert [(read.answered, read.strays) for read in reads] == [(True, 0), (True, 1), (True, 1)]
    assert line.bus.unrequested == 1  # the second one answers no question of this host


def test_a_doubled_reply_is_explained_by_the_transaction_before(talk):
    doubled = (300_000, ANSWER)
    line = ScriptedLine([(700_000, ANSWER)], [doubled, (700_000, GOOD)], [doubled, (700_000, GOOD)])
    (question, *reads), _, _ = talk(line, QUESTION, READ, READ)
    assert question.answered
    assert [(read.answered, read.strays) for read in reads] == [(True, 1), (True, 1)]
    assert line.bus.unrequested == 1  # the one that came after another transaction


def test_draining_ends_on_a_line_that_babbles(talk):
    babble = [(step * 100_000, b"\x55") for step in range(1, 400)]
    line = ScriptedLine(babble, [])
    ((reply, _), _, _) = talk(line, READ, listen(0))
    assert reply.outcome is Outcome.GARBLED
    assert line.clock.now_ns() <= 1_000 + READ.timeout_ns + 5_000_000


def test_a_false_header_does_not_cost_the_timeout(talk):
    line = ScriptedLine([(650_000, b"\xff\xff\x03\x60"), (700_000, GOOD)])
    ((reply,), _, received) = talk(line, READ)
    assert reply.parameters == b"abcdef"
    assert line.clock.now_ns() == 701_000
    assert received == b"\xff\xff\x03\x60" + GOOD


def test_an_echo_is_told(talk):
    ((reply,), _, _) = talk(ScriptedLine([(80_000, READ.packet), (700_000, GOOD)]), READ)
    assert reply.answered
    assert reply.echoed


def test_the_next_instruction_waits_for_the_wire(talk):
    goals = LINE.unanswered(protocol1.sync_write(30, 4, {7: b"abcd"}))
    line = ScriptedLine([], [(700_000, GOOD)])
    ((first, second), sink, _) = talk(line, goals, READ)
    assert first.outcome is Outcome.SENT
    assert second.answered
    assert [packet[3] for packet in sink[:2]] == [1_000, 1_000 + 130_000]
