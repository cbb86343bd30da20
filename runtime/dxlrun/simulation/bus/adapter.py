"""The USB adapter between line and host: when it hands over what it has heard, and in what pieces.

Not modelled: the frames of USB itself (125 us or 1 ms), what a hub or another device on it costs, the way of
the host's bytes to the line, and modem lines.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from dxlrun.simulation.bus.wire import Chunk
from dxlrun.simulation.configuration import AdapterConfig

BURST = 62
"""Bytes that an FTDI chip hands over without waiting for its timer: a USB packet of 64 bytes less two of
status (FTDI, AN232B-04, "Data Throughput, Latency and Handshaking")."""

UNREAD_LIMIT = 4096
"""Bytes that wait for a host that does not take them; more are lost, as in the kernel's terminal buffer."""

_LONGEST_PIECE = 8
"""Bytes of the longest piece of `random`."""


@dataclass(frozen=True, slots=True)
class HandOver:
    """Bytes for the host."""

    planned_ns: int
    data: bytes
    ended: tuple[Chunk, ...]
    """What the host has now got to its end."""


class Adapter:
    """Holds what has passed the wire until the host gets it."""

    def __init__(self, config: AdapterConfig, start_ns: int) -> None:
        self.config = config
        self.immediate = config.latency_timer_ns == 0 and config.split == "whole"
        """True: what ends on the wire is with the host at that moment."""
        self.arrived: deque[Chunk] = deque()
        """What has passed the wire to its end and is not all handed over."""
        self._chance = random.Random(config.seed)
        self._piece = self._next_piece()
        self._timed_ns = start_ns
        """When the latency timer last ran out, or a burst went before it did."""
        self._burst: deque[HandOver] = deque()
        """Pieces of what the timer let go."""

    @property
    def holds(self) -> bool:
        """True when something has arrived that the host has not got."""
        return bool(self.arrived or self._burst)

    def accept(self, chunk: Chunk) -> bool:
        """Take what has passed the wire; False: there is no room for it."""
        if self.arrived and sum(len(each.data) for each in self.arrived) + len(chunk.data) > UNREAD_LIMIT:
            return False
        self.arrived.append(chunk)
        return True

    def give_all(self) -> Sequence[Chunk]:
        """Return all that has passed the wire, as an adapter without timer and pieces gives it."""
        given = tuple(self.arrived)
        self.arrived.clear()
        return given

    def forget(self) -> None:
        """Lose everything that the host has not got."""
        self.arrived.clear()
        self._burst.clear()

    def next_ns(self, passing: Sequence[Chunk]) -> int | None:
        """Return when the next bytes are handed over, were nothing to disturb them; None: never."""
        if self.immediate:
            first = self.arrived or passing
            return first[0].due_ns if first else None
        if self._burst:
            return self._burst[0].planned_ns
        queue = (*self.arrived, *passing)
        if not queue:
            return None
        if self.config.latency_timer_ns:
            return self._timer_ns(queue)
        return queue[0].passed_ns(min(len(queue[0].data), queue[0].given + self._piece) - 1)

    def hand_over(self, now_ns: int, passing: Sequence[Chunk]) -> HandOver | None:
        """Return what the host gets next by timer and pieces, None when that is after `now_ns`."""
        due_ns = self.next_ns(passing)
        if due_ns is None or due_ns > now_ns:
            return None
        if self._burst:
            return self._burst.popleft()
        if self.config.latency_timer_ns:
            self._timed_ns = due_ns
            self._burst.extend(self._pieces(due_ns, self._gather(due_ns, BURST, passing)))
            return self._burst.popleft()
        gathered = self._gather(due_ns, self._piece, passing[:0] if self.arrived else passing)
        self._piece = self._next_piece()
        return gathered

    def _timer_ns(self, queue: Sequence[Chunk]) -> int:
        """Return when the timer runs out with a byte there, or so many are there that it does not count.

        It starts anew with each hand-over and runs out with nothing to give, too (AN232B-04).
        """
        timer_ns = self.config.latency_timer_ns
        oldest_ns = max(queue[0].passed_ns(queue[0].given), self._timed_ns + 1)
        runs_out_ns = self._timed_ns - -(oldest_ns - self._timed_ns) // timer_ns * timer_ns
        missing = BURST
        for chunk in queue:
            left = len(chunk.data) - chunk.given
            if left >= missing:
                return min(runs_out_ns, max(self._timed_ns, chunk.passed_ns(chunk.given + missing - 1)))
            missing -= left
        return runs_out_ns

    def _gather(self, now_ns: int, most: int, passing: Sequence[Chunk]) -> HandOver:
        """Take up to so many bytes that have passed the wire."""
        data = bytearray()
        ended = []
        for chunk in (*self.arrived, *passing):
            first = chunk.given
            while chunk.given < len(chunk.data) and len(data) + chunk.given - first < most:
                if chunk.passed_ns(chunk.given) > now_ns:
                    break
                chunk.given += 1
            data += chunk.data[first : chunk.given]
            if chunk.given == len(chunk.data):
                ended.append(chunk)
        while self.arrived and self.arrived[0].given == len(self.arrived[0].data):
            self.arrived.popleft()
        return HandOver(now_ns, bytes(data), tuple(ended))

    def _pieces(self, due_ns: int, burst: HandOver) -> list[HandOver]:
        """Return a burst in pieces, so far from each other that a host can tell them apart [i]."""
        if self.config.split == "whole":
            return [burst]
        pieces: list[HandOver] = []
        start = 0
        while start < len(burst.data):
            end = min(len(burst.data), start + self._piece)
            self._piece = self._next_piece()
            ended = burst.ended if end == len(burst.data) else ()
            pieces.append(HandOver(due_ns + len(pieces) * 10_000, burst.data[start:end], ended))
            start = end
        return pieces

    def _next_piece(self) -> int:
        match self.config.split:
            case "whole":
                return UNREAD_LIMIT
            case "byte":
                return 1
            case "random":
                return self._chance.randint(1, _LONGEST_PIECE)
