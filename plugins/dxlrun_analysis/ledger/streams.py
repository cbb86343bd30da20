"""One direction of one bus as a stream of bytes with times, by the log and by the ledger; where they differ.

Packets cannot be compared one by one: a terminal splits and joins what passes it, and what was corrupted on
the way is no packet for one of the two. The bytes in their order are the same for both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.packets import LoggedPacket, PacketKind
from dxlrun.simulation import LedgerEntry

Way = Literal["sent", "received"]
"""Seen from the host: `sent` to the servos, `received` from them."""
WAYS: tuple[Way, ...] = ("sent", "received")

ANCHOR_BYTES = 10
"""So many equal bytes put two streams in step again; no instruction or status packet of a cycle is shorter
than six, and values tell packets of the same form apart."""
_REACH_BYTES = 2048
"""How far ahead an anchor is looked for."""
_EARLIER_NS = 5_000_000
"""A reply has passed the wire at most so long before its host reads it, when neither hangs [i]."""
_COST_NS = 100_000
"""So far apart in time is as bad as one byte that only one of them has [i]."""
_MOST = 1000
"""Differences after which the rest is one: the two have nothing to do with each other."""
_REACH_NS = 1_000_000_000
"""Bytes that are farther apart in time than this are not the same ones, however alike [i]."""
_BLOCK = 1 << 16


@dataclass(frozen=True, slots=True)
class ByteStream:
    """Bytes in their order, in pieces that have one time each."""

    data: bytes
    ends: NDArray[np.int64]
    """Where each piece ends in `data`."""
    times: NDArray[np.int64]
    """ns of the run's clock, of each piece; never falling."""

    def time_at(self, index: int) -> int:
        """Return the time of a byte, ns; of the last one where the stream has ended, 0 where it is empty."""
        if not len(self.ends):
            return 0
        piece = int(np.searchsorted(self.ends, index, side="right"))
        return int(self.times[min(piece, len(self.times) - 1)])

    def first_from(self, t_ns: int) -> int:
        """Return the index of the first byte at or after a time; the length of the stream when none is."""
        piece = int(np.searchsorted(self.times, t_ns, side="left"))
        return int(self.ends[piece - 1]) if piece else 0

    def between(self, begin_ns: int, end_ns: int) -> ByteStream:
        """Return the pieces from `begin_ns` to `end_ns`, both included."""
        first = int(np.searchsorted(self.times, begin_ns, side="left"))
        last = int(np.searchsorted(self.times, end_ns, side="right"))
        start = int(self.ends[first - 1]) if first else 0
        stop = int(self.ends[last - 1]) if last else 0
        return ByteStream(self.data[start:stop], self.ends[first:last] - start, self.times[first:last])


def logged(packets: Sequence[LoggedPacket], way: Way) -> ByteStream:
    """Return what the runtime logged as sent (before each write) or received (after each packet's last read).

    `packets` of one bus, in order of time.
    """
    if way == "sent":
        chosen = [packet for packet in packets if packet.kind == PacketKind.INSTRUCTION]
        return _stream((packet.data, packet.first_ns) for packet in chosen)
    chosen = [packet for packet in packets if packet.kind != PacketKind.INSTRUCTION]
    return _stream((packet.data, packet.last_ns) for packet in chosen)


def seen(entries: Iterable[LedgerEntry], way: Way) -> ByteStream:
    """Return what the simulated bus took from the host or gave to it. `entries` of one bus."""
    direction = "in" if way == "sent" else "out"
    return _stream((entry.data, entry.t_ns) for entry in entries if entry.direction == direction)


def _stream(pieces: Iterable[tuple[bytes, int]]) -> ByteStream:
    data = bytearray()
    ends: list[int] = []
    times: list[int] = []
    for piece, t_ns in pieces:
        data += piece
        ends.append(len(data))
        times.append(t_ns)
    rising = np.maximum.accumulate(np.array(times, np.int64)) if times else np.zeros(0, np.int64)
    return ByteStream(bytes(data), np.array(ends, np.int64), rising)


