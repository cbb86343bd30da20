"""Real time: requests priority and core for the process of the simulated buses."""

from __future__ import annotations

import ctypes
import gc
import os

_PR_SET_TIMERSLACK = 29  # linux/prctl.h


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
