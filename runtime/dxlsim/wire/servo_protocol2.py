"""Protocol 2.0 for simulated servos: parses instructions and builds replies as bytes.

Only the CRC comes from a library; the tests use another implementation."""

from __future__ import annotations

from enum import IntEnum, unique
from functools import lru_cache

from fastcrc.crc16 import umts

from dxlsim.wire.servo_packets import (
    BROADCAST,
    GroupRead,
    Instruction,
    InstructionPacket,
    ListedWrites,
    PacketCodec,
    ReadEntry,
    ServoReply,
    sync_writes,
)

HEADER = b"\xff\xff\xfd"
RESERVED = 0x00
STATUS = 0x55
ALERT = 0x80
"""Bit of a status packet's error: Hardware Error Status is set. The instruction may have succeeded."""

LONGEST = 0xFFFF  # Largest value of the length field

_OVERHEAD = 7  # Bytes that the length does not count: header, reserved byte, ID, length
_STUFFED = HEADER + b"\xfd"


# Size of a list of all servos of a line, bytes; longer lists are corrupted and not cached
_LONGEST_KNOWN = 1265

SLOT_NS = 1_000_000  # Time by which a servo's slot after a broadcast ping exceeds its reply [i]
_PING_REPLY = 14

_FAST_READS = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
_GROUP_READS = _FAST_READS | {Instruction.SYNC_READ, Instruction.BULK_READ}


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


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """Return the CRC-16 of bytes: polynomial 8005 (hex), not reflected; `crc` is that of the bytes before."""
    return umts(data, crc)


def ping_slot_ns(baud_rate: int) -> int:
    """Return the delay (ns) between the answers of two successive IDs to a broadcast ping, at a rate in
    bit/s."""
    return _PING_REPLY * (10_000_000_000 // baud_rate) + SLOT_NS


def stuffed(body: bytes) -> bytes:
    """Return instruction and parameters with byte stuffing, so that they contain no header."""
    return body.replace(HEADER, _STUFFED)


def unstuffed(body: bytes) -> bytes:
    """Return instruction and parameters without byte stuffing."""
    return body.replace(_STUFFED, HEADER)


def status_packet(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet, the reply of a servo."""
    body = bytes((STATUS, error)) + parameters
    if HEADER in body:
        body = stuffed(body)
    packet = _head(servo_id, len(body) + 2) + body
    return packet + umts(packet).to_bytes(2, "little")


class FastStatusPacket:
    """Shared status packet of a fast sync or bulk read: each servo adds error, ID, data and CRC.

    It has no byte stuffing. Each CRC covers everything before it, including earlier CRCs."""

    def __init__(self, lengths: tuple[int, ...]) -> None:
        self._head = _head(BROADCAST, _fast_length(lengths)) + bytes((STATUS,))
        self._crc = 0
        self._sent_crc = b""  # Previous CRC as sent; the next CRC covers it

    def part(self, reply: ServoReply) -> bytes:
        """Return the bytes that the next servo adds for its reply; the first servo also sends the header."""
        servo_id, error, parameters, _ = reply
        data = b"%b%c%c%b" % (self._head, error, servo_id, parameters)
        self._head = b""
        self._crc = crc = umts(self._sent_crc + data, self._crc)
        self._sent_crc = sent = crc.to_bytes(2, "little")
        return data + sent


def group_read(packet: InstructionPacket) -> GroupRead | None:
    """Parse a sync, bulk or fast read; return None for another or a malformed instruction."""
    if packet.instruction not in _GROUP_READS or not packet.intact or packet.servo_id != BROADCAST:
        return None
    known = _group_read if len(packet.parameters) <= _LONGEST_KNOWN else _group_read.__wrapped__
    return known(packet.instruction, packet.parameters)


@lru_cache(maxsize=16)  # Hosts repeat the same reads
def _group_read(instruction: int, parameters: bytes) -> GroupRead | None:
    fast = instruction in _FAST_READS
    if instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        entries = _sync_entries(parameters)
    else:
        entries = _bulk_entries(parameters)
    # A fast status is one packet [i]: with an absent servo it stays incomplete.
    read = GroupRead(instruction, entries, fast=fast, has_slots=not fast)
    if not entries or (fast and _fast_length(read.lengths) > LONGEST):
        return None
    return read


def _sync_entries(parameters: bytes) -> tuple[ReadEntry, ...]:
    address, length = _word(parameters, 0), _word(parameters, 2)
    return tuple(ReadEntry(servo_id, address, length) for servo_id in parameters[4:])


def _bulk_entries(parameters: bytes) -> tuple[ReadEntry, ...]:
    if len(parameters) % 5:
        return ()
    return tuple(
        ReadEntry(parameters[start], _word(parameters, start + 1), _word(parameters, start + 3))
        for start in range(0, len(parameters), 5)
    )


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


def _fast_length(lengths: tuple[int, ...]) -> int:
    return 1 + sum(length + 4 for length in lengths)


def _head(servo_id: int, length: int) -> bytes:
    return HEADER + bytes((RESERVED, servo_id)) + length.to_bytes(2, "little")


def _word(data: bytes | bytearray, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")


def _packet(data: bytes, end: int) -> InstructionPacket:
    known = _packet_of if len(data) <= _LONGEST_KNOWN else _packet_of.__wrapped__
    return known(data, end)


@lru_cache(maxsize=16)  # Hosts repeat the same packets
def _packet_of(data: bytes, end: int) -> InstructionPacket:
    body = unstuffed(data[_OVERHEAD:-2])
    intact = int.from_bytes(data[-2:], "little") == umts(data[:-2])
    return InstructionPacket(data[4], body[0], body[1:], intact, end, data)


CODEC = PacketCodec(
    header=HEADER + bytes((RESERVED,)),
    no_id=frozenset((0xFD, 0xFF)),
    length_bytes=2,
    shortest=3,
    longest_pause_ns=1_500_000,
    packet=_packet,
    status_packet=status_packet,
    read=lambda parameters: (_word(parameters, 0), _word(parameters, 2)) if len(parameters) == 4 else None,
    write=lambda parameters: (_word(parameters, 0), parameters[2:]) if len(parameters) >= 3 else None,
    listed_writes=_listed_writes,
    group_read=group_read,
    ping_slot_ns=ping_slot_ns,
    error=StatusErrorNumber,
    damaged=StatusErrorNumber.CRC,
    unknown=StatusErrorNumber.INSTRUCTION,
    no_cells=StatusErrorNumber.ACCESS,
)
