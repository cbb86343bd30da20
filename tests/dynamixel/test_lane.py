"""Reads that go through a lane leave the same behind as those that go step by step, whatever arrives."""

import random
from dataclasses import replace

import pytest

from dxlrun.clock import VirtualClock
from dxlrun.dynamixel import exchange, protocol1, protocol2
from dxlrun.dynamixel.bus import Bus
from dxlrun.dynamixel.exchange import CyclicReads
from dxlrun.dynamixel.pump import clear, pump
from dxlrun.dynamixel.state_arrays import Arrivals, StateArrays
from dxlrun.errors import PortError
from dxlrun.packets import PacketKind, decode_packets

IDS = (1, 7, 3, 20)
BUSES = {
    "single reads": ("AX-12A", 1.0),
    "bulk read": ("MX-28", 1.0),
    "sync read": ("XM430-W350", 2.0),
    "fast sync read": ("XM430-W350", 2.0),
    "single reads beside a bulk read": (("AX-12A", "MX-28"), 1.0),
    "two layouts": (("XM430-W350", "XL-320"), 2.0),
}
PERIOD_NS = 20_000_000
GOALS = b"goals that nobody answers"


class Sink:
    def __init__(self):
        self.packets = []

    def packet(self, bus, kind, servo_id, first_ns, last_ns, data):  # noqa: PLR0917  as PacketSink has it
        self.packets.append((kind, servo_id, first_ns, last_ns, bytes(data)))

    def records(self, records):
        self.packets += [
            (one.kind, one.servo_id, one.first_ns, one.last_ns, one.data) for one in decode_packets(records)
        ]


class Line:
    """Says to the n-th instruction of a cycle what it was told: pieces of (ns after it, bytes)."""

    def __init__(self, clock):
        self.clock = clock
        self.told, self.said = [], []
        self.stall_ns = 0
        """How long the host stands still behind each instruction."""

    def write(self, data):
        if data == GOALS:
            return
        pieces = self.told.pop(0) if self.told else []
        if pieces is None:
            raise PortError("it is gone")
        self.said += [(self.clock.now_ns() + at, piece) for at, piece in pieces]
        self.said.sort(key=lambda one: one[0])
        self.clock.wait_until(self.clock.now_ns() + self.stall_ns)

    def read_into(self, buffer):
        if not self.heard:
            return 0
        _, data = self.said.pop(0)
        buffer[: len(data)] = data
        return len(data)

    @property
    def heard(self):
        return bool(self.said) and self.said[0][0] <= self.clock.now_ns()


class Lines:
    """Some lines, waited for together."""

    polling = None

    def __init__(self, count):
        self.clock = VirtualClock(1_000_000)
        self.ports = [Line(self.clock) for _ in range(count)]

    def wait(self, deadline_ns):
        self.clock.wait_until(min([deadline_ns, *(at for line in self.ports for at, _ in line.said)]))
        return [index for index, line in enumerate(self.ports) if line.heard]


class Side:
    """Some buses with their cyclic reads, and what became of each cycle."""

    def __init__(self, plan, count):
        self.lines = Lines(count)
        self.sinks = [Sink() for _ in range(count)]
        self.buses = [
            Bus(index, plan, line, self.lines.clock, sink)
            for index, (line, sink) in enumerate(zip(self.lines.ports, self.sinks, strict=True))
        ]
        self.arrays = [StateArrays(plan, Arrivals.none(len(plan.servos))) for _ in range(count)]
        self.reads = [
            CyclicReads(plan, arrays, bus) for arrays, bus in zip(self.arrays, self.buses, strict=True)
        ]
        self.straight = 0

    def begin(self):
        """Begin a cycle; return the reads of each bus."""
        for reads in self.reads:
            reads.begin()
        return [[request.patient[0] for request in reads._queue] for reads in self.reads]

    def cycle(self, told, split_ns):
        """Read once; return what can be told apart. `split_ns`: the gap behind the requests, if any."""
        for sink in self.sinks:
            sink.packets.clear()
        if split_ns is not None:
            clear(self.buses, self.lines)
        for bus, reads, line, mine in zip(self.buses, self.reads, self.lines.ports, told, strict=True):
            line.told = list(mine)
            if split_ns is not None and bus.failure is None:
                bus.send(GOALS)
            bus.load(reads, reads.lane)
            if split_ns is not None:
                bus.begin_behind()
        clock = self.lines.clock
        if split_ns is not None:
            pump(self.buses, self.lines, clock, lambda: None, clock.now_ns() + split_ns)
        pump(self.buses, self.lines, clock, lambda: None)
        self.straight += sum(reads.lane is not None and reads.lane.through for reads in self.reads)
        found = [self.found(index) for index in range(len(self.buses))]
        end_ns = clock.now_ns()
        clock.wait_until(end_ns + PERIOD_NS)
        return found, end_ns

    def found(self, index):
        """Return what can be told apart of one bus."""
        arrays, reads = self.arrays[index], self.reads[index]
        bus, packets = self.buses[index], self.sinks[index].packets
        if not reads.counted:
            arrays.count()
        for servo, fresh in enumerate(reads.fresh.tolist()):
            reads.missed[servo] = 0 if fresh else reads.missed[servo] + 1
        return (
            [packet for packet in packets if packet[0] is not PacketKind.NOISE],
            b"".join(packet[-1] for packet in packets if packet[0] is PacketKind.NOISE),
            reads.fresh.tolist(),
            reads.arrived_ns.tolist(),
            list(reads.errors),
            list(reads.garbled),
            arrays.arrivals.ticks[:, reads.fresh].tolist(),
            (bus.noise_bytes, str(bus.failure)),
        )


