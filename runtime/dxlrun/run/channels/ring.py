"""Rings: how records leave the loop; shared memory, one writer that never waits and never looks at readers.

Tested on x86-64 only. Python has no memory barriers: that a reader sees a slot's payload before its
sequence number follows from the order in which x86-64 makes stores visible. On other processors (ARM) the
CRC-32 of every record still tells a torn one from a whole one, but that has not been run there.

Layout of the memory, little-endian, 64-bit words aligned:

    header  magic u64, slot size u32, slots u32, head u64 (records appended so far), 40 bytes reserved
    slot    sequence u64 (number of the record + 1; 0 while it is being written), length u32, CRC-32 u32,
            payload of up to `slot size` bytes

The CRC-32 (zlib, polynomial 0xEDB88320) starts from the sequence number, so that an old payload under a new
number does not pass.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol
from zlib import crc32

SLOT_HEADER = 16
RING_SECONDS = 10
"""How long a reader may be away before records are lost, at the rates that the sizes are computed for."""

_HEADER = 64
_MAGIC = int.from_bytes(b"dxlring1", "little")
_HEAD = 2
_WORD = 8
_FIXED = struct.Struct("=QIIQ")
_LENGTH_CRC = struct.Struct("=II")
_MASK = 0xFFFFFFFF

Payload = bytes | bytearray | memoryview
"""Bytes of one record; a memoryview must be contiguous and of format B."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Records that a reader did not get: overwritten before it came, or damaged."""

    lost: int


class Appender(Protocol):
    """Where records go: a ring, or straight to a reader in the same process."""

    @property
    def slot_size(self) -> int:
        """The longest record, bytes."""
        ...

    @property
    def head(self) -> int:
        """Records appended so far: the number that the next one gets."""
        ...

    def append(self, payload: Payload) -> int:
        """Take one record; return its number, counted from 0."""
        ...


