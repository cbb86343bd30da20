"""What the two protocols have in common for a servo: instruction packets, replies, group reads, framing.

Written from the protocols alone (ROBOTIS e-Manual, "Protocol 1.0", "Protocol 2.0"), without the host's packet
code: one codec for both sides would agree with its own mistakes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum, IntFlag, unique
from typing import NamedTuple

import msgspec

BROADCAST = 0xFE


@unique
class Instruction(IntEnum):
    """Instruction byte (e-Manual, "Instruction"); Protocol 1.0 has some of them."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class InstructionPacket(NamedTuple):
    """One packet on the line."""

    servo_id: int
    instruction: int
    parameters: bytes
    intact: bool  # False when the checksum is wrong: then nothing else of it can be trusted
    end: int  # Index behind its last byte, in the bytes that completed it
    raw: bytes = b""  # All of its bytes, as they were on the line


class ServoReply(NamedTuple):
    """What a servo sends back, and how long after the instruction's last byte it starts to."""

    servo_id: int
    error: int
    parameters: bytes
    delay_ns: int


class ReadEntry(NamedTuple):
    """What is read of one servo of a list."""

    servo_id: int
    address: int
    length: int


class GroupRead(msgspec.Struct, frozen=True):
    """An instruction that several servos answer one after the other, in the order of its list."""

    instruction: int
    entries: tuple[ReadEntry, ...]
    fast: bool = False  # True: the servos share one status packet
    has_slots: bool = False
    """True: a servo may wait for the time of an absent one before it [?]; False: it waits for its reply."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of bytes of each entry."""
        return tuple(each.length for each in self.entries)


ListedWrites = Mapping[int, Sequence[tuple[int, int, int, bytes]]]
"""The writes of a list for each ID: place in the list, ID, address, data."""


def sync_writes(listed: bytes, address: int, length: int) -> ListedWrites | None:
    """Return the writes of a sync write, whose list has ID and data of each; None: it has another form."""
    if length == 0 or len(listed) % (length + 1):
        return None
    writes: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for start in range(0, len(listed), length + 1):
        servo_id, data = listed[start], listed[start + 1 : start + 1 + length]
        writes.setdefault(servo_id, []).append((start, servo_id, address, data))
    return writes


class Codec(NamedTuple):
    """A protocol's bytes: `protocol1.CODEC` and `protocol2.CODEC`; functions return None for a wrong form."""

    header: bytes  # The ID follows it
    no_id: frozenset[int]  # Bytes that cannot be an ID
    length_bytes: int  # Of the length, which follows the ID
    shortest: int  # The least length
    longest_pause_ns: int  # Longest gap inside an instruction
    packet: Callable[[bytes, int], InstructionPacket]  # The packet that some bytes are, and its `end`
    status_packet: Callable[[int, int, bytes], bytes]  # Of ID, error and parameters
    read: Callable[[bytes], tuple[int, int] | None]  # Address and length of a read's parameters
    write: Callable[[bytes], tuple[int, bytes] | None]  # Address and data of a write's
    listed_writes: Callable[[InstructionPacket], ListedWrites | None]  # Those of a sync or bulk write
    group_read: Callable[[InstructionPacket], GroupRead | None]  # None also: it is none
    ping_slot_ns: Callable[[int], int]
    """How much later than the ID before it a servo answers a ping to all, at a baud rate."""
    error: Callable[[int], IntEnum | IntFlag]  # What an error is
    damaged: int  # Its errors: a wrong checksum
    unknown: int  # an instruction that it does not know, or wrong parameters
    no_cells: int  # no such address


class InstructionReceiver:
    """Finds instruction packets in the bytes of a line, noise or not; holds at most one packet."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._held = b""

    @property
    def pending(self) -> int:
        """Number of bytes of a packet that is not complete."""
        return len(self._held)

    def forget(self) -> None:
        """Drop a packet that was not completed in time."""
        self._held = b""

    def feed(self, data: bytes | bytearray, start: int = 0) -> InstructionPacket | None:
        """Take bytes of `data` from `start` on until a packet is complete, and return it.

        None: all were taken, and no packet is complete. One with a wrong checksum is a packet too. Go on at
        `packet.end`.
        """
        held = len(self._held)
        seen = self._held + data[start:]
        at = 0
        while not self._may_begin(seen[at : at + 8]):
            at += 1
        size = self._size(seen[at : at + 8])
        if size is None or at + size > len(seen):
            self._held = bytes(seen[at:])
            return None
        self._held = b""
        end = at + size
        return self._codec.packet(bytes(seen[at:end]), start + end - held)

    def _size(self, head: bytes) -> int | None:
        """Return the bytes of a packet that begins so; None: too little of it is there."""
        codec = self._codec
        begin = len(codec.header) + 1
        end = begin + codec.length_bytes
        return None if len(head) < end else end + int.from_bytes(head[begin:end], "little")

    def _may_begin(self, head: bytes) -> bool:
        """Return whether a packet can begin so: the header, an ID that can be, a length that can be."""
        header, no_id = self._codec.header, self._codec.no_id
        if not head.startswith(header[: len(head)]):
            return False
        if len(head) > len(header) and head[len(header)] in no_id:
            return False
        size = self._size(head)
        return size is None or size >= len(header) + 1 + self._codec.length_bytes + self._codec.shortest
