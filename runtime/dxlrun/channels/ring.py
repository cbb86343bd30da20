"""Rings: buffers of records in shared memory. The one writer never waits and never reads the readers' state.

A record has a kind and any length up to the ring's longest. Records are contiguous and never wrap: the memory
extends beyond the capacity by the longest record. Positions count all bytes ever appended. The offset of a
record is its position modulo the capacity.

Layout of the memory, little-endian, everything aligned to 8 bytes:

    header  magic u64, capacity u64, longest record u64, head u64 (end of the last complete record),
            intent u64 (end of the record that is being written, or was written last), latest u64 (start of
            the last record), taken u64 (position that a reader has reported), number u64 (of the next record)
    record  mark u64 (its position + 1), number u32 (counted from 0, modulo 2^32), length u32, kind u32,
            CRC-32 u32 of these fields and of the payload (zlib, polynomial 0xEDB88320), payload

The writer raises `intent` before it overwrites a byte. A reader copies a record and then reads `intent`. The
copy is valid if the record cannot have been overwritten by then and the CRC-32 matches. A reader that was
overtaken, or that finds damage, searches for the next valid mark. The numbers of the records, or the number
of the next one, show how many were lost. This is implemented in C with the required memory order:
`shared_memory.c`. `ring_model.c` of the tests executes it in every order that C11 allows.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Callable
from enum import IntEnum, unique
from functools import partial
from typing import NamedTuple, Protocol

from dxlrun.channels import shared_memory
from dxlrun.channels.shared_memory import library, load, mapped, store
from dxlwire.compiled import array_of

RING_SECONDS = 10
"""Time for which a ring's reader may pause without losing records, s; ring sizes are computed for it."""

_HEADER = 64
_MAGIC = int.from_bytes(b"dxlring2", "little")
_HEAD, _TAKEN = 3, 6
_POSITION, _PASSED, _KIND, _LOST = range(4)  # Words of a reader
_GAP = -2
_WORD = 8
_FIXED = struct.Struct("=QQQ")
RECORD_HEADER = 24

Payload = bytes | bytearray | memoryview
"""Bytes of a record. A memoryview must be contiguous and of format B."""


@unique
class RecordKind(IntEnum):
    """Kind of a record's payload; each kind's docstring names the module that declares the layout."""

    CYCLE = 1
    """cycle.py"""
    PACKETS = 2
    """packets.py: packets of about one cycle"""
    TAGGED = 3
    """tagged.py: all other records"""


class Record(NamedTuple):
    """A record that was read from a ring. `kind` is an int, because damaged memory may have any value."""

    kind: int
    payload: bytes


class Gap(NamedTuple):
    """Result of a read that reports how many records were overwritten or damaged before they were read."""

    lost: int


class Appender(Protocol):
    """Destination of records: a ring, or a function in the same process."""

    @property
    def head(self) -> int:
        """Position at which the next record will be appended."""
        ...

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Append a record; return its end position."""
        ...

    def make_appender(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return a function that appends the current content of a memoryview at each call."""
        ...


