"""The exchange of dxlwire alone, back to back, and how its replies are slept and polled for."""

import ctypes

import pytest
from msgspec.structs import replace
from tests.kit.exchanges import IDS, MODELS, Host, SpoiltReplies
from tests.kit.plans import ScriptedLine, make_plan

from dxlwire.bus.blocking_bus import ServoSet
from dxlwire.bus.programs import Addressed
from dxlwire.bus.servo_group import ServoGroup
from dxlwire.bus.session import Session, line_plan
from dxlwire.control_table import find_table
from dxlwire.exchange import kernel
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import RECORD, Desk, PacketKind, PacketLog
from dxlwire.plan.line import Line
from dxlwire.port.ports import AUTO_SHARE, MOST_SHARE, ReplyPolling
from dxlwire.transaction import TransactionOutcome
from dxlwire.wire import protocol1, protocol2


class Reading:
    """A job: reads one after the other; keeps each status and how each read ended."""

    def __init__(self, reads):
        self.reads, self.number = list(reads), -1
        self.found, self.outcomes, self.strays = {}, [], 0

    def next_transaction(self, reply):
        if reply is not None:
            self.outcomes.append(reply.outcome)
            self.strays += reply.strays
        self.number += 1
        return self.reads[self.number] if self.number < len(self.reads) else None

    def status(self, index, reply):
        servo_id = self.reads[self.number].awaited[index].servo_id
        self.found[servo_id] = (reply.error, bytes(reply.parameters), reply.last_ns)


class DeskLog(PacketLog):
    """A log with memory for the packets that the kernel records."""

    def __init__(self):
        self.packets, self._records, self._used = [], memoryview(bytearray(1 << 16)), memoryview(bytearray(8))

    @property
    def desk(self):
        return Desk(self._records, self._used.cast("Q"))

    def packet(self, _, kind, servo_id, first_ns, last_ns, data):
        self.commit_packets()
        self.packets.append((kind, bytes(data), last_ns))

    def commit_packets(self):
        at, end = 0, int.from_bytes(self._used, "little")
        while at < end:
            _, kind, _, size, _, last_ns = RECORD.unpack_from(self._records, at)
            at += RECORD.size
            self.packets.append((PacketKind(kind), bytes(self._records[at : at + size]), last_ns))
            at += size
        self._used[:] = bytes(8)


class EngineHost(Host):
    """A scripted line on virtual time."""

    def __init__(self, way):
        protocol = 1.0 if MODELS[way] in ("AX-12A", "MX-28") else 2.0
        self.dialect = protocol1 if protocol == 1.0 else protocol2
        line, fast = Line(1_000_000, 0, 0, self.dialect), way.startswith("fast")
        entries = [(servo_id, *((36, 6) if protocol == 1.0 else (126, 10))) for servo_id in IDS]
        singles = way == "single reads"
        self._reads = (
            [line.read_range(*one) for one in entries] if singles else [line.read_many(entries, fast=fast)]
        )
        self.sink, self.line = DeskLog(), ScriptedLine()
        plans = [make_plan(IDS, protocol=protocol, model=MODELS[way])]
        self.lines = Lines(plans, self.line, self.line.clock, self.sink)

    def say(self, given):
        self.line.script = [pieces for _, pieces in given]
        self.line.clock.wait_until(self.line.clock.now_ns() + 20_000_000)

    def reads(self):
        return self._reads

    def exchange(self, given):
        self.sink.packets.clear()
        self.say(given)
        self.job = Reading(self._reads)
        self.lines.buses[0].load_job(self.job, cyclic=True)
        self.lines.discard_input(self.lines.buses)
        self.lines.pump()
        return [servo_id in self.job.found for servo_id in IDS]

    @property
    def log(self):
        return self.sink.packets

    @property
    def errors(self):
        return [self.job.found[servo_id][0] for servo_id in IDS]

    @property
    def noise_bytes(self):
        return self.lines.buses[0].noise_bytes


