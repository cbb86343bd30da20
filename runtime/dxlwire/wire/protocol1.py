"""Protocol 1.0: builds and parses packets, instructions of a host and replies of a servo, as bytes; pure
functions.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 1.0". Instruction `FF FF ID LEN INST P.. CHK`, status `FF FF
ID LEN ERR P.. CHK`; LEN = parameters + 2; CHK = ~(ID + LEN + INST or ERR + parameters) & FF. A status has
no mark that distinguishes it from an instruction: an echoed instruction parses as a status."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum, IntFlag, unique

from dxlwire.packets import Bytes
from dxlwire.transaction import BROADCAST_ID, Status

PROTOCOL = 1.0
HEADER = b"\xff\xff"
OVERHEAD = 6  # Bytes of a packet without parameters
LONGEST = 0xFF + 4
"""Size of the longest packet, bytes: LEN is one byte and counts everything after itself."""
CHECKSUM = 1  # Size of the checksum at the end of a packet, bytes
ID_AT = 2  # Offset of the ID, which is that of the addressed or the answering servo
HIGHEST_ID = 0xFD
PING_LENGTH = 0  # Parameters of the answer to a ping; the model number needs a read
MOST_GOAL_BYTES = 0xFF - 4  # Parameters of a sync write after address and length: LEN is one byte
ALERT = 0  # The error byte has no alert bit that refers to another item
NO_FAST_FORM = "Protocol 1.0 has no fast sync read and no fast bulk read"
_MOST_PARAMETERS = 0xFF - 2


@unique
class Protocol1Instruction(IntEnum):
    """Codes of the instructions that a host sends (e-Manual, "Instruction Details")."""

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
    """Bits of a status packet's error byte: the state of the servo, reported together with valid data."""

    INPUT_VOLTAGE = 0x01
    ANGLE_LIMIT = 0x02
    OVERHEATING = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


REFUSALS = StatusError.RANGE | StatusError.CHECKSUM | StatusError.INSTRUCTION
"""Error bits that mean the servo did not execute the instruction."""

_LENGTHS: Mapping[int, tuple[int, int]] = {
    Protocol1Instruction.PING: (2, 2),
    Protocol1Instruction.READ: (4, 4),
    Protocol1Instruction.WRITE: (4, 0xFF),
    Protocol1Instruction.REG_WRITE: (4, 0xFF),
    Protocol1Instruction.ACTION: (2, 2),
    Protocol1Instruction.FACTORY_RESET: (2, 2),
}
"""Smallest and largest LEN of an instruction to one servo (e-Manual, "Instruction Details")."""
_SENTENCES: Mapping[StatusError, str] = {
    StatusError.INPUT_VOLTAGE: "input voltage error: the voltage is out of the range of the control table",
    StatusError.ANGLE_LIMIT: "angle limit error: the goal position is outside the CW and CCW angle limits",
    StatusError.OVERHEATING: "overheating error: the temperature is out of the range of the control table",
    StatusError.RANGE: "range error: a written value is out of range",
    StatusError.CHECKSUM: "checksum error: the checksum of the instruction packet was wrong",
    StatusError.OVERLOAD: "overload error: the load exceeds the set torque",
    StatusError.INSTRUCTION: "instruction error: an undefined instruction, or action without reg write",
}


def describe_error(error: int) -> str:
    """Return the e-Manual's words for every bit of an error byte; `no error` for 0."""
    words = [sentence for bit, sentence in _SENTENCES.items() if error & bit]
    if error & 0x80:
        words.append("bit 7, not defined in Protocol 1.0")
    return "; ".join(words) or "no error"


def refused(error: int, length: int, awaited: int) -> bool:
    """Return True if a status of `length` parameters, where `awaited` were expected, reports that the
    instruction was not executed.

    The error bits describe the state of the servo if data is present. Without data they are the reason of
    the refusal."""
    return length == 0 != awaited and error & REFUSALS != 0


def widest(length: int) -> int:
    """Return the size on the line of a status packet with `length` parameters, bytes."""
    return OVERHEAD + length


def size_at(buffer: Bytes, start: int, end: int) -> int:
    """Return the size of the packet whose header is at `start`; 0: not known yet, -1: not a real header."""
    known = end - start
    if known > 2 and buffer[start + 2] == 0xFF:
        return -1
    if known < 4:
        return 0
    length = buffer[start + 3]
    return length + 4 if length >= 2 else -1