def record_size(length: int) -> int:
    """Return how many bytes a record takes in a ring, with header, for a payload of `length` bytes."""
    return -(-(RECORD_HEADER + length) // _WORD) * _WORD


def memory_size(capacity: int, longest: int) -> int:
    """Return the size of a ring's memory: header, capacity, and room for the longest record after it."""
    return _HEADER + capacity + record_size(longest)


def lay_out(memory: memoryview, capacity: int, longest: int) -> None:
    """Write the header of an empty ring into zeroed memory.

    Raises ValueError if the ring cannot hold its longest record.
    """
    if longest < 1 or capacity % _WORD or capacity < record_size(longest):
        raise ValueError(f"a ring of {capacity} bytes cannot hold a record of {longest} bytes")
    _FIXED.pack_into(memory, 0, _MAGIC, capacity, longest)


def create(name: str, capacity: int, longest: int) -> int:
    """Create a ring and return the descriptor of its memory.

    Args:
        name: Name for diagnostics.
        capacity: Room for records, bytes; rounded up to whole words.
        longest: Longest payload, bytes.
    """
    capacity = -(-capacity // _WORD) * _WORD
    fixed = bytearray(_HEADER)
    lay_out(memoryview(fixed), capacity, longest)
    descriptor = shared_memory.create(name, memory_size(capacity, longest))
    os.pwrite(descriptor, fixed, 0)
    return descriptor


class _Ring:
    """Mapped memory of a ring, given as a descriptor or as memory."""

    __slots__ = ("_bytes", "_place", "_words", "longest")

    def __init__(self, memory: int | memoryview, flags: int = 0) -> None:
        if isinstance(memory, int):
            memory = mapped(memory, flags)
        magic, capacity, self.longest = _FIXED.unpack_from(memory)
        size = memory_size(capacity, self.longest) if magic == _MAGIC and capacity else 0
        if not 0 < size <= len(memory):
            raise ValueError("this memory is not a ring of this version")
        self._bytes = memory[:size]
        self._words = self._bytes.cast("Q")
        self._place = array_of(self._bytes), capacity

    @property
    def head(self) -> int:
        """End position of the last complete record. Records that a writer left unfinished do not count."""
        return self._words[_HEAD]


class RingWriter(_Ring):
    """The only writer of a ring. `append` is safe in the loop: it never waits or locks.

    The constructor touches all pages, so that the loop has no page faults. A writer continues after the last
    record of an earlier writer.

    Args:
        memory: Descriptor of the ring, or its mapped memory.

    Raises:
        ValueError: The memory does not hold a ring.
        NotCompiled: The compiled writer is missing.
    """

    __slots__ = ("_append",)

    def __init__(self, memory: int | memoryview) -> None:
        super().__init__(memory, mmap.MAP_POPULATE)
        self._append = partial(library().dxl_append, *self._place, self.longest)

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Append a record; return its end position. Raises ValueError if it is too long."""
        self._require(len(payload))
        end: int = self._append(kind, bytes(payload), len(payload))
        return end

    def make_appender(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return a function that appends the current content of a memoryview at each call."""
        self._require(len(memory))
        return partial(self._append, kind, array_of(memory), len(memory))

    def commits(self, desk: memoryview, most: int) -> Callable[[], object]:
        """Return a function that appends the batch on a desk to the ring, at most `most` bytes.

        See `PacketBatch`.
        """
        self._require(most)
        return partial(library().dxl_commit, *self._place, most, array_of(desk))

    def _require(self, length: int) -> None:
        if length > self.longest:
            raise ValueError(f"a record of {length} bytes is longer than the ring's maximum, {self.longest}")

    @property
    def taken(self) -> int:
        """Position up to which a reader has reported (`report_taken`) that it has read.

        `append` ignores it.
        """
        return load(self._words, _TAKEN)


class RingReader(_Ring):
    """Reader of a ring. A ring may have several readers, each with its own position.

    No method raises for damaged memory, and the time of a call is bounded by the longest record.

    Args:
        memory: Descriptor of the ring, or its mapped memory.

    Raises:
        ValueError: The memory does not hold a ring.
        NotCompiled: The compiled reader is missing.
    """

    __slots__ = ("_newest", "_next", "_payload", "_reader")

    def __init__(self, memory: int | memoryview) -> None:
        super().__init__(memory)
        self._reader = memoryview(bytearray(4 * _WORD)).cast("Q")
        copy = memoryview(
            mmap.mmap(-1, record_size(self.longest))
        )  # unused pages of a long buffer take no memory
        self._payload = copy[RECORD_HEADER:]
        place = *self._place, self.longest, array_of(self._reader.cast("B")), array_of(copy)
        self._next = partial(library().dxl_read_next, *place)
        self._newest = partial(library().dxl_read_newest, *place)

    @property
    def position(self) -> int:
        """Position of the next record to read, in bytes ever appended."""
        return self._reader[_POSITION]

    @position.setter
    def position(self, position: int) -> None:
        self._reader[_POSITION] = position

    @property
    def passed(self) -> int:
        """Number of records ever appended before `position`, modulo 2^32."""
        return self._reader[_PASSED]

    def read_record(self) -> Record | Gap | None:
        """Return the next record, a Gap if records were lost, or None if nothing is new."""
        found = self._next()
        return Gap(self._reader[_LOST]) if found == _GAP else self._record(found)

    def newest(self) -> Record | None:
        """Return the newest record and skip all older ones.

        None if nothing is new or the record is damaged.
        """
        return self._record(self._newest())

    def report_taken(self) -> None:
        """Publish this reader's position, for a queue whose writer must not overwrite unread records."""
        store(self._words, _TAKEN, self.position)

    def _record(self, length: int) -> Record | None:
        return None if length < 0 else Record(self._reader[_KIND], bytes(self._payload[:length]))


class Handover:
    """Appender without a ring: passes each record to the function `take` in the same process."""

    __slots__ = ("_take", "head")

    def __init__(self, take: Callable[[RecordKind, Payload], None]) -> None:
        self._take = take
        self.head = 0
        """Number of records passed so far."""

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Pass a record to the function. The payload is valid only during the call."""
        self._take(kind, payload)
        self.head += 1
        return self.head

    def make_appender(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return a function that passes the current content of a memoryview at each call."""
        return partial(self.append, kind, memory)
