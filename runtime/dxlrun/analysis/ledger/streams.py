"""One direction of one bus as a stream of bytes with times, from the runtime's log and from the ledger.

Packets cannot be compared one by one: a terminal splits and joins what passes it, and what was corrupted on
the way is no packet for one of the two. The bytes in their order are the same for both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dxlrun.run.channels.packets import LoggedPacket, PacketKind
from dxlrun.simulation import LedgerEntry

Way = Literal["sent", "received"]
"""Seen from the host: `sent` to the servos, `received` from them."""
WAYS: tuple[Way, ...] = ("sent", "received")


@dataclass(frozen=True, slots=True)
class Stream:
    """Bytes in their order, in pieces that have one time each."""

    data: bytes
    ends: NDArray[np.int64]
    """Where each piece ends in `data`."""
    times: NDArray[np.int64]
    """ns of the run's clock, of each piece; never falling."""

    def time_at(self, index: int) -> int:
        """Return the time of a byte, ns; of the last one where the stream has ended, 0 where it is empty."""
        if not len(self.ends):
            return 0
        piece = int(np.searchsorted(self.ends, index, side="right"))
        return int(self.times[min(piece, len(self.times) - 1)])

    def first_from(self, t_ns: int) -> int:
        """Return the index of the first byte at or after a time; the length of the stream when none is."""
        piece = int(np.searchsorted(self.times, t_ns, side="left"))
        return int(self.ends[piece - 1]) if piece else 0

    def between(self, begin_ns: int, end_ns: int) -> Stream:
        """Return the pieces from `begin_ns` to `end_ns`, both included."""
        first = int(np.searchsorted(self.times, begin_ns, side="left"))
        last = int(np.searchsorted(self.times, end_ns, side="right"))
        start = int(self.ends[first - 1]) if first else 0
        stop = int(self.ends[last - 1]) if last else 0
        return Stream(self.data[start:stop], self.ends[first:last] - start, self.times[first:last])


def logged(packets: Sequence[LoggedPacket], way: Way) -> Stream:
    """Return what the runtime says it sent (before each write) or got (after each packet's last read).

    `packets` of one bus, in order of time.
    """
    if way == "sent":
        chosen = [packet for packet in packets if packet.kind == PacketKind.INSTRUCTION]
        return _stream((packet.data, packet.first_ns) for packet in chosen)
    chosen = [packet for packet in packets if packet.kind != PacketKind.INSTRUCTION]
    return _stream((packet.data, packet.last_ns) for packet in chosen)


def seen(entries: Iterable[LedgerEntry], way: Way) -> Stream:
    """Return what the simulated bus took from the host or gave to it. `entries` of one bus."""
    direction = "in" if way == "sent" else "out"
    return _stream((entry.data, entry.t_ns) for entry in entries if entry.direction == direction)


def _stream(pieces: Iterable[tuple[bytes, int]]) -> Stream:
    data = bytearray()
    ends: list[int] = []
    times: list[int] = []
    for piece, t_ns in pieces:
        data += piece
        ends.append(len(data))
        times.append(t_ns)
    rising = np.maximum.accumulate(np.array(times, np.int64)) if times else np.zeros(0, np.int64)
    return Stream(bytes(data), np.array(ends, np.int64), rising)
