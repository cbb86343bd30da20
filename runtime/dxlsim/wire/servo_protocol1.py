"""Protocol 1.0 for simulated servos: errors, and the parameters of writes."""

from __future__ import annotations

from enum import IntFlag, unique

from dxlsim.wire.servo_packets import Instruction, InstructionPacket, ListedWrites, PacketCodec, sync_writes

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


def _listed_writes(packet: InstructionPacket) -> ListedWrites | None:
    parameters = packet.parameters
    if packet.instruction != Instruction.SYNC_WRITE or len(parameters) < 2:
        return None
    return sync_writes(parameters[2:], *parameters[:2])


CODEC = PacketCodec(
    protocol=1.0,
    write=lambda parameters: (parameters[0], parameters[1:]) if len(parameters) >= 2 else None,
    listed_writes=_listed_writes,
    error=ErrorBit,
    damaged=ErrorBit.CHECKSUM,
    unknown=ErrorBit.INSTRUCTION,
)
