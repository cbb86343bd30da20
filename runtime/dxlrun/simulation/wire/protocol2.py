"""Protocol 2.0 as a servo sees it: bytes of the line -> instructions, replies -> bytes.

Written from the protocol alone (ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0"), without the host's packet code:
one codec for both sides would agree with its own mistakes.
Only the CRC is a library's; the tests have another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum, unique
from functools import lru_cache

from fastcrc.crc16 import umts

from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry, ServoReply

LONGEST_PAUSE_NS = 1_500_000  # Longest gap inside an instruction
ID_AT = 4

HEADER = b"\xff\xff\xfd"
RESERVED = 0x00
STATUS = 0x55
ALERT = 0x80
"""Bit of a status packet's error: look at Hardware Error Status. It does not mean that anything failed."""

LONGEST = 0xFFFF  # The greatest length of a packet

_OVERHEAD = 7  # Bytes that the length does not count: header, reserved byte, ID, length
_STUFFED = HEADER + b"\xfd"
_PLAIN_HEAD = HEADER + bytes((RESERVED,))
_NO_ID = (0xFD, 0xFF)


@unique
class Instruction(IntEnum):
    """Instruction byte (e-Manual, Protocol 2.0, "Instruction")."""

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


_LONGEST_KNOWN = 1265
"""Bytes that list all servos of a line once: longer lists are rubbish, and not kept."""

SLOT_NS = 1_000_000  # What a servo's slot after a broadcast ping is longer than its reply [i]
_PING_REPLY = 14

_FAST_READS = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
_GROUP_READS = _FAST_READS | {Instruction.SYNC_READ, Instruction.BULK_READ}


@unique
class ErrorNumber(IntEnum):
    """Number in bits 0..6 of a status packet's error (e-Manual, Protocol 2.0, "Error")."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """Return the CRC-16 of some bytes: polynomial 8005 (hex), not reflected; `crc` is that so far."""
    return umts(data, crc)


def ping_slot_ns(baud_rate: int) -> int:
    """Return how much later than the ID before it a servo answers a ping to all."""
    return _PING_REPLY * (10_000_000_000 // baud_rate) + SLOT_NS


def stuffed(body: bytes) -> bytes:
    """Return instruction and parameters as they are on the line: no header is in them."""
    return body.replace(HEADER, _STUFFED)


def unstuffed(body: bytes) -> bytes:
    """Return instruction and parameters as they were meant."""
    return body.replace(_STUFFED, HEADER)


def status_packet(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet."""
    body = bytes((STATUS, error)) + parameters
    if HEADER in body:
        body = stuffed(body)
    packet = _head(servo_id, len(body) + 2) + body
    return packet + umts(packet).to_bytes(2, "little")


class FastStatusPacket:
    """The one status packet of a fast sync or bulk read: each servo adds error, ID, data and CRC.

    Nothing in it is stuffed. Each CRC is over everything before it, earlier CRCs included.
    """

    def __init__(self, lengths: tuple[int, ...]) -> None:
        self._head = _head(BROADCAST, _fast_length(lengths)) + bytes((STATUS,))
        self._crc = 0
        self._sent_crc = b""  # The CRC so far as it was sent: it counts for the next one

    def part(self, reply: ServoReply) -> bytes:
        """Return the bytes that the next servo adds; the first one also sends the header."""
        servo_id, error, parameters, _ = reply
        data = b"%b%c%c%b" % (self._head, error, servo_id, parameters)
        self._head = b""
        self._crc = crc = umts(self._sent_crc + data, self._crc)
        self._sent_crc = sent = crc.to_bytes(2, "little")
        return data + sent


def fast_status(lengths: tuple[int, ...]) -> FastStatusPacket:
    """Return an empty status packet for so many bytes of so many servos."""
    return FastStatusPacket(lengths)


def group_read(packet: InstructionPacket) -> GroupRead | None:
    """Return the group read that a packet is; None: it is none, or its parameters are wrong."""
    if packet.instruction not in _GROUP_READS or not packet.intact or packet.servo_id != BROADCAST:
        return None
    known = _group_read if len(packet.parameters) <= _LONGEST_KNOWN else _group_read.__wrapped__
    return known(packet.instruction, packet.parameters)


