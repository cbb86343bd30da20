"""Packet columns: the bus packets of a log as one NumPy array per field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.logged_packets import BEFORE_FIRST_CYCLE, LoggedPacket
from dxlrun.messages.cdr_columns import pieces
from dxlwire.packets import PacketKind


@dataclass(frozen=True, slots=True, eq=False)
class PacketColumns(Sequence[LoggedPacket]):
    """Packets of a log, one element of each array per packet; also a sequence of single packets.

    Times are ns of the run's clock.
    """

    cycle: NDArray[np.int64]
    """Number of the cycle in which the packet was sent or received; BEFORE_FIRST_CYCLE before the first. The
    cycle in which a process died has no record."""
    bus: NDArray[np.uint8]
    """Bus of the packet, as an index into the log's buses."""
    kind: NDArray[np.uint8]
    """Kind of packet, such as instruction or status, as a number of `PacketKind`."""
    servo_id: NDArray[np.uint8]
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]
    start: NDArray[np.int64]
    """Index of the packet's first byte in `data`."""
    length: NDArray[np.int64]
    data: NDArray[np.uint8]
    """Bytes of all packets, possibly also of packets that are not in these columns."""

    @overload
    def __getitem__(self, index: int) -> LoggedPacket: ...
    @overload
    def __getitem__(self, index: slice) -> PacketColumns: ...
    def __getitem__(self, index: int | slice) -> LoggedPacket | PacketColumns:
        """Return one packet, or the columns of a slice of packets."""
        if isinstance(index, slice):
            return self.select_rows(np.arange(len(self))[index])
        start = int(self.start[index])
        return LoggedPacket(
            int(self.bus[index]),
            PacketKind(int(self.kind[index])),
            int(self.servo_id[index]),
            int(self.first_ns[index]),
            int(self.last_ns[index]),
            self.data[start : start + int(self.length[index])].tobytes(),
        )

    def __len__(self) -> int:
        """Return the number of packets."""
        return len(self.bus)

    def __iter__(self) -> Iterator[LoggedPacket]:
        """Yield the packets one by one; computing with the columns is faster."""
        data = self.data.data
        columns = (self.bus, self.kind, self.servo_id, self.first_ns, self.last_ns, self.start, self.length)
        for bus, kind, servo_id, first_ns, last_ns, start, length in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            body = bytes(data[start : start + length])
            yield LoggedPacket(bus, PacketKind(kind), servo_id, first_ns, last_ns, body)

    def select_rows(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> PacketColumns:
        """Return the columns of selected packets, by indices or boolean mask; `data` is not copied."""
        rows = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return replace(self, **{name: getattr(self, name)[rows] for name in _OF_EACH})

    def compact(self) -> PacketColumns:
        """Return the same packets with a new `data` that contains only their bytes."""
        start = np.cumsum(self.length) - self.length
        return replace(self, start=start, data=pieces(self.data, self.start, self.length))

    def byte(self, index: int) -> NDArray[np.uint8]:
        """Return the byte at one offset of each packet, shape (packets,); 0 where a packet is too short."""
        there = index < self.length
        if there.all():
            return self.data[self.start + index]
        found = np.zeros(len(self), np.uint8)
        found[there] = self.data[self.start[there] + index]
        return found

    @classmethod
    def joined(cls, parts: Sequence[PacketColumns]) -> PacketColumns:
        """Concatenate the packets of several columns."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return cls.from_packets(())
        before = np.cumsum([0, *(len(part.data) for part in parts[:-1])])
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_OF_EACH, "data")
        }
        columns["start"] += np.repeat(before, [len(part) for part in parts])
        return cls(**columns)

    @classmethod
    def from_packets(
        cls, packets: Iterable[LoggedPacket], cycle: NDArray[np.int64] | None = None
    ) -> PacketColumns:
        """Convert packets to columns; `cycle` has their cycle numbers, None means before the first cycle."""
        rows = list(packets)
        length = np.array([len(packet.data) for packet in rows], np.int64)
        return cls(
            np.full(len(rows), BEFORE_FIRST_CYCLE, np.int64) if cycle is None else cycle,
            np.array([packet.bus for packet in rows], np.uint8),
            np.array([packet.kind for packet in rows], np.uint8),
            np.array([packet.servo_id for packet in rows], np.uint8),
            np.array([packet.first_ns for packet in rows], np.int64),
            np.array([packet.last_ns for packet in rows], np.int64),
            np.cumsum(length) - length,
            length,
            np.frombuffer(b"".join(packet.data for packet in rows), np.uint8),
        )


_OF_EACH = ("cycle", "bus", "kind", "servo_id", "first_ns", "last_ns", "start", "length")
"""Columns with one element per packet."""


def numbers(data: NDArray[np.uint8], at: NDArray[np.int64], kind: str) -> NDArray[np.int64]:
    """Read little-endian integers of NumPy type `kind` at these byte offsets in `data`."""
    dtype = np.dtype(kind)
    count = max(len(data) - dtype.itemsize + 1, 0)
    found: NDArray[np.int64] = np.ndarray((count,), dtype, data, 0, (1,))[at].astype(np.int64)
    return found
