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
records it missed.

Fences (`fence.py`) keep that order on every processor: between `intent`, the record and the head, and between
the head, the copy and `intent`. A reader that sees a head before its record all the same looks again until a
later record is whole, or the memory is overwritten: nothing that may still come is declared lost. Run on
x86-64 only.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import struct
from collections.abc import Callable
from enum import IntEnum, unique
from functools import partial
from typing import NamedTuple, Protocol
from zlib import crc32

from dxlrun.channels.fence import array_of, fence, library

RING_SECONDS = 10
"""How long a reader may be away before records are lost, at the rates that the sizes are computed for."""

_HEADER = 64
_MAGIC = int.from_bytes(b"dxlring2", "little")
_HEAD, _INTENT, _LATEST, _TAKEN = 3, 4, 5, 6
_WORD = 8
_FIXED = struct.Struct("=QQQ")
_FIELDS = struct.Struct("=QIII")
_CRC = struct.Struct("=I")
_CRC_AT = _FIELDS.size
RECORD_HEADER = _CRC_AT + _CRC.size
_NUMBERS = 1 << 32

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
    """Create a ring and return its memfd; hand it to a process with `pass_fds`; nothing is left in /dev/shm.

    `capacity`: bytes of records that are kept (rounded up to whole words); `longest`: payload of the longest
    record, bytes. The size is sealed: no process can shrink the memory under another.
    """
    capacity = -(-capacity // _WORD) * _WORD
    descriptor = os.memfd_create(f"dxlrun-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, memory_size(capacity, longest))
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        fixed = bytearray(_HEADER)
        lay_out(memoryview(fixed), capacity, longest)
        os.pwrite(descriptor, fixed, 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


class _Ring:
    """The memory of a ring: a descriptor to be mapped, or a part of memory that is mapped already."""

    __slots__ = ("_bytes", "_capacity", "_words", "longest")

    def __init__(self, memory: int | memoryview, flags: int = 0) -> None:
        if isinstance(memory, int):
            memory = memoryview(mmap.mmap(memory, 0, flags=mmap.MAP_SHARED | flags))
        magic, self._capacity, self.longest = _FIXED.unpack_from(memory)
        size = memory_size(self._capacity, self.longest) if magic == _MAGIC and self._capacity else 0
        if not 0 < size <= len(memory):
            raise ValueError("this memory is not a ring of this version")
        self._bytes = memory[:size]
        self._words = self._bytes.cast("Q")

    @property
    def head(self) -> int:
        """The position behind the last whole record; one that the writer left unfinished does not count."""
        return self._words[_HEAD]


class RingWriter(_Ring):
    """The one writer of a ring; `append` is made for the loop: no wait, no lock, no look at readers.

    The pages are touched when it is built, so that the loop does not meet their first use. Continues after
    the last record when the ring was written before. What writes is in C (`kernel.c`). Raises ValueError when
    the memory is no ring, StartUpError where the kernel was not compiled.
    """

    __slots__ = ("_append", "_compiled", "_place")

    def __init__(self, memory: int | memoryview, compiled: ctypes.CDLL | None = None) -> None:
        super().__init__(memory, mmap.MAP_POPULATE)
        self._compiled = compiled or library()
        self._place = array_of(self._bytes), self._capacity
        self._append = partial(self._compiled.dxl_append, *self._place, self.longest)

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
        return partial(self._compiled.dxl_commit, *self._place, most, array_of(desk))

    def _require(self, length: int) -> None:
        if length > self.longest:
            raise ValueError(
                f"a record of {length} bytes does not fit this ring, its longest is {self.longest}"
            )

    @property
    def taken(self) -> int:
        """The position that a reader has reported with `report_taken`; `append` does not care for it."""
        return int(self._words[_TAKEN])


class RingReader(_Ring):
    """One reader of a ring, at its own pace. Raises ValueError when the memory is no ring.

    Whatever the memory holds, no method raises, and each takes a time that the longest record bounds.
    """

    __slots__ = ("_number", "position")

    def __init__(self, memory: int | memoryview) -> None:
        super().__init__(memory)
        self.position = 0
        """Where the next record is expected."""
        self._number = 0

    @property
    def passed(self) -> int:
        """How many records were appended before `position`, as the last one shows; modulo 2^32."""
        return self._number

    def read(self) -> Record | Gap | None:
        """Return the next record, a Gap where records were lost, or None when there is nothing new.

        A record that is not whole may come a moment later than its head: it is lost when one behind it is.
        """
        if self.head <= self.position:
            return None
        found = self._copy(self.position)
        if found is None:
            head = self.head  # again: a writer that overtook this copy is further
            found = self._search(head)
            if found is None:
                reach = self.position + record_size(self.longest)
                if self.position < head <= reach and not self._overwritten(self.position):
                    return None
                return Gap(self.give_up())
        number, record = found
        if number != self._number:
            lost = (number - self._number) % _NUMBERS
            self._number = number
            return Gap(lost)
        self._pass(number, record)
        return record

    def newest(self) -> Record | None:
        """Return the newest record and go on behind it; None when there is nothing new, or it is damaged."""
        position = self._words[_LATEST]
        if self.head <= self.position or position < self.position:
            return None
        self.position = position
        return self.take()

    def take(self) -> Record | None:
        """Return the record at `position` and go on behind it; None when it is not whole, see `skip`."""
        found = self._copy(self.position)
        if found is None:
            return None
        self._pass(*found)
        return found[1]

    def skip(self) -> None:
        """Leave out everything up to the head."""
        self.position = self.head

    def give_up(self) -> int:
        """Leave out what is not whole; return how many records that are at least.

        The number of the next one shows how many more.
        """
        lost = int(self.head > self.position)
        if lost:
            self.skip()
            self._number = (self._number + 1) % _NUMBERS
        return lost

    def report_taken(self) -> None:
        """Let the writer know how far this reader is: for a queue whose writer refuses what has no room."""
        fence()
        self._words[_TAKEN] = self.position % (1 << 64)

    def _pass(self, number: int, record: Record) -> None:
        self.position += record_size(len(record.payload))
        self._number = (number + 1) % _NUMBERS

    def _copy(self, position: int) -> tuple[int, Record] | None:
        """Return number and content of the record that begins here, None when none does that is whole."""
        start = _HEADER + position % self._capacity
        body = start + RECORD_HEADER
        fence()  # no byte of it is older than the head
        fields = bytes(self._bytes[start : start + _CRC_AT])
        mark, number, length, kind = _FIELDS.unpack(fields)
        if mark != position + 1 or length > self.longest:
            return None
        (crc,) = _CRC.unpack_from(self._bytes, start + _CRC_AT)
        payload = bytes(self._bytes[body : body + length])
        fence()  # the intent is no older than the copy
        if self._overwritten(position) or crc32(payload, crc32(fields)) != crc:
            return None
        return number, Record(kind, payload)

    def _overwritten(self, position: int) -> bool:
        """Whether the writer may have begun to overwrite what lies from here on."""
        return bool(self._words[_INTENT] > position + self._capacity)

    def _search(self, head: int) -> tuple[int, Record] | None:
        """Go to the next whole record before `head` and return it; the longest one's size bounds the way."""
        oldest = max(self.position, self._words[_INTENT] - self._capacity)
        oldest = -(-oldest // _WORD) * _WORD
        for position in range(oldest, min(head, oldest + record_size(self.longest) + _WORD), _WORD):
            index = (_HEADER + position % self._capacity) // _WORD
            if self._words[index] == position + 1 and (found := self._copy(position)) is not None:
                self.position = position
                return found
        return None


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
