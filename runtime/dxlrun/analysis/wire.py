"""Packets as the analysis reads them: who is asked, who answers with which error; both protocols, by bytes.

The log keeps the bytes of the wire; they are read here anew, so that nothing depends on what the run
believed. Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction and status packets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

BROADCAST_ID = 0xFE

_HEADER_2 = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_PING, _READ = 0x01, 0x02
_SYNC_READ, _FAST_SYNC_READ, _BULK_READ, _FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A

ERROR_BITS = {
    0x01: "voltage",
    0x02: "angle limit",
    0x04: "overheating",
    0x08: "range",
    0x10: "checksum",
    0x20: "overload",
    0x40: "instruction",
}
"""Bits of the error byte (ROBOTIS e-Manual, Protocol 1.0, Status Packet)."""

ERROR_NUMBERS = {
    1: "result fail",
    2: "instruction",
    3: "CRC",
    4: "range",
    5: "length",
    6: "limit",
    7: "access",
}
"""Bits 0 to 6 of the error byte, a number (ROBOTIS e-Manual, Protocol 2.0, Status Packet)."""

ALERT = 0x80
"""Bit 7 of the error byte of Protocol 2.0: the servo has a hardware error; the reply itself is good."""


@dataclass(frozen=True, slots=True)
class Question:
    """What one instruction asks: the servos that have to answer, and how many bytes of data each."""

    servo_ids: tuple[int, ...] = ()
    sizes: tuple[int, ...] = ()
    """Bytes of data a servo; only for reads of several servos."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer of one servo; a fast status packet holds several."""

    servo_id: int
    error: int
    """The error byte."""
    protocol: int


def is_protocol_2(data: bytes) -> bool:
    """Tell the protocol by the header; a Protocol 1.0 packet of ID 253 has no length 0."""
    return data.startswith(_HEADER_2)


@lru_cache(maxsize=1024)
def question(data: bytes) -> Question:
    """Return who has to answer an instruction at every status return level: pings and reads."""
    second = is_protocol_2(data)
    servo_id, code = (_byte(data, 4), _byte(data, 7)) if second else (_byte(data, 2), _byte(data, 4))
    if code in (_PING, _READ):
        return Question() if servo_id == BROADCAST_ID else Question((servo_id,))
    if not second:
        return _entries(data[6:-1], 3, 1) if code == _BULK_READ else Question()
    body = data[8:-2].replace(_STUFFED, _PLAIN)
    if code in (_SYNC_READ, _FAST_SYNC_READ):
        return Question(tuple(body[4:]), (int.from_bytes(body[2:4], "little"),) * len(body[4:]))
    return _entries(body, 5, 0) if code in (_BULK_READ, _FAST_BULK_READ) else Question()


def _entries(body: bytes, width: int, at: int) -> Question:
    """Return the servos of a bulk read: entries of `width` bytes, the ID at `at`, the size first or last."""
    entries = [body[start : start + width] for start in range(0, len(body) - width + 1, width)]
    sizes = (entry[0] if at else int.from_bytes(entry[3:5], "little") for entry in entries)
    return Question(tuple(entry[at] for entry in entries), tuple(sizes))


def replies(servo_id: int, data: bytes, asked: Question) -> Iterator[Reply]:
    """Yield the answers in one status packet; `asked` tells the blocks of a fast one apart."""
    if not is_protocol_2(data):
        yield Reply(servo_id, _byte(data, 4), 1)
    elif servo_id != BROADCAST_ID:
        yield Reply(servo_id, _byte(data, 8), 2)
    else:
        at = 8
        for size in asked.sizes:  # a block: error, ID, data, CRC
            if at + 1 < len(data):
                yield Reply(data[at + 1], data[at], 2)
            at += size + 4


def error_names(protocol: int, errors: set[int]) -> tuple[str, ...]:
    """Return the names of all errors in these error bytes."""
    if protocol == 1:
        return tuple(name for bit, name in ERROR_BITS.items() if any(error & bit for error in errors))
    numbers = {error & ~ALERT for error in errors}
    names = tuple(name for number, name in ERROR_NUMBERS.items() if number in numbers)
    return (*names, "alert") if any(error & ALERT for error in errors) else names


def _byte(data: bytes, index: int) -> int:
    return data[index] if index < len(data) else 0
