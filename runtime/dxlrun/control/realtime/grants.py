"""Real time: asks the operating system for what the plan wishes, and says plainly what it did not get."""

from __future__ import annotations

import ctypes
import gc
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec

from dxlrun.control.loop_plan import Policy, SchedulerPlan
from dxlrun.control.realtime import memory
from dxlrun.control.realtime.rights import allow, user
from dxlrun.run.channels.events import EventCode, EventSink, Granted, Severity

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_TASKS = Path("/proc/self/task")
IDLE_LATENCY = Path("/dev/cpu_dma_latency")
"""As long as somebody holds it open, cores wake from idle within the microseconds written to it
(kernel: Documentation/power/pm_qos_interface.rst)."""
_AGAIN = "and log in again"


@dataclass(frozen=True, slots=True)
class Grant:
    """One wish to the operating system, and what became of it."""

    wish: str
    """collector, timer slack, memory in place, locked memory, cores, idle latency, scheduler, polling"""
    granted: bool
    sentence: str
    """For a person; says what is lost where something was refused."""
    mend: str = ""
    """What to do where something was refused; empty where nothing helps."""

    @property
    def told(self) -> str:
        """The whole of it in one sentence."""
        return f"{self.sentence}: {self.mend}" if self.mend else self.sentence


def apply(plan: SchedulerPlan) -> tuple[Grant, ...]:
    """Prepare the calling thread for the loop; never raises.

    Order matters: what allocates comes first, the policy last, so that nothing slow runs with priority.
    """
    return (
        freeze_collector(),
        _attempt("timer slack", _timer_slack),
        *((_attempt("cores", lambda: _stay_on(plan.cores)),) if plan.cores else ()),
        _attempt("memory in place", _keep_memory),
        *((lock_memory(),) if plan.lock_memory else ()),
        *((_attempt("idle latency", _wake_at_once),) if plan.idle_latency else ()),
        *((_policy_of(plan),) if plan.policy != "other" else ()),
    )


def apply_to_guardian(priority: int, lock: bool) -> tuple[Grant, ...]:
    """Prepare the guardian's process; a priority of 0 asks for none; never raises."""
    return (
        *((lock_memory(),) if lock else ()),
        *((set_policy("round_robin", priority),) if priority else ()),
    )


def tell(grants: Sequence[Grant], source: str, events: EventSink) -> None:
    """Leave in the log what became of the wishes of a process."""
    for grant in grants:
        severity = Severity.INFO if grant.granted else Severity.WARNING
        data = msgspec.json.encode(Granted(grant.wish, grant.granted))
        events.emit(EventCode.SCHEDULER, severity, source, grant.told, data)


def freeze_collector() -> Grant:
    """Collect garbage once, take what is left out of every later search, and switch the collector off.

    The loop makes no cycles of references, so nothing piles up; a collection takes milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return Grant("collector", True, "the garbage collector is frozen and off")


def set_policy(policy: Policy, priority: int, limit: int | None = None) -> Grant:
    """Give the calling thread a real-time policy; a child process does not inherit it; never raises.

    `limit` is the rtprio that a refusal asks for, where other processes need more than `priority`.
    """
    return _attempt("scheduler", lambda: _set_policy(policy, priority, limit or priority))


def lock_memory() -> Grant:
    """Lock all memory, now and later, but only where later allocations cannot fail by it; never raises."""
    return _attempt("locked memory", _lock_memory)


def _policy_of(plan: SchedulerPlan) -> Grant:
    return set_policy(plan.policy, plan.priority, guardian_priority(plan))


def guardian_priority(plan: SchedulerPlan) -> int:
    """Return the priority of the guardian, one above the loop's; 0: none."""
    return 0 if plan.policy == "other" else min(plan.priority + 1, 99)


def thread_count() -> int:
    """Return the number of threads of this process, in a microsecond; 1 where the system does not tell."""
    tasks = _tasks()
    return 1 if tasks is None else os.fstat(tasks).st_nlink - 2


