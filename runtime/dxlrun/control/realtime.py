"""Real time: ask the operating system for what the plan requests, and report what was not granted.

`apply` prepares the loop's process, `apply_to_guardian` the guardian's; `Pacing` measures how long before a
deadline the clock is polled; what a process may ask for, and the command that allows more, is at the end.
"""

from __future__ import annotations

import ctypes
import gc
import os
import struct
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from typing import ParamSpec

import msgspec

from dxlrun.channels.events import EventCode, EventSink, Granted, Severity
from dxlrun.plan.loop_plan import MOST_SHARE, Policy, SchedulerPlan
from dxlwire.clock import MonotonicClock

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_RESET_ON_FORK = 1  # SCHED_FLAG_RESET_ON_FORK, linux/sched.h: for this process, not for its children
_TASKS = Path("/proc/self/task")
IDLE_LATENCY = Path("/dev/cpu_dma_latency")
"""As long as it is held open, cores wake from idle within the microseconds written to it
(kernel: Documentation/power/pm_qos_interface.rst)."""
_AGAIN = "and log in again"
P = ParamSpec("P")


class Grant(msgspec.Struct, frozen=True):
    """One request to the operating system, and what became of it."""

    request: str
    """collector, timer slack, memory in place, locked memory, cores, idle latency, scheduler, time slice,
    polling"""
    granted: bool
    sentence: str
    """For a person; names the consequence where something was refused."""
    fix: str = ""
    """What to do where something was refused; empty where nothing helps."""
    process: str = "loop"

    @property
    def text(self) -> str:
        """Sentence and fix, with the process where that is not the loop."""
        text = f"{self.sentence}: {self.fix}" if self.fix else self.sentence
        return text if self.process == "loop" else f"{self.process}: {text}"

    @property
    def name(self) -> str:
        """What was asked for; with the process where that is not the loop."""
        return self.request if self.process == "loop" else f"{self.process}: {self.request}"


def apply(plan: SchedulerPlan) -> tuple[Grant, ...]:
    """Prepare the calling thread for the loop; never raises.

    Order matters: what allocates comes first, the policy last, so that nothing slow runs with priority.
    """
    grants = [freeze_collector(), _timer_slack()]
    grants += [_stay_on(plan.cores)] if plan.cores else []
    grants += [_keep_memory()]
    grants += [lock_memory()] if plan.lock_memory else []
    grants += [keep_awake()] if plan.idle_latency else []
    if plan.policy != "other":
        grants += [set_policy(plan.policy, plan.priority, guardian_priority(plan))]
    ordinary = plan.policy == "other" or not grants[-1].granted
    return (*grants, *_short_slice()) if ordinary else tuple(grants)


def apply_to_guardian(priority: int, lock: bool) -> tuple[Grant, ...]:
    """Prepare the guardian's process; a priority of 0 asks for none; never raises."""
    return (
        *((lock_memory(),) if lock else ()),
        *((set_policy("round_robin", priority),) if priority else ()),
    )


def log_grants(grants: Sequence[Grant], source: str, events: EventSink) -> None:
    """Log what became of a process' requests."""
    for grant in grants:
        severity = Severity.INFO if grant.granted else Severity.WARNING
        data = msgspec.json.encode(Granted(grant.request, grant.granted))
        events.emit(EventCode.SCHEDULER, severity, source, grant.text, data)


def freeze_collector() -> Grant:
    """Collect garbage once, take what is left out of every later search, and switch the collector off.

    The loop makes no cycles of references, so nothing piles up; a collection takes milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return Grant("collector", True, "the garbage collector is frozen and off")


def guardian_priority(plan: SchedulerPlan) -> int:
    """Return the priority of the guardian, one above the loop's; 0: none."""
    return 0 if plan.policy == "other" else min(plan.priority + 1, 99)


def thread_count() -> int:
    """Return the number of threads of this process, in a microsecond; 1 where that is not known."""
    tasks = _tasks()
    return 1 if tasks is None else os.fstat(tasks).st_nlink - 2


