"""Awaited replies: asleep until shortly before they are due by the plan, then polled for without blocking.

Waking a process that blocks costs some 50 us on a stock kernel, of each reply. The plan knows when a reply is
due, so the time until then can be slept away, as before a deadline, and the rest of it polled. What is polled
is credit: a share of the time that passes, so that no more than that share of a core is ever spent on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

AUTO_SHARE = 0.1
"""Without a word in the file, no more of a core is spent on polling for replies."""
MOST_SHARE = 0.5
"""Whatever the file says, half of a core is left to others."""
_SAVED_NS = 50_000_000
"""So much unpolled time counts at most; what was saved in a pause is not spent at once."""
_LEAST_NAP_NS = 15_000
"""A shorter sleep is not worth its two system calls."""
_USUAL_MARGIN_NS = 60_000
_LONGEST_NS = 1_000_000
"""A reply is polled for at most so long, if the file does not say it: beyond that it is late, or lost."""
_EARLIEST_NS = -2_000_000
_LATEST_NS = 20_000_000


def _sleep(duration_ns: int) -> int:
    """Sleep; return the time after that, ns."""
    time.sleep(duration_ns * 1e-9)
    return time.monotonic_ns()


class ReplyPolling:
    """How long the next reply is slept for, and how long it is polled for, on all lines together.

    Replies keep a distance from when the plan expects them: servos may answer sooner than their return delay
    says, adapters later. It is followed, quickly toward sooner and slowly toward later, because too long a
    sleep costs time and too short a one only credit.
    """

    __slots__ = (
        "_credit_ns",
        "_late_ns",
        "_longest_ns",
        "_nap",
        "_share",
        "_slept",
        "_step_ns",
        "_updated_ns",
        "margin_ns",
    )

    def __init__(
        self,
        longest_ns: int | None = None,
        share: float | None = None,
        nap: Callable[[int], int] = _sleep,
    ) -> None:
        """`longest_ns`: of polling for one reply; None: as usual. `share`: of a core; None: by `longest_ns`.

        `nap` sleeps for so many ns and returns the time then.
        """
        self._nap = nap
        self._longest_ns = _LONGEST_NS if longest_ns is None else longest_ns
        if share is None:
            share = AUTO_SHARE if longest_ns is None else MOST_SHARE
        self._share = share
        self._credit_ns = 0.0
        self._updated_ns: int | None = None
        self._late_ns = 0
        self._slept = False
        self._step_ns = _USUAL_MARGIN_NS
        self.margin_ns = _USUAL_MARGIN_NS
        """How long before a reply is expected sleeping ends; as sleeps were measured to overshoot."""

    def await_until(self, due_ns: int, now_ns: int, deadline_ns: int) -> int:
        """Sleep until shortly before a reply that is due at `due_ns`; return until when to poll for it.

        Never beyond `deadline_ns`. 0 where there is no credit, and then nothing was slept.
        """
        self._slept = False
        passed_ns = 0 if self._updated_ns is None else now_ns - self._updated_ns
        self._credit_ns = min(self._credit_ns + self._share * passed_ns, _SAVED_NS)
        self._updated_ns = now_ns
        expected_ns = due_ns + self._late_ns
        most_ns = min(self._longest_ns, int(self._credit_ns))
        until_ns = expected_ns - self.margin_ns + self._longest_ns
        if most_ns < self.margin_ns or until_ns <= now_ns or expected_ns >= deadline_ns:
            return 0
        nap_ns = expected_ns - self.margin_ns - now_ns
        if nap_ns >= _LEAST_NAP_NS:
            now_ns = self._nap(nap_ns)
            self._slept = True
        return min(until_ns, now_ns + most_ns, deadline_ns)

    def spent(self, duration_ns: int, looks: int) -> None:
        """Take note of how long was polled, and how often."""
        self._credit_ns -= duration_ns
        self._slept = self._slept and looks == 1

    def came(self, due_ns: int, at_ns: int) -> None:
        """Take note that all of the replies that were due at `due_ns` were there at `at_ns`."""
        late_ns = at_ns - due_ns
        if self._slept and late_ns >= self._late_ns - self.margin_ns:
            # they were there before: since when, nobody knows, so sleep less and less until it is seen
            late_ns = self._late_ns - self._step_ns
            self._step_ns *= 2
        else:
            self._step_ns = self.margin_ns
            change_ns = late_ns - self._late_ns
            # one that is very late says nothing of the next
            late_ns = self._late_ns + (
                change_ns // 2 if change_ns < 0 else min(change_ns, self.margin_ns) // 8
            )
        self._late_ns = max(_EARLIEST_NS, min(late_ns, _LATEST_NS))