class ScriptHost(EngineHost):
    """The reader of a `Bus`, by the kernel if it can."""

    def __init__(self, way):
        protocol = 1.0 if MODELS[way] in ("AX-12A", "MX-28") else 2.0
        self.dialect = protocol1 if protocol == 1.0 else protocol2
        self.line = ScriptedLine()
        plan = line_plan("line", 1_000_000, protocol, 0)
        session = Session(self.line, self.line.clock, plan, lambda: None)
        session.log.recording = self.sink = DeskLog()
        self.lines = session.lines
        table = find_table(MODELS[way], protocol)
        if not way.startswith("fast"):
            table = replace(table, capabilities=table.capabilities - {"fast_sync_read"})
        servos = ServoSet(ServoGroup(session, [Addressed(servo_id, table) for servo_id in IDS]))
        self.read = servos.reader("present_position", table.present_speed_item, table.effort_item)
        assert way in ("single reads", self.read.instructions)

    @property
    def reading(self):
        return self.read._reading

    def reads(self):
        reads = self.reading.reads
        cycle = reads.plan() if reads.stale else reads.cycle
        return [reads._in_length(one.patient, one.group) for one in cycle.queue]

    def exchange(self, given):
        self.sink.packets.clear()
        self.say(given)
        return self.read().valid.tolist()

    def check_reader(self, by_kernel):
        assert self.reading.by_kernel == by_kernel

    @property
    def errors(self):
        return self.reading.reads.errors


class TestVirtualTime(SpoiltReplies):
    host = EngineHost


class TestScript(SpoiltReplies):
    host = ScriptHost


OK, TIMEOUT, GARBLED, REFUSED = (TransactionOutcome[one] for one in ("OK", "TIMEOUT", "GARBLED", "REFUSED"))


@pytest.mark.parametrize(
    ("second", "outcome"),
    [
        (protocol2.status_packet(7, 0, bytes(10)), OK),
        (protocol2.status_packet(7, 0x80, bytes(10)), OK),  # an alert comes with good data
        (b"", TIMEOUT),
        (protocol2.status_packet(7, 0, bytes(9)), GARBLED),
        (protocol2.status_packet(7, 0, bytes(10))[:9], GARBLED),
        (protocol2.read_range(7, 126, 4), TIMEOUT),  # of another host: the servo did not garble it
        (protocol2.status_packet(7, 0x07), REFUSED),  # which ends its turn and no other
    ],
)
def test_outcome_of_a_group_read_and_how_long_it_takes(second, outcome):
    host = EngineHost("sync read")
    good = [protocol2.status_packet(one, 0, bytes(10)) for one in IDS]
    pieces = [(400_000, good[0]), (700_000, second), (1_000_000, good[2]), (1_300_000, good[3])]
    (read,) = host.reads()
    host.sink.packets.clear()
    host.exchange([(read.packet, [piece for piece in pieces if piece[1]])])
    assert host.job.outcomes == [outcome]
    began_ns = next(at for kind, _, at in host.log if kind is PacketKind.INSTRUCTION)
    took_ns = host.line.clock.now_ns() - began_ns
    assert took_ns >= read.timeout_ns if outcome in (TIMEOUT, GARBLED) else took_ns == 1_300_000
    times = [at for _, _, at in host.job.found.values()]
    assert times[0] == began_ns + 400_000


def test_a_reply_of_the_read_before_is_a_stray():
    host = EngineHost("sync read")
    (read,) = host.reads()
    good = [protocol2.status_packet(one, 0, bytes(10)) for one in IDS]
    host.exchange([(read.packet, [(100_000, good[0]), (400_000, b"".join(good))])])
    assert (host.job.outcomes, host.job.strays, len(host.job.found)) == ([OK], 1, 4)
    host.exchange([(read.packet, [(400_000, good[0]), (500_000, b"".join(good))])])
    assert (host.job.outcomes, host.job.strays, len(host.job.found)) == ([OK], 1, 4)


LIBRARY = kernel.library()

CYCLE_NS = 1_000_000
WAKE_NS = 50_000


