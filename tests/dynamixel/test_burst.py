"""Replies taken as a whole are what the receiver makes of the same bytes packet by packet, whatever comes."""

import random

import pytest

from dxlrun.clock import VirtualClock
from dxlrun.dynamixel import protocol1, protocol2
from dxlrun.dynamixel.burst import Burst
from dxlrun.dynamixel.bus import Bus
from dxlrun.dynamixel.line import Line
from dxlrun.dynamixel.pump import pump
from dxlrun.dynamixel.transaction import Outcome
from dxlrun.packets import PacketKind

IDS = (1, 7, 253, 20)
LENGTH = 6
READS = {
    "bulk read": (protocol1, Line(1_000_000, 0, 0, protocol1), False),
    "read": (protocol1, Line(1_000_000, 0, 0, protocol1), False),
    "sync read": (protocol2, Line(1_000_000, 0, 0, protocol2), False),
    "fast sync read": (protocol2, Line(1_000_000, 0, 0, protocol2), True),
}


def asked(name):
    """Return dialect, the servos that are read and the transaction."""
    dialect, line, fast = READS[name]
    ids = [servo_id if dialect is protocol1 or servo_id < 253 else 252 for servo_id in IDS]
    ids = ids[:1] if name == "read" else ids
    return dialect, ids, line.read_many([(one, 36, LENGTH) for one in ids], fast=fast)


class Script:
    """A line that says what it was told after the instruction: (ns, bytes) each."""

    polling = None

    def __init__(self, said):
        self.clock = VirtualClock(1_000)
        self.said = [(1_000 + at, data) for at, data in said]

    @property
    def ports(self):
        return [self]

    def write(self, data):
        pass

    def read_into(self, buffer):
        if not self.said or self.said[0][0] > self.clock.now_ns():
            return 0
        _, data = self.said.pop(0)
        buffer[: len(data)] = data
        return len(data)

    def wait(self, deadline_ns):
        self.clock.wait_until(min([deadline_ns, *(at for at, _ in self.said)]))
        return [0] if self.said and self.said[0][0] <= self.clock.now_ns() else []


class Job:
    """Reads once and keeps what came of it; with or without a burst."""

    def __init__(self, transaction, burst):
        self.transaction, self.burst = transaction, burst
        self.statuses, self.end, self.took = {}, None, False

    def advance(self, reply):
        if reply is None:
            return self.transaction
        self.end = (reply.outcome, reply.strays)
        return None

    def status(self, index, reply):
        self.statuses[index] = (reply.error, bytes(reply.parameters), reply.last_ns)

    def take(self, burst, times_ns):
        self.took = True
        times = times_ns if isinstance(times_ns, list) else [times_ns] * burst.count
        for index, (error, data, at) in enumerate(zip(burst.errors, burst.data, times, strict=True)):
            self.statuses[index] = (error, data.tobytes(), at)


class Sink:
    def __init__(self):
        self.packets = []

    def packet(self, bus, kind, servo_id, first_ns, last_ns, data):  # noqa: PLR0917  as PacketSink has it
        self.packets.append((kind, servo_id, first_ns, last_ns, bytes(data)))


def replies(name, rng):
    """Return the replies to a read as servos send them: any data, now and then an error."""
    dialect, ids, _ = asked(name)
    bytes_of = (0xFF, 0xFD, 0x00) if rng.random() < 0.2 else range(256)
    errors = (0, 0, 0x80) if rng.random() < 0.7 else (0, 0x20, 4, 0x84)
    found = []
    for servo_id in ids:
        error = rng.choice(errors)
        found.append((servo_id, error, bytes(rng.choices(bytes_of, k=LENGTH))))
    if name != "fast sync read":
        return [dialect.status_packet(*one) for one in found]
    packet = protocol2.HEADER + b"\xfe" + (len(ids) * (LENGTH + 4) + 1).to_bytes(2, "little") + b"\x55"
    for servo_id, error, data in found:
        packet += bytes((error, servo_id)) + data
        packet += protocol2.crc(packet).to_bytes(2, "little")
    return [packet]


