"""Mailbox: shared memory by which one other process hands commands to the loop, which it can never delay.

Two lanes. *Operations* go through a ring of bytes, first in, first out; when it is full the writer is told,
and refuses its client. *Set-points* of streams have one place for each controller, where the newest wins.
Answers come back through an ordinary ring (`dxlrun.run.channels.ring`).

One writer (the gateway), one reader (the loop). The reader trusts nothing that it finds: whatever has a wrong
length or checksum is dropped, and counted. Torn set-points are left for the next cycle, not waited for.
Layout, little-endian, 64-bit words aligned:

    header      magic u64, bytes of the ring u64, places u64, head u64 (bytes ever put), tail u64 (bytes ever
                taken), generation u64 (set-points ever put)
    ring        records: length u32, CRC-32 u32, payload, up to whole words; length SKIP: go on at the start
    places      count u64 (odd while it is written), length u32, CRC-32 u32, payload of up to PLACE bytes
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from collections.abc import Sequence
from zlib import crc32

from dxlrun.run.channels.inbox import MOST_PER_CYCLE, Command
from dxlrun.run.channels.ring import Appender, RingReader

LARGEST = 256 * 1024
"""The longest operation, bytes: a trajectory of some thousand points for twenty joints."""
PLACE = 2048
"""The longest set-point, bytes."""
MOST_BYTES = 64 * 1024
"""After so many a cycle takes no more operations, so that of long ones it takes one: copying 256 KiB into the
log takes some 2 ms [measured]."""
ANSWER_SLOT = 512
ANSWER_SLOTS = 1024

_RING = 4 * LARGEST
_HEADER = 64
_MAGIC = int.from_bytes(b"dxlmail1", "little")
_HEAD, _TAIL, _GENERATION = 3, 4, 5
_SKIP = 0xFFFFFFFF
_PREFIX = struct.Struct("<II")
_FIXED = struct.Struct("<QQQ")
_COMMAND = struct.Struct("<qqHHH2x")
_ANSWER = struct.Struct("<q")
_STRIDE = 16 + PLACE


def create(places: int) -> int:
    """Create a mailbox with a place for each of so many streams; return its memfd, sealed in its size."""
    descriptor = os.memfd_create("dxlrun-mailbox", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, _HEADER + _RING + places * _STRIDE)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
    os.pwrite(descriptor, _FIXED.pack(_MAGIC, _RING, places), 0)
    return descriptor


class _Mapping:
    """The memory, as bytes and as words."""

    __slots__ = ("bytes", "places", "words")

    def __init__(self, descriptor: int) -> None:
        self.bytes = memoryview(mmap.mmap(descriptor, 0))
        self.words = self.bytes.cast("Q")
        magic, ring, self.places = _FIXED.unpack_from(self.bytes)
        if magic != _MAGIC or ring != _RING or len(self.bytes) != _HEADER + _RING + self.places * _STRIDE:
            raise ValueError("this descriptor is not a mailbox of this version")


class MailboxWriter:
    """The gateway's end."""

    def __init__(self, descriptor: int) -> None:
        self._memory = _Mapping(descriptor)

    def post(self, command: Command) -> bool:
        """Put an operation behind the others; False when there is no room, or it is longer than LARGEST."""
        payload = encode(command)
        size = _whole_words(_PREFIX.size + len(payload))
        words, memory = self._memory.words, self._memory.bytes
        head, tail = words[_HEAD], words[_TAIL]
        at = head % _RING
        skipped = _RING - at if at + size > _RING else 0
        if len(payload) > LARGEST or head + skipped + size - tail > _RING:
            return False
        if skipped:
            _PREFIX.pack_into(memory, _HEADER + at, _SKIP, 0)
            at = 0
        start = _HEADER + at
        memory[start + _PREFIX.size : start + _PREFIX.size + len(payload)] = payload
        _PREFIX.pack_into(memory, start, len(payload), crc32(payload))
        words[_HEAD] = head + skipped + size
        return True

    def set_point(self, place: int, command: Command) -> bool:
        """Put the newest set-point of a stream into its place; False when it is longer than PLACE."""
        payload = encode(command)
        if len(payload) > PLACE:
            return False
        words, memory = self._memory.words, self._memory.bytes
        start = _HEADER + _RING + place * _STRIDE
        word = start // 8
        count = words[word]
        words[word] = count + 1
        memory[start + 16 : start + 16 + len(payload)] = payload
        _PREFIX.pack_into(memory, start + 8, len(payload), crc32(payload))
        words[word] = count + 2
        words[_GENERATION] += 1
        return True


