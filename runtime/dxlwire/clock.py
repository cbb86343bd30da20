"""Clocks: the machine's monotonic time, and virtual time for simulated runs, with one interface."""

from __future__ import annotations

import heapq
import itertools
import time
from array import array
from collections.abc import Callable
from typing import Protocol

NEVER_NS = 1 << 62


class Clock(Protocol):
    """Time source of a run: loop, hardware, recorder and buses use it. All times are integers of
    nanoseconds."""

    def now_ns(self) -> int:
        """Return the current time, ns. The origin is arbitrary; the time never jumps."""
        ...

    def wait_until(self, deadline_ns: int) -> int:
        """Wait until `deadline_ns` and return the time after the wake-up, ns, which is never earlier than
        the deadline."""
        ...


class MonotonicClock:
    """Clock of the machine, CLOCK_MONOTONIC. A wait sleeps until shortly before the deadline, then polls the
    clock.

    A sleep alone wakes some 50-100 us late on a stock Linux. Polling for the last `spin_ns` avoids that
    and costs `spin_ns / period` of one core."""

    __slots__ = ("spin_ns",)

    def __init__(self, spin_ns: int = 100_000) -> None:
        self.spin_ns = spin_ns

    now_ns = staticmethod(time.monotonic_ns)
    """Return CLOCK_MONOTONIC, ns. This is the function itself, because the loop calls it some hundred times a
    cycle."""

    def wait_until(self, deadline_ns: int) -> int:
        """Sleep until `spin_ns` before the deadline, then poll; return the time after the wake-up, ns."""
        now = time.monotonic_ns()
        nap = deadline_ns - self.spin_ns - now
        if nap > 0:
            time.sleep(nap * 1e-9)
        while now < deadline_ns:
            now = time.monotonic_ns()
        return now


class VirtualClock:
    """Simulated clock that advances only in `wait_until`; two runs from one seed have the same times."""

    __slots__ = ("_calls", "_order", "_overridden", "state")

    def __init__(self, start_ns: int = 0) -> None:
        self._overridden = type(self).wait_until is not VirtualClock.wait_until
        self.state = array("q", (start_ns, 0 if self._overridden else NEVER_NS))
        """For compiled code: the time, which it may advance up to the second number, that of the next
        scheduled call."""
        self._calls: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def now_ns(self) -> int:
        """Return virtual time, ns."""
        return self.state[0]

    def wait_until(self, deadline_ns: int) -> int:
        """Advance virtual time to the deadline if it is in the future, and make the scheduled calls that
        are due; return the time, ns."""
        state = self.state
        while self._calls and self._calls[0][0] <= deadline_ns:
            due_ns, _, action = heapq.heappop(self._calls)
            self._note_next_call()
            state[0] = max(state[0], due_ns)
            action()
        state[0] = max(state[0], deadline_ns)
        return state[0]

    def _note_next_call(self) -> None:
        """Note until when compiled code may advance the time; never if a subclass waits in another way."""
        if not self._overridden:
            self.state[1] = self._calls[0][0] if self._calls else NEVER_NS

    def call_at(self, t_ns: int, action: Callable[[], None]) -> None:
        """Schedule a call at a virtual time, ns, even in the middle of a wait. The action itself must not
        wait."""
        heapq.heappush(self._calls, (t_ns, next(self._order), action))
        self._note_next_call()
