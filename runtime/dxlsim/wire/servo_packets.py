"""Packets: common code of both protocols for simulated servos: instruction packets, replies, group reads,
framing.

Written from the protocols alone (ROBOTIS e-Manual, "Protocol 1.0", "Protocol 2.0"), without the host's
packet code: a common codec would hide its own errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum, IntFlag, unique
from typing import NamedTuple

import msgspec

BROADCAST = 0xFE


@unique
class Instruction(IntEnum):
    """Codes of instructions (e-Manual, "Instruction"); Protocol 1.0 has only some of them."""

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
    """One packet that a servo has received from the line."""

    servo_id: int
    instruction: int
    parameters: bytes
    intact: bool  # False if the checksum is wrong; the other fields are then unreliable
    end: int  # Index after its last byte, in the bytes that completed it
    raw: bytes = b""  # All of its bytes, as they were on the line


class ServoReply(NamedTuple):
    """Reply of a servo to an instruction, with its delay after the instruction's last byte."""

    servo_id: int
    error: int
    parameters: bytes
    delay_ns: int


class ReadEntry(NamedTuple):
    """Address range that a group read asks of one servo."""

    servo_id: int
    address: int
    length: int


class GroupRead(msgspec.Struct, frozen=True):
    """Instruction (sync or bulk read) that several servos answer one after the other, in the order of its
    list."""

    instruction: int
    entries: tuple[ReadEntry, ...]
    fast: bool = False  # True: the servos share one status packet
    has_slots: bool = False
    """True: a servo may wait for the slot of an absent servo before it [?]; False: it waits for the actual
    reply."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of bytes that each entry asks for."""
        return tuple(each.length for each in self.entries)


ListedWrites = Mapping[int, Sequence[tuple[int, int, int, bytes]]]
"""Writes of a sync or bulk write by ID: place in the list, ID, address, data."""


def sync_writes(listed: bytes, address: int, length: int) -> ListedWrites | None:
    """Return the writes in a sync write's list of IDs and data, by ID, or None if the length of the list
    is wrong."""
    if length == 0 or len(listed) % (length + 1):
        return None
    writes: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for start in range(0, len(listed), length + 1):
        servo_id, data = listed[start], listed[start + 1 : start + 1 + length]
        writes.setdefault(servo_id, []).append((start, servo_id, address, data))
    return writes


class PacketCodec(NamedTuple):
    """Functions and constants with which simulated servos parse and build packets of a protocol:
    `protocol1.CODEC` and `protocol2.CODEC`. Functions return None for malformed input."""

    header: bytes  # The ID follows the header
    no_id: frozenset[int]  # Bytes that cannot be an ID
    length_bytes: int  # Size of the length field, which follows the ID
    shortest: int  # Smallest valid length
    longest_pause_ns: int  # Longest gap inside an instruction
    packet: Callable[[bytes, int], InstructionPacket]  # Parses the bytes of a packet, given its `end`
    status_packet: Callable[[int, int, bytes], bytes]  # From ID, error and parameters
    read: Callable[[bytes], tuple[int, int] | None]  # Address and length from the parameters of a read
    write: Callable[[bytes], tuple[int, bytes] | None]  # Address and data from the parameters of a write
    listed_writes: Callable[[InstructionPacket], ListedWrites | None]  # From a sync write or bulk write
    group_read: Callable[[InstructionPacket], GroupRead | None]  # None also for other instructions
    ping_slot_ns: Callable[[int], int]
    """Delay (ns) between the answers of two successive IDs to a broadcast ping, at a baud rate."""
    error: Callable[[int], IntEnum | IntFlag]  # Enum member of an error
    damaged: int  # Error for a wrong checksum
    unknown: int  # Error for an unknown instruction, or wrong parameters
    no_cells: int  # Error for an invalid address


class InstructionReceiver:
    """Extracts instruction packets from the bytes that a host sends on a line, despite noise; holds at
    most one packet."""

    def __init__(self, codec: PacketCodec) -> None:
        self._codec = codec
        self._held = b""

    @property
    def pending(self) -> int:
        """Number of received bytes of an incomplete packet."""
        return len(self._held)

    def discard_packet(self) -> None:
        """Discard the bytes of a packet that was not completed in time."""
        self._held = b""

    def feed_bytes(self, data: bytes | bytearray, start: int = 0) -> InstructionPacket | None:
        """Process `data` from `start` until a packet is complete, and return the packet.

        None means that all bytes were processed without completing a packet. A packet with a wrong
        checksum is returned, too. Continue at `packet.end`."""
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
        """Return the size of a packet with this beginning, bytes, or None if the beginning is too short."""
        codec = self._codec
        begin = len(codec.header) + 1
        end = begin + codec.length_bytes
        return None if len(head) < end else end + int.from_bytes(head[begin:end], "little")

    def _may_begin(self, head: bytes) -> bool:
        """Return True if a packet can begin with these bytes: header, valid ID, valid length."""
        header, no_id = self._codec.header, self._codec.no_id
        if not head.startswith(header[: len(head)]):
            return False
        if len(head) > len(header) and head[len(header)] in no_id:
            return False
        size = self._size(head)
        return size is None or size >= len(header) + 1 + self._codec.length_bytes + self._codec.shortest
