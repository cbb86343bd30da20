"""Campaign: packets of random kinds, bytes and times, paired by the compiled pairing of the analysis.

Nothing may be raised. Each requested reply is missing, or has a reply of the same servo in the same exchange.

    python bench/fuzz_pairing.py 100000
    python bench/fuzz_pairing.py 20000 --sanitized

CI runs a seeded sample of it (tests/analysis/test_exchanges.py).
"""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.sanitizers import load_sanitized, run_sanitized

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos import compiled_pairing
from dxlrun_analysis.servos.exchanges import Pairing
from dxlwire.packets import PacketKind

IDS = (0, 1, 2, 3, 253, 254, 255)
SIZES = (0, 1, 4)
BUSES = 2
EDGES = (-(1 << 63), -1, 0, 1_000_000, (1 << 63) - 1)  # Times, rates and return delays


def random_bytes(chance: random.Random, count: int) -> bytes:
    """Return random bytes, many of them those of headers."""
    return bytes(chance.choice((0xFF, 0xFD, 0, 0x55, chance.randrange(256))) for _ in range(count))


def blocks(chance: random.Random) -> bytes:
    """Return blocks of a fast status packet: error, ID, data and CRC."""
    count = chance.randrange(4)
    return b"".join(bytes((0, chance.choice(IDS))) + bytes(chance.choice(SIZES) + 2) for _ in range(count))


def instruction(chance: random.Random) -> bytes:
    """Return an instruction of either protocol that may ask servos."""
    code, count = chance.choice((1, 2, 3, 0x82, 0x83, 0x8A, 0x92, 0x9A)), chance.randrange(5)
    ids = bytes(chance.choice(IDS) for _ in range(count))
    if chance.random() < 0.2:
        body = b"\0" + b"".join(bytes((4, one, 43)) for one in ids)
        return bytes((0xFF, 0xFF, chance.choice(IDS), len(body) + 2, code)) + body + b"\0"
    size = chance.choice(SIZES)
    several = b"".join(bytes((one, 132, 0, size, 0)) for one in ids)
    body = several if code in (0x92, 0x9A) else bytes((132, 0, size, 0)) + ids
    return bytes((0xFF, 0xFF, 0xFD, 0, chance.choice(IDS), len(body) + 3, 0, code)) + body + bytes(2)


def status(chance: random.Random) -> bytes:
    """Return a status packet of either protocol, of one servo or of several."""
    head = b"\xff\xff\xfd\x00\xfe\x10\x00\x55"
    alone = bytes((0xFF, 0xFF, 0xFD, 0, chance.choice(IDS), 8, 0, 0x55, 0, 1, 2))
    first = bytes((0xFF, 0xFF, chance.choice(IDS), 3, 0, 1, 2))
    return chance.choice((head + blocks(chance), alone, first))


def random_packets(chance: random.Random) -> PacketColumns:
    """Return packets, sorted by bus; some times go back."""
    texts, rows, at_ns = [instruction(chance) for _ in range(chance.randint(1, 24))], [], 0
    for _ in range(chance.randrange(60)):
        kind = chance.choice((*PacketKind, PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.STATUS))
        at_ns += chance.choice((-1000, 0, 1000, 1_000_000))
        times = (at_ns, at_ns + 1000) if chance.random() < 0.95 else (chance.choice(EDGES),) * 2
        sent = kind in (PacketKind.INSTRUCTION, PacketKind.OTHER_HOST, PacketKind.ECHO)
        data = chance.choice(texts) if sent else chance.choice((status(chance), blocks(chance)))
        data = data if chance.random() < 0.9 else random_bytes(chance, chance.randrange(12))
        servo_id = data[4] if len(data) > 4 else 0
        rows.append(LoggedPacket(chance.randrange(BUSES), kind, servo_id, *times, data))
    rows.sort(key=lambda packet: packet.bus)
    return PacketColumns.from_packets(rows)


def pair(chance: random.Random) -> int:
    """Pair packets once; return the number of missing replies."""
    rates = (chance.choice((57_600, 1_000_000, *EDGES)) for _ in range(BUSES))
    buses = [LoggedBus("", baud_rate=rate, return_delay_ns=chance.choice(EDGES)) for rate in rates]
    packets = random_packets(chance)
    pairing = Pairing(tuple(buses))
    found = pairing.alone(packets)
    due, replies = found.due, found.replies
    came = np.flatnonzero(due.reply >= 0)
    answers = due.reply[came]
    for one in ("exchange", "servo", "place"):
        assert (getattr(due, one)[came] == getattr(replies, one)[answers]).all(), one
    assert sorted(answers.tolist()) == np.flatnonzero(replies.answers).tolist()
    assert due.missing.tolist() == np.flatnonzero(due.reply < 0).tolist()
    assert len(due.exchange) == found.requests.servos[found.request].sum()
    assert (found.count_due(found.times) == np.bincount(due.servo, minlength=512)).all()
    assert (pairing.counts.replies == np.bincount(replies.servo, minlength=512)).all()
    took_ns = replies.last_ns - found.asked_ns[replies.exchange]
    assert (replies.took_us == np.where(replies.answers, took_ns // 1000, 0)).all()
    last = np.full(len(found.bus), -1)
    last[replies.exchange[replies.answers]] = np.flatnonzero(replies.answers)
    assert found.answer.tolist() == last.tolist()
    asked = int(np.count_nonzero(packets.kind == PacketKind.INSTRUCTION))
    assert len(found.bus) == asked + BUSES
    assert (np.diff(found.bus) >= 0).all()
    return len(due.missing)


def campaign(count: int, seed: int) -> tuple[int, int]:
    """Pair packets `count` times; return the number of times, and of missing replies."""
    chance = random.Random(seed)
    return count, sum(pair(chance) for _ in range(count))


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int, nargs="?", default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sanitized", action="store_true", help="with AddressSanitizer and UBSan of gcc")
    chosen = parser.parse_args()
    if chosen.sanitized:
        run_sanitized([compiled_pairing])
    load_sanitized([compiled_pairing])
    print("{} times, {} missing replies".format(*campaign(chosen.count, chosen.seed)))


if __name__ == "__main__":
    main()
