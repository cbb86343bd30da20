"""Campaign: fuzzed packets through the host's receiver, of both protocols.

Every packet of a stream is intact, damaged, cut off or noise, and the stream arrives in pieces of any size,
with flushes in between as after a timeout; now and then it has the replies to a read, whole, damaged, or not
at all. Nothing may be raised, the receiver keeps no more than its one buffer, each byte leaves it once
and in order, and every intact packet is delivered exactly once.

    python bench/fuzz_receiver.py 1000000

CI runs a seeded sample of it (tests/dxlwire/test_protocols.py).
"""

from __future__ import annotations

import random
import sys
import time
import tracemalloc
from dataclasses import dataclass

from fastcrc import crc16

from dxlwire.wire import protocol1, protocol2
from dxlwire.wire.dialect import Dialect
from dxlwire.wire.receiver import Receiver

BATCH = 100
"""Packets between two flushes."""


@dataclass(slots=True)
class Tally:
    """What came of a campaign."""

    packets: int = 0
    intact: int = 0
    delivered: int = 0
    accidents: int = 0
    """Packets with a right checksum among damaged bytes: by chance, or the damage lies beside them."""
    swallowed: int = 0
    """Intact packets of which such an accident took a part."""
    noise_bytes: int = 0
    most_pending: int = 0


