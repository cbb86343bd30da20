"""Messages of `/bus/NAME`: the packets of a bus in one cycle, as arrays; packing, and reading as columns.

Layout: CDR (see messages/cdr.py) of dxlrun_msgs/msg/BusPackets, and, in logs of formats 3 and 4, of
dxlrun_msgs/msg/BusPacket: int64 first_ns, int64 last_ns, uint8 kind, uint8 servo_id, uint8[] data.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import sub

import numpy as np
from numpy.typing import NDArray

from dxlrun.log.columns import PacketColumns, numbers
from dxlrun.messages.cdr import ENCAPSULATION
from dxlrun.run.channels.packets import BEFORE_FIRST_CYCLE, BatchedPacket, PacketKind

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

_HEAD = len(ENCAPSULATION)
_TIMES_AT = 16
"""Where the first array of times begins, behind cycle and length."""
_OLD_DATA_AT = 24


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


@dataclass(frozen=True, slots=True)
class BusMessages:
    """Where messages of one bus lie in a run of bytes."""

    bus: int
    """Index in the log's buses."""
    start: Indices
    """Of each message's encapsulation header."""
    size: Indices
    """Bytes of each message."""
    single: bool = False
    """Each is one packet: a log of format 3 or 4."""


@dataclass(frozen=True, slots=True)
class FoundPackets:
    """Packets of messages, and how many messages were not what their definition says."""

    packets: PacketColumns
    wrong: int


def read_packets(data: Bytes, messages: BusMessages) -> FoundPackets:
    """Return the packets of messages that lie in `data`; their bytes stay there."""
    return _read_single(data, messages) if messages.single else _read_many(data, messages)


def _aligned(at: Indices) -> Indices:
    return (at + 3) & ~3


def _read_many(data: Bytes, messages: BusMessages) -> FoundPackets:
    body, size = messages.start + _HEAD, messages.size - _HEAD
    fits = size >= _TIMES_AT
    body, size = body[fits], size[fits]
    wrong = len(fits) - len(body)
    count = numbers(data, body + 8, "<u4")
    duration_at = 24 + 8 * count
    kind_at = duration_at + 8 * count + 4
    servo_at = _aligned(kind_at + count) + 4
    length_at = _aligned(servo_at + count) + 4
    data_at = _aligned(length_at + 2 * count) + 4
    empty = count == 0  # without elements nothing is aligned to 8 bytes: it ends elsewhere, and has nothing
    good = ~empty & (data_at <= size)
    wrong += int(np.count_nonzero(~empty & ~good))
    body, size, count = body[good], size[good], count[good]
    duration_at, kind_at, servo_at = duration_at[good], kind_at[good], servo_at[good]
    length_at, data_at = length_at[good], data_at[good]
    good = np.ones(len(body), np.bool_)
    for at in (duration_at - 8, kind_at - 4, servo_at - 4, length_at - 4):
        good &= numbers(data, body + at, "<u4") == count
    total = numbers(data, body + data_at - 4, "<u4")
    good &= data_at + total <= size
    wrong += int(np.count_nonzero(~good))
    keep = np.flatnonzero(good)
    body, count, total = body[keep], count[keep], total[keep]
    duration_at, kind_at, servo_at = duration_at[keep], kind_at[keep], servo_at[keep]
    length_at, data_at = length_at[keep], data_at[keep]

    message = np.repeat(np.arange(len(keep)), count)
    before = np.cumsum(count) - count
    within = np.arange(len(message)) - before[message]
    length = numbers(data, (body + length_at)[message] + 2 * within, "<u2")
    behind = np.cumsum(length)
    offset = behind - length
    first = offset[before] if len(before) else offset[:0]
    held = behind[before + count - 1] - first if len(before) else total
    kind = data[(body + kind_at)[message] + within]
    bad = held != total
    if len(message):
        bad |= np.add.reduceat((kind < min(PacketKind)) | (kind > max(PacketKind)), before) > 0
    first_ns = numbers(data, (body + _TIMES_AT)[message] + 8 * within, "<i8")
    packets = PacketColumns(
        cycle=numbers(data, body, "<i8")[message],
        bus=np.full(len(message), messages.bus, np.uint8),
        kind=kind,
        servo_id=data[(body + servo_at)[message] + within],
        first_ns=first_ns,
        last_ns=first_ns + numbers(data, (body + duration_at)[message] + 8 * within, "<i8"),
        start=(body + data_at - first)[message] + offset,
        length=length,
        data=data,
    )
    if bad.any():
        packets = packets.take(~bad[message])
    return FoundPackets(packets, wrong + int(np.count_nonzero(bad)))


def _read_single(data: Bytes, messages: BusMessages) -> FoundPackets:
    body, size = messages.start + _HEAD, messages.size - _HEAD
    fits = size >= _OLD_DATA_AT
    wrong = len(fits) - int(np.count_nonzero(fits))
    body, size = body[fits], size[fits]
    length = numbers(data, body + _OLD_DATA_AT - 4, "<u4")
    kind = data[body + 16]
    packets = PacketColumns(
        cycle=np.full(len(body), BEFORE_FIRST_CYCLE, np.int64),
        bus=np.full(len(body), messages.bus, np.uint8),
        kind=kind,
        servo_id=data[body + 17],
        first_ns=numbers(data, body, "<i8"),
        last_ns=numbers(data, body + 8, "<i8"),
        start=body + _OLD_DATA_AT,
        length=length,
        data=data,
    )
    good = (length <= size - _OLD_DATA_AT) & (kind >= min(PacketKind)) & (kind <= max(PacketKind))
    if not good.all():
        packets = packets.take(good)
    return FoundPackets(packets, wrong + int(np.count_nonzero(~good)))