def create(name: str, slot_size: int, slots: int) -> int:
    """Create a ring and return its memfd; hand it to a process with `pass_fds`; nothing is left in /dev/shm.

    `slot_size`: longest record, bytes (rounded up to whole words); `slots`: how many records are kept.
    The size is sealed: no process can shrink the memory under another. Raises ValueError for a ring without
    room, OSError when there is no memory.
    """
    if slot_size < 1 or slots < 2:
        raise ValueError(f"a ring needs at least 1 byte a slot and 2 slots, not {slot_size} and {slots}")
    slot_size = -(-slot_size // _WORD) * _WORD
    descriptor = os.memfd_create(f"dxlrun-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, _HEADER + slots * (SLOT_HEADER + slot_size))
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        os.pwrite(descriptor, _FIXED.pack(_MAGIC, slot_size, slots, 0), 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


class _Mapping:
    """The memory of a ring, seen as bytes and as words."""

    __slots__ = ("_map", "bytes", "slot_size", "slots", "stride", "words")

    def __init__(self, descriptor: int, flags: int) -> None:
        self._map = mmap.mmap(descriptor, 0, flags=flags)
        self.bytes = memoryview(self._map)
        self.words = self.bytes[: len(self.bytes) // _WORD * _WORD].cast("Q")
        magic, self.slot_size, self.slots, _ = _FIXED.unpack_from(self.bytes)
        self.stride = SLOT_HEADER + self.slot_size
        if magic != _MAGIC or len(self.bytes) != _HEADER + self.slots * self.stride:
            self.close()
            raise ValueError("this descriptor is not a ring of this version")

    def close(self) -> None:
        self.words.release()
        self.bytes.release()
        self._map.close()


class RingWriter:
    """The one writer of a ring; `append` is made for the loop: no wait, no lock, no look at readers.

    The pages are touched when it is built, so that the loop does not meet their first use. Continues after
    the last record when the ring was written before. Raises ValueError when the descriptor is no ring.
    """

    __slots__ = ("_bytes", "_mapping", "_next", "_slots", "_stride", "_words", "slot_size")

    def __init__(self, descriptor: int) -> None:
        self._mapping = _Mapping(descriptor, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._bytes, self._words = self._mapping.bytes, self._mapping.words
        self._slots, self._stride = self._mapping.slots, self._mapping.stride
        self.slot_size = self._mapping.slot_size
        self._next = self._words[_HEAD]

    @property
    def head(self) -> int:
        """Records appended so far: the number that the next one gets."""
        return self._next

    def append(self, payload: Payload) -> int:
        """Copy one record into the next slot; return its number. Raises ValueError when it is too long."""
        length = len(payload)
        if length > self.slot_size:
            raise ValueError(f"a record of {length} bytes does not fit a slot of {self.slot_size}")
        number = self._next
        start = _HEADER + number % self._slots * self._stride
        word = start // _WORD
        words = self._words
        words[word] = 0  # a reader that copies now sees that the slot changed under it
        body = start + SLOT_HEADER
        self._bytes[body : body + length] = payload
        _LENGTH_CRC.pack_into(self._bytes, start + _WORD, length, crc32(payload, (number + 1) & _MASK))
        self._next = words[word] = words[_HEAD] = number + 1
        return number

    def close(self) -> None:
        """Let go of the memory; records stay for readers that have it mapped."""
        self._mapping.close()


class RingReader:
    """One reader of a ring, at its own pace: copies a slot, then checks that it held still.

    Raises ValueError when the descriptor is no ring.
    """

    __slots__ = ("_bytes", "_mapping", "_next", "_slots", "_stride", "_words", "slot_size")

    def __init__(self, descriptor: int) -> None:
        self._mapping = _Mapping(descriptor, mmap.MAP_SHARED)
        self._bytes, self._words = self._mapping.bytes, self._mapping.words
        self._slots, self._stride = self._mapping.slots, self._mapping.stride
        self.slot_size = self._mapping.slot_size
        self._next = 0

    @property
    def head(self) -> int:
        """Records that the writer has appended so far; one that it left unfinished does not count."""
        return self._words[_HEAD]

    def read(self) -> bytes | Gap | None:
        """Return the next record, a Gap where records were lost, or None when there is nothing new."""
        number = self._next
        head = self._words[_HEAD]
        if head <= number:
            return None
        if head - number > self._slots:
            # One slot more than was overwritten: the oldest is the one that the writer fills next.
            lost = head - number - self._slots + 1
            self._next = number + lost
            return Gap(lost)
        self._next = number + 1
        record = self._copy(number)
        return Gap(1) if record is None else record

    def newest(self) -> bytes | None:
        """Return the newest record and go on behind it; None when there is nothing new, or it was damaged."""
        head = self._words[_HEAD]
        if head <= self._next:
            return None
        self._next = head
        return self._copy(head - 1)

    def _copy(self, number: int) -> bytes | None:
        start = _HEADER + number % self._slots * self._stride
        word = start // _WORD
        if self._words[word] != number + 1:
            return None
        length, crc = _LENGTH_CRC.unpack_from(self._bytes, start + _WORD)
        if length > self.slot_size:
            return None
        body = start + SLOT_HEADER
        record = bytes(self._bytes[body : body + length])
        if self._words[word] != number + 1 or crc32(record, (number + 1) & _MASK) != crc:
            return None
        return record

    def close(self) -> None:
        """Let go of the memory."""
        self._mapping.close()


class Handover:
    """A ring of length zero: hands each record straight to `take`, in the same process, on virtual time."""

    __slots__ = ("_count", "_take", "slot_size")

    def __init__(self, take: Callable[[Payload], None], slot_size: int = 1 << 20) -> None:
        self._take = take
        self.slot_size = slot_size
        self._count = 0

    @property
    def head(self) -> int:
        """Records handed over so far."""
        return self._count

    def append(self, payload: Payload) -> int:
        """Hand over one record; it is valid only during the call. Returns its number."""
        self._take(payload)
        self._count += 1
        return self._count - 1