class _Ear:
    """Keeps what a receiver delivers."""

    def __init__(self, dialect: Dialect) -> None:
        self.packets: list[bytes] = []
        self.noise = 0
        self.everything = bytearray()
        self.receiver = Receiver(self._packet, self._noise, dialect)

    def _packet(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        assert first_ns <= last_ns
        self.packets.append(bytes(data))
        self.everything += data

    def _noise(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        assert first_ns <= last_ns
        self.noise += len(data)
        self.everything += data


def status(dialect: Dialect, rng: random.Random) -> bytes:
    """Return an intact status packet, now and then full of the header's bytes."""
    length = rng.choice((0, 1, 2, 6, 10, 10, 10, 40, 200))
    bytes_of = (0xFF, 0xFF, 0xFD, 0x00) if rng.random() < 0.3 else range(256)
    data = bytes(rng.choices(bytes_of, k=length))
    make = protocol1.status_packet if dialect.PROTOCOL == 1.0 else protocol2.status_packet
    return make(rng.randrange(dialect.HIGHEST_ID + 1), rng.randrange(256), data)


def damaged(packet: bytes, rng: random.Random) -> bytes:
    """Return a packet with a bit turned, bytes lost, or bytes too many."""
    broken = bytearray(packet)
    where = rng.randrange(len(broken))
    match rng.randrange(4):
        case 0:
            broken[where] ^= 1 << rng.randrange(8)
        case 1:
            del broken[where : where + rng.randint(1, 6)]
        case 2:
            broken[where:where] = rng.randbytes(rng.randint(1, 6))
        case _:
            del broken[where:]
    return bytes(broken)


def noise(dialect: Dialect, rng: random.Random) -> bytes:
    """Return random bytes, often with something like a header."""
    made = rng.randbytes(rng.randint(0, 30))
    return made + dialect.HEADER[: rng.randint(0, 4)] + made[:3] if rng.random() < 0.5 else made


def replies(dialect: Dialect, rng: random.Random) -> list[bytes]:
    """Return the intact packets that answer a read of some servos, or their one packet of a fast form."""
    ids = rng.sample(range(dialect.HIGHEST_ID + 1), rng.randint(1, 9))
    length = rng.choice((1, 2, 6, 10, 27))
    if dialect.PROTOCOL == 1.0 or rng.random() < 0.5:
        make = dialect.status_packet
        return [make(servo_id, rng.choice((0, 0, 0, 0x80)), rng.randbytes(length)) for servo_id in ids]
    packet = b"\xff\xff\xfd\x00\xfe" + (1 + len(ids) * (length + 4)).to_bytes(2, "little") + b"\x55"
    for servo_id in ids:
        packet += bytes((rng.choice((0, 0x80)), servo_id)) + rng.randbytes(length)
        packet += crc16.umts(packet).to_bytes(2, "little")
    return [packet]


def batch(dialect: Dialect, rng: random.Random) -> tuple[bytes, list[bytes], list[bytes]]:
    """Return a stream, its intact packets without rubbish before them, and all intact ones."""
    stream, certain, intact = bytearray(), [], []
    clean = True
    while len(intact) < BATCH:
        kind = rng.random()
        if kind < 0.1:
            answers = replies(dialect, rng)
            if rng.random() < 0.7:
                stream += b"".join(answers)
                intact += answers
                certain += answers if clean else []
                continue
            clean = False
            stream += damaged(b"".join(answers), rng) if rng.random() < 0.8 else b""
            continue
        if kind < 0.7:
            packet = status(dialect, rng)
            stream += packet
            intact.append(packet)
            if clean:
                certain.append(packet)
            continue
        clean = False
        stream += damaged(status(dialect, rng), rng) if kind < 0.85 else noise(dialect, rng)
    return bytes(stream), certain, intact


def campaign(dialect: Dialect, count: int, seed: int) -> Tally:
    """Send `count` fuzzed packets through one receiver; raises AssertionError when a promise is broken."""
    rng = random.Random(seed)
    ear, tally = _Ear(dialect), Tally()
    now = 0
    while tally.packets < count:
        stream, certain, intact = batch(dialect, rng)
        ear.packets.clear()
        ear.everything.clear()
        start = 0
        while start < len(stream):
            now += 1
            piece = stream[start : start + rng.choice((1, 5, 16, 64, 64, 512, 2048))]
            ear.receiver.feed_bytes(piece, now)
            tally.most_pending = max(tally.most_pending, ear.receiver.pending)
            start += len(piece)
        ear.receiver.flush()
        assert bytes(ear.everything) == stream, f"bytes lost or doubled, seed {seed}"
        assert ear.receiver.pending == 0
        assert ear.packets[: len(certain)] == certain, (
            f"an intact packet before any rubbish was lost, seed {seed}"
        )
        whole = judge(dialect, stream, intact, ear.packets, seed)
        tally.accidents += len(ear.packets) - whole
        tally.swallowed += len(intact) - whole
        tally.packets += BATCH
        tally.intact += len(intact)
        tally.delivered += len(ear.packets)
    tally.noise_bytes = ear.noise
    return tally


def judge(dialect: Dialect, stream: bytes, intact: list[bytes], delivered: list[bytes], seed: int) -> int:
    """Compare what was delivered with what a slow scan finds; return how many intact ones are in it.

    A false packet may have a right checksum and swallow the beginning of a true one: then, and only then, an
    intact packet is not delivered.
    """
    expected = scan(dialect, stream)
    assert delivered == expected, (
        f"delivered {len(delivered)} packets, {len(expected)} are in it, seed {seed}"
    )
    return len(matched(intact, expected))


def matched(intact: list[bytes], delivered: list[bytes]) -> list[bytes]:
    """Return the intact packets that were delivered, in order; missing ones were swallowed by an accident."""
    found, position = [], 0
    for packet in intact:
        try:
            position = delivered.index(packet, position) + 1
        except ValueError:
            continue
        found.append(packet)
    return found


def scan(dialect: Dialect, stream: bytes) -> list[bytes]:
    """Return the packets of a whole stream: at each byte, is a whole packet here? Written to be obvious."""
    found, start = [], 0
    while start < len(stream):
        if stream.startswith(dialect.HEADER, start):
            size = dialect.size_at(stream, start, len(stream))
            packet = stream[start : start + size]
            if size > 0 and len(packet) == size and dialect.intact(memoryview(packet)):
                found.append(packet)
                start += size
                continue
        start += 1
    return found


def main() -> None:
    """Run the campaign: count of packets per protocol, seed."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    for dialect in (protocol1, protocol2):
        tracemalloc.start()
        began = time.monotonic()
        tally = campaign(dialect, count, seed)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        print(
            f"Protocol {dialect.PROTOCOL}: {tally}, peak {peak >> 10} KiB, {time.monotonic() - began:.0f} s"
        )


if __name__ == "__main__":
    main()
