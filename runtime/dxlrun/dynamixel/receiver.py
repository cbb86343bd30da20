"""Receiver: bytes of one serial line in, intact packets of its protocol out; finds its way through noise.

One preallocated buffer, no growth. Each byte leaves it exactly once: inside an intact packet, or as noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from dxlrun.dynamixel.dialect import Dialect
from dxlrun.dynamixel.port import Port

if TYPE_CHECKING:  # the guardian makes servos limp without numpy
    from dxlrun.dynamixel.burst import Burst

Taker = Callable[[memoryview, int, int], None]
"""Takes bytes with the times (ns) of the read() calls that brought the first and the last of them.

The view is only good during the call.
"""

BurstTaker = Callable[["Burst", list[int], list[int]], bool]
"""Takes whole replies with where each read() ended, and when; False: they are to be taken one by one."""

_GOOD_READ = 765
"""Bytes that one read may bring beside an unfinished packet."""


class Receiver:
    """Takes packets out of a stream; decides on a header only when its whole packet is there.

    A false header in noise can announce up to the protocol's longest packet and so hold back what follows
    it; `flush` ends that when a deadline has passed. Replies that are awaited as a burst are taken as one,
    as long as what arrives looks like them.
    """

    __slots__ = (
        "_beginnings",
        "_buffer",
        "_burst",
        "_end",
        "_ends",
        "_header",
        "_intact",
        "_noise",
        "_packet",
        "_size_at",
        "_taken",
        "_times",
        "_view",
        "buffer",
        "space",
    )

    def __init__(
        self, packet: Taker, noise: Taker, dialect: Dialect, taken: BurstTaker = lambda *_: False
    ) -> None:
        header = dialect.HEADER
        self._header = header
        self._beginnings = tuple(header[:count] for count in range(len(header) - 1, 0, -1))
        self._size_at = dialect.size_at
        self._intact = dialect.intact
        self.buffer = self._buffer = bytearray(dialect.LONGEST + _GOOD_READ)
        """Where replies lie; a burst at its start."""
        self.space = self._view = memoryview(self._buffer)
        """All of it; for who reads himself while nothing is pending."""
        self._end = 0
        self._ends: list[int] = []  # where each read() ended in the buffer; as many as unfinished reads
        self._times: list[int] = []
        self._packet = packet
        self._noise = noise
        self._taken = taken
        self._burst: Burst | None = None

    def expect(self, burst: Burst | None) -> None:
        """Take the next bytes as a whole if they are these replies; call it when nothing is pending."""
        self._burst = burst

    @property
    def room(self) -> int:
        """The most bytes that a burst may have, so that one read() fits behind it."""
        return len(self._buffer) - _GOOD_READ // 3

    @property
    def gathering(self) -> bool:
        """True while what has come can become the burst that is awaited."""
        return self._burst is not None

    @property
    def pending(self) -> int:
        """Number of bytes that are neither packet nor noise yet."""
        return self._end

    def read_from(self, port: Port, now_ns: Callable[[], int]) -> int:
        """Take what the port has, deliver what became whole; return the number of bytes taken.

        Raises PortError when the adapter is gone.
        """
        count = port.read_into(self._view[self._end :] if self._end else self._view)
        if count:
            self.accept(count, now_ns())
        return count

    def feed(self, data: bytes, now_ns: int) -> None:
        """Take bytes that arrived at `now_ns`, deliver what became whole."""
        start = 0
        while start < len(data):
            chunk = data[start : start + min(_GOOD_READ, len(self._view) - self._end)]
            self._view[self._end : self._end + len(chunk)] = chunk
            start += len(chunk)
            self.accept(len(chunk), now_ns)

    def skip_header(self) -> None:
        """Give up the header that is being waited for, as false; what follows it gets its chance."""
        self._scatter()
        if self._end:
            self._forget(self._scan(1))

    def flush(self) -> None:
        """Give up waiting for the rest of an unfinished packet: scan again behind its header."""
        self._scatter()
        while self._end:
            if self._buffer.startswith(self._header, 0, self._end):
                self._forget(self._scan(1))
            else:
                self._emit(self._noise, 0, self._end)
                self._forget(self._end)

    def accept(self, count: int, at_ns: int) -> None:
        """Take bytes that were put into `space`, deliver what became whole."""
        self._end += count
        self._ends.append(self._end)
        self._times.append(at_ns)
        burst = self._burst
        if burst is not None:
            if self._end < burst.size:
                if burst.begun(self._end):
                    return
            elif burst.whole() and self._taken(burst, self._ends, self._times):
                self._forget(burst.size)
            self._burst = None
            if not self._end:
                return
        self._forget(self._scan(0))

    def _scatter(self) -> None:
        """Take what has come of a burst packet by packet."""
        if self._burst is not None:
            self._burst = None
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
        """Deliver what is whole, looking for headers from `search` on; return the start of what is not."""
        buffer, end = self._buffer, self._end
        done = 0  # everything before it was delivered
        while True:
            start = buffer.find(self._header, search, end)
            if start < 0:
                start = self._beginning(search)
                break
            size = self._size_at(buffer, start, end)
            stop = start + size
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
        """Return where the last bytes may be the beginning of a header; their end when they cannot."""
        for beginning in self._beginnings:
            if self._buffer.endswith(beginning, search, self._end):
                return self._end - len(beginning)
        return self._end

    def _forget(self, count: int) -> None:
        """Drop the first `count` bytes."""
        if count == self._end:
            self._end = 0
            self._ends.clear()
            self._times.clear()
        elif count:
            rest = self._end - count
            self._buffer[:rest] = self._buffer[count : self._end]
            while self._ends[0] <= count:
                del self._ends[0], self._times[0]
            for i, end in enumerate(self._ends):
                self._ends[i] = end - count
            self._end = rest