@lru_cache(maxsize=16)  # hosts read the same again and again
def _group_read(instruction: int, parameters: bytes) -> GroupRead | None:
    fast = instruction in _FAST_READS
    if instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        entries = _sync_entries(parameters)
    else:
        entries = _bulk_entries(parameters)
    # A fast status is one packet [i]: with an absent servo in it, it stays short.
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


ListedWrites = Mapping[int, Sequence[tuple[int, int, int, bytes]]]
"""The writes of a list for each ID: place in the list, ID, address, data."""


@lru_cache(maxsize=1)  # each servo of a line looks itself up
def sync_writes(parameters: bytes) -> ListedWrites | None:
    """Return the writes of a sync write by ID; None: its parameters are wrong."""
    address, length = _word(parameters, 0), _word(parameters, 2)
    if length == 0 or len(parameters) < 5 + length or (len(parameters) - 4) % (length + 1):
        return None
    writes: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for start in range(4, len(parameters), length + 1):
        servo_id, data = parameters[start], parameters[start + 1 : start + 1 + length]
        writes.setdefault(servo_id, []).append((start, servo_id, address, data))
    return writes


@lru_cache(maxsize=1)
def bulk_writes(parameters: bytes) -> ListedWrites | None:
    """Return the writes of a bulk write by ID; None: its parameters are wrong."""
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

        None: all were taken, and no packet is complete. One with a wrong CRC is a packet too. Go on at
        `packet.end`.
        """
        buffer = self._buffer
        if not buffer and data.startswith(_PLAIN_HEAD, start):
            end = start + _OVERHEAD + int.from_bytes(data[start + 5 : start + 7], "little")
            if start + _OVERHEAD + 3 <= end <= len(data) and data[start + 4] not in _NO_ID:
                # the usual case: hosts hand over whole packets, and the same ones again and again
                known = _packet if end - start <= _LONGEST_KNOWN else _packet.__wrapped__
                return known(bytes(data[start:end]), end)
        index = start
        while index < len(data):
            missing = max(1, _size(buffer) - len(buffer)) if len(buffer) >= _OVERHEAD else 1
            buffer += data[index : index + missing]
            index = min(len(data), index + missing)
            while buffer and not _may_begin(buffer):
                del buffer[0]
            if len(buffer) >= _OVERHEAD and len(buffer) == _size(buffer):
                packet = _packet(bytes(buffer), index)
                buffer.clear()
                return packet
        return None


def receiver() -> InstructionReceiver:
    """Return a receiver for one line."""
    return InstructionReceiver()


def _fast_length(lengths: tuple[int, ...]) -> int:
    return 1 + sum(length + 4 for length in lengths)


def _head(servo_id: int, length: int) -> bytes:
    return HEADER + bytes((RESERVED, servo_id)) + length.to_bytes(2, "little")


def _word(data: bytes | bytearray, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")


def _size(data: bytes | bytearray) -> int:
    return _OVERHEAD + _word(data, 5)


@lru_cache(maxsize=16)
def _packet(data: bytes, end: int) -> InstructionPacket:
    body = data[_OVERHEAD:-2]
    if _STUFFED in body:
        body = unstuffed(body)
    intact = int.from_bytes(data[-2:], "little") == umts(data[:-2])
    return InstructionPacket(data[4], body[0], body[1:], intact, end, data)


def _may_begin(data: bytes | bytearray) -> bool:
    """Return whether a packet can begin so: header, reserved 0, an ID that can be, a length of at least 3."""
    size = len(data)
    return (
        data[0] == 0xFF
        and (size < 2 or data[1] == 0xFF)
        and (size < 3 or data[2] == 0xFD)
        and (size < 4 or data[3] == RESERVED)
        and (size < 5 or data[4] not in _NO_ID)
        and (size < _OVERHEAD or _word(data, 5) >= 3)
    )
