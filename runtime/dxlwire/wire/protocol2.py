"""Protocol 2.0: builds and parses packets, instructions of a host and replies of a servo, as bytes; pure
functions.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". Instruction `FF FF FD 00 ID LENL LENH INST P.. CRCL
CRCH`; a status has INST 55 and an error byte before its parameters. LEN counts everything after itself.
From INST to the last parameter `FF FF FD` is sent as `FF FF FD FD` (byte stuffing). The CRC covers
everything before it, including stuffing: CRC-16 of polynomial 8005, not reflected, from 0."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum, unique

from fastcrc import crc16

from dxlwire.packets import Bytes
from dxlwire.transaction import BROADCAST_ID, Status

PROTOCOL = 2.0
HEADER = b"\xff\xff\xfd\x00"
OVERHEAD = 11  # Bytes of a status packet without parameters and without stuffing
LONGEST = 2048
"""Size of the longest packet that a receiver waits for, bytes; a longer announced size means a false header.

The protocol allows 65,542. No servo answers with more than a control table (about 1,000 bytes), or 140
servos' states in a fast form. A false header must not hold the line back for longer.
"""
CHECKSUM = 2  # Size of the CRC at the end of a packet, bytes
ID_AT = 4  # Offset of the ID, which is that of the addressed or the answering servo
HIGHEST_ID = 0xFC
PING_LENGTH = 3  # Parameters of the answer to a ping: model number (2), firmware version (1)
MOST_GOAL_BYTES = 1024
"""Limit of a sync write's parameters after address and length, bytes: even with stuffing they fit a batch
of the log."""
STATUS = 0x55
ALERT = 0x80  # Bit of the error byte: a hardware error, see `ControlTable.errors`; the data is valid
_MOST_PARAMETERS = 0xFFFF - 3
_PATTERN = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"
_BACKUP = b"\x43\x54\x52\x4c"


@unique
class Protocol2Instruction(IntEnum):
    """Codes of the instructions that a host sends (e-Manual, "Instruction")."""

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


@unique
class ErrorNumber(IntEnum):
    """Bits 0..6 of a status packet's error byte: the reason why the servo did not execute the instruction."""

    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    RANGE = 4
    LENGTH = 5
    LIMIT = 6
    ACCESS = 7


@unique
class Reset(IntEnum):
    """Scope of a factory reset: the settings of a servo that it keeps."""

    ALL = 0xFF
    KEEP_ID = 0x01
    KEEP_ID_AND_BAUD_RATE = 0x02


_NUMBERS: Mapping[int, str] = {
    ErrorNumber.RESULT_FAIL: "result fail: the servo could not do what the instruction asks",
    ErrorNumber.INSTRUCTION: "instruction error: an undefined instruction, or action without reg write",
    ErrorNumber.CRC: "CRC error: the CRC of the instruction packet was wrong",
    ErrorNumber.RANGE: "data range error: a written value is out of the range of the control table",
    ErrorNumber.LENGTH: "data length error: fewer bytes than the item needs",
    ErrorNumber.LIMIT: "data limit error: a written value is beyond a limit set in the servo",
    ErrorNumber.ACCESS: "access error: the address cannot be accessed, or is in EEPROM and torque is on",
}


def describe_error(error: int) -> str:
    """Return an error byte in the e-Manual's words; `no error` for 0."""
    words = []
    if error & ALERT:
        words.append("alert: the servo has a hardware error")
    if number := error & ~ALERT:
        words.append(_NUMBERS.get(number, f"error number {number}, not defined in Protocol 2.0"))
    return "; ".join(words) or "no error"


def refused(error: int, length: int, awaited: int) -> bool:
    """Return True if a status of `length` parameters, where `awaited` were expected, reports that the
    instruction was not executed.

    An error number is a refusal, and an error reply to a read has no data. The alert bit alone is not a
    refusal."""
    return error & ~ALERT != 0 and length in (0, awaited)


def crc(data: Bytes) -> int:
    """Return the CRC that belongs at the end of a packet, given without its last two bytes (e-Manual, "CRC
    Calculation")."""
    return crc16.umts(data)


