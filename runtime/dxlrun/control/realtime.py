"""Real time: asks the operating system for what the plan wishes, and says plainly what it did not get."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from dxlrun.control.loop_plan import Policy, SchedulerPlan

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # asm-generic/mman.h
_CAP_IPC_LOCK = 14  # linux/capability.h
_TASKS = Path("/proc/self/task")
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True, slots=True)
class Grant:
    """One wish to the operating system, and what became of it."""

    wish: str
    """collector, timer slack, locked memory, scheduler"""
    granted: bool
    sentence: str
    """For a person; says what to do where something was refused."""


def apply(plan: SchedulerPlan) -> tuple[Grant, ...]:
    """Prepare the calling thread for the loop; never raises.

    Order matters: what allocates comes first, the policy last, so that nothing slow runs with priority.
    """
    return (
        freeze_collector(),
        _attempt("timer slack", _timer_slack),
        *((_attempt("locked memory", _lock_memory),) if plan.lock_memory else ()),
        *((set_policy(plan.policy, plan.priority),) if plan.policy != "other" else ()),
    )


def freeze_collector() -> Grant:
    """Collect garbage once, take what is left out of every later search, and switch the collector off.

    The loop makes no cycles of references, so nothing piles up; a collection takes milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return Grant("collector", True, "the garbage collector is frozen and off")


def set_policy(policy: Policy, priority: int) -> Grant:
    """Give the calling thread a real-time policy; a child process does not inherit it; never raises."""
    return _attempt("scheduler", lambda: _set_policy(policy, priority))


def thread_count() -> int:
    """Return the number of threads of this process; 1 where the system does not tell."""
    try:
        return sum(1 for _ in _TASKS.iterdir())
    except OSError:
        return 1


def _attempt(wish: str, act: Callable[[], Grant]) -> Grant:
    """Return what became of a wish; whatever goes wrong is a refusal, because a robot runs without it too."""
    try:
        return act()
    except (AttributeError, OSError, ValueError) as error:
        return Grant(wish, False, f"{wish}: this system does not offer it ({error})")


def _set_policy(policy: Policy, priority: int) -> Grant:
    if policy == "other":
        return Grant("scheduler", True, "the ordinary scheduler was asked for")
    wished = os.SCHED_FIFO if policy == "fifo" else os.SCHED_RR
    try:
        os.sched_setscheduler(0, wished | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return Grant(
            "scheduler",
            False,
            f"scheduler {policy} {priority} was refused, the loop runs with ordinary priority: allow it with "
            f"`echo '{_user()} - rtprio {priority + 1}' | sudo tee -a /etc/security/limits.d/dxlrun.conf` "
            "and log in again",
        )
    return Grant("scheduler", True, f"scheduler {policy}, priority {priority}")


def _timer_slack() -> Grant:
    """Ask the kernel to wake an ordinary thread within 1 ns of the timer instead of 50 us (prctl(2))."""
    if _libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return Grant("timer slack", True, "timer slack 1 ns")


def _lock_memory() -> Grant:
    """Lock all memory, now and later, but only where later allocations cannot fail by it (mlockall(2))."""
    if not (_may_lock() or _unlimited_lock()):
        return Grant(
            "locked memory",
            False,
            "memory is not locked, a page that was swapped out may delay the loop: allow it with "
            f"`echo '{_user()} - memlock unlimited' | sudo tee -a /etc/security/limits.d/dxlrun.conf` "
            "and log in again",
        )
    if _libc().mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return Grant("locked memory", True, "all memory is locked")


def _may_lock() -> bool:
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> _CAP_IPC_LOCK & 1)
    return False


def _unlimited_lock() -> bool:
    import resource

    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY


def _libc() -> ctypes.CDLL:
    if not sys.platform.startswith("linux"):
        raise OSError(f"{sys.platform} is not Linux")
    return ctypes.CDLL(None, use_errno=True)


def _user() -> str:
    """Return this user as limits.conf(5) names one."""
    import pwd

    user = os.getuid()
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return f"{user}:{user}"
