"""Burst: the replies to one read, taken as a whole when they come as they should.

What is awaited is known to the byte: whose status stands where, and what its header says. So the replies of a
chain, or the one status of a fast form, are compared and checked where they lie in the receive buffer, and
their data leave it as one array. Whatever does not fit (a servo that is silent or refuses, noise, stuffing,
another order) is none, and the receiver takes the same bytes packet by packet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from fastcrc import crc16
from numpy.typing import NDArray

from dxlrun.dynamixel.dialect import Dialect
from dxlrun.dynamixel.transaction import BROADCAST_ID, Status, Transaction

_STUFFING = b"\xff\xff\xfd\xfd"
_FAST_HEAD = 8
_FAST_TAIL = 2
_NUMBERS = bytes(number for number in range(256) if number & 0x7F)
"""Error bytes of Protocol 2.0 that say more than that there is an alert."""

_crc = crc16.umts


def _words(kind: str, at: int, step: int, count: int) -> Callable[[bytearray], tuple[int, ...]]:
    """Return what reads `count` words of a buffer, from `at` on, `step` apart; quicker than an array is."""
    gap = f"{step - struct.calcsize('<' + kind)}x{kind}"
    return struct.Struct(f"<{at}x{kind}{gap * (count - 1)}").unpack_from


class Burst:
    """The replies to one transaction, all of one length, and their place at the start of a buffer."""

    __slots__ = (
        "_alone",
        "_bodies",
        "_buffer",
        "_end",
        "_errors_at",
        "_expected",
        "_fast",
        "_head",
        "_heads",
        "_ids",
        "_ids_at",
        "_lead",
        "_no_errors",
        "_quiet_lead",
        "_tails",
        "_two",
        "count",
        "data",
        "data_at",
        "first",
        "first_size",
        "ids",
        "packets",
        "size",
        "step",
    )

    def __init__(self, dialect: Dialect, transaction: Transaction) -> None:
        awaited = transaction.awaited
        length = awaited[0].length
        self.ids = tuple(one.servo_id for one in awaited)
        """Who answers, in the order of their turns."""
        self.count = len(awaited)
        self._two = dialect.PROTOCOL == 2.0
        self._fast = transaction.fast
        whole = [dialect.status_packet(servo_id, 0, bytes(length)) for servo_id in self.ids]
        self._head = 8 if self._two else 4
        self.step = length + 4 if self._fast else len(whole[0])
        """Bytes from one servo's data to those of the next."""
        self.data_at = self._head + (_FAST_TAIL if self._fast else 1)
        """Where the data of the first one begin."""
        self.size = _FAST_HEAD + self.step * self.count if self._fast else self.step * self.count
        """Bytes of all replies."""
        self.first_size = self.size if self._fast else self.step
        """Bytes of the first status packet."""
        if self._fast:
            lead = (self.size - 7).to_bytes(2, "little")
            whole = [dialect.HEADER + bytes((BROADCAST_ID,)) + lead + whole[0][7:8]]
        self._expected = tuple(int.from_bytes(packet[: self._head], "little") for packet in whole)
        self._heads = _words("IQ"[self._two], 0, self.step, len(whole))
        self._lead = whole[0][: self._head]
        self._quiet_lead = self._lead + b"\0"
        self._errors_at = slice(self._head, self.size, self.step)
        self._ids = bytes(self.ids)
        self._ids_at = slice(self._head + 1, self.size, self.step)
        first_end = self.size - (self.count - 1) * self.step
        self._tails = _words("H", first_end - 2, self.step, self.count)
        self._alone = self.count == 1 and not self._two
        self._no_errors = bytes(self.count)
        self._buffer = bytearray()
        self.bind(bytearray(self.size))

    @classmethod
    def of(cls, dialect: Dialect, transaction: Transaction, room: int) -> Burst | None:
        """Return the burst of a read; None when its replies differ in length, or a buffer has no room."""
        lengths = {one.length for one in transaction.awaited}
        if len(lengths) != 1 or 0 in lengths:
            return None
        burst = cls(dialect, transaction)
        return burst if burst.size <= room else None

    def bind(self, buffer: bytearray) -> None:
        """Look for the replies at the start of a buffer from now on."""
        if buffer is self._buffer:
            return
        self._buffer = buffer
        view, step, count = memoryview(buffer), self.step, self.count
        data_at = self.data_at
        length = self.size - (count - 1) * step - data_at - (2 if self._two else 1)
        self.data: NDArray[np.uint8] = np.ndarray(
            (count, length), np.uint8, buffer, offset=data_at, strides=(step, 1)
        )
        """What they say, one row a servo; good until the buffer is filled again."""
        self.first = view[data_at : data_at + length]
        """What the first one says."""
        ends = [self.size - (count - 1 - number) * step for number in range(count)]
        if self._fast:
            # each CRC goes on where the one before it ended, and covers that one, too
            starts = [0, *(end - 2 for end in ends[:-1])]
            self._bodies = [view[start : end - 2] for start, end in zip(starts, ends, strict=True)]
            self.packets = [(BROADCAST_ID, view[: self.size])]
            """Each status packet and who sent it, where they lie."""
        else:
            self.packets = [
                (servo_id, view[end - step : end]) for servo_id, end in zip(self.ids, ends, strict=True)
            ]
            skip, tail = (0, 2) if self._two else (2, 0)
            self._bodies = [packet[skip : step - tail] for _, packet in self.packets]

    @property
    def errors(self) -> bytes:
        """The error bytes, one a servo."""
        return bytes(self._buffer[self._errors_at])

    def begun(self, end: int) -> bool:
        """Say whether the first `end` bytes of the buffer can become these replies."""
        if end < self._head:
            return self._buffer.startswith(self._lead[:end])
        known = 1 if self._fast else (end - self._head) // self.step + 1
        return self._heads(self._buffer)[:known] == self._expected[:known]

    def clean(self) -> bool:
        """Say whether these replies are `whole`, and nobody reports anything."""
        if self._alone:
            return self._buffer.startswith(self._quiet_lead) and sum(self._bodies[0]) & 0xFF == 0xFF
        if self._buffer[self._errors_at] != self._no_errors:
            return False
        if self._fast:
            return self._buffer.startswith(self._lead) and self._theirs() and self._chained()
        return self.whole()

    def whole(self) -> bool:
        """Say whether the buffer begins with exactly these replies, every checksum right, no refusal."""
        if self._heads(self._buffer) != self._expected:
            return False
        if not self._two:
            # the checksum is the complement of the sum of what stands before it (protocol1)
            return all([sum(body) & 0xFF == 0xFF for body in self._bodies])  # noqa: C419  twice as quick
        errors = self._buffer[self._errors_at]
        if errors != self._no_errors and len(errors.translate(None, _NUMBERS)) != self.count:
            return False
        return self._theirs() and self._chained() if self._fast else self._separate()

    def _separate(self) -> bool:
        if [_crc(body) for body in self._bodies] != [*self._tails(self._buffer)]:
            return False
        return self._buffer.find(_STUFFING, 0, self.size) < 0

    def _chained(self) -> bool:
        """Say whether every CRC is right: the last one says only that the wire was as its servo heard it.

        Whoever adds its part goes on with the CRC of what it heard [i], also where noise had changed that.
        """
        crc = 0
        return [crc := _crc(body, crc) for body in self._bodies] == [*self._tails(self._buffer)]

    def _theirs(self) -> bool:
        """Say whether the parts of the one status of a fast form are of whom they should be."""
        return self._buffer[self._ids_at] == self._ids

    def spans(self, ends: list[int], times: list[int]) -> list[tuple[int, int]]:
        """Return of each status packet when the read() of its first and of its last byte was.

        `ends`, `times`: where each read() ended in the buffer, and when it was.
        """
        found: list[tuple[int, int]] = []
        start = first = last = 0
        for _, data in self.packets:
            while ends[first] <= start:
                first += 1
            start += len(data)
            while ends[last] < start:
                last += 1
            found.append((times[first], times[last]))
        return found


def good_parts(dialect: Dialect, transaction: Transaction, data: memoryview) -> tuple[list[Status], int]:
    """Return what is good of the one status of a fast form that is cut off or spoilt, and its bytes."""
    if dialect.size_at(data, 0, len(data)) != transaction.widest:
        return [], 0
    awaited = transaction.awaited
    try:
        parts = dialect.fast_answers(data, [one.length for one in awaited])
    except ValueError:  # spoilt before its first part
        return [], 0
    count = 0
    while count < len(parts) and parts[count].servo_id == awaited[count].servo_id:
        count += 1
    used = dialect.fast_size(sum(one.length for one in awaited[:count]), count) if count else 0
    return parts[:count], used