class Mailbox:
    """The loop's end: an Inbox. `dropped` counts what was not as it should be."""

    def __init__(self, descriptor: int, answers: Appender) -> None:
        self._memory = _Mapping(descriptor)
        self._answers = answers
        self._generation = 0
        self._seen = [0] * self._memory.places
        self.dropped = 0

    def take(self) -> Sequence[Command]:
        """Return what has come, in order, at most MOST_PER_CYCLE (fewer where they are long, see MOST_BYTES)
        and the newest set-point of each stream."""
        words = self._memory.words
        if words[_HEAD] == words[_TAIL] and words[_GENERATION] == self._generation:
            return ()
        commands: list[Command] = []
        begin = words[_TAIL]
        for _ in range(MOST_PER_CYCLE):
            if words[_HEAD] == words[_TAIL] or words[_TAIL] - begin > MOST_BYTES:
                break
            self._next(commands)
        if words[_GENERATION] != self._generation:
            self._set_points(commands)
        return commands

    def answer(self, number: int, refusal: str) -> None:
        """Tell the gateway; a long sentence is cut."""
        text = refusal.encode(errors="replace")[: ANSWER_SLOT - _ANSWER.size]
        self._answers.append(_ANSWER.pack(number) + text)

    def _next(self, commands: list[Command]) -> None:
        """Take one record; after one that cannot be, everything that waits is dropped."""
        words, memory = self._memory.words, self._memory.bytes
        head, tail = words[_HEAD], words[_TAIL]
        at = tail % _RING
        length, checksum = _PREFIX.unpack_from(memory, _HEADER + at)
        if length == _SKIP and tail + _RING - at <= head:
            words[_TAIL] = tail + _RING - at
            return
        size = _whole_words(_PREFIX.size + length)
        if length > LARGEST or at + size > _RING or tail + size > head:
            words[_TAIL] = head
            self.dropped += 1
            return
        start = _HEADER + at + _PREFIX.size
        payload = bytes(memory[start : start + length])
        words[_TAIL] = tail + size
        self._decode(payload, checksum, commands)

    def _set_points(self, commands: list[Command]) -> None:
        words, memory = self._memory.words, self._memory.bytes
        generation = words[_GENERATION]
        whole = True
        for place in range(self._memory.places):
            start = _HEADER + _RING + place * _STRIDE
            count = words[start // 8]
            if count == self._seen[place]:
                continue
            length, checksum = _PREFIX.unpack_from(memory, start + 8)
            payload = bytes(memory[start + 16 : start + 16 + min(length, PLACE)])
            if count & 1 or words[start // 8] != count:
                whole = False
                continue
            self._seen[place] = count
            self._decode(payload, checksum, commands)
        if whole:
            self._generation = generation

    def _decode(self, payload: bytes, checksum: int, commands: list[Command]) -> None:
        if crc32(payload) != checksum:
            self.dropped += 1
            return
        try:
            commands.append(decode(payload))
        except ValueError:
            self.dropped += 1


class Answers:
    """The gateway's view of what became of its commands."""

    def __init__(self, descriptor: int) -> None:
        self._ring = RingReader(descriptor)

    def new(self) -> list[tuple[int, str]]:
        """Return number and refusal of what was answered since the last call; empty: done."""
        found: list[tuple[int, str]] = []
        while (record := self._ring.read()) is not None:
            if isinstance(record, bytes) and len(record) >= _ANSWER.size:
                found.append(
                    (_ANSWER.unpack_from(record)[0], record[_ANSWER.size :].decode(errors="replace"))
                )
        return found


def encode(command: Command) -> bytes:
    """Return the bytes of a command."""
    names = [
        text.encode(errors="replace")[:0xFFFF] for text in (command.controller, command.kind, command.origin)
    ]
    head = _COMMAND.pack(command.number, command.lease_ns, *(len(name) for name in names))
    return head + b"".join(names) + command.data


def decode(payload: bytes) -> Command:
    """Return the command of some bytes; raises ValueError when they are none."""
    try:
        number, lease_ns, *lengths = _COMMAND.unpack_from(payload)
    except struct.error as error:
        raise ValueError(f"a command ends inside its header: {error}") from error
    at, names = _COMMAND.size, []
    for length in lengths:
        names.append(payload[at : at + length].decode(errors="replace"))
        at += length
    if at > len(payload) or lease_ns < 0:
        raise ValueError("a command is shorter than its names")
    controller, kind, origin = names
    return Command(number, controller, kind, payload[at:], origin, lease_ns)


def _whole_words(size: int) -> int:
    return -(-size // 8) * 8
