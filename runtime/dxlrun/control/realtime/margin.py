"""Margin: how long before a deadline the clock is polled instead of slept away; measured, and bounded."""

from __future__ import annotations

import time
from collections.abc import Callable

from dxlrun.clock import MonotonicClock
from dxlrun.control.loop_plan import MOST_SHARE
from dxlrun.control.realtime.grants import Grant

AUTO_SHARE = 10
"""Without a word in the file, at most one part in so many of the period is polled."""
_TRIES = 32
_NAP_NS = 2_000_000
"""All tries together take 64 ms; longer sleeps overshoot more, which _RESERVE is for."""
_QUANTILE = 0.95
_RESERVE = 1.5
"""Sleeps of 20 ms overshoot 1.4 times as much as those of 2 ms [measured, round_robin, x86-64]."""


def overshoot_ns(nap_ns: int) -> int:
    """Return how late a sleep of so many ns wakes, ns."""
    deadline_ns = time.monotonic_ns() + nap_ns
    time.sleep(nap_ns * 1e-9)
    return time.monotonic_ns() - deadline_ns


class Pacing:
    """Sets a clock's margin to what was measured once, bounded by the file's wish and by the period."""

    def __init__(self, clock: MonotonicClock, most_ns: int | None) -> None:
        self._clock = clock
        self._most_ns = most_ns
        self.wanted_ns = clock.spin_ns
        """The margin that was measured, without the bounds."""

    def measure(
        self, period_ns: int, beat: Callable[[], None], nap: Callable[[int], int] = overshoot_ns
    ) -> Grant:
        """Sleep a few times, set the margin for a period, and tell what it is; `beat` is called between.

        The margin covers 19 of 20 sleeps and half as much again.
        """
        late: list[int] = []
        for _ in range(_TRIES):
            late.append(nap(min(_NAP_NS, period_ns)))
            beat()
        usual_ns = sorted(late)[int(_QUANTILE * _TRIES)]
        self.wanted_ns = round(_RESERVE * usual_ns)
        self(period_ns)
        margin_ns = self._clock.spin_ns
        return Grant(
            "polling",
            True,
            f"polls the clock for {margin_ns / 1e3:.0f} us before each deadline, {margin_ns / period_ns:.1%} "
            f"of a core; 19 of 20 sleeps woke at most {usual_ns / 1e3:.0f} us late"
            + ("" if margin_ns >= usual_ns else ", so that some cycles begin late"),
        )

    def __call__(self, period_ns: int) -> None:
        """Keep the margin within its share of another period, ns."""
        most_ns = period_ns // AUTO_SHARE if self._most_ns is None else self._most_ns
        self._clock.spin_ns = min(self.wanted_ns, most_ns, period_ns // MOST_SHARE)
