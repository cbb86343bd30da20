"""Receiver: extracts intact packets of a protocol from the byte stream of one serial line, despite noise.

One preallocated buffer, no growth. Each byte is delivered exactly once: inside an intact packet, or as
noise."""

from __future__ import annotations

from collections.abc import Callable

from dxlwire.port.ports import Port
from dxlwire.wire.dialect import Dialect

Taker = Callable[[memoryview, int, int], None]
"""Callback for a packet or noise: bytes, and the times (ns) of the read() calls that returned the first
and the last of them. The view is valid only during the call."""

_GOOD_READ = 765  # Bytes that one read may return in addition to an unfinished packet


class Receiver:
    """Extracts packets from the bytes of one line and passes packets and noise to two callbacks; it decides
    on a header only when its whole packet has arrived.

    A false header in noise can announce up to the protocol's longest packet and so hold back the bytes
    after it; `flush` ends that after a deadline."""

    def __init__(self, packet: Taker, noise: Taker, dialect: Dialect) -> None:
        header = dialect.HEADER
        self._header = header
        self._beginnings = tuple(header[:count] for count in range(len(header) - 1, 0, -1))
        self._size_at = dialect.size_at
        self._intact = dialect.intact
        self._buffer = bytearray(dialect.LONGEST + _GOOD_READ)
        self._view = memoryview(self._buffer)
        self.pending = 0  # Number of bytes that are neither packet nor noise yet
        self._ends: list[int] = []  # End of each read() in the buffer, for the bytes that are pending
        self._times: list[int] = []
        self._packet = packet
        self._noise = noise

    def read_from(self, port: Port, now_ns: Callable[[], int]) -> int:
        """Read bytes from the port and deliver the packets that are complete; return the number of bytes
        read.

        Raises:
            PortError: The adapter is gone.
        """
        count = port.read_into(self._view[self.pending :] if self.pending else self._view)
        if count:
            self._accept(count, now_ns())
        return count

    def feed_bytes(self, data: bytes, now_ns: int) -> None:
        """Add bytes that arrived at `now_ns`, and deliver the packets that are complete; keep an
        unfinished packet."""
        start = 0
        while start < len(data):
            chunk = data[start : start + min(_GOOD_READ, len(self._view) - self.pending)]
            self._view[self.pending : self.pending + len(chunk)] = chunk
            start += len(chunk)
            self._accept(len(chunk), now_ns)

    def skip_header(self) -> None:
        """Treat the header of the unfinished packet as noise, and search for packets in the bytes after
        it."""
        if self.pending:
            self._forget(self._scan(1))

    def reset(self) -> None:
        """Drop all pending bytes, after an exception may have interrupted a method."""
        self.pending = 0
        self._ends.clear()
        self._times.clear()

    def flush(self) -> None:
        """Stop waiting for the rest of an unfinished packet: deliver all pending bytes, as later packets
        or as noise."""
        while self.pending:
            if self._buffer.startswith(self._header, 0, self.pending):
                self._forget(self._scan(1))
            else:
                self._emit(self._noise, 0, self.pending)
                self._forget(self.pending)

    def _accept(self, count: int, at_ns: int) -> None:
        self.pending += count
        self._ends.append(self.pending)
        self._times.append(at_ns)
        self._forget(self._scan(0))

    def _emit(self, taker: Taker, start: int, stop: int) -> None:
        times = self._times
        if len(times) == 1:
            taker(self._view[start:stop], times[0], times[0])
            return
        ends = self._ends
        first = next(i for i, end in enumerate(ends) if end > start)
        last = next(i for i, end in enumerate(ends) if end >= stop)
        taker(self._view[start:stop], times[first], times[last])

    def _scan(self, search: int) -> int:
        """Deliver complete packets with headers from `search` on, and noise between them; return the start
        of the remaining bytes."""
        buffer, end = self._buffer, self.pending
        done = 0  # Everything before this index was delivered
        while True:
            start = buffer.find(self._header, search, end)
            if start < 0:
                start = self._beginning(search)
                break
            size = self._size_at(buffer, start, end)
            stop = start + size
            # A false header: the real one may begin at any later byte.
            if size < 0:
                search = start + 1
                continue
            if size == 0 or stop > end:
                break
            if not self._intact(self._view[start:stop]):
                search = start + 1
                continue
            if start > done:
                self._emit(self._noise, done, start)
            self._emit(self._packet, start, stop)
            done = search = stop
        if start > done:
            self._emit(self._noise, done, start)
        return start

    def _beginning(self, search: int) -> int:
        """Return the index at which the last bytes may be the start of a header; without such bytes, the
        end of all bytes."""
        for beginning in self._beginnings:
            if self._buffer.endswith(beginning, search, self.pending):
                return self.pending - len(beginning)
        return self.pending

    def _forget(self, count: int) -> None:
        if count == self.pending:
            self.pending = 0
            self._ends.clear()
            self._times.clear()
        elif count:
            rest = self.pending - count
            self._buffer[:rest] = self._buffer[count : self.pending]
            while self._ends[0] <= count:
                del self._ends[0], self._times[0]
            for i, end in enumerate(self._ends):
                self._ends[i] = end - count
            self.pending = rest
