"""Simulated USB adapter between line and host: when it delivers received bytes to the host, and in which
pieces.

Not modelled: the frames of USB itself (125 us or 1 ms), delays by hubs and other devices, the transfer of
the host's bytes to the line, and modem lines."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence

from dxlsim.bus.simulated_line import LineTransmission
from dxlsim.simulation_plan import AdapterConfig

BURST = 62
"""Bytes that an FTDI chip delivers without waiting for its latency timer: a USB packet of 64 bytes minus
two status bytes (FTDI, AN232B-04, "Data Throughput, Latency and Handshaking")."""

UNREAD_LIMIT = 4096
"""Size (bytes) of the receive buffer for a host that does not read; further bytes are lost, as in the
kernel's terminal buffer."""

_LONGEST_PIECE = 8  # Longest piece with the split `random`, bytes


HandOver = tuple[int, bytes, Sequence[LineTransmission]]
"""One delivery to the host: its planned time (ns), its bytes, and the transmissions that are complete with
it."""


class SimulatedAdapter:
    """Adapter of one simulated line: keeps bytes that have passed the wire until the host receives them."""

    def __init__(self, config: AdapterConfig, start_ns: int) -> None:
        self.timer_ns = config.latency_timer_ns
        self._split = config.split
        self.immediate = config.latency_timer_ns == 0 and config.split == "whole"
        """True if the host receives a transmission at the moment at which it ends on the wire: no latency
        timer, no splitting."""
        self._arrived: deque[LineTransmission] = deque()
        """Transmissions that have ended on the wire and are not fully delivered to the host."""
        self._chance = random.Random(config.seed)
        self._piece = self._next_piece()  # Size of the next piece, bytes
        self._timed_ns = start_ns
        """Time (ns) at which the latency timer last expired, or at which a full burst was sent before
        that."""
        self._burst: deque[HandOver] = deque()  # Pieces of the burst that is being delivered

    def set_timer(self, timer_ns: int, now_ns: int) -> None:
        """Set the latency timer to `timer_ns` (0: none) and restart it at `now_ns`."""
        self.timer_ns, self._timed_ns = timer_ns, now_ns
        self.immediate = timer_ns == 0 and self._split == "whole"

    def accept_transmission(self, new: LineTransmission) -> bool:
        """Store a transmission that has ended on the wire; return False if the buffer is full and the
        bytes are lost."""
        if self._arrived and sum([len(each.data) for each in self._arrived]) + len(new.data) > UNREAD_LIMIT:
            return False
        self._arrived.append(new)
        return True

    def discard_bytes(self) -> None:
        """Discard all bytes that the host has not received."""
        self._arrived.clear()
        self._burst.clear()

    def next_ns(self, passing: Sequence[LineTransmission]) -> int | None:
        """Return the time (ns) of the next delivery to the host if nothing else happens; None without
        bytes. `passing` is still on the wire."""
        if self._burst:
            return self._burst[0][0]
        if not (self._arrived or passing):
            return None
        if self.timer_ns:
            return self._timer_end_ns((*self._arrived, *passing))
        first = self._arrived[0] if self._arrived else passing[0]
        return first.passed_ns(min(len(first.data), first.given + self._piece) - 1)

    def hand_over(self, now_ns: int, passing: Sequence[LineTransmission]) -> list[HandOver]:
        """Return the deliveries to the host that are due by `now_ns`, each once."""
        given: list[HandOver] = []
        # Without a timer a transmission is delivered in the moment in which it leaves the wire.
        if self.immediate and not self._arrived and not self._burst:
            return given
        while (due_ns := self.next_ns(passing)) is not None and due_ns <= now_ns:
            if self._burst:
                given.append(self._burst.popleft())
            elif self.timer_ns:
                self._timed_ns = due_ns
                self._burst.extend(self._pieces(due_ns, self._gather(due_ns, BURST, passing)))
            else:
                first = self._arrived[0] if self._arrived else passing[0]
                most = min(self._piece, len(first.data) - first.given)
                given.append(self._gather(due_ns, most, passing))
                self._piece = self._next_piece()
        return given

    def _timer_end_ns(self, queue: Sequence[LineTransmission]) -> int:
        """Return the time (ns) at which the latency timer expires with a byte waiting, or a full burst is
        complete.

        The timer restarts with each delivery. It also expires with an empty buffer (AN232B-04)."""
        timer_ns = self.timer_ns
        oldest_ns = max(queue[0].passed_ns(queue[0].given), self._timed_ns + 1)
        # The timer is periodic: round up to its next expiry (-(-a // b) is a ceiling division).
        runs_out_ns = self._timed_ns - -(oldest_ns - self._timed_ns) // timer_ns * timer_ns
        missing = BURST
        for each in queue:
            left = len(each.data) - each.given
            if left >= missing:
                return min(runs_out_ns, max(self._timed_ns, each.passed_ns(each.given + missing - 1)))
            missing -= left
        return runs_out_ns

    def _gather(self, now_ns: int, most: int, passing: Sequence[LineTransmission]) -> HandOver:
        """Take up to `most` bytes that have passed the wire, and return them as one delivery."""
        data, ended = b"", []
        for each in (*self._arrived, *passing):
            if each.first_ns >= now_ns:
                continue
            first, end = each.given, min(len(each.data), each.given + most - len(data))
            if each.due_ns > now_ns:
                while end > first and each.passed_ns(end - 1) > now_ns:
                    end -= 1
            each.given = end
            data += each.data[first:end]
            if end == len(each.data):
                ended.append(each)
        while self._arrived and self._arrived[0].given == len(self._arrived[0].data):
            self._arrived.popleft()
        return now_ns, data, ended

    def _pieces(self, due_ns: int, burst: HandOver) -> list[HandOver]:
        """Split a delivery into pieces with pauses of 10 us, long enough for a host to distinguish them
        [i]."""
        if self._split == "whole":
            return [burst]
        _, data, ended = burst
        pieces: list[HandOver] = []
        start = 0
        while start < len(data):
            end = min(len(data), start + self._piece)
            self._piece = self._next_piece()
            planned_ns = due_ns + len(pieces) * 10_000
            pieces.append((planned_ns, data[start:end], ended if end == len(data) else ()))
            start = end
        return pieces

    def _next_piece(self) -> int:
        if self._split == "random":
            return self._chance.randint(1, _LONGEST_PIECE)
        return UNREAD_LIMIT if self._split == "whole" else 1