class PolledLine:
    """Answers each request after a while; polled by the time that a clock of its own shows."""

    def __init__(self, *wish, after_ns=400_000, overshoot_ns=20_000):
        self.now_ns = 10_000_000
        self.after_ns, self.overshoot_ns = after_ns, overshoot_ns
        self.naps = []
        self.polled_ns = 0
        self.polling = kernel.polling_state(ReplyPolling(*wish))

    def await_until(self, due_ns, deadline_ns):
        """Sleep as the kernel says; return until when it polls."""
        until = ctypes.c_int64()
        nap = LIBRARY.dxl_polling_begin
        nap.restype, nap.argtypes = ctypes.c_int64, [ctypes.c_void_p, *[ctypes.c_int64] * 3, ctypes.c_void_p]
        polling = ctypes.addressof(self.polling)
        nap_ns = nap(polling, due_ns, self.now_ns, deadline_ns, ctypes.addressof(until))
        if nap_ns:
            self.naps.append(nap_ns)
            self.now_ns += nap_ns + self.overshoot_ns
        return until.value

    def came(self, due_ns, at_ns):
        came = LIBRARY.dxl_polling_came
        came(ctypes.byref(self.polling), ctypes.c_int64(due_ns), ctypes.c_int64(at_ns))

    def cycle(self, due_ns=400_000):
        """Ask and await; return how late the reply is taken."""
        start = self.now_ns
        due, there = start + due_ns, start + self.after_ns
        until = self.await_until(due, start + 10 * CYCLE_NS)
        since, looks = self.now_ns, 0
        while until and self.now_ns < until and (looks == 0 or self.now_ns < there):
            self.now_ns += 1_000
            looks += 1
        if until:
            LIBRARY.dxl_polling_spent(ctypes.byref(self.polling), ctypes.c_int64(self.now_ns - since), looks)
            self.polled_ns += self.now_ns - since
        if self.now_ns < there:
            self.now_ns = there + WAKE_NS
        late = self.now_ns - there
        if there - start < CYCLE_NS:
            self.came(due, self.now_ns)
        self.now_ns = start + CYCLE_NS
        return late


def settled(line, cycles=300, **due):
    """Let the estimate settle; return how late each of the last replies was taken."""
    return [line.cycle(**due) for _ in range(cycles)][-50:]


def test_a_reply_is_slept_for_until_shortly_before_it_is_due_and_then_taken_at_once():
    line = PolledLine()
    late = settled(line)
    assert max(late) <= 1_000
    assert line.naps[-1] == pytest.approx(400_000 - line.polling.margin_ns, abs=30_000)


@pytest.mark.parametrize(
    ("after_ns", "due_ns"), [(150_000, 500_000), (900_000, 400_000)], ids=["sooner", "later"]
)
def test_replies_that_keep_another_distance_than_the_plan_says_are_followed(after_ns, due_ns):
    line = PolledLine(after_ns=after_ns)
    late = settled(line, due_ns=due_ns)
    assert sum(late) / len(late) < 25_000


@pytest.mark.parametrize(
    ("wish", "share"), [((), AUTO_SHARE), ((1_000_000,), MOST_SHARE), ((1_000_000, 0.02), 0.02)]
)
def test_no_more_than_a_share_of_a_core_is_polled_even_for_replies_that_never_come(wish, share):
    line = PolledLine(*wish, after_ns=10 * CYCLE_NS)
    for _ in range(2_000):
        line.cycle()
    assert 0 < line.polled_ns <= share * 2_001 * CYCLE_NS


@pytest.mark.parametrize("ahead_ns", [-50_000, 0, 10_000, 100_000])
def test_one_reply_is_polled_for_no_longer_than_the_longest_time(ahead_ns):
    line = PolledLine(300_000)
    line.polling.credit_ns = line.polling.saved_ns
    start = line.now_ns
    until = line.await_until(start + line.polling.margin_ns + ahead_ns, 1 << 62)
    assert start < until <= start + sum(line.naps) + 300_000


def test_without_credit_a_reply_is_neither_slept_nor_polled_for():
    line = PolledLine()
    assert line.await_until(line.now_ns + 400_000, 1 << 62) == 0
    assert line.naps == []


def test_nobody_sleeps_beyond_the_next_deadline():
    line = PolledLine()
    settled(line)
    line.naps.clear()
    assert line.await_until(line.now_ns + 400_000, line.now_ns + 300_000) == 0
    assert line.naps == []


def test_one_reply_that_is_very_late_does_not_let_the_next_ones_be_slept_through():
    line = PolledLine()
    settled(line)
    line.came(line.now_ns - 15_000_000, line.now_ns)
    assert sum(line.cycle() for _ in range(20)) / 20 < 25_000


def test_replies_that_begin_to_come_much_sooner_are_found_soon():
    line = PolledLine(after_ns=900_000)
    settled(line, due_ns=900_000)
    line.after_ns = 100_000
    assert [line.cycle(due_ns=900_000) for _ in range(8)][-1] < 25_000