@cache
def _tasks() -> int | None:
    """Return a descriptor of the directory that has a directory in it for each thread."""
    try:
        return os.open(_TASKS, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None


class _Refused(Exception):
    """The sentence and the fix of a grant that was refused."""


def _requested(request: str) -> Callable[[Callable[P, str]], Callable[P, Grant]]:
    """Make a grant of what is returned, or raised: whatever fails is refused, as a robot runs without it."""

    def decorate(act: Callable[P, str]) -> Callable[P, Grant]:
        @wraps(act)
        def attempt(*arguments: P.args, **named: P.kwargs) -> Grant:
            try:
                return Grant(request, True, act(*arguments, **named))
            except _Refused as refused:
                return Grant(request, False, *refused.args)
            except (AttributeError, OSError, ValueError) as error:
                return Grant(request, False, f"{request}: this system does not offer it ({error})")

        return attempt

    return decorate


@_requested("scheduler")
def set_policy(policy: Policy, priority: int, limit: int | None = None) -> str:
    """Give the calling thread a real-time policy; a child process does not inherit it; never raises.

    `limit` is the rtprio that a refusal asks for, where other processes need more than `priority`.
    """
    if policy == "other":
        return "the ordinary scheduler was asked for"
    kind = os.SCHED_FIFO if policy == "fifo" else os.SCHED_RR
    try:
        os.sched_setscheduler(0, kind | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        raise _Refused(
            f"scheduler {policy} {priority} was refused, it runs with ordinary priority and any busy "
            "program may delay it by milliseconds",
            f"allow it with `{allow('rtprio', limit or priority)}` {_AGAIN}",
        ) from None
    return f"scheduler {policy}, priority {priority}"


@_requested("timer slack")
def _timer_slack() -> str:
    """Ask Linux to wake an ordinary thread within 1 ns of the timer instead of 50 us (prctl(2))."""
    succeed(libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0))
    return "timer slack 1 ns"


SLICE_NS = 100_000
"""The shortest time slice that Linux gives an ordinary program (kernel/sched/syscalls.c)."""
_SCHED_ATTR = struct.Struct("<IIQiIQQQ")
"""struct sched_attr of sched_setattr(2): size, policy, flags, nice, priority, runtime, deadline, period."""
_SCHED_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of sched_setattr and sched_getattr; the C library has no functions for them before 2.41."""


def _short_slice() -> tuple[Grant, ...]:
    """Ask for short time slices, for which Linux interrupts other ordinary programs sooner; never raises.

    Nothing is reported where the kernel has no such request (before 6.12): nothing can be done about it.
    """
    try:
        set_attributes, get_attributes = _SCHED_CALLS[os.uname().machine]
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        request = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, _RESET_ON_FORK, nice, 0, SLICE_NS, 0, 0)
        succeed(libc().syscall(set_attributes, 0, request, 0))
        found = ctypes.create_string_buffer(_SCHED_ATTR.size)
        succeed(libc().syscall(get_attributes, 0, found, _SCHED_ATTR.size, 0))
    except (AttributeError, KeyError, OSError):
        return ()
    if _SCHED_ATTR.unpack(found.raw)[5] != SLICE_NS:
        return ()
    sentence = f"time slices of {SLICE_NS / 1e6:g} ms, they begin sooner than those of other programs"
    return (Grant("time slice", True, sentence),)


@_requested("cores")
def _stay_on(cores: Sequence[int]) -> str:
    """Bind the calling thread to cores; Linux drops those that there are not (sched_setaffinity(2))."""
    before, fix = os.sched_getaffinity(0), "write others under loop.scheduler.cores"
    try:
        os.sched_setaffinity(0, cores)
    except OSError:
        found, missing = sorted(before), list(cores)
    else:
        found = sorted(os.sched_getaffinity(0))
        missing, fix = sorted(set(cores) - set(found)), "take it out of loop.scheduler.cores"
    if missing:
        raise _Refused(
            f"there is no core {_listed(missing)} for this process, it runs on {_listed(found)}", fix
        )
    return f"stays on {'core' if len(found) == 1 else 'cores'} {_listed(found)}"


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores))


@_requested("memory in place")
def _keep_memory() -> str:
    kept = keep_freed()
    touch()
    touched = f"{HEAP >> 20} MiB of heap and the stack are touched, what is freed"
    if not kept:
        raise _Refused(f"{touched} goes back to the kernel, mallopt is missing")
    return f"{touched} is kept"


@_requested("locked memory")
def lock_memory() -> str:
    """Lock all memory, now and later, but only where later allocations cannot fail by it; never raises."""
    if not may_lock():
        raise _Refused(
            "memory is not locked, a page that was swapped out may delay it by milliseconds",
            f"allow it with `{allow('memlock', 'unlimited')}` {_AGAIN}",
        )
    succeed(libc().mlockall(_MCL_CURRENT | _MCL_FUTURE))  # mlockall(2)
    return "all memory is locked"


@_requested("idle latency")
def keep_awake() -> str:
    """Keep the cores from deep idle states for as long as this process lives; never raises."""
    try:
        descriptor = os.open(IDLE_LATENCY, os.O_WRONLY)
    except PermissionError:
        sentence = "cores may sleep deeply and wake some 100 us late"
        raise _Refused(sentence, f"allow it with `{allow_idle_latency()}`") from None
    os.write(descriptor, struct.pack("i", 0))  # never closed: the request ends with the descriptor
    return "cores are kept from deep idle states"


def allow_idle_latency(account: str = "") -> str:
    """Return the command that lets a user (this one) keep cores from deep idle states, for good."""
    rule = f'KERNEL=="cpu_dma_latency", OWNER="{account or user()}"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-dxlrun.rules && sudo udevadm control --reload && "
        "sudo udevadm trigger --name-match=cpu_dma_latency"
    )


def raise_share(process: int, nice: int) -> None:
    """Give an ordinary process a larger share of a busy processor, as far as its user may; never raises.

    Without CAP_SYS_NICE or a limit (RLIMIT_NICE), a process keeps its share. Linux may divide a processor
    among sessions first (sched_autogroup, sched(7)): each process of a run is a session of its own, so the
    nice value of the group counts there, which has the same limit.
    """
    lowest = max(nice, lowest_nice())
    with suppress(OSError):
        if lowest < os.getpriority(os.PRIO_PROCESS, process):
            os.setpriority(os.PRIO_PROCESS, process, lowest)
            Path(f"/proc/{process}/autogroup").write_text(f"{lowest}")


# Memory

HEAP = 8 << 20
"""Bytes of heap that are touched; a loop of 20 servos allocates some kB in a cycle and frees them [i]."""
_STACK_DEPTH = 800
"""Lists in each other, whose text is made in one C call a list: 800 touch some 100 kB of stack [measured];
the recursion limit of Python is 1000."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # asm-generic/mman.h
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def libc() -> ctypes.CDLL:
    """Return the C library. Raises OSError on a system that is not Linux."""
    if not sys.platform.startswith("linux"):
        raise OSError(f"{sys.platform} is not Linux")
    return ctypes.CDLL(None, use_errno=True)


def succeed(code: int) -> None:
    """Raise OSError when a call of the C library returned something else than 0."""
    if code != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def may_lock() -> bool:
    """Return whether all memory may be locked: under a limit a later allocation would fail."""
    return lockable_bytes() == UNLIMITED


def keep_freed() -> bool:
    """Have malloc give nothing back to the Linux kernel: the next allocation finds it touched (mallopt(3)).

    Returns False where the C library has no mallopt (musl): the pages then come and go.
    """
    try:
        mallopt = libc().mallopt
    except AttributeError:
        return False
    return all(mallopt(option, value) == 1 for option, value in ((_M_TRIM_THRESHOLD, -1), (_M_MMAP_MAX, 0)))


def touch() -> None:
    """Touch heap and stack once, so that no page is missing when a cycle first comes that far."""
    bytearray(HEAP)  # zeroed, so each page is written; freed at once, and kept by `keep_freed`
    nested: list[object] = []
    for _ in range(_STACK_DEPTH):
        nested = [nested]
    with suppress(RecursionError):  # called from deep down, or a Python with a lower limit: less is touched
        repr(nested)


# Polling before a deadline

AUTO_SHARE = 10
"""Where the file does not set it, at most one part in so many of the period is polled."""
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
    """Sets a clock's margin to what was measured once, bounded by the file and by the period."""

    def __init__(self, clock: MonotonicClock, most_ns: int | None) -> None:
        self._clock = clock
        self._most_ns = most_ns
        self.measured_ns = clock.spin_ns
        """The margin that was measured, without the bounds."""

    def measure(
        self, period_ns: int, beat: Callable[[], None], nap: Callable[[int], int] = overshoot_ns
    ) -> Grant:
        """Sleep a few times, set the margin for a period, and report it; `beat` is called between.

        The margin covers 19 of 20 sleeps and half as much again.
        """
        late: list[int] = []
        for _ in range(_TRIES):
            late.append(nap(min(_NAP_NS, period_ns)))
            beat()
        usual_ns = sorted(late)[int(_QUANTILE * _TRIES)]
        self.measured_ns = round(_RESERVE * usual_ns)
        self.set_period(period_ns)
        margin_ns = self._clock.spin_ns
        return Grant(
            "polling",
            True,
            f"polls the clock for {margin_ns / 1e3:.0f} us before each deadline, {margin_ns / period_ns:.1%} "
            f"of a core; 19 of 20 sleeps woke at most {usual_ns / 1e3:.0f} us late"
            + ("" if margin_ns >= usual_ns else ", so that some cycles begin late"),
        )

    def set_period(self, period_ns: int) -> None:
        """Keep the margin within its share of another period, ns."""
        most_ns = period_ns // AUTO_SHARE if self._most_ns is None else self._most_ns
        self._clock.spin_ns = min(self.measured_ns, most_ns, period_ns // MOST_SHARE)


# What a process may ask for

IPC_LOCK, SYS_NICE = 14, 23
"""Capabilities, by their bit (linux/capability.h)."""
LIMITS = Path("/etc/security/limits.d/dxlrun.conf")
UNLIMITED = -1
_STATUS = Path("/proc/self/status")


def has_capability(bit: int, status: Path = _STATUS) -> bool:
    """Return whether this process has an effective capability; False where the system has none."""
    try:
        text = status.read_text()
    except OSError:
        return False
    masks = (line.split()[1] for line in text.splitlines() if line.startswith("CapEff:"))
    return any(int(mask, 16) >> bit & 1 for mask in masks)


def highest_priority() -> int:
    """Return the highest real-time priority that this process may take by its limit (RLIMIT_RTPRIO).

    99 with CAP_SYS_NICE. 0: none, or the system has no such limit.
    """
    import resource

    if has_capability(SYS_NICE):
        return 99
    limit = getattr(resource, "RLIMIT_RTPRIO", None)
    return 0 if limit is None else _finite(resource.getrlimit(limit)[0], 99)


def missing_priority(plan: SchedulerPlan) -> str:
    """Return the command that lets this user take the priorities of a plan; empty where they may already."""
    needed = guardian_priority(plan)
    return "" if highest_priority() >= needed else allow("rtprio", needed)


def lowest_nice() -> int:
    """Return the lowest nice value that this process may take by its limit (RLIMIT_NICE, getrlimit(2)).

    -20 with CAP_SYS_NICE; 20: none lower than its own.
    """
    import resource

    if has_capability(SYS_NICE):
        return -20
    limit = getattr(resource, "RLIMIT_NICE", None)
    return 20 if limit is None else 20 - _finite(resource.getrlimit(limit)[0], 40)


def lockable_bytes() -> int:
    """Return how much memory this process may lock (RLIMIT_MEMLOCK); UNLIMITED, also with CAP_IPC_LOCK."""
    import resource

    if has_capability(IPC_LOCK):
        return UNLIMITED
    return _finite(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], UNLIMITED)


def allow(limit: str, value: int | str, account: str = "") -> str:
    """Return the command that raises a limit of a user (this one) from the next log-in on, limits.conf(5)."""
    return f"echo '{account or user()} - {limit} {value}' | sudo tee -a {LIMITS}"


def user() -> str:
    """Return this user as limits.conf(5) names one."""
    if not hasattr(os, "getuid"):
        return sys.platform
    import pwd

    number = os.getuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"{number}:{number}"


def _finite(limit: int, unlimited: int) -> int:
    import resource

    return unlimited if limit == resource.RLIM_INFINITY else limit