# Where two streams that should be one differ: the fewest bytes that one of them lacks, in place


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes `log[log_start:log_stop]` stand where the ledger has `ledger[ledger_start:ledger_stop]`."""

    log_start: int
    log_stop: int
    ledger_start: int
    ledger_stop: int


def differing(log: ByteStream, ledger: ByteStream) -> list[Span]:
    """Return where the streams differ, in order; empty when they are the same bytes."""
    spans: list[Span] = []
    at = there = 0
    while True:
        same = _same_from(log.data, at, ledger.data, there)
        at, there = at + same, there + same
        if at == len(log.data) or there == len(ledger.data) or len(spans) == _MOST:
            break
        next_at, next_there = _in_step_again(log, at, ledger, there)
        spans.append(Span(at, next_at, there, next_there))
        at, there = next_at, next_there
    if at < len(log.data) or there < len(ledger.data):
        spans.append(Span(at, len(log.data), there, len(ledger.data)))
    return _joined(spans)


def _same_from(one: bytes, at: int, other: bytes, there: int) -> int:
    """Return how many bytes are the same from here on."""
    most = min(len(one) - at, len(other) - there)
    done = 0
    while done < most:
        size = min(_BLOCK, most - done)
        mine = one[at + done : at + done + size]
        theirs = other[there + done : there + done + size]
        if mine != theirs:
            unequal = np.frombuffer(mine, np.uint8) != np.frombuffer(theirs, np.uint8)
            return done + int(unequal.argmax())
        done += size
    return most


def _in_step_again(log: ByteStream, at: int, ledger: ByteStream, there: int) -> tuple[int, int]:
    """Return the nearest place behind a difference from which both go on alike; their ends if none is."""
    here_ns, there_ns = log.time_at(at), ledger.time_at(there)
    # what lies far behind the other in time can have no partner there: one of them has a hole
    if there_ns < here_ns - _REACH_NS:
        return at, max(there + 1, ledger.first_from(here_ns - _REACH_NS))
    if here_ns < there_ns - _REACH_NS:
        return max(at + 1, log.first_from(there_ns - _REACH_NS)), there
    best = (_REACH_BYTES, -1, -1)
    for skipped in range(min(_REACH_BYTES, len(log.data) - at)):
        if skipped >= best[0]:
            break
        best = min(best, _anchored(log, at + skipped, ledger, there, skipped))
    return best[1:] if best[1] >= 0 else _beyond(log, at, ledger, there)


def _anchored(
    log: ByteStream, here: int, ledger: ByteStream, there: int, skipped: int
) -> tuple[int, int, int]:
    """Return the cost of going on at `here`, and from where in both; a cost beyond reach where none is alike.

    The same request goes out in every cycle, so where its bytes are found is not yet where it is: what was
    at another time costs more.
    """
    anchor = log.data[here : here + ANCHOR_BYTES]
    here_ns = log.time_at(here)
    best = (_REACH_BYTES + 1, -1, -1)
    for start in (there, max(there, ledger.first_from(here_ns - _EARLIER_NS))):
        found = ledger.data.find(anchor, start, start + _REACH_BYTES)
        if found < 0 or (len(anchor) < ANCHOR_BYTES and found + len(anchor) < len(ledger.data)):
            continue
        apart_ns = abs(ledger.time_at(found) - here_ns)
        best = min(best, (skipped + found - there + apart_ns // _COST_NS, here, found))
    return best


def _beyond(log: ByteStream, at: int, ledger: ByteStream, there: int) -> tuple[int, int]:
    """Go on where both are a reach later: nothing nearby is alike."""
    later_ns = max(log.time_at(at), ledger.time_at(there)) + _REACH_NS // 10
    return max(at + 1, log.first_from(later_ns)), max(there + 1, ledger.first_from(later_ns))


def _joined(spans: list[Span]) -> list[Span]:
    """Join differences between which nothing is alike."""
    joined: list[Span] = []
    for span in spans:
        last = joined[-1] if joined else None
        if last and (last.log_stop, last.ledger_stop) == (span.log_start, span.ledger_start):
            joined[-1] = Span(last.log_start, span.log_stop, last.ledger_start, span.ledger_stop)
        else:
            joined.append(span)
    return joined