@cache
def _tasks() -> int | None:
    """Return a descriptor of the directory that has a directory in it for each thread."""
    try:
        return os.open(_TASKS, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None


def _attempt(wish: str, act: Callable[[], Grant]) -> Grant:
    """Return what became of a wish; whatever goes wrong is a refusal, because a robot runs without it too."""
    try:
        return act()
    except (AttributeError, OSError, ValueError) as error:
        return Grant(wish, False, f"{wish}: this system does not offer it ({error})")


def _set_policy(policy: Policy, priority: int, limit: int) -> Grant:
    if policy == "other":
        return Grant("scheduler", True, "the ordinary scheduler was asked for")
    wished = os.SCHED_FIFO if policy == "fifo" else os.SCHED_RR
    try:
        os.sched_setscheduler(0, wished | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return Grant(
            "scheduler",
            False,
            f"scheduler {policy} {priority} was refused, it runs with ordinary priority and any busy "
            "program may delay it by milliseconds",
            f"allow it with `{allow('rtprio', limit)}` {_AGAIN}",
        )
    return Grant("scheduler", True, f"scheduler {policy}, priority {priority}")


def _timer_slack() -> Grant:
    """Ask the kernel to wake an ordinary thread within 1 ns of the timer instead of 50 us (prctl(2))."""
    memory.succeed(memory.libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0))
    return Grant("timer slack", True, "timer slack 1 ns")


def _stay_on(cores: Sequence[int]) -> Grant:
    """Bind the calling thread to cores; the kernel drops those that there are not (sched_setaffinity(2))."""
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, cores)
    except OSError:
        return Grant(
            "cores",
            False,
            f"there is no core {_listed(cores)} for this process, it runs on {_listed(sorted(before))}",
            "write others under loop.scheduler.cores",
        )
    found = sorted(os.sched_getaffinity(0))
    if missing := sorted(set(cores) - set(found)):
        return Grant(
            "cores",
            False,
            f"there is no core {_listed(missing)} for this process, it runs on {_listed(found)}",
            "take it out of loop.scheduler.cores",
        )
    return Grant("cores", True, f"stays on {'core' if len(found) == 1 else 'cores'} {_listed(found)}")


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores))


def _keep_memory() -> Grant:
    kept = memory.keep_freed()
    memory.touch()
    how = "what is freed is kept" if kept else "what is freed goes back to the kernel, mallopt is missing"
    return Grant("memory in place", kept, f"{memory.HEAP >> 20} MiB of heap and the stack are touched, {how}")


def _lock_memory() -> Grant:
    if not memory.may_lock():
        return Grant(
            "locked memory",
            False,
            "memory is not locked, a page that was swapped out may delay it by milliseconds",
            f"allow it with `{allow('memlock', 'unlimited')}` {_AGAIN}",
        )
    memory.lock()
    return Grant("locked memory", True, "all memory is locked")


def _wake_at_once() -> Grant:
    """Keep the cores from deep idle states for as long as this process lives."""
    try:
        descriptor = os.open(IDLE_LATENCY, os.O_WRONLY)
    except PermissionError:
        return Grant(
            "idle latency",
            False,
            "cores may sleep deeply and wake some 100 us late",
            f"allow it with `{allow_idle_latency()}`",
        )
    os.write(descriptor, struct.pack("i", 0))  # never closed: the wish ends with the descriptor
    return Grant("idle latency", True, "cores are kept from deep idle states")


def allow_idle_latency(who: str = "") -> str:
    """Return the command that lets a user (this one) keep cores from deep idle states, for good."""
    rule = f'KERNEL=="cpu_dma_latency", OWNER="{who or user()}"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-dxlrun.rules && sudo udevadm control --reload && "
        "sudo udevadm trigger --name-match=cpu_dma_latency"
    )
