"""Messages of `/bus/NAME`: the packets of a bus in one cycle, as arrays; packing, and reading as columns.

Layout: CDR (see messages/cdr.py) of dxlrun_msgs/msg/BusPackets.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from operator import sub

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.packets import BatchedPacket, PacketKind
from dxlrun.log.columns import PacketColumns, numbers
from dxlrun.messages.cdr import ENCAPSULATION

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

_HEAD = len(ENCAPSULATION)
_TIMES_AT = 16
"""Where the first array of times begins, behind cycle and length."""


@lru_cache(maxsize=256)
def _layout(count: int) -> struct.Struct:
    """Return the layout of a message of so many packets, up to the length of its data."""
    times = f"I4x{count}q"
    small = f"I{count}B{-count % 4}x"
    return struct.Struct(f"<4sq{times}{times}{small}{small}I{count}H{2 * count % 4}xI")


def pack_packets(packets: Sequence[BatchedPacket]) -> bytes:
    """Return the message of one cycle's packets on one bus, at least one."""
    cycle, _, kind, servo_id, first_ns, last_ns, data = zip(*packets, strict=True)
    count = len(packets)
    duration_ns = map(sub, last_ns, first_ns)  # most are short: compressed, they take half of what times do
    lengths = [len(one) for one in data]
    head = _layout(count).pack(
        ENCAPSULATION, cycle[0], count, *first_ns, count, *duration_ns, count, *kind, count, *servo_id,
        count, *lengths, sum(lengths),
    )  # fmt: skip
    return b"".join((head, *data))


def _aligned(at: Indices) -> Indices:
    return (at + 3) & ~3


def read_packets(data: Bytes, bus: Bytes, start: Indices, size: Indices) -> tuple[PacketColumns, int]:
    """Return the packets of messages that lie in `data`, and how many are not what their definition says.

    `bus`: index in the log's buses; `start`: of each message's encapsulation header; `size`: its bytes.
    """
    body, size = start + _HEAD, size - _HEAD
    good = size >= _TIMES_AT
    count = np.zeros(len(body), np.int64)
    count[good] = numbers(data, body[good] + 8, "<u4")
    empty = count == 0  # without elements nothing is aligned to 8 bytes: it ends elsewhere, and has nothing
    duration_at = 24 + 8 * count
    kind_at = duration_at + 8 * count + 4
    servo_at = _aligned(kind_at + count) + 4
    length_at = _aligned(servo_at + count) + 4
    data_at = _aligned(length_at + 2 * count) + 4

    def without(good: NDArray[np.bool_], lost: int) -> tuple[PacketColumns, int]:
        """Read these messages only; the others are wrong, or have nothing."""
        rows = np.flatnonzero(good)
        packets, wrong = read_packets(data, bus[rows], start[rows], size[rows] + _HEAD)
        return packets, wrong + lost

    good &= ~empty & (data_at <= size)
    lost = int(np.count_nonzero(~good & ~(empty & (size >= _TIMES_AT))))
    if not good.all():
        return without(good, lost)
    total = numbers(data, body + data_at - 4, "<u4")
    good = data_at + total <= size
    for at in (duration_at - 8, kind_at - 4, servo_at - 4, length_at - 4):
        good &= numbers(data, body + at, "<u4") == count
    if not good.all():
        return without(good, int(np.count_nonzero(~good)))

    message = np.repeat(np.arange(len(body)), count)
    before = np.cumsum(count) - count
    within = np.arange(len(message)) - before[message]
    length = numbers(data, (body + length_at)[message] + 2 * within, "<u2")
    kind = data[(body + kind_at)[message] + within]
    if len(message):
        good = np.add.reduceat(length, before) == total
        good &= np.add.reduceat((kind < min(PacketKind)) | (kind > max(PacketKind)), before) == 0
        if not good.all():
            return without(good, int(np.count_nonzero(~good)))
    first_ns = numbers(data, (body + _TIMES_AT)[message] + 8 * within, "<i8")
    begin = body + data_at
    view = data.data
    bodies = [view[a:b] for a, b in zip(begin.tolist(), (begin + total).tolist(), strict=True)]
    packets = PacketColumns(
        cycle=numbers(data, body, "<i8")[message],
        bus=bus[message],
        kind=kind,
        servo_id=data[(body + servo_at)[message] + within],
        first_ns=first_ns,
        last_ns=first_ns + numbers(data, (body + duration_at)[message] + 8 * within, "<i8"),
        start=np.cumsum(length) - length,
        length=length,
        data=np.frombuffer(b"".join(bodies), np.uint8),
    )
    return packets, 0
