"""Rings: how records leave a process; shared memory, one writer that never waits and never looks at readers.

A record has a kind and any length up to the ring's longest. It lies in one piece: the memory runs on behind
the ring for as long as the longest record, so that none has to be cut, and none wraps. Positions count the
bytes that were ever appended; a record lies at its position modulo the ring's capacity.

Layout of the memory, little-endian, everything aligned to 8 bytes:

    header  magic u64, capacity u64, longest record u64, head u64 (end of the last whole record), intent u64
            (end of the record that is being written, or was last), latest u64 (start of the last record),
            taken u64 (for a reader that lets the writer know how far it is), number u64 (of the next record)
    record  mark u64 (its position + 1), number u32 (counted from 0, modulo 2^32), length u32, kind u32,
            CRC-32 u32 of these fields and of the payload (zlib, polynomial 0xEDB88320), payload

The writer raises `intent` before it overwrites a byte. A reader copies a record, and then looks at `intent`:
what it copied is good if nothing of it can have been overwritten by then, and if the CRC-32 agrees. A reader
that was overtaken, or finds damage, looks for the next mark that is one, and declares by the numbers how many
records it missed; where none is left, by the number of the next record. All of that is in C, in an order that
every processor keeps: `shared_memory.c`; `ring_model.c` of the tests runs it in every order that C11 allows.
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
"""How long a reader may be away before records are lost, at the rates that the sizes are computed for."""

_HEADER = 64
_MAGIC = int.from_bytes(b"dxlring2", "little")
_HEAD, _TAKEN = 3, 6
_POSITION, _PASSED, _KIND, _LOST = range(4)  # Words of a reader
_GAP = -2
_WORD = 8
_FIXED = struct.Struct("=QQQ")
RECORD_HEADER = 24

Payload = bytes | bytearray | memoryview
"""Bytes of one record; a memoryview must be contiguous and of format B."""


@unique
class RecordKind(IntEnum):
    """What the payload of a record is; the module named here declares its layout."""

    CYCLE = 1
    """cycle.py"""
    PACKETS = 2
    """packets.py: the packets of about one cycle"""
    TAGGED = 3
    """tagged.py: anything else"""


class Record(NamedTuple):
    """One record as a reader gets it; `kind` is a plain number, because memory may be damaged."""

    kind: int
    payload: bytes


class Gap(NamedTuple):
    """Records that a reader did not get: overwritten before it came, or damaged."""

    lost: int


class Appender(Protocol):
    """Where records go: a ring, or straight to a reader in the same process."""

    @property
    def head(self) -> int:
        """The position that the next record gets."""
        ...

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Take one record; return the position behind it."""
        ...

    def repeat(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return what appends the present content of some memory, each time it is called."""
        ...


def record_size(length: int) -> int:
    """Return how many bytes of a ring a record takes whose payload has this length."""
    return -(-(RECORD_HEADER + length) // _WORD) * _WORD


def memory_size(capacity: int, longest: int) -> int:
    """Return how many bytes a ring needs: its header, its capacity, and what a record may run on behind."""
    return _HEADER + capacity + record_size(longest)


def lay_out(memory: memoryview, capacity: int, longest: int) -> None:
    """Make an empty ring of zeroed memory. Raises ValueError when it cannot hold its longest record."""
    if longest < 1 or capacity % _WORD or capacity < record_size(longest):
        raise ValueError(f"a ring of {capacity} bytes cannot hold a record of {longest} bytes")
    _FIXED.pack_into(memory, 0, _MAGIC, capacity, longest)


def create(name: str, capacity: int, longest: int) -> int:
    """Create a ring and return the descriptor of its memory.

    `capacity`: bytes of records that are kept (rounded up to whole words); `longest`: payload of the longest
    record, bytes.
    """
    capacity = -(-capacity // _WORD) * _WORD
    fixed = bytearray(_HEADER)
    lay_out(memoryview(fixed), capacity, longest)
    descriptor = shared_memory.create(name, memory_size(capacity, longest))
    os.pwrite(descriptor, fixed, 0)
    return descriptor


class _Ring:
    """The memory of a ring: a descriptor to be mapped, or a part of memory that is mapped already."""

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
        """The position behind the last whole record; one that the writer left unfinished does not count."""
        return self._words[_HEAD]


class RingWriter(_Ring):
    """The one writer of a ring; `append` is made for the loop: no wait, no lock, no look at readers.

    The pages are touched when it is built, so that the loop does not meet their first use. Continues after
    the last record when the ring was written before. Raises ValueError when the memory is no ring,
    NotCompiled where what writes was not compiled.
    """

    __slots__ = ("_append",)

    def __init__(self, memory: int | memoryview) -> None:
        super().__init__(memory, mmap.MAP_POPULATE)
        self._append = partial(library().dxl_append, *self._place, self.longest)

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Copy one record behind the last; return the position behind it. Raises ValueError when too long."""
        self._require(len(payload))
        end: int = self._append(kind, bytes(payload), len(payload))
        return end

    def repeat(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return what appends the present content of some memory, each time it is called."""
        self._require(len(memory))
        return partial(self._append, kind, array_of(memory), len(memory))

    def commits(self, desk: memoryview, most: int) -> Callable[[], object]:
        """Return what appends the batch on a desk, see `PacketBatch`, of at most so many bytes."""
        self._require(most)
        return partial(library().dxl_commit, *self._place, most, array_of(desk))

    def _require(self, length: int) -> None:
        if length > self.longest:
            raise ValueError(
                f"a record of {length} bytes does not fit this ring, its longest is {self.longest}"
            )

    @property
    def taken(self) -> int:
        """The position that a reader has reported with `report_taken`; `append` does not care for it."""
        return load(self._words, _TAKEN)


class RingReader(_Ring):
    """One reader of a ring, at its own pace. Raises ValueError if the memory does not hold a ring, and
    NotCompiled if the compiled reader is missing.

    Whatever the memory holds, no method raises, and each takes a time that the longest record bounds.
    """

    __slots__ = ("_newest", "_next", "_payload", "_reader")

    def __init__(self, memory: int | memoryview) -> None:
        super().__init__(memory)
        self._reader = memoryview(bytearray(4 * _WORD)).cast("Q")
        copy = memoryview(
            mmap.mmap(-1, record_size(self.longest))
        )  # pages that no record needs are never used
        self._payload = copy[RECORD_HEADER:]
        place = *self._place, self.longest, array_of(self._reader.cast("B")), array_of(copy)
        self._next = partial(library().dxl_read_next, *place)
        self._newest = partial(library().dxl_read_newest, *place)

    @property
    def position(self) -> int:
        """Where the next record is expected."""
        return self._reader[_POSITION]

    @position.setter
    def position(self, position: int) -> None:
        self._reader[_POSITION] = position

    @property
    def passed(self) -> int:
        """How many records were appended before `position`, as the last one shows; modulo 2^32."""
        return self._reader[_PASSED]

    def read(self) -> Record | Gap | None:
        """Return the next record, a Gap where records were lost, or None when there is nothing new."""
        found = self._next()
        return Gap(self._reader[_LOST]) if found == _GAP else self._record(found)

    def newest(self) -> Record | None:
        """Return the newest record and go on behind it; None when there is nothing new, or it is damaged."""
        return self._record(self._newest())

    def report_taken(self) -> None:
        """Let the writer know how far this reader is: for a queue whose writer refuses what has no room."""
        store(self._words, _TAKEN, self.position)

    def _record(self, length: int) -> Record | None:
        return None if length < 0 else Record(self._reader[_KIND], bytes(self._payload[:length]))


class Handover:
    """A ring of length zero: hands each record straight to `take`, in the same process, on virtual time."""

    __slots__ = ("_take", "head")

    def __init__(self, take: Callable[[RecordKind, Payload], None]) -> None:
        self._take = take
        self.head = 0
        """Records handed over so far."""

    def append(self, kind: RecordKind, payload: Payload) -> int:
        """Hand over one record; it is valid only during the call."""
        self._take(kind, payload)
        self.head += 1
        return self.head

    def repeat(self, kind: RecordKind, memory: memoryview) -> Callable[[], object]:
        """Return what hands over the present content of some memory, each time it is called."""
        return partial(self.append, kind, memory)
