"""Bus messages: packs the packets of a bus into messages of `/bus/NAME`, and reads them back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.logged_packets import BatchedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun.log.schemas import BUS_PACKETS
from dxlrun.messages.cdr import Codec
from dxlrun.messages.cdr_columns import ColumnReader, FieldColumn
from dxlwire.packets import PacketKind

_CODEC, _READER = Codec(BUS_PACKETS), ColumnReader(BUS_PACKETS)
_FIELDS = ("cycle_delta", "first_ns_delta", "duration_ns", "kind", "servo_id", "length", "data")
"""Fields of the message, one element per packet; `data` has the bytes of all packets."""


def pack_packets(packets: Sequence[BatchedPacket]) -> bytes:
    """Pack packets of one bus into one encoded message; times and cycles are stored as differences."""
    cycle, _, kind, servo_id, first_ns, last_ns, data = zip(*packets, strict=True)
    first = np.array(first_ns, np.int64)
    took = np.array(last_ns, np.int64) - first
    length = np.array([len(one) for one in data], np.uint16)
    # Differences repeat, so they compress to a fifth of the size of absolute times and cycles.
    steps = (np.diff(np.array(each, np.int64), prepend=np.int64(0)) for each in (cycle, first))
    return _CODEC.pack(*steps, took, bytes(kind), bytes(servo_id), length, b"".join(data))


def read_packets(
    data: NDArray[np.uint8],
    bus: NDArray[np.uint8],
    start: NDArray[np.int64],
    size: NDArray[np.int64],
) -> tuple[PacketColumns, int]:
    """Return the packets of all bus messages in `data`, and how many messages were skipped as damaged.

    Args:
        data: Bytes that contain the messages.
        bus: Index into the log's buses, for each message.
        start: Index of each message's encapsulation header.
        size: Length of each message, bytes.
    """
    try:
        whole, tree = _READER.read_columns(data, start, size)
    # None of them is a valid message.
    except ValueError:
        return PacketColumns.from_packets(()), len(start)
    good = _consistent(tree)
    if not good.all():
        whole, tree = whole[good], tree.select_rows(np.flatnonzero(good))
    cycle, first, took_ns, kind, servo_id, length, bodies = (tree.leaf(name).flat[1] for name in _FIELDS)
    count, size = tree.leaf("kind").flat[0], length.astype(np.int64)
    first_ns = _summed_up(count, first)
    packets = PacketColumns(
        cycle=_summed_up(count, cycle),
        bus=np.repeat(bus[whole], count),
        kind=kind.astype(np.uint8, copy=False),
        servo_id=servo_id.astype(np.uint8, copy=False),
        first_ns=first_ns,
        last_ns=first_ns + took_ns.astype(np.int64, copy=False),
        start=np.cumsum(size) - size,
        length=size,
        data=bodies.astype(np.uint8, copy=False),
    )
    return packets, len(start) - len(whole)


def _consistent(tree: FieldColumn) -> NDArray[np.bool_]:
    """Return which messages are consistent: equal field lengths, known packet kinds, enough bytes."""
    *counts, bytes_each = (tree.leaf(name).flat[0] for name in _FIELDS)
    good = np.all([one == counts[0] for one in counts], axis=0)
    kinds, lengths = (tree.leaf(name).flat for name in ("kind", "length"))
    odd = ~np.isin(kinds[1], list(PacketKind))
    found: NDArray[np.bool_] = good & (_sums(kinds[0], odd) == 0) & (_sums(*lengths) == bytes_each)
    return found


def _summed_up(count: NDArray[np.int64], deltas: NDArray[np.generic]) -> NDArray[np.int64]:
    """Add up differences separately for each message; `count` has the number of differences in each."""
    sums = np.cumsum(deltas.astype(np.int64, copy=False))
    before = np.concatenate([[0], sums])[np.cumsum(count) - count]
    found: NDArray[np.int64] = sums - np.repeat(before, count)
    return found


def _sums(count: NDArray[np.int64], values: NDArray[np.generic]) -> NDArray[np.number]:
    """Return the sum of each message's values; `count` has the number of values in each."""
    return np.bincount(np.repeat(np.arange(len(count)), count), values, len(count))
