"""Protocol 1.0 packets as bytes: instructions of a host, replies of a servo; pure functions.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 1.0". Instruction `FF FF ID LEN INST P.. CHK`, status
`FF FF ID LEN ERR P.. CHK`; LEN = parameters + 2; CHK = ~(ID + LEN + INST or ERR + parameters) & FF.
A status carries no mark that distinguishes it from an instruction: an echoed instruction parses as a status.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum, IntFlag, unique

from dxlwire.packets import Bytes
from dxlwire.transaction import BROADCAST_ID, Status

PROTOCOL = 1.0
HEADER = b"\xff\xff"
OVERHEAD = 6  # Bytes of a packet beside its parameters
LONGEST = 0xFF + 4
"""Bytes of the longest packet: LEN is one byte and counts everything behind itself."""
CHECKSUM = 1  # Bytes of the checksum, the last one of a packet
ID_AT = 2  # Where a packet has its ID, of the servo that is addressed or answers
HIGHEST_ID = 0xFD
PING_LENGTH = 0  # Parameters of the answer to a ping: the model number must be read
MOST_GOAL_BYTES = 0xFF - 4  # Parameters of a sync write behind address and length: LEN is one byte
ALERT = 0  # No bit of the error byte asks to read more: the byte is complete
NO_FAST_FORM = "Protocol 1.0 has no fast sync read and no fast bulk read"
_MOST_PARAMETERS = 0xFF - 2


@unique
class Instruction(IntEnum):
    """What a host can ask (e-Manual, "Instruction Details")."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    SYNC_WRITE = 0x83
    BULK_READ = 0x92  # MX only


@unique
class StatusError(IntFlag):
    """Bits of a status packet's error byte; the servo's state, it comes with good data."""

    INPUT_VOLTAGE = 0x01
    ANGLE_LIMIT = 0x02
    OVERHEATING = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


REFUSALS = StatusError.RANGE | StatusError.CHECKSUM | StatusError.INSTRUCTION
"""The bits of a servo that did not execute the instruction."""

_LENGTHS: Mapping[int, tuple[int, int]] = {
    Instruction.PING: (2, 2),
    Instruction.READ: (4, 4),
    Instruction.WRITE: (4, 0xFF),
    Instruction.REG_WRITE: (4, 0xFF),
    Instruction.ACTION: (2, 2),
    Instruction.FACTORY_RESET: (2, 2),
}
"""The least and the most that LEN is in an instruction to one servo (e-Manual, "Instruction Details")."""
_SENTENCES: Mapping[StatusError, str] = {
    StatusError.INPUT_VOLTAGE: "input voltage error: the voltage is out of the range of the control table",
    StatusError.ANGLE_LIMIT: "angle limit error: the goal position is outside the CW and CCW angle limits",
    StatusError.OVERHEATING: "overheating error: the temperature is out of the range of the control table",
    StatusError.RANGE: "range error: a written value is out of its range of use",
    StatusError.CHECKSUM: "checksum error: the checksum of the instruction packet was wrong",
    StatusError.OVERLOAD: "overload error: the load cannot be controlled by the set torque",
    StatusError.INSTRUCTION: "instruction error: an undefined instruction, or action without reg write",
}


def describe_error(error: int) -> str:
    """Return the e-Manual's words for every bit of an error byte; `no error` for 0."""
    words = [sentence for bit, sentence in _SENTENCES.items() if error & bit]
    if error & 0x80:
        words.append("bit 7, which Protocol 1.0 does not define")
    return "; ".join(words) or "no error"


def refused(error: int, length: int, awaited: int) -> bool:
    """Check whether a status of `length` parameters, where `awaited` were due, is a refusal.

    The bits are the servo's state and come with good data; without it they are the reason.
    """
    return length == 0 != awaited and error & REFUSALS != 0


def widest(length: int) -> int:
    """Return the most bytes that a status packet of `length` parameters has on the line."""
    return OVERHEAD + length


def size_at(buffer: Bytes, start: int, end: int) -> int:
    """Return the size of the packet whose header is at `start`: 0 is not known yet, -1 a false header."""
    known = end - start
    if known > 2 and buffer[start + 2] == 0xFF:
        return -1
    if known < 4:
        return 0
    length = buffer[start + 3]
    return length + 4 if length >= 2 else -1


