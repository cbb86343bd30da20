"""Mailbox: shared memory through which the gateway passes commands to the loop without ever delaying it.

There are two lanes. *Operations* go through a ring, first in, first out. The loop reports its position, and
an operation that would overwrite an unread one is refused. *Setpoints* of streams have a small ring for each
controller, of which the loop reads the newest record. Answers return through a ring of their own.

There is one writer (the gateway) and one reader (the loop). The reader validates all records and drops
invalid ones. Layout, little-endian, 64-bit words aligned:

    header      magic u64, places u64, generation u64 (set-points ever put), 40 bytes reserved
    operations  a ring
    places      a ring each, of two set-points: the newest, and the one that is being written
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Sequence

from dxlrun.channels import ring, shared_memory
from dxlrun.channels.answers import Answer, AnswerMessage, encode_answer
from dxlrun.channels.commands import (
    LONGEST_COMMAND,
    MOST_PER_CYCLE,
    CommandMessage,
    encode_command,
)
from dxlrun.channels.ring import Appender, Gap, Record, RecordKind, RingReader, RingWriter, record_size
from dxlrun.channels.shared_memory import load, store
from dxlrun.channels.tagged import Tagged, decode

LONGEST_SET_POINT = 4096
"""Longest record of a command in a stream, bytes."""
MOST_BYTES = 64 * 1024
"""Bytes of operations after which a cycle reads no more of them, so that it reads only one long one: copying
256 KiB into the log takes some 2 ms [measured].
"""
LONGEST_ANSWER = 2048
"""Longest record of an answer, bytes; long texts of a refusal are cut."""
ANSWERS_CAPACITY = 256 * 1024

_CAPACITY = 4 * LONGEST_COMMAND
_PLACE_CAPACITY = 2 * record_size(LONGEST_SET_POINT)
_OPERATIONS_SIZE = ring.memory_size(_CAPACITY, LONGEST_COMMAND)
_PLACE_SIZE = ring.memory_size(_PLACE_CAPACITY, LONGEST_SET_POINT)
_HEADER = 64
_MAGIC = int.from_bytes(b"dxlmail2", "little")
_GENERATION = 2
_FIXED = struct.Struct("=QQ")


def create(places: int) -> int:
    """Create a mailbox with a place for the stream of each controller; return its descriptor."""
    descriptor = shared_memory.create("mailbox", _size(places))
    with mmap.mmap(descriptor, 0) as mapped, memoryview(mapped) as memory:
        _FIXED.pack_into(memory, 0, _MAGIC, places)
        operations, *rings = _parts(memory, places)
        ring.lay_out(operations, _CAPACITY, LONGEST_COMMAND)
        for place in rings:
            ring.lay_out(place, _PLACE_CAPACITY, LONGEST_SET_POINT)
            place.release()
        operations.release()
    return descriptor


def capacity(places: int) -> int:
    """Return the size of all command records in a full mailbox, bytes."""
    return _CAPACITY + places * _PLACE_CAPACITY


def _size(places: int) -> int:
    return _HEADER + _OPERATIONS_SIZE + places * _PLACE_SIZE


def _parts(memory: memoryview, places: int) -> list[memoryview]:
    """Split a mailbox's memory into the ring of operations and the ring of each stream."""
    start = _HEADER + _OPERATIONS_SIZE
    ends = [start + index * _PLACE_SIZE for index in range(places + 1)]
    return [memory[_HEADER:start], *(memory[end : end + _PLACE_SIZE] for end in ends[:-1])]


def _mapped(descriptor: int) -> tuple[memoryview, list[memoryview]]:
    """Map a mailbox; return the words of its header, and its parts. Raises ValueError for other memory."""
    memory = shared_memory.mapped(descriptor)
    magic, places = _FIXED.unpack_from(memory)
    if magic != _MAGIC or len(memory) != _size(places):
        raise ValueError("this descriptor is not a mailbox of this version")
    return memory[:_HEADER].cast("Q"), _parts(memory, places)


class MailboxWriter:
    """Writer of a mailbox, in the gateway process: passes client commands to the loop."""

    def __init__(self, descriptor: int) -> None:
        self._words, (operations, *places) = _mapped(descriptor)
        self._operations = RingWriter(operations)
        self._places = [RingWriter(place) for place in places]

    @property
    def used(self) -> bool:
        """True if the gateway, or an earlier one, has ever posted an operation."""
        return self._operations.head > 0

    def post_command(self, command: CommandMessage) -> bool:
        """Pass a single command to the loop; return False if the mailbox is full or the command too long."""
        payload = encode_command(command)
        lane = self._operations
        untaken = lane.head - lane.taken
        if len(payload) > LONGEST_COMMAND or untaken + record_size(len(payload)) > _CAPACITY:
            return False
        lane.append(RecordKind.TAGGED, payload)
        return True

    def set_point(self, place: int, command: CommandMessage) -> bool:
        """Pass the newest command of a stream to the loop, in place of an unread one.

        Returns False if too long.
        """
        payload = encode_command(command, LONGEST_SET_POINT)
        if len(payload) > LONGEST_SET_POINT:
            return False
        self._places[place].append(RecordKind.TAGGED, payload)
        store(
            self._words, _GENERATION, self._words[_GENERATION] + 1
        )  # last, because the loop reads the places after it has seen a new generation
        return True


class Mailbox:
    """Reader of a mailbox, in the loop: an `Inbox` of client commands."""

    def __init__(self, descriptor: int, answers: Appender) -> None:
        self._words, (operations, *places) = _mapped(descriptor)
        self._operations = RingReader(operations)
        self._places = [RingReader(place) for place in places]
        self._answers = answers
        self._generation = 0

    def drain_commands(self) -> Sequence[CommandMessage]:
        """Return new operations, oldest first, and the newest setpoint of each stream.

        There are at most MOST_PER_CYCLE operations, fewer if they are long (see MOST_BYTES).
        """
        lane, generation = self._operations, self._words[_GENERATION]
        if lane.head <= lane.position and generation == self._generation:
            return ()
        commands: list[CommandMessage] = []
        begin = lane.position
        for _ in range(MOST_PER_CYCLE):
            if lane.position - begin > MOST_BYTES or (record := lane.read_record()) is None:
                break
            _append_command(record, commands)
        lane.report_taken()
        if generation != self._generation:
            self._generation = load(self._words, _GENERATION)  # acquire: the places are at least as new
            for place in self._places:
                if place.head > place.position:
                    _append_command(place.newest(), commands)
        return commands

    def answer_command(self, number: int, answer: Answer) -> None:
        """Send the answer to a command to the gateway. Long texts in a refusal's fields are cut."""
        self._answers.append(RecordKind.TAGGED, encode_answer(number, answer, LONGEST_ANSWER))


class Answers:
    """Reader, in the gateway, of the ring with the loop's answers to commands."""

    def __init__(self, descriptor: int) -> None:
        self._ring = RingReader(descriptor)

    def new(self) -> list[AnswerMessage]:
        """Return the loop's answers since the last call."""
        found = [_found(one) for one in iter(self._ring.read_record, None) if isinstance(one, Record)]
        return [one for one in found if isinstance(one, AnswerMessage)]


def _append_command(record: Record | Gap | None, commands: list[CommandMessage]) -> None:
    """Decode a record and append its command to the list; ignore a gap or invalid record."""
    if isinstance(record, Record) and isinstance(found := _found(record), CommandMessage):
        commands.append(found)


def _found(record: Record) -> Tagged | None:
    """Decode a tagged record; return None if it is invalid."""
    try:
        return decode(record.payload)
    except ValueError:
        return None
