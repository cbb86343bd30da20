"""Half-duplex line of a simulated bus: packets and noise on their way to the host, and their collisions.

Not modelled: reception of noise and of other servos' replies by servos (except for the end of the previous
reply in a group read), framing errors and breaks, garbage between rates that differ by less than 3 %,
levels and reflections on the cable."""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from dxlsim.wire.servo_packets import ServoReply

MOST_PASSING = 512
"""Limit of packets on their way to the host. It bounds the memory if a host floods a line on virtual time."""

ECHO = "echo"  # Note of the host's own bytes, echoed by its adapter


class Turn(NamedTuple):
    """Turn of one servo in a group read (sync or bulk read), with its replies."""

    servo_id: int
    replies: tuple[tuple[ServoReply, bytes], ...]
    """Replies with their bytes on the wire: several if servos share an ID, none if the servo is absent."""
    slot_bytes: int  # Size of a whole reply: the turn ends after that time on the wire


class GroupReply(msgspec.Struct):
    """Replies to one group read (sync or bulk read); each one is sent after the end of the previous reply."""

    turns: Sequence[Turn]
    has_slots: bool
    """True: a servo that misses the end of the previous reply waits for the end of that turn. False: the
    servo never replies [?]."""
    sent: int = 0  # Number of decided turns


class LineTransmission(msgspec.Struct):
    """Contiguous bytes on their way to the host: a reply, noise, or an echo."""

    first_ns: int  # Time at which the first byte begins to pass the wire
    due_ns: int  # Time at which the last byte has passed the wire
    data: bytes
    note: str = ""
    group: GroupReply | None = None  # Group read that continues after this transmission
    turn: int = 0  # Index of the turn in the group read
    turn_end_ns: int = 0  # Time at which that turn ends
    broken: bool = False  # True if the servos cannot parse the packet
    given: int = 0  # Number of bytes that the adapter has already delivered

    def passed_ns(self, index: int) -> int:
        """Return the time (ns) at which the byte at `index` has passed the wire."""
        return self.first_ns + (self.due_ns - self.first_ns) * (index + 1) // len(self.data)

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Return True if the bytes are on the wire within this interval, ns. An adapter's echo never is."""
        return self.note != ECHO and self.first_ns < end_ns and begin_ns < self.due_ns


class SimulatedLine:
    """Bytes of servos and noise that are on one simulated line, ordered by their end."""

    def __init__(self, baud_rate: int, note: Callable[[str], None]) -> None:
        self.passing: list[LineTransmission] = []
        self.baud_rate = baud_rate  # bit/s
        self._note = note

    def duration_ns(self, size: int) -> int:
        """Return how long `size` bytes take on the wire, ns: 10 bits each (e-Manual, 8N1)."""
        return size * 10_000_000_000 // self.baud_rate

    def send(self, new: LineTransmission) -> None:
        """Add a transmission to the host. It is mixed with those that are on the wire at the same time: a
        collision."""
        passing = self.passing
        if len(passing) >= MOST_PASSING:
            self._note(f"{len(new.data)} bytes to the host are lost: too many transmissions overlap")
            return
        if not passing or passing[-1].due_ns <= new.first_ns:  # Almost always true: the line is free by then
            passing.append(new)
            return
        for other in [each for each in passing if each.overlaps(new.first_ns, new.due_ns)]:
            passing.remove(other)
            self._note(f"collision: {other.data.hex(' ')} overlaps {new.data.hex(' ')}")
            new = self._mixed(other, new)
        insort(passing, new, key=_due)

    def echo(self, own: LineTransmission) -> None:
        """Add the adapter's echo of the host's own bytes, which collides with nothing."""
        insort(self.passing, own, key=_due)

    def withdraw(self, group: GroupReply) -> None:
        """Remove those replies of a group read that have not begun because they wait for the end of
        another reply."""
        under_way = [each for each in self.passing if each.group is group]
        if not under_way:
            return
        group.sent = under_way[0].turn + 1
        self.passing[:] = [each for each in self.passing if each.group is not group or each.turn < group.sent]

    def talk_over(self, sent: bytearray, position: int, start_ns: int) -> None:
        """Apply a collision of the host's bytes from `position` with replies: set the host's bytes to 0, and
        truncate the replies.

        A servo does not receive while it sends: it sees the host's bytes as 0 [i]."""
        byte_ns = self.duration_ns(1)
        begin_ns, end_ns = start_ns + self.duration_ns(position), start_ns + self.duration_ns(len(sent))
        for each in [each for each in self.passing if each.overlaps(begin_ns, end_ns)]:
            first = max(position, (each.first_ns - start_ns) // byte_ns)
            last = min(len(sent), -(-(each.due_ns - start_ns) // byte_ns))
            sent[first:last] = bytes(last - first)
            kept = max(0, (begin_ns - each.first_ns) // byte_ns)
            self._note(f"collision: the host sends during {each.data.hex(' ')}; reply cut to {kept} bytes")
            self.passing.remove(each)
            if kept:
                due_ns = each.first_ns + self.duration_ns(kept)
                cut = replace(each, due_ns=due_ns, data=each.data[:kept], note="collision", broken=True)
                insort(self.passing, cut, key=_due)

    def _mixed(self, one: LineTransmission, other: LineTransmission) -> LineTransmission:
        """Return the transmission that results from two simultaneous senders: the AND of their bytes, as
        two drivers pulling low [i]."""
        early, late = sorted((one, other), key=_first)
        offset = round((late.first_ns - early.first_ns) / self.duration_ns(1))
        # An idle line reads as FF, the neutral element of AND.
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
    """Return a packet with the bits of `flip` inverted in the byte at `index`. Raises IndexError if the
    packet is shorter."""
    broken = bytearray(packet)
    broken[index] ^= flip
    return bytes(broken)


def _due(each: LineTransmission) -> int:
    return each.due_ns


def _first(each: LineTransmission) -> int:
    return each.first_ns
