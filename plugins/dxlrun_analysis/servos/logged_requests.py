"""Requests: which servos an instruction asks for a reply, in which order, and for how many bytes of data.

Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction packets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.tooling.logs import PacketColumns

IDS = 256  # Servos are numbered by index of the bus times this, plus ID
_HEADER_2 = b"\xff\xff\xfd\x00"
_HEADER_2_NUMBER = int.from_bytes(_HEADER_2, "little")
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_SYNC_READ, _FAST_SYNC_READ, _FAST_BULK_READ = 0x82, 0x8A, 0x9A  # Instruction codes
_HEAD_2 = 8  # Bytes before error, ID and data of the blocks of a fast status packet
_BEYOND = 1 << 17  # Longer than any packet
_WORD = 8  # Bytes that are compared at once
_KEPT = np.array([(1 << 8 * count) - 1 for count in range(_WORD + 1)], np.uint64)

Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Words = NDArray[np.uint64]


class LoggedRequest(NamedTuple):
    """Replies that one instruction requests: IDs in the order of the replies, or none."""

    servo_ids: tuple[int, ...] = ()
    sizes: tuple[int, ...] = ()  # Data bytes per servo; only for reads of several servos
    fast: bool = False  # All servos answer in one status packet


class DistinctRequests(NamedTuple):
    """Table of all distinct requests of a log; columns of shape (requests,).

    Row 0 requests nothing, rows 1 to 256 ask one servo by ID, then follow reads of several servos.
    """

    kinds: tuple[LoggedRequest, ...] = ()
    servos: Numbers = np.zeros(0, np.int64)  # Number of servos that each request asks
    fast: Flags = np.zeros(0, np.bool_)
    places: Numbers = np.zeros((0, IDS), np.int64)
    """Place of each ID in the chain of replies; -1: not asked; shape (requests, 256)."""
    ids: Numbers = np.zeros(0, np.int64)
    """IDs that all requests ask, request by request, in the order of their replies."""
    begins: Numbers = np.zeros(0, np.int64)  # Index in `ids` of the first servo that each request asks
    blocks: Numbers = np.zeros((0, 0), np.int64)
    """Offset of each block in the common status packet of a fast read, shape (requests, blocks)."""
    block_ends: Numbers = np.zeros((0, 0), np.int64)
    """Offset of the first byte after each block; for a block that is absent, beyond any packet."""

    def and_more(self, kinds: tuple[LoggedRequest, ...]) -> DistinctRequests:
        """Return a copy of the table with requests appended."""
        all_kinds = (*self.kinds, *kinds)
        places = np.full((len(kinds), IDS), -1, np.int64)
        for row, one in zip(places, kinds, strict=True):
            row[list(one.servo_ids)] = np.arange(len(one.servo_ids))
        servos = np.array([len(one.servo_ids) for one in all_kinds])
        # A block consists of error, ID, data and CRC.
        sizes = np.full((len(all_kinds), max(len(one.sizes) for one in all_kinds)), _BEYOND)
        for row, one in zip(sizes, all_kinds, strict=True):
            row[: len(one.sizes)] = np.array(one.sizes, np.int64) + 4
        ends = _HEAD_2 + np.cumsum(sizes, axis=1)
        return DistinctRequests(
            all_kinds,
            servos,
            np.array([one.fast for one in all_kinds]),
            np.concatenate([self.places, places]),
            np.array([servo_id for one in all_kinds for servo_id in one.servo_ids], np.int64),
            np.cumsum(servos) - servos,
            ends - sizes,
            ends,
        )


_ALONE = DistinctRequests().and_more(
    (LoggedRequest(), *(LoggedRequest((servo_id,)) for servo_id in range(IDS)))
)


class RequestTable:
    """Table of the requests of a log, to which each distinct instruction is added once."""

    def __init__(self) -> None:
        self.all = _ALONE
        self._known: dict[bytes, int] = {}

    def replace_samples(self, packets: PacketColumns, instruction: Numbers, request: Numbers) -> None:
        """Replace each request of several servos by its row of `all`; add new requests.

        Args:
            packets: The packets.
            instruction: Row of the instruction of each exchange, shape (exchanges,).
            request: Request of each exchange; that of several servos is -1 minus the index of an exchange
                with the same instruction.
        """
        several = np.flatnonzero(request < 0)
        sample = -1 - request[several]
        first = several[sample == several]
        start = packets.start[instruction[first]]
        ends = start + packets.length[instruction[first]]
        for one, begin, end in zip(first.tolist(), start.tolist(), ends.tolist(), strict=True):
            text = packets.data[begin:end].tobytes()
            request[one] = self._known.setdefault(text, len(_ALONE.kinds) + len(self._known))
        request[several] = request[sample]
        new = tuple(self._known)[len(self.all.kinds) - len(_ALONE.kinds) :]
        if new:
            self.all = self.all.and_more(tuple(map(request_of, new)))


def heads(packets: PacketColumns) -> Words:
    """Return the first eight bytes of each packet as a little-endian number; bytes after its end are 0."""
    return _words(packets.data, packets.start, packets.length)


def _words(data: NDArray[np.uint8], start: Numbers, length: Numbers | int) -> Words:
    """Return eight bytes from each index `start`, or `length` bytes and zeros if that is less."""
    data = data if len(data) >= _WORD else np.append(data, np.zeros(_WORD, np.uint8))
    # The last packets of `data` begin less than eight bytes before its end.
    at = np.minimum(start, len(data) - _WORD)
    words = np.ndarray((len(data) - _WORD + 1,), "<u8", data, 0, (1,))[at]
    words >>= (8 * (start - at)).astype(np.uint64)
    return words & _KEPT[np.minimum(length, _WORD)]


def instruction_of(head: NDArray[np.uint64]) -> Numbers:
    """Return the instruction code of packets with these heads, such as 0x02 for Read."""
    code = np.where(second_of(head), head >> np.uint64(56), head >> np.uint64(32))
    return code.astype(np.uint8).astype(np.int64)


def second_of(head: NDArray[np.uint64]) -> Flags:
    """Return which heads are those of Protocol 2.0.

    A Protocol 1.0 packet of ID 253 cannot have length 0.
    """
    second: Flags = head.astype(np.uint32) == _HEADER_2_NUMBER
    return second


def request_of(data: bytes) -> LoggedRequest:
    """Parse an instruction packet that reads several servos; `pairing.c` finds these packets. Only pings
    and reads count as requests, which servos answer at every status return level."""
    if not data.startswith(_HEADER_2):
        return _entries(data[6:-1], 3, 1, fast=False)
    code, body = data[7], data[8:-2].replace(_STUFFED, _PLAIN)
    fast = code in (_FAST_SYNC_READ, _FAST_BULK_READ)
    if code in (_SYNC_READ, _FAST_SYNC_READ):
        sizes = (int.from_bytes(body[2:4], "little"),) * len(body[4:])
        return LoggedRequest(tuple(dict.fromkeys(body[4:])), sizes, fast)
    return _entries(body, 5, 0, fast=fast)


def _entries(body: bytes, width: int, at: int, *, fast: bool) -> LoggedRequest:
    """Parse the body of a bulk read.

    Entries have `width` bytes, the ID at `at`, and the size first or last.
    """
    entries = [body[start : start + width] for start in range(0, len(body) - width + 1, width)]
    sizes = (entry[0] if at else int.from_bytes(entry[3:5], "little") for entry in entries)
    return LoggedRequest(tuple(dict.fromkeys(entry[at] for entry in entries)), tuple(sizes), fast)