def stuffed(body: bytes) -> bytes:
    """Return the bytes from INST to the last parameter with byte stuffing, as they are sent."""
    return body.replace(_PATTERN, _STUFFED)


def unstuffed(body: bytes) -> bytes:
    """Return the bytes from INST to the last parameter without byte stuffing; the inverse of `stuffed`."""
    return body.replace(_STUFFED, _PATTERN)


def widest(length: int) -> int:
    """Return the largest size on the line of a status, bytes: one stuffing byte per three of `length`
    parameters."""
    return OVERHEAD + length + (length + 2) // 3


def size_at(buffer: Bytes, start: int, end: int) -> int:
    """Return the size of the packet whose header is at `start`; 0: not known yet, -1: not a real header."""
    known = end - start
    if known > 4 and buffer[start + 4] in (0xFD, 0xFF):
        return -1
    if known < 7:
        return 0
    length = buffer[start + 5] | buffer[start + 6] << 8
    return length + 7 if 3 <= length <= LONGEST - 7 else -1


def intact(packet: memoryview) -> bool:
    """Return True if the CRC of a whole packet is correct."""
    return crc16.umts(packet[:-2]) == packet[-2] | packet[-1] << 8


def opened(packet: memoryview) -> Status | None:
    """Parse an intact packet as a status; return None if it is not a status, such as an echoed instruction.

    The shared status of a fast read (from the broadcast ID) has no stuffing: `fast_answers` reads its
    parameters."""
    if packet[7] != STATUS or len(packet) < OVERHEAD:
        return None
    body = bytes(packet[7:-2])
    if packet[4] != BROADCAST_ID:
        body = unstuffed(body)
    return Status(packet[4], body[1], body[2:])


def instructs(packet: memoryview) -> bool:
    """Return True if an intact packet is an instruction of a host: any packet but a status."""
    return packet[7] != STATUS


def fast_size(length: int, count: int) -> int:
    """Return the size (bytes) of the status that `count` servos share in a fast read of `length` bytes in
    total.

    Each part adds an error byte, an ID and a CRC to its data (e-Manual, "Fast Sync Read (0x8A)")."""
    return 8 + length + 4 * count


def fast_answers(packet: Bytes, lengths: Sequence[int]) -> list[Status]:
    """Return the servos' parts of the shared status of a fast read, in their order.

    Each part's CRC covers everything since the first FF. The list ends before the first part that is
    truncated or has a wrong CRC, so the parts before an absent servo stay usable.

    Args:
        packet: The status packet, possibly truncated.
        lengths: Requested bytes of data of each servo.

    Raises:
        ValueError: The packet is not the status of a fast form.
    """
    data = bytes(packet)
    if len(data) < 8 or data[:4] != HEADER or data[4] != BROADCAST_ID or data[7] != STATUS:
        raise ValueError(f"not a status packet of a fast read: {data.hex(' ')}")
    found: list[Status] = []
    start = 8
    for length in lengths:
        end = start + 2 + length
        if len(data) < end + 2 or _tail(data[:end]) != data[end : end + 2]:
            break
        found.append(Status(data[start + 1], data[start], data[start + 2 : end]))
        start = end + 2
    return found


def _tail(data: bytes) -> bytes:
    return crc16.umts(data).to_bytes(2, "little")