def intact(packet: memoryview) -> bool:
    """Return True if the checksum of a whole packet is correct."""
    return ~sum(packet[2:-1]) & 0xFF == packet[-1]


def opened(packet: memoryview) -> Status | None:
    """Parse an intact packet as a status; return None for the broadcast ID, which is never in a status.

    An instruction to one servo parses as a status, too."""
    return None if packet[2] == BROADCAST_ID else Status(packet[2], packet[4], packet[5:-1])


def instructs(packet: memoryview) -> bool:
    """Return True if an intact packet parses as an instruction of a host, by its code and length.

    A status can have the same bytes: its error byte would then equal the code."""
    if packet[2] == BROADCAST_ID:
        return True
    least, most = _LENGTHS.get(packet[4], (1, 0))
    return least <= packet[3] <= most


def checksum(body: Bytes) -> int:
    """Return the checksum of the bytes between the header and the checksum itself."""
    return ~sum(body) & 0xFF


def _packet(servo_id: int, kind: int, parameters: bytes) -> bytes:
    if len(parameters) > _MOST_PARAMETERS:
        raise ValueError(
            f"{len(parameters)} parameter bytes do not fit one packet; send at most {_MOST_PARAMETERS}"
        )
    body = bytes((servo_id, len(parameters) + 2, kind)) + parameters
    return HEADER + body + bytes((checksum(body),))


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return an instruction packet with a code of `Protocol1Instruction`.

    Raises:
        ValueError: `servo_id` is neither 0..253 nor broadcast, or the parameters do not fit.
    """
    if not (0 <= servo_id <= HIGHEST_ID or servo_id == BROADCAST_ID):
        raise ValueError(f"{servo_id} is not an ID (servo: 0..{HIGHEST_ID}, broadcast: {BROADCAST_ID})")
    return _packet(servo_id, instruction, parameters)


def status_packet(servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
    """Return the status packet that a servo would send. Raises ValueError if the parameters do not fit."""
    return _packet(servo_id, error, parameters)


def ping(servo_id: int) -> bytes:
    """Return the packet that asks a servo for an empty status, to check its presence."""
    return instruction_packet(servo_id, Protocol1Instruction.PING)


def read_range(servo_id: int, address: int, length: int) -> bytes:
    """Return the packet that reads `length` bytes of the control table from `address`."""
    return instruction_packet(servo_id, Protocol1Instruction.READ, bytes((address, length)))


def write_range(servo_id: int, address: int, data: bytes) -> bytes:
    """Return the packet that writes `data` into the control table from `address`."""
    return instruction_packet(servo_id, Protocol1Instruction.WRITE, bytes((address,)) + data)


def factory_reset(servo_id: int) -> bytes:
    """Return the packet that resets a servo's control table to factory values, including ID and baud rate."""
    return instruction_packet(servo_id, Protocol1Instruction.FACTORY_RESET)


def bulk_read(requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
    """Return the packet that reads two or more MX servos in turn, given (ID, address, length) for each.

    Each servo waits for the status of the servo before it, so an absent servo ends the chain.

    Raises:
        ValueError: `fast` is set: only Protocol 2.0 has fast forms.
    """
    if fast:
        raise ValueError(NO_FAST_FORM)
    parameters = b"\0" + b"".join(bytes((length, one, address)) for one, address, length in requests)
    return instruction_packet(BROADCAST_ID, Protocol1Instruction.BULK_READ, parameters)


read_many = bulk_read  # Common name in both dialects


def fast_size(length: int, count: int) -> int:
    """Raise ValueError: only Protocol 2.0 has fast reads."""
    raise ValueError(NO_FAST_FORM)


def fast_answers(packet: Bytes, lengths: Sequence[int]) -> list[Status]:
    """Raise ValueError: only Protocol 2.0 has fast reads."""
    raise ValueError(NO_FAST_FORM)


def sync_write(address: int, length: int, data: Mapping[int, bytes]) -> bytes:
    """Return the broadcast packet that writes `length` bytes from `address` to several servos, `data` by
    ID; it has no reply.

    Raises:
        ValueError: The data of a servo does not have `length` bytes, or the packet would be too long.
    """
    for one, chunk in data.items():
        if len(chunk) != length:
            raise ValueError(f"servo {one} gets {len(chunk)} bytes instead of {length}")
    records = b"".join(bytes((one,)) + chunk for one, chunk in data.items())
    return instruction_packet(
        BROADCAST_ID, Protocol1Instruction.SYNC_WRITE, bytes((address, length)) + records
    )
