"""The half-duplex line: what passes it toward the host, and what becomes of two that talk at once.

Not modelled: what servos make of noise and of each other's replies (of those they hear only the end of the
one before them in a read in turn), framing errors and breaks, garbage between rates that differ by less than
3 %, levels and reflections on the cable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from dxlrun.simulation.wire.packets import FastStatus, ReadEntry, ReadInTurn, Reply

MOST_PASSING = 256
"""Packets on their way to the host at once: a host that floods a line on virtual time fills no memory."""


STATUS_BYTES = 11
"""Bytes of a status packet of Protocol 2.0 without data: the slot of an absent servo is as long [i]."""
Alteration = Callable[[bytes], bytes]
"""What becomes of a packet's bytes."""


@dataclass(slots=True)
class Chain:
    """A read in turn that is under way: who is still to answer, each after it heard the one before it."""

    reading: ReadInTurn
    waiting: deque[tuple[ReadEntry, list[Reply]]]
    fast: FastStatus | None
    has_slots: bool
    """True: who does not hear the one before it answers when that one's time is over; False: never [?]."""
    slot_end_ns: int = 0
    """When the time of the one that answers now is over."""


@dataclass(slots=True)
class Chunk:
    """Bytes on their way to the host, one after the other without a pause."""

    first_ns: int
    """When the first of them begins to pass the wire."""
    due_ns: int
    """When the last of them has passed it."""
    data: bytes
    note: str = ""
    chain: Chain | None = None
    """Who listens for its end, to answer next."""
    broken: bool = False
    """True when those who listen cannot make out the packet."""
    given: int = 0
    """So many of its bytes the adapter has handed to the host already."""

    def passed_ns(self, index: int) -> int:
        """Return when one of its bytes has passed the wire."""
        return self.first_ns + (self.due_ns - self.first_ns) * (index + 1) // len(self.data)

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether it is on the wire within a time; what an adapter echoes never is."""
        return self.note != "echo" and self.first_ns < end_ns and begin_ns < self.due_ns


@dataclass(frozen=True, slots=True)
class Change:
    """What happens to the next packet of somebody."""

    text: str
    change: Alteration
    delay_ns: int = 0
    copies: int = 1


class Wire:
    """The bytes of servos and noise on one line, in the order in which they end."""

    def __init__(self, baud_rate: int, note: Callable[[str], None]) -> None:
        self.passing: list[Chunk] = []
        self.baud_rate = baud_rate
        """bit/s"""
        self._note = note

    def duration_ns(self, size: int) -> int:
        """Return how long so many bytes take: 10 bits each (e-Manual, 8N1)."""
        return size * 10_000_000_000 // self.baud_rate

    def send(self, chunk: Chunk) -> None:
        """Put bytes on their way to the host, mixed with what is on the wire at the same time."""
        passing = self.passing
        if len(passing) >= MOST_PASSING:
            self._note(f"{len(chunk.data)} bytes to the host are lost: too much waits for the line")
        elif passing:
            for other in [each for each in passing if each.overlaps(chunk.first_ns, chunk.due_ns)]:
                passing.remove(other)
                self._note(f"collision: {other.data.hex(' ')} and {chunk.data.hex(' ')} at once")
                chunk = self._mixed(other, chunk)
            passing.append(chunk)
            passing.sort(key=_due)
        else:
            passing.append(chunk)

    def echo(self, chunk: Chunk) -> None:
        """Let the adapter hear what the host itself sends."""
        self.passing.append(chunk)
        self.passing.sort(key=_due)

    def talk_over(self, heard: bytearray, position: int, start_ns: int) -> None:
        """Spoil what the host sends from `position` on while a servo talks, and the rest of what it says.

        Who talks does not listen: where both talk the host's bytes arrive as 0 [i].
        """
        byte_ns = self.duration_ns(1)
        begin_ns, end_ns = start_ns + self.duration_ns(position), start_ns + self.duration_ns(len(heard))
        for chunk in [each for each in self.passing if each.overlaps(begin_ns, end_ns)]:
            first = max(position, (chunk.first_ns - start_ns) // byte_ns)
            last = min(len(heard), -(-(chunk.due_ns - start_ns) // byte_ns))
            heard[first:last] = bytes(last - first)
            kept = max(0, (begin_ns - chunk.first_ns) // byte_ns)
            self._note(f"collision: the host talks into {chunk.data.hex(' ')}, {kept} bytes of it arrive")
            self.passing.remove(chunk)
            if kept:
                self._shorten(chunk, kept)

    def _shorten(self, chunk: Chunk, kept: int) -> None:
        due_ns = chunk.first_ns + self.duration_ns(kept)
        rest = Chunk(chunk.first_ns, due_ns, chunk.data[:kept], "collision", chunk.chain, True, chunk.given)
        self.passing.append(rest)
        self.passing.sort(key=_due)

    def _mixed(self, one: Chunk, other: Chunk) -> Chunk:
        """Return what two talkers give: their bytes ANDed, as drivers that both pull low would [i]."""
        early, late = sorted((one, other), key=_first)
        offset = round((late.first_ns - early.first_ns) / self.duration_ns(1))
        mixed = bytearray(early.data).ljust(offset + len(late.data), b"\xff")
        for index, byte in enumerate(late.data, start=offset):
            mixed[index] &= byte
        due_ns = early.first_ns + self.duration_ns(len(mixed))
        chain = one.chain or other.chain
        broken = bytes(mixed) != (one if chain is one.chain else other).data
        return Chunk(early.first_ns, due_ns, bytes(mixed), "collision", chain, broken, early.given)


def flipped(packet: bytes, index: int, flip: int) -> bytes:
    """Return a packet with bits of one byte flipped; raises IndexError when it is shorter."""
    broken = bytearray(packet)
    broken[index] ^= flip
    return bytes(broken)


def _due(chunk: Chunk) -> int:
    return chunk.due_ns


def _first(chunk: Chunk) -> int:
    return chunk.first_ns