def intact(packet: memoryview) -> bool:
    """Check whether the checksum of a whole packet is right."""
    return ~sum(packet[2:-1]) & 0xFF == packet[-1]


def opened(packet: memoryview) -> Status | None:
    """Take an intact packet apart; an instruction to one servo looks like a status, too.

    None when it cannot be a status: of the broadcast ID.
    """
    return None if packet[2] == BROADCAST_ID else Status(packet[2], packet[4], packet[5:-1])


def instructs(packet: memoryview) -> bool:
    """Check whether an intact packet reads as a host's instruction, by its code and length.

    A status of these bytes is possible, too: its error byte would be that code.
    """
    if packet[2] == BROADCAST_ID:
        return True
    least, most = _LENGTHS.get(packet[4], (1, 0))
    return least <= packet[3] <= most


def checksum(body: Bytes) -> int:
    """Return the checksum of the bytes between the header and the checksum itself."""
    return ~sum(body) & 0xFF


def _packet(servo_id: int, kind: int, parameters: bytes) -> bytes:
    if len(parameters) > _MOST_PARAMETERS:
        raise ValueError(f"{len(parameters)} parameter bytes do not fit one packet, {_MOST_PARAMETERS} do")
    body = bytes((servo_id, len(parameters) + 2, kind)) + parameters
    return HEADER + body + bytes((checksum(body),))


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return any instruction packet.

    Raises ValueError when `servo_id` is neither 0..253 nor broadcast, or the parameters do not fit.
    """
    if not (0 <= servo_id <= HIGHEST_ID or servo_id == BROADCAST_ID):
        raise ValueError(f"{servo_id} is no ID: a servo has 0..{HIGHEST_ID}, broadcast is {BROADCAST_ID}")
    return _packet(servo_id, instruction, parameters)


def status_packet(servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
    """Return the status packet that a servo would send; raises ValueError when the parameters do not fit."""
    return _packet(servo_id, error, parameters)


def ping(servo_id: int) -> bytes:
    """Return the packet that asks for an empty status."""
    return instruction_packet(servo_id, Instruction.PING)


def read(servo_id: int, address: int, length: int) -> bytes:
    """Return the packet that asks for `length` bytes of the control table from `address` on."""
    return instruction_packet(servo_id, Instruction.READ, bytes((address, length)))


def write(servo_id: int, address: int, data: bytes) -> bytes:
    """Return the packet that writes `data` into the control table from `address` on."""
    return instruction_packet(servo_id, Instruction.WRITE, bytes((address,)) + data)


def factory_reset(servo_id: int) -> bytes:
    """Return the packet that sets the control table to its factory values, ID and baud rate included."""
    return instruction_packet(servo_id, Instruction.FACTORY_RESET)


def bulk_read(requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
    """Return the packet that asks two or more MX servos, each by (ID, address, length); they answer in turn.

    Each waits for the status of the one before it, so an absent servo ends the chain. Raises ValueError when
    a fast form is asked for.
    """
    if fast:
        raise ValueError(NO_FAST_FORM)
    parameters = b"\0" + b"".join(bytes((length, one, address)) for one, address, length in requests)
    return instruction_packet(BROADCAST_ID, Instruction.BULK_READ, parameters)


read_many = bulk_read  # The one packet that asks several servos, as every protocol has one


def fast_size(length: int, count: int) -> int:
    """Raise ValueError: only Protocol 2.0 has fast forms."""
    raise ValueError(NO_FAST_FORM)


def fast_answers(packet: Bytes, lengths: Sequence[int]) -> list[Status]:
    """Raise ValueError: only Protocol 2.0 has fast forms."""
    raise ValueError(NO_FAST_FORM)


def sync_write(address: int, length: int, data: Mapping[int, bytes]) -> bytes:
    """Return the broadcast packet that writes `length` bytes from `address` on, per servo ID; no reply.

    Raises ValueError when a servo's data is not `length` bytes long, or the packet would be too long.
    """
    for one, chunk in data.items():
        if len(chunk) != length:
            raise ValueError(f"servo {one} gets {len(chunk)} bytes where {length} are announced")
    records = b"".join(bytes((one,)) + chunk for one, chunk in data.items())
    return instruction_packet(BROADCAST_ID, Instruction.SYNC_WRITE, bytes((address, length)) + records)
