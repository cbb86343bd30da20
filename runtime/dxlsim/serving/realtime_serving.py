"""Real time: requests priority and core for the process of the simulated buses, and decides between
sleeping and polling for punctual wake-ups."""

from __future__ import annotations

import ctypes
import gc
import os

_PR_SET_TIMERSLACK = 29  # linux/prctl.h

LONGEST_POLL_NS = 50_000
"""Longest polling of the clock before a reply is due, ns: a sleep wakes some 30 us late on a stock kernel."""
_POLL_SHARE = 6
"""Polling is limited to one part in this many of the time by which the process waits longer than it works."""
_BUDGET_NS = 20_000_000
_PAUSE_NS = 100_000
"""Shortest sleep while polling is not allowed, ns; everything that becomes due during the sleep is sent
together."""


def prepare_process(priority: int, core: int) -> str:
    """Request a real-time priority and a core for this process; return a text about what was granted.

    Never raises: a simulation without real time still works, and its ledger shows the lateness.

    Args:
        priority: Priority for SCHED_FIFO, 1 to 99; 0: none.
        core: Core to run on; -1: any.
    """
    # Objects from the start-up are excluded from garbage collection, which would delay replies.
    gc.collect()
    gc.freeze()
    # 1 ns of timer slack; the default of 50 us would delay every wake-up.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    return f"{_take_core(core)}, {_take_priority(priority)}"


def _take_core(core: int) -> str:
    allowed = os.sched_getaffinity(0)
    if core < 0:
        return "no dedicated core was requested"
    if len(allowed) < 2:
        return "no dedicated core: only one core is allowed"
    if core not in allowed:
        return f"no dedicated core: core {core} is not allowed"
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        return f"no dedicated core: {error.strerror}"
    return f"core {core}"


def _take_priority(priority: int) -> str:
    if priority <= 0:
        return "no real-time priority was requested"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        return f"no real-time priority {priority}: {reason}; `dxlrun doctor` shows how to allow it"
    return f"real-time priority {priority}"


class PollBudget:
    """Decides how long a server sleeps before an event, and when it polls the clock instead.

    Polling is punctual but uses the processor. It is limited to a sixth of the time, and a process that
    works half of the time does not poll at all. Without polling, replies are delivered slightly late,
    several at once."""

    def __init__(self, now_ns: int) -> None:
        self._budget_ns = _BUDGET_NS
        self._asked_ns = self._woken_ns = now_ns
        self._polls = False

    def sleep_s(self, due_ns: int | None, now_ns: int, easy_ns: int | None = None) -> float | None:
        """Return the time to sleep before the next event, s; 0: poll the clock; None: sleep until a host
        writes.

        Args:
            due_ns: Time of the next punctual event; None: no event.
            now_ns: Current time.
            easy_ns: Time of the next event that need not be punctual.
        """
        self._asked_ns = now_ns
        worked_ns = now_ns - self._woken_ns
        self._budget_ns = max(-_BUDGET_NS, self._budget_ns - worked_ns // _POLL_SHARE)
        self._polls = False
        if easy_ns is not None and (due_ns is None or easy_ns < due_ns - LONGEST_POLL_NS):
            return max(0.0, (easy_ns - now_ns) * 1e-9)
        if due_ns is None:
            return None
        left_ns = due_ns - now_ns
        if left_ns > LONGEST_POLL_NS:
            return (left_ns - (LONGEST_POLL_NS if self._budget_ns > 0 else 0)) * 1e-9
        self._polls = self._budget_ns > 0
        return 0.0 if self._polls or left_ns <= 0 else _PAUSE_NS * 1e-9

    def woke(self, now_ns: int) -> None:
        """Charge the time since the last `sleep_s` to the budget; call it after each sleep or polling."""
        self._woken_ns = now_ns
        waited_ns = now_ns - self._asked_ns
        spent_ns = waited_ns if self._polls else 0
        self._budget_ns = min(_BUDGET_NS, self._budget_ns + waited_ns // _POLL_SHARE - spent_ns)
