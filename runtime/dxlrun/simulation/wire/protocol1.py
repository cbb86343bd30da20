"""Protocol 1.0 as a servo sees it: bytes of the line -> instructions, replies -> bytes.

Written from the protocol alone (ROBOTIS e-Manual, "Protocol 1.0"), without the host's packet code: one codec
for both sides would agree with its own mistakes.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag, unique
from typing import NoReturn

from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry

LONGEST_PAUSE_NS = 100_000_000  # Longest gap inside an instruction (e-Manual, Protocol 1.0)
ID_AT = 2

HEADER = b"\xff\xff"
LONGEST = 4 + 255
"""Bytes of the longest packet: header, ID, a length byte of 255 and what it counts."""


@unique
class Instruction(IntEnum):
    """Instruction byte (e-Manual, Protocol 1.0, "Instruction")."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    SYNC_WRITE = 0x83
    BULK_READ = 0x92


class ErrorBit(IntFlag):
    """Error byte of a status packet (e-Manual, Protocol 1.0, "Error")."""

    VOLTAGE = 0x01
    ANGLE_LIMIT = 0x02
    OVERHEATING = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


def checksum(body: bytes | bytearray) -> int:
    """Return the checksum of everything between header and checksum."""
    return ~sum(body) & 0xFF


def status_packet(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet."""
    body = bytes((servo_id, len(parameters) + 2, error)) + parameters
    return HEADER + body + bytes((checksum(body),))


def group_read(packet: InstructionPacket) -> GroupRead | None:
    """Return the group read that a packet is; None: it is none, or its parameters are wrong."""
    if not packet.intact or packet.servo_id != BROADCAST or packet.instruction != Instruction.BULK_READ:
        return None
    listed = packet.parameters[1:]
    if packet.parameters[:1] != b"\x00" or not listed or len(listed) % 3:
        return None
    entries: dict[int, ReadEntry] = {}
    for length, servo_id, address in zip(listed[::3], listed[1::3], listed[2::3], strict=True):
        entries.setdefault(servo_id, ReadEntry(servo_id, address, length))  # of an ID listed twice the first
    return GroupRead(packet.instruction, tuple(entries.values()))


def fast_status(lengths: tuple[int, ...]) -> NoReturn:
    """Raise NotImplementedError: this protocol has no fast reads."""
    raise NotImplementedError("Protocol 1.0 has no fast reads")


class InstructionReceiver:
    """Finds instruction packets in the bytes of a line, noise or not; holds at most one packet."""

    __slots__ = ("_buffer",)

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Number of bytes of a packet that is not complete."""
        return len(self._buffer)

    def forget(self) -> None:
        """Drop a packet that was not completed in time."""
        self._buffer.clear()

    def feed(self, data: bytes | bytearray, start: int = 0) -> InstructionPacket | None:
        """Take bytes of `data` from `start` on until a packet is complete, and return it.

        None: all were taken, and no packet is complete. One with a wrong checksum is a packet too. Go on at
        `packet.end`.
        """
        if not self._buffer:
            packet = _packet_at(data, start)
            if packet is not None:  # the usual case: a host hands over whole packets
                return packet
        for index in range(start, len(data)):
            self._buffer.append(data[index])
            while self._buffer and not _may_begin(self._buffer):
                del self._buffer[0]
            if len(self._buffer) >= 4 and len(self._buffer) == 4 + self._buffer[3]:
                packet = _packet(self._buffer, index + 1)
                self._buffer.clear()
                return packet
        return None


def receiver() -> InstructionReceiver:
    """Return a receiver for one line."""
    return InstructionReceiver()


def _packet(data: bytes | bytearray, end: int) -> InstructionPacket:
    return InstructionPacket(
        servo_id=data[2],
        instruction=data[4],
        parameters=bytes(data[5:-1]),
        intact=data[-1] == checksum(data[2:-1]),
        end=end,
        raw=bytes(data),
    )


def _packet_at(data: bytes | bytearray, start: int) -> InstructionPacket | None:
    head = data[start : start + 4]
    if len(head) < 4 or not _may_begin(head):
        return None
    end = start + 4 + head[3]
    return _packet(data[start:end], end) if end <= len(data) else None


def _may_begin(data: bytes | bytearray) -> bool:
    """Return whether a packet can begin so: header, an ID that is not 0xFF, a length of at least 2."""
    size = len(data)
    return (
        data[0] == 0xFF
        and (size < 2 or data[1] == 0xFF)
        and (size < 3 or data[2] != 0xFF)
        and (size < 4 or data[3] >= 2)
    )
