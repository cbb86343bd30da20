"""Packets: common code of both protocols for simulated servos: instructions, group reads, listed writes.

`line.c` frames instructions and composes replies. All is written from the protocols alone (ROBOTIS
e-Manual, "Protocol 1.0", "Protocol 2.0"), without the host's packet code: a common codec would hide its own
errors."""

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
    """Functions and constants with which simulated servos parse the writes of a protocol:
    `protocol1.CODEC` and `protocol2.CODEC`. Functions return None for malformed input."""

    protocol: float
    write: Callable[[bytes], tuple[int, bytes] | None]  # Address and data from the parameters of a write
    listed_writes: Callable[[InstructionPacket], ListedWrites | None]  # From a sync write or bulk write
    error: Callable[[int], IntEnum | IntFlag]  # Enum member of an error
    damaged: int  # Error for a wrong checksum
    unknown: int  # Error for an unknown instruction, or wrong parameters
