"""The half-duplex line: what is transmitted toward the host, and what becomes of collisions.

Not modelled: what servos make of noise and of each other's replies (of those they receive only the end of the
one before them in a group read), framing errors and breaks, garbage between rates that differ by less than
3 %, levels and reflections on the cable.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from dxlsim.wire.packets import ServoReply

MOST_PASSING = 512
"""Packets on their way to the host at once: a host that floods a line on virtual time fills no memory."""

ECHO = "echo"  # Note of the host's own bytes, which its adapter gives back


class Turn(NamedTuple):
    """One servo's turn in a group read."""

    servo_id: int
    replies: tuple[tuple[ServoReply, bytes], ...]
    """Reply and its bytes; two servos may share an ID, and an absent one has none."""
    slot_bytes: int  # Bytes of a whole reply: the turn is over when they would have passed


class GroupReply(msgspec.Struct):
    """The replies to a group read, each sent after the end of the one before it."""

    turns: Sequence[Turn]
    has_slots: bool
    """True: a servo that misses the end of the reply before it waits for the end of that turn; False: it
    never replies [?]."""
    sent: int = 0  # So many turns are decided


class Transmission(msgspec.Struct):
    """Bytes on their way to the host, one after the other without a pause."""

    first_ns: int  # When the first of them begins to pass the wire
    due_ns: int  # When the last of them has passed it
    data: bytes
    note: str = ""
    group: GroupReply | None = None  # The group read that continues when this has passed
    turn: int = 0  # Which of its turns this is
    turn_end_ns: int = 0  # When that turn is over
    broken: bool = False  # True when the servos cannot make out the packet
    given: int = 0  # So many of its bytes the adapter has handed to the host already

    def passed_ns(self, index: int) -> int:
        """Return when one of its bytes has passed the wire."""
        return self.first_ns + (self.due_ns - self.first_ns) * (index + 1) // len(self.data)

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether it is on the wire within a time; what an adapter echoes never is."""
        return self.note != ECHO and self.first_ns < end_ns and begin_ns < self.due_ns


class SimulatedLine:
    """What servos and noise put on one line, in the order in which it ends."""

    def __init__(self, baud_rate: int, note: Callable[[str], None]) -> None:
        self.passing: list[Transmission] = []
        self.baud_rate = baud_rate  # bit/s
        self._note = note

    def duration_ns(self, size: int) -> int:
        """Return how long so many bytes take: 10 bits each (e-Manual, 8N1)."""
        return size * 10_000_000_000 // self.baud_rate

    def send(self, new: Transmission) -> None:
        """Put bytes on their way to the host, mixed with what is on the wire at the same time."""
        passing = self.passing
        if len(passing) >= MOST_PASSING:
            self._note(f"{len(new.data)} bytes to the host are lost: too many are on their way")
            return
        if not passing or passing[-1].due_ns <= new.first_ns:  # nearly always: the line is free by then
            passing.append(new)
            return
        for other in [each for each in passing if each.overlaps(new.first_ns, new.due_ns)]:
            passing.remove(other)
            self._note(f"collision: {other.data.hex(' ')} and {new.data.hex(' ')} at once")
            new = self._mixed(other, new)
        insort(passing, new, key=_due)

    def echo(self, own: Transmission) -> None:
        """Let the adapter receive what the host itself sends."""
        insort(self.passing, own, key=_due)

    def withdraw(self, group: GroupReply) -> None:
        """Take back the replies of a group read that wait for the end of another one."""
        under_way = [each for each in self.passing if each.group is group]
        if not under_way:
            return
        group.sent = under_way[0].turn + 1
        self.passing[:] = [each for each in self.passing if each.group is not group or each.turn < group.sent]

    def talk_over(self, sent: bytearray, position: int, start_ns: int) -> None:
        """Spoil what the host sends from `position` on while a servo sends, and the rest of that reply.

        A servo does not receive while it sends: there the host's bytes arrive as 0 [i].
        """
        byte_ns = self.duration_ns(1)
        begin_ns, end_ns = start_ns + self.duration_ns(position), start_ns + self.duration_ns(len(sent))
        for each in [each for each in self.passing if each.overlaps(begin_ns, end_ns)]:
            first = max(position, (each.first_ns - start_ns) // byte_ns)
            last = min(len(sent), -(-(each.due_ns - start_ns) // byte_ns))
            sent[first:last] = bytes(last - first)
            kept = max(0, (begin_ns - each.first_ns) // byte_ns)
            self._note(f"collision: the host sends into {each.data.hex(' ')}, {kept} bytes of it arrive")
            self.passing.remove(each)
            if kept:
                due_ns = each.first_ns + self.duration_ns(kept)
                cut = replace(each, due_ns=due_ns, data=each.data[:kept], note="collision", broken=True)
                insort(self.passing, cut, key=_due)

    def _mixed(self, one: Transmission, other: Transmission) -> Transmission:
        """Return what two senders give: their bytes ANDed, as drivers that both pull low would [i]."""
        early, late = sorted((one, other), key=_first)
        offset = round((late.first_ns - early.first_ns) / self.duration_ns(1))
        mixed = bytearray(early.data).ljust(offset + len(late.data), b"\xff")
        for index, byte in enumerate(late.data, start=offset):
            mixed[index] &= byte
        awaited = one if one.group is not None else other
        return replace(
            awaited,
            first_ns=early.first_ns,
            due_ns=early.first_ns + self.duration_ns(len(mixed)),
            data=bytes(mixed),
            note="collision",
            broken=bytes(mixed) != awaited.data,
            given=early.given,
        )


def flipped(packet: bytes, index: int, flip: int) -> bytes:
    """Return a packet with bits of one byte flipped; raises IndexError when it is shorter."""
    broken = bytearray(packet)
    broken[index] ^= flip
    return bytes(broken)


def _due(each: Transmission) -> int:
    return each.due_ns


def _first(each: Transmission) -> int:
    return each.first_ns
