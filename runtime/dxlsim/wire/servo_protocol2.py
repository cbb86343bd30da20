"""Protocol 2.0 for simulated servos: errors, and the parameters of writes."""

from __future__ import annotations

from enum import IntEnum, unique
from functools import lru_cache

from dxlsim.wire.servo_packets import Instruction, InstructionPacket, ListedWrites, PacketCodec, sync_writes


@unique
class StatusErrorNumber(IntEnum):
    """Numbers in bits 0..6 of a status packet's error (e-Manual, Protocol 2.0, "Error")."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _listed_writes(packet: InstructionPacket) -> ListedWrites | None:
    return (_sync_writes if packet.instruction == Instruction.SYNC_WRITE else _bulk_writes)(packet.parameters)


@lru_cache(maxsize=1)  # Each servo of a line looks itself up
def _sync_writes(parameters: bytes) -> ListedWrites | None:
    listed = parameters[4:]
    return sync_writes(listed, _word(parameters, 0), _word(parameters, 2)) if listed else None


@lru_cache(maxsize=1)
def _bulk_writes(parameters: bytes) -> ListedWrites | None:
    writes: dict[int, list[tuple[int, int, int, bytes]]] = {}
    start = 0
    while start < len(parameters):
        servo_id, length = parameters[start], _word(parameters, start + 3)
        data = parameters[start + 5 : start + 5 + length]
        if length == 0 or len(data) < length:
            return None
        writes.setdefault(servo_id, []).append((start, servo_id, _word(parameters, start + 1), data))
        start += 5 + length
    return writes


def _word(data: bytes, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")


CODEC = PacketCodec(
    protocol=2.0,
    write=lambda parameters: (_word(parameters, 0), parameters[2:]) if len(parameters) >= 3 else None,
    listed_writes=_listed_writes,
    error=StatusErrorNumber,
    damaged=StatusErrorNumber.CRC,
    unknown=StatusErrorNumber.INSTRUCTION,
)
