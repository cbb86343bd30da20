"""Requests: which servos an instruction asks for a reply, in which order, and for how many bytes of data.

Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction packets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.tooling.logs import PacketColumns
from dxlwire import BROADCAST_ID

IDS = 256  # Servos are numbered by index of the bus times this, plus ID
_HEADER_2 = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
PING, _READ = 0x01, 0x02  # Instruction codes of both protocols
_SYNC_READ, _FAST_SYNC_READ, _BULK_READ, _FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A
_FAST = (_FAST_SYNC_READ, _FAST_BULK_READ)
_MIXED = np.random.default_rng(15).integers(1, 2**63, 1 << 17, dtype=np.uint64) | np.uint64(1)
"""Odd weights of a multilinear hash (Dietzfelbinger 1996): collisions are improbable."""

Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]


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
    ids: Numbers = np.zeros((0, IDS), np.int64)
    """All IDs; the last `servos` of them are asked, in the order of their replies; shape (requests, 256)."""

    def and_more(self, kinds: tuple[LoggedRequest, ...]) -> DistinctRequests:
        """Return a copy of the table with requests appended."""
        places = np.full((len(kinds), IDS), -1, np.int64)
        for row, one in zip(places, kinds, strict=True):
            row[list(one.servo_ids)] = np.arange(len(one.servo_ids))
        return DistinctRequests(
            (*self.kinds, *kinds),
            np.append(self.servos, [len(one.servo_ids) for one in kinds]),
            np.append(self.fast, [one.fast for one in kinds]),
            np.concatenate([self.places, places]),
            np.concatenate([self.ids, np.argsort(places, axis=1, kind="stable")]),
        )


_ALONE = DistinctRequests().and_more(
    (LoggedRequest(), *(LoggedRequest((servo_id,)) for servo_id in range(IDS)))
)


class RequestTable:
    """Table of the requests of a log, to which each distinct instruction is added once."""

    def __init__(self) -> None:
        self.all = _ALONE
        self._known: dict[bytes, int] = {}

    def request_indices(self, packets: PacketColumns) -> Numbers:
        """Return the row of `all` for each instruction packet; add new requests to the table."""
        second, code = second_of(packets), instruction_of(packets)
        servo_id = np.where(second, packets.byte(4), packets.byte(2)).astype(np.int64)
        found = np.zeros(len(packets), np.int64)
        single = np.isin(code, (PING, _READ)) & (servo_id != BROADCAST_ID)
        found[single] = servo_id[single] + 1
        many = np.where(second, np.isin(code, (_SYNC_READ, _BULK_READ, *_FAST)), code == _BULK_READ)
        for length in np.unique(packets.length[many]).tolist():
            rows = np.flatnonzero(many & (packets.length == length))
            text = packets.data[packets.start[rows][:, None] + np.arange(length)]
            mixed = text.astype(np.uint64) @ _MIXED[:length]
            _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
            index = [
                self._known.setdefault(text[row].tobytes(), len(_ALONE.kinds) + len(self._known))
                for row in first.tolist()
            ]
            found[rows] = np.array(index)[inverse]
        new = tuple(self._known)[len(self.all.kinds) - len(_ALONE.kinds) :]
        if new:
            self.all = self.all.and_more(tuple(map(request_of, new)))
        return found


def instruction_of(packets: PacketColumns) -> Numbers:
    """Return the instruction code of each packet, such as 0x02 for Read."""
    return np.where(second_of(packets), packets.byte(7), packets.byte(4)).astype(np.int64)


def second_of(packets: PacketColumns) -> Flags:
    """Return which packets have the Protocol 2.0 header.

    A Protocol 1.0 packet of ID 253 cannot have length 0.
    """
    second = packets.length >= len(_HEADER_2)
    for index, byte in enumerate(_HEADER_2):
        second &= packets.byte(index) == byte
    return second


def request_of(data: bytes) -> LoggedRequest:
    """Parse one instruction packet: return the servos that it asks. Only pings and reads count, which
    servos answer at every status return level."""
    second = data.startswith(_HEADER_2)
    servo_id, code = (_byte(data, 4), _byte(data, 7)) if second else (_byte(data, 2), _byte(data, 4))
    if code in (PING, _READ):
        return LoggedRequest() if servo_id == BROADCAST_ID else LoggedRequest((servo_id,))
    if not second:
        return _entries(data[6:-1], 3, 1, fast=False) if code == _BULK_READ else LoggedRequest()
    body = data[8:-2].replace(_STUFFED, _PLAIN)
    fast = code in _FAST
    if code in (_SYNC_READ, _FAST_SYNC_READ):
        sizes = (int.from_bytes(body[2:4], "little"),) * len(body[4:])
        return LoggedRequest(tuple(dict.fromkeys(body[4:])), sizes, fast)
    return _entries(body, 5, 0, fast=fast) if code in (_BULK_READ, _FAST_BULK_READ) else LoggedRequest()


def _entries(body: bytes, width: int, at: int, *, fast: bool) -> LoggedRequest:
    """Parse the body of a bulk read.

    Entries have `width` bytes, the ID at `at`, and the size first or last.
    """
    entries = [body[start : start + width] for start in range(0, len(body) - width + 1, width)]
    sizes = (entry[0] if at else int.from_bytes(entry[3:5], "little") for entry in entries)
    return LoggedRequest(tuple(dict.fromkeys(entry[at] for entry in entries)), tuple(sizes), fast)


def _byte(data: bytes, index: int) -> int:
    return data[index] if index < len(data) else 0
