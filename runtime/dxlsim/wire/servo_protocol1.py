"""Protocol 1.0 for simulated servos: parses instructions and builds replies as bytes."""

from __future__ import annotations

from enum import IntFlag, unique

from dxlsim.wire.servo_packets import (
    BROADCAST,
    GroupRead,
    Instruction,
    InstructionPacket,
    ListedWrites,
    PacketCodec,
    ReadEntry,
    sync_writes,
)

HEADER = b"\xff\xff"
# Size of the longest packet, bytes: header, ID, a length byte of 255 and the bytes that it counts
LONGEST = 4 + 255


@unique
class ErrorBit(IntFlag):
    """Bits of the error byte in a status packet (e-Manual, Protocol 1.0, "Error")."""

    VOLTAGE = 0x01
    ANGLE_LIMIT = 0x02
    OVERHEATING = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


def checksum(body: bytes | bytearray) -> int:
    """Return the checksum of a packet, given the bytes between header and checksum."""
    return ~sum(body) & 0xFF


def status_packet(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet, the reply of a servo."""
    body = bytes((servo_id, len(parameters) + 2, error)) + parameters
    return HEADER + body + bytes((checksum(body),))


def group_read(packet: InstructionPacket) -> GroupRead | None:
    """Parse a bulk read; return None for another or a malformed instruction."""
    if not packet.intact or packet.servo_id != BROADCAST or packet.instruction != Instruction.BULK_READ:
        return None
    listed = packet.parameters[1:]
    if packet.parameters[:1] != b"\x00" or not listed or len(listed) % 3:
        return None
    entries: dict[int, ReadEntry] = {}
    for length, servo_id, address in zip(listed[::3], listed[1::3], listed[2::3], strict=True):
        # For an ID that is listed twice the first entry counts
        entries.setdefault(servo_id, ReadEntry(servo_id, address, length))
    return GroupRead(packet.instruction, tuple(entries.values()))


def _listed_writes(packet: InstructionPacket) -> ListedWrites | None:
    parameters = packet.parameters
    if packet.instruction != Instruction.SYNC_WRITE or len(parameters) < 2:
        return None
    return sync_writes(parameters[2:], *parameters[:2])


def _packet(data: bytes, end: int) -> InstructionPacket:
    intact = data[-1] == checksum(data[2:-1])
    return InstructionPacket(data[2], data[4], data[5:-1], intact, end, data)


CODEC = PacketCodec(
    header=HEADER,
    no_id=frozenset((0xFF,)),
    length_bytes=1,
    shortest=2,
    longest_pause_ns=100_000_000,  # e-Manual, Protocol 1.0
    packet=_packet,
    status_packet=status_packet,
    read=lambda parameters: (parameters[0], parameters[1]) if len(parameters) == 2 else None,
    write=lambda parameters: (parameters[0], parameters[1:]) if len(parameters) >= 2 else None,
    listed_writes=_listed_writes,
    group_read=group_read,
    ping_slot_ns=lambda baud_rate: 0,
    error=ErrorBit,
    damaged=ErrorBit.CHECKSUM,
    unknown=ErrorBit.INSTRUCTION,
    no_cells=ErrorBit.RANGE,
)