def replies(transaction, dialect, rng):
    """Return the replies to a read, as servos send them."""
    error = rng.choice((0x80, 0x20)) if rng.random() < 0.05 else 0
    found = [(one.servo_id, error, rng.randbytes(one.length)) for one in transaction.awaited]
    if not transaction.fast:
        return [dialect.status_packet(*one) for one in found]
    size = sum(one.length + 4 for one in transaction.awaited) + 1
    packet = protocol2.HEADER + b"\xfe" + size.to_bytes(2, "little") + b"\x55"
    for servo_id, fault, data in found:
        packet += bytes((fault, servo_id)) + data
        packet += protocol2.crc(packet).to_bytes(2, "little")
    return [packet]


def spoilt(packets, rng):
    """Return the bytes of replies after an accident."""
    match rng.randrange(6):
        case 0:
            packets.pop(rng.randrange(len(packets)))
        case 1:
            packets.insert(rng.randrange(len(packets) + 1), rng.randbytes(rng.randint(1, 20)))
        case 2:
            packets.insert(rng.randrange(len(packets) + 1), rng.choice(packets))
    stream = bytearray(b"".join(packets))
    if stream and rng.random() < 0.6:
        where = rng.randrange(len(stream))
        match rng.randrange(3):
            case 0:
                stream[where] ^= 1 << rng.randrange(8)
            case 1:
                del stream[where : where + rng.randint(1, 4)]
            case _:
                stream[where:where] = rng.randbytes(rng.randint(1, 4))
    return bytes(stream)


def said(transactions, dialect, rng, accident):
    """Return what a line says to each read of a cycle; with an accident in one of them."""
    told = []
    victim = rng.randrange(len(transactions)) if accident else -1
    for number, transaction in enumerate(transactions):
        packets = replies(transaction, dialect, rng)
        stream, at, most = b"".join(packets), 1_500_000, rng.choice((9, 1_000, 1_000))
        if number == victim:
            if rng.random() < 0.1:
                told.append(None)
                continue
            stream = spoilt(packets, rng)
            at, most = (
                rng.choice((1_000, 1_500_000, 1_500_000, 9_000_000, 30_000_000)),
                rng.choice((5, 17, 999)),
            )
        pieces = []
        while stream:
            pieces.append((at, stream[:most]))
            stream, at = stream[most:], at + rng.choice((0, 1_000, 100_000))
        told.append(pieces)
    return told


def planned(make_plan, name):
    """Return the plan of a bus that is read in some way, and its dialect."""
    models, protocol = BUSES[name]
    models = (models,) if isinstance(models, str) else models
    plan = make_plan(IDS, protocol=protocol, models=[*models * len(IDS)][: len(IDS)])
    plan = replace(plan, fast=(name == "fast sync read",) * len(plan.groups))
    return plan, protocol1 if protocol == 1.0 else protocol2


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("name", BUSES)
def test_a_lane_leaves_behind_what_reads_step_by_step_do(make_plan, monkeypatch, name, count):
    plan, dialect = planned(make_plan, name)
    rng = random.Random(f"{name} {count}")
    straight = accidents = 0
    for _ in range(25 if count == 1 else 15):
        quick, slow = Side(plan, count), Side(plan, count)
        for number in range(60):
            with monkeypatch.context() as patch:
                patch.setattr(exchange, "CALM_CYCLES", 1 << 30)
                reads = slow.begin()
            assert quick.begin() == reads
            accident = number % 6 == 5
            victim = rng.randrange(count)
            told = [
                said(mine, dialect, rng, accident and index == victim) for index, mine in enumerate(reads)
            ]
            split_ns = rng.choice((None, 0, 1_000_000, 5_000_000))
            assert quick.cycle(told, split_ns) == slow.cycle(told, split_ns)
            accidents += accident
            if any(bus.failure for bus in quick.buses):
                break
        assert not slow.straight
        straight += quick.straight
    assert min(straight, accidents) > 40  # neither side of the comparison is empty


def test_a_bus_that_is_silent_costs_the_others_neither_time_nor_their_lane(make_plan):
    plan, dialect = planned(make_plan, "fast sync read")
    side = Side(plan, 3)
    for number in range(20):
        told = [
            [[(1_500_000, b"".join(replies(one, dialect, random.Random(1))))] for one in mine]
            for mine in side.begin()
        ]
        if number == 19:
            told[1] = [[]]
        asked_ns = side.lines.clock.now_ns()
        side.cycle(told, None)
    arrived_ns = [reads.arrived_ns.tolist() for reads in side.reads]
    assert arrived_ns[0] == arrived_ns[2] == [asked_ns + 1_500_000] * len(IDS)
    assert [reads.lane.through for reads in side.reads] == [True, False, True]


@pytest.mark.parametrize("name", ["single reads", "fast sync read"])
@pytest.mark.parametrize("split_ns", [None, 0])
def test_a_reply_that_was_there_before_the_request_is_nobodys_however_late_the_host_looks(
    make_plan, name, split_ns
):
    plan, dialect = planned(make_plan, name)
    side = Side(plan, 1)
    (line,) = side.lines.ports
    before = b""
    for number in range(8):
        (reads,) = side.begin()
        told = [b"".join(replies(one, dialect, random.Random(number))) for one in reads]
        if number == 7:
            assert side.reads[0].lane is not None
            line.said.append((side.lines.clock.now_ns(), before))
            line.stall_ns = 2_000_000  # longer than the wire takes for both
        side.cycle([[[(3_000_000, one)] for one in told]], split_ns)
        before = told[0]
    assert side.sinks[0].packets[0][0] is not PacketKind.INSTRUCTION
    assert side.straight > 3
    assert side.reads[0].fresh.all()
    answers = [packet for packet in side.sinks[0].packets[1:] if packet[0] is PacketKind.STATUS]
    assert b"".join(packet[-1] for packet in answers) == b"".join(told)
