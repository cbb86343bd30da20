"""Counts the instructions that an AX-12A misses on a line with an XL430, for which a bus has one protocol.

    python bench/mixed_line.py [--reads 1000000]

The host reads an XL430 in a random state, and then an AX-12A, again and again: of an arm, whose joints stay
within a turn, and of a continuous joint. What the AX-12A then do is in docs/explanation/bus.md.
"""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.mixed_line import MixedBus
from tests.kit.packets import packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.simulation_plan import ServoConfig

AX_IDS, X_ID, MS = range(1, 9), 11, 1_000_000
READ_STATE = packet2(X_ID, 2, bytes((126, 0, 10, 0)))
"""Read of an XL430 in a cycle: load (2 bytes), velocity (4), position (4)."""
TURNS = {"arm": (0, 4095), "continuous": (-1_048_575, 1_048_575)}
"""Positions, ticks."""


def measure(reads: int, turns: tuple[int, int], chance: random.Random) -> str:
    """Return what became of so many reads of AX-12A, each behind a status of the XL430."""
    shown = dict.fromkeys(("present_load", "present_velocity", "present_position"), 0)
    servos = [ServoConfig(servo_id, "AX-12A", 2.0) for servo_id in AX_IDS]
    bus = MixedBus([*servos, ServoConfig(X_ID, "XL430-W250", 2.0, 0)], Ledger(keep=False))
    bus.servo(X_ID).show_live({name: lambda name=name: shown[name] for name in shown})
    missed = changed = 0
    for t_ns in range(0, reads * 4 * MS, 4 * MS):
        state = chance.randint(-1000, 1000), chance.randint(-265, 265), chance.randint(*turns)
        shown.update(zip(shown, state, strict=True))
        bus.receive_bytes(READ_STATE, t_ns)
        bus.drain_bytes(t_ns + MS)
        bus.drain_bytes(t_ns + 2 * MS)  # An answer of an AX-12A to the status
        servo_id = chance.choice(AX_IDS)
        bus.receive_bytes(packet1(servo_id, 2, 36, 6), t_ns + 2 * MS)
        missed += not bus.drain_bytes(t_ns + 4 * MS).startswith(bytes((0xFF, 0xFF, servo_id, 8)))
        for servo, own_id in zip(bus.kinds[0].servos, AX_IDS, strict=True):
            if servo.servo_id != own_id:
                changed += 1
                servo.poke("id", own_id)
    obeyed = sum(servo.counts.received for servo in bus.kinds[0].servos) - (reads - missed)
    return f"{missed / reads:.1%} missed; {obeyed:,} other instructions obeyed, {changed} changed an ID"


def main() -> None:
    """Print what becomes of the reads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reads", type=int, default=1_000_000)
    for kind, turns in TURNS.items():
        print(f"{kind}: {measure(parser.parse_args().reads, turns, random.Random(1))}")


if __name__ == "__main__":
    main()