def _packet(address: int, body: bytes) -> bytes:
    if len(body) > _MOST_PARAMETERS + 1:
        raise ValueError(
            f"{len(body) - 1} parameter bytes do not fit one packet; send at most {_MOST_PARAMETERS}"
        )
    data = HEADER + bytes((address,)) + _word(len(body) + 2) + body
    return data + _tail(data)


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return an instruction packet with a code of `Protocol2Instruction`.

    Raises:
        ValueError: `servo_id` is neither 0..252 nor broadcast, or the parameters do not fit.
    """
    if not (0 <= servo_id <= HIGHEST_ID or servo_id == BROADCAST_ID):
        raise ValueError(f"{servo_id} is not an ID (servo: 0..{HIGHEST_ID}, broadcast: {BROADCAST_ID})")
    return _packet(servo_id, stuffed(bytes((instruction,)) + parameters))


def status_packet(servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
    """Return the status packet that a servo would send. Raises ValueError if the parameters do not fit."""
    return _packet(servo_id, stuffed(bytes((STATUS, error)) + parameters))


def ping(servo_id: int = BROADCAST_ID) -> bytes:
    """Return the packet that asks one servo, or all, for model number and firmware version."""
    return instruction_packet(servo_id, Protocol2Instruction.PING)


def read_range(servo_id: int, address: int, length: int) -> bytes:
    """Return the packet that reads `length` bytes of the control table from `address`."""
    return instruction_packet(servo_id, Protocol2Instruction.READ, _word(address) + _word(length))


def write_range(servo_id: int, address: int, data: bytes) -> bytes:
    """Return the packet that writes `data` into the control table from `address`."""
    return instruction_packet(servo_id, Protocol2Instruction.WRITE, _word(address) + data)


def factory_reset(servo_id: int, what: Reset) -> bytes:
    """Return the packet that resets a servo's control table to factory values; `what` decides about ID and
    baud rate."""
    return instruction_packet(servo_id, Protocol2Instruction.FACTORY_RESET, bytes((what,)))


def reboot(servo_id: int) -> bytes:
    """Return the packet that restarts a servo; its RAM registers return to their defaults."""
    return instruction_packet(servo_id, Protocol2Instruction.REBOOT)


def back_up(servo_id: int) -> bytes:
    """Return the packet that stores the control table in the backup inside the servo; refused while torque
    is on."""
    return instruction_packet(servo_id, Protocol2Instruction.CONTROL_TABLE_BACKUP, b"\x01" + _BACKUP)


def restore(servo_id: int) -> bytes:
    """Return the packet that restores the EEPROM from the backup inside the servo; the servo then reboots."""
    return instruction_packet(servo_id, Protocol2Instruction.CONTROL_TABLE_BACKUP, b"\x02" + _BACKUP)


def sync_read(address: int, length: int, servo_ids: Iterable[int], *, fast: bool = False) -> bytes:
    """Return the packet that reads `length` bytes from `address` of several servos; `fast`: they share one
    status."""
    instruction = Protocol2Instruction.FAST_SYNC_READ if fast else Protocol2Instruction.SYNC_READ
    parameters = _word(address) + _word(length) + bytes(servo_ids)
    return instruction_packet(BROADCAST_ID, instruction, parameters)


def bulk_read(requests: Iterable[tuple[int, int, int]], *, fast: bool = False) -> bytes:
    """Return the packet that reads different bytes from servos, given (ID, address, length) for each;
    `fast`: they share one status."""
    instruction = Protocol2Instruction.FAST_BULK_READ if fast else Protocol2Instruction.BULK_READ
    parameters = b"".join(
        bytes((servo_id,)) + _word(address) + _word(length) for servo_id, address, length in requests
    )
    return instruction_packet(BROADCAST_ID, instruction, parameters)


def read_many(requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
    """Return a packet that reads several servos in turn, given (ID, address, length) for each: sync read
    if all have the same bytes, else bulk read."""
    _, address, length = requests[0]
    if all(request[1:] == (address, length) for request in requests):
        return sync_read(address, length, (servo_id for servo_id, _, _ in requests), fast=fast)
    return bulk_read(requests, fast=fast)


def sync_write(address: int, length: int, data: Mapping[int, bytes]) -> bytes:
    """Return the broadcast packet that writes `length` bytes from `address` to several servos, `data` by
    ID; it has no reply.

    Raises:
        ValueError: The data of a servo does not have `length` bytes.
    """
    for servo_id, chunk in data.items():
        if len(chunk) != length:
            raise ValueError(f"servo {servo_id} gets {len(chunk)} bytes instead of {length}")
    records = b"".join(bytes((servo_id,)) + chunk for servo_id, chunk in data.items())
    parameters = _word(address) + _word(length) + records
    return instruction_packet(BROADCAST_ID, Protocol2Instruction.SYNC_WRITE, parameters)


def _word(value: int) -> bytes:
    return value.to_bytes(2, "little")