def spoilt(packets, name, rng):
    """Return the bytes of replies after an accident, or none."""
    dialect, ids, transaction = asked(name)
    match rng.randrange(15):
        case 0:
            packets.pop(rng.randrange(len(packets)))
        case 1:
            rng.shuffle(packets)
        case 2:
            packets.insert(rng.randrange(len(packets) + 1), rng.randbytes(rng.randint(1, 20)))
        case 3:
            packets.insert(rng.randrange(len(packets) + 1), rng.choice(packets))
        case 4:
            packets[rng.randrange(len(packets))] = dialect.status_packet(rng.choice(ids), 0x48)
        case 5:
            packets.insert(0, transaction.packet)
    stream = bytearray(b"".join(packets))
    if stream and rng.random() < 0.25:
        where = rng.randrange(len(stream))
        match rng.randrange(3):
            case 0:
                stream[where] ^= 1 << rng.randrange(8)
            case 1:
                del stream[where : where + rng.randint(1, 4)]
            case _:
                stream[where:where] = dialect.HEADER[: rng.randint(1, 4)]
    return bytes(stream)


def pieces(stream, rng):
    """Return a stream as it arrives: now and then sooner than the wire allows."""
    at = rng.choice((1_000, 300_000, 800_000, 800_000, 900_000))
    found = []
    while stream:
        size = rng.choice((1, 7, 20, 1_000, 1_000, 1_000))
        found.append((at, stream[:size]))
        stream = stream[size:]
        at += rng.choice((0, 1_000, 100_000))
    return found


def exchange(make_plan, name, said, *, burst):
    dialect, ids, transaction = asked(name)
    line, sink = Script(said), Sink()
    model = "XM430-W350" if dialect is protocol2 else "MX-28"
    plan = make_plan(tuple(ids), protocol=dialect.PROTOCOL, model=model)
    bus = Bus(0, plan, line, line.clock, sink)
    job = Job(transaction, Burst.of(dialect, transaction, bus.room) if burst else None)
    bus.load(job)
    pump([bus], line, line.clock, lambda: None)
    return job, sink.packets, bus.noise_bytes


def split(packets):
    """Return intact packets with their times, and what is noise, which may be cut at other places."""
    intact = [packet for packet in packets if packet[0] is not PacketKind.NOISE]
    return intact, b"".join(packet[-1] for packet in packets if packet[0] is PacketKind.NOISE)


@pytest.mark.parametrize("name", READS)
def test_a_burst_is_what_the_receiver_makes_of_the_same_bytes(make_plan, name):
    rng = random.Random(name)
    whole = 0
    for number in range(250):
        said = pieces(spoilt(replies(name, rng), name, rng), rng)
        job, packets, noise = exchange(make_plan, name, said, burst=True)
        other, others, noises = exchange(make_plan, name, said, burst=False)
        assert (job.statuses, job.end[0]) == (other.statuses, other.end[0]), f"stream {number}: {said}"
        assert split(packets) == split(others), f"stream {number}: {said}"
        assert noise == noises
        whole += job.took
        assert not job.took or job.end[0] is Outcome.OK
    assert 25 < whole < 240  # neither side of the comparison is empty


def test_noise_that_the_servos_behind_it_heard_as_well_is_in_no_fast_reply(make_plan):
    name, count = "fast sync read", len(IDS)
    rng = random.Random(2)
    packet = next(one for (one,) in iter(lambda: replies(name, rng), []) if not any(one[8 : -1 : LENGTH + 4]))
    assert exchange(make_plan, name, [(900_000, packet)], burst=True)[0].took
    step = LENGTH + 4
    for spoilt_part in range(count):
        stream = bytearray(packet)
        stream[8 + spoilt_part * step + 4] ^= 0x10
        for part in range(spoilt_part + 1, count):  # each goes on with the CRC of what it heard
            end = 8 + (part + 1) * step
            stream[end - 2 : end] = protocol2.crc(bytes(stream[: end - 2])).to_bytes(2, "little")
        job, *_ = exchange(make_plan, name, [(900_000, bytes(stream))], burst=True)
        assert not job.took
        assert not job.statuses.keys() & set(range(spoilt_part, count))
