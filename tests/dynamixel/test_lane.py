"""Reads that go through a lane leave the same behind as those that go step by step, whatever arrives."""

import random
from dataclasses import replace

import pytest

from dxlrun.clock import VirtualClock
from dxlrun.dynamixel import exchange, protocol1, protocol2
from dxlrun.dynamixel.bus import Bus
from dxlrun.dynamixel.exchange import CyclicReads
from dxlrun.dynamixel.pump import pump
from dxlrun.dynamixel.state_arrays import Arrivals, StateArrays
from dxlrun.errors import PortError
from dxlrun.packets import PacketKind, decode_packets

IDS = (1, 7, 3, 20)
BUSES = {
    "single reads": ("AX-12A", 1.0),
    "bulk read": ("MX-28", 1.0),
    "sync read": ("XM430-W350", 2.0),
    "fast sync read": ("XM430-W350", 2.0),
}
PERIOD_NS = 20_000_000


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

    polling = None

    def __init__(self):
        self.clock = VirtualClock(1_000_000)
        self.told, self.said = [], []

    @property
    def ports(self):
        return [self]

    def write(self, data):
        pieces = self.told.pop(0) if self.told else []
        if pieces is None:
            raise PortError("it is gone")
        self.said += [(self.clock.now_ns() + at, piece) for at, piece in pieces]
        self.said.sort(key=lambda one: one[0])

    def read_into(self, buffer):
        if not self.said or self.said[0][0] > self.clock.now_ns():
            return 0
        _, data = self.said.pop(0)
        buffer[: len(data)] = data
        return len(data)

    def wait(self, deadline_ns):
        self.clock.wait_until(min([deadline_ns, *(at for at, _ in self.said)]))
        return [0] if self.said and self.said[0][0] <= self.clock.now_ns() else []


class Side:
    """One bus with its cyclic reads, and what became of each cycle."""

    def __init__(self, plan):
        self.line, self.sink = Line(), Sink()
        self.bus = Bus(0, plan, self.line, self.line.clock, self.sink)
        self.arrays = StateArrays(plan, Arrivals.none(len(plan.servos)))
        self.reads = CyclicReads(plan, self.arrays, self.bus)
        self.straight = 0

    def begin(self):
        """Begin a cycle; return its reads."""
        self.reads.begin()
        return [request.patient[0] for request in self.reads._queue]

    def cycle(self, told):
        """Read once; return what can be told apart."""
        self.line.told, self.line.said = list(told), []
        self.sink.packets.clear()
        self.bus.load(self.reads, self.reads.lane)
        lane = self.reads.lane
        pump([self.bus], self.line, self.line.clock, lambda: None)
        self.straight += lane is not None and lane.through
        reads = self.reads
        for index, fresh in enumerate(reads.fresh.tolist()):
            reads.missed[index] = 0 if fresh else reads.missed[index] + 1
        intact = [packet for packet in self.sink.packets if packet[0] is not PacketKind.NOISE]
        noise = b"".join(packet[-1] for packet in self.sink.packets if packet[0] is PacketKind.NOISE)
        data = [bytes(reply) for reply in self.arrays.replies]
        state = (
            reads.fresh.tolist(),
            reads.arrived_ns.tolist(),
            list(reads.errors),
            list(reads.garbled),
            data,
        )
        end = (self.bus.noise_bytes, str(self.bus.failure), self.line.clock.now_ns())
        self.line.clock.wait_until(self.line.clock.now_ns() + PERIOD_NS)
        return intact, noise, state, end


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


@pytest.mark.parametrize("name", BUSES)
def test_a_lane_leaves_behind_what_reads_step_by_step_do(make_plan, monkeypatch, name):
    model, protocol = BUSES[name]
    dialect = protocol1 if protocol == 1.0 else protocol2
    plan = make_plan(IDS, protocol=protocol, model=model)
    plan = replace(plan, fast=(name == "fast sync read",) * len(plan.groups))
    rng = random.Random(name)
    straight = accidents = 0
    for _ in range(25):
        quick, slow = Side(plan), Side(plan)
        for number in range(60):
            with monkeypatch.context() as patch:
                patch.setattr(exchange, "CALM_CYCLES", 1 << 30)
                reads = slow.begin()
            assert quick.begin() == reads
            told = said(reads, dialect, rng, number % 6 == 5)
            assert quick.cycle(told) == slow.cycle(told)
            accidents += number % 6 == 5
            if quick.bus.failure is not None:
                break
        assert not slow.straight
        straight += quick.straight
    assert min(straight, accidents) > 40  # neither side of the comparison is empty
