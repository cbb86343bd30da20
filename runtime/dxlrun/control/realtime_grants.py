"""Real time: request scheduling, memory and power settings from the operating system, and report refusals.

`apply_scheduler` prepares the loop's process, `apply_to_guardian` the guardian's. `Pacing` measures the time
for which the clock is polled before a deadline. The functions at the end of the module return the limits of
this process and the commands that raise them.
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

from dxlrun.channels.event_records import EventSink, SchedulerGrant
from dxlrun.control import texts
from dxlrun.plan.loop_plan import MOST_SHARE, Policy, SchedulerPlan
from dxlwire.clock import MonotonicClock

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_RESET_ON_FORK = 1  # SCHED_FLAG_RESET_ON_FORK, linux/sched.h: for this process, not for its children
_TASKS = Path("/proc/self/task")
IDLE_LATENCY = Path("/dev/cpu_dma_latency")
"""Device file that limits the wake-up time of idle cores, int32 in us. The request ends when the file is
closed (kernel: Documentation/power/pm_qos_interface.rst)."""
_AGAIN = "and log in again"
P = ParamSpec("P")


class Grant(msgspec.Struct, frozen=True):
    """A real-time setting requested from the operating system, and whether it was granted."""

    request: str
    """Name: collector, timer slack, memory in place, locked memory, cores, idle latency, scheduler, time
    slice or polling.
    """
    granted: bool
    sentence: str
    """Result for the user in one sentence; for a refusal, with its consequence."""
    fix: str = ""
    """Command or change that a user can make to get the request granted; empty if there is none."""
    process: str = "loop"

    @property
    def full_sentence(self) -> str:
        """Result and fix as one text, prefixed with the process if that is not the loop."""
        text = f"{self.sentence}: {self.fix}" if self.fix else self.sentence
        return text if self.process == "loop" else f"{self.process}: {text}"

    @property
    def full_request(self) -> str:
        """Name of the request, prefixed with the process if that is not the loop."""
        return self.request if self.process == "loop" else f"{self.process}: {self.request}"


def apply_scheduler(plan: SchedulerPlan) -> tuple[Grant, ...]:
    """Apply the real-time settings of the robot file to the calling thread; return one result for each.

    Never raises.

    Steps that allocate come first and the scheduling policy comes last, so that no slow step runs with
    real-time priority.
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
    """Apply real-time settings to the guardian's process; return one result for each. Never raises.

    Args:
        priority: Real-time priority; 0: none.
        lock: True to lock the memory.
    """
    return (
        *((lock_memory(),) if lock else ()),
        *((set_policy("round_robin", priority),) if priority else ()),
    )


def log_grants(grants: Sequence[Grant], source: str, events: EventSink) -> None:
    """Emit an event for the result of each request: information if granted, a warning if refused."""
    for grant in grants:
        text = texts.request_granted if grant.granted else texts.request_denied
        events.emit_event(
            source,
            text(grant.full_sentence),
            msgspec.json.encode(SchedulerGrant(grant.request, grant.granted)),
        )


def freeze_collector() -> Grant:
    """Collect garbage once, exempt the remaining objects from collection, and disable Python's collector.

    A collection takes milliseconds, and the loop creates no reference cycles that would need one.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    return Grant("collector", True, "the garbage collector is frozen and off")


def guardian_priority(plan: SchedulerPlan) -> int:
    """Return the guardian's real-time priority, one above the loop's; 0 without real-time policy."""
    return 0 if plan.policy == "other" else min(plan.priority + 1, 99)


def thread_count() -> int:
    """Return the number of threads of this process; 1 if it is not known. Takes a microsecond."""
    tasks = _tasks()
    return 1 if tasks is None else os.fstat(tasks).st_nlink - 2


@cache
def _tasks() -> int | None:
    """Return a descriptor of /proc/self/task, whose link count is the number of threads plus 2."""
    try:
        return os.open(_TASKS, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None


class _GrantRefusal(Exception):
    """Raised inside a request that was refused. Its arguments are `sentence` and `fix` of the Grant."""


def _requested(request: str) -> Callable[[Callable[P, str]], Callable[P, Grant]]:
    """Return a decorator that converts the result or exception of a request to a Grant.

    A failed request is only reported, because a robot can run without it.
    """

    def decorate(act: Callable[P, str]) -> Callable[P, Grant]:
        @wraps(act)
        def attempt(*arguments: P.args, **named: P.kwargs) -> Grant:
            try:
                return Grant(request, True, act(*arguments, **named))
            except _GrantRefusal as refused:
                return Grant(request, False, *refused.args)
            except (AttributeError, OSError, ValueError) as error:
                return Grant(request, False, f"{request}: not available on this system ({error})")

        return attempt

    return decorate


@_requested("scheduler")
def set_policy(policy: Policy, priority: int, limit: int | None = None) -> str:
    """Set the scheduling policy of the calling thread. Child processes do not inherit it. Never raises.

    Args:
        policy: Policy.
        priority: Real-time priority, 1..99; ignored with the policy `other`.
        limit: rtprio limit for the fix of a refusal, if another process needs more than `priority`.
    """
    if policy == "other":
        return "ordinary scheduler, as requested"
    kind = os.SCHED_FIFO if policy == "fifo" else os.SCHED_RR
    try:
        os.sched_setscheduler(0, kind | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        raise _GrantRefusal(
            f"scheduler {policy} {priority} was refused; busy programs may delay this process by "
            "milliseconds",
            f"allow it with `{allow('rtprio', limit or priority)}` {_AGAIN}",
        ) from None
    return f"scheduler {policy}, priority {priority}"


@_requested("timer slack")
def _timer_slack() -> str:
    """Reduce the timer slack of an ordinary thread from 50 us to 1 ns (prctl(2))."""
    succeed(libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0))
    return "timer slack 1 ns"


SLICE_NS = 100_000
"""Requested time slice; the shortest that Linux accepts for an ordinary process (kernel/sched/syscalls.c)."""
_SCHED_ATTR = struct.Struct("<IIQiIQQQ")
"""struct sched_attr of sched_setattr(2): size, policy, flags, nice, priority, runtime, deadline, period."""
_SCHED_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""System call numbers of sched_setattr and sched_getattr by machine; the C library lacks these functions
before 2.41.
"""


def _short_slice() -> tuple[Grant, ...]:
    """Request short time slices, with which Linux interrupts other processes sooner. Never raises.

    Kernels before 6.12 lack this request. They return an empty tuple, since a user cannot fix that.
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
    sentence = f"time slices of {SLICE_NS / 1e6:g} ms, so that the process is scheduled before others"
    return (Grant("time slice", True, sentence),)


@_requested("cores")
def _stay_on(cores: Sequence[int]) -> str:
    """Bind the calling thread to these cores.

    Linux ignores cores that do not exist (sched_setaffinity(2)).
    """
    before, fix = os.sched_getaffinity(0), "write other cores under loop.scheduler.cores"
    try:
        os.sched_setaffinity(0, cores)
    except OSError:
        found, missing = sorted(before), list(cores)
    else:
        found = sorted(os.sched_getaffinity(0))
        missing = sorted(set(cores) - set(found))
        fix = f"remove {_listed(missing)} from loop.scheduler.cores"
    if missing:
        raise _GrantRefusal(
            f"this process cannot run on core {_listed(missing)}; it runs on {_listed(found)}", fix
        )
    return f"stays on {'core' if len(found) == 1 else 'cores'} {_listed(found)}"


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores))


@_requested("memory in place")
def _keep_memory() -> str:
    kept = keep_freed()
    touch_memory()
    touched = f"{HEAP >> 20} MiB of heap and the stack are touched"
    if not kept:
        raise _GrantRefusal(f"{touched}; freed memory returns to the kernel, as mallopt is missing")
    return f"{touched}; freed memory is kept"


@_requested("locked memory")
def lock_memory() -> str:
    """Lock all current and future memory of this process in RAM. Never raises.

    Refused under a memory limit, where later allocations would fail.
    """
    if not may_lock():
        raise _GrantRefusal(
            "memory is not locked; a swapped page may delay this process by milliseconds",
            f"allow it with `{allow('memlock', 'unlimited')}` {_AGAIN}",
        )
    succeed(libc().mlockall(_MCL_CURRENT | _MCL_FUTURE))  # mlockall(2)
    return "all memory is locked"


@_requested("idle latency")
def keep_awake() -> str:
    """Keep the cores out of deep idle states until this process exits. Never raises."""
    try:
        descriptor = os.open(IDLE_LATENCY, os.O_WRONLY)
    except PermissionError:
        sentence = "cores may enter deep idle states and wake about 100 us late"
        raise _GrantRefusal(sentence, f"allow it with `{allow_idle_latency()}`") from None
    os.write(descriptor, struct.pack("i", 0))  # never closed: the request ends with the descriptor
    return "cores are kept from deep idle states"


def allow_idle_latency(account: str = "") -> str:
    """Return the shell command that permanently allows a user to keep cores out of deep idle states.

    Args:
        account: Name of the user; empty: the current user.
    """
    rule = f'KERNEL=="cpu_dma_latency", OWNER="{account or user()}"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-dxlrun.rules && sudo udevadm control --reload && "
        "sudo udevadm trigger --name-match=cpu_dma_latency"
    )


def raise_share(process: int, nice: int) -> None:
    """Lower the nice value of an ordinary process as far as its limit permits. Never raises.

    The value stays unchanged without CAP_SYS_NICE or RLIMIT_NICE. Linux may share a processor among sessions
    first (sched_autogroup, sched(7)). Each process of a run is a session, so the nice value of its group is
    set too, which has the same limit.

    Args:
        process: Process ID.
        nice: Requested nice value.
    """
    lowest = max(nice, lowest_nice())
    with suppress(OSError):
        if lowest < os.getpriority(os.PRIO_PROCESS, process):
            os.setpriority(os.PRIO_PROCESS, process, lowest)
            Path(f"/proc/{process}/autogroup").write_text(f"{lowest}")


# Memory

HEAP = 8 << 20
"""Bytes of heap that `touch_memory` writes before the loop. A loop of 20 servos allocates and frees a few kB
in a cycle [i]."""
_STACK_DEPTH = 800
"""Depth of nested lists for `repr`, which makes one C call a level: 800 levels touch some 100 kB of stack
[measured]. Python's recursion limit is 1000."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # asm-generic/mman.h
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def libc() -> ctypes.CDLL:
    """Return the C library. Raises OSError on a system that is not Linux."""
    if not sys.platform.startswith("linux"):
        raise OSError(f"{sys.platform} is not Linux")
    return ctypes.CDLL(None, use_errno=True)


def succeed(code: int) -> None:
    """Raise OSError from errno if a C library call returned another code than 0."""
    if code != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def may_lock() -> bool:
    """Return whether this process may lock its memory without a limit (RLIMIT_MEMLOCK)."""
    return lockable_bytes() == UNLIMITED


def keep_freed() -> bool:
    """Configure malloc to keep freed memory, so that later allocations cause no page faults (mallopt(3)).

    Returns:
        False if the C library has no mallopt (musl).
    """
    try:
        mallopt = libc().mallopt
    except AttributeError:
        return False
    return all(mallopt(option, value) == 1 for option, value in ((_M_TRIM_THRESHOLD, -1), (_M_MMAP_MAX, 0)))


def touch_memory() -> None:
    """Write to HEAP bytes and to the stack once, so that no cycle has the page faults of a first use."""
    bytearray(HEAP)  # zeroed, so each page is written; freed at once, and kept by `keep_freed`
    nested: list[object] = []
    for _ in range(_STACK_DEPTH):
        nested = [nested]
    with suppress(RecursionError):  # with a deep call stack or a lower limit, less is touched
        repr(nested)


# Polling before a deadline

AUTO_SHARE = 10
"""Divider: without `polling` in the robot file, the polling time is at most period / AUTO_SHARE."""
_TRIES = 32
_NAP_NS = 2_000_000
"""Longest sleep of a try, ns. All tries together take 64 ms. Longer sleeps overshoot more, which _RESERVE
covers."""
_QUANTILE = 0.95
_RESERVE = 1.5
"""Factor on the measured delay. Sleeps of 20 ms overshoot 1.4 times as much as those of 2 ms [measured,
round_robin, x86-64]."""


def overshoot_ns(nap_ns: int) -> int:
    """Sleep for `nap_ns`, and return how much later than that the thread woke up, ns."""
    deadline_ns = time.monotonic_ns() + nap_ns
    time.sleep(nap_ns * 1e-9)
    return time.monotonic_ns() - deadline_ns


class Pacing:
    """Measures and sets how long a clock is polled before a deadline, bounded by robot file and period.

    Args:
        clock: The clock.
        most_ns: Longest margin, as `SchedulerPlan.polling_ns`; None: a share of the period.
    """

    def __init__(self, clock: MonotonicClock, most_ns: int | None) -> None:
        self._clock = clock
        self._most_ns = most_ns
        self.measured_ns = clock.spin_ns
        """Measured polling time, ns, before the limits are applied."""

    def measure_margin(
        self, period_ns: int, beat: Callable[[], None], nap: Callable[[int], int] = overshoot_ns
    ) -> Grant:
        """Measure how late sleeps wake up, and set the polling time to 1.5 times the 95th percentile.

        Args:
            period_ns: Period of the loop.
            beat: Called after each sleep, for the guardian.
            nap: Sleeps for a time in ns and returns the delay in ns.
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
            f"polls the clock for {margin_ns / 1e3:.0f} us before each deadline ({margin_ns / period_ns:.1%} "
            f"of a core); 19 of 20 sleeps woke at most {usual_ns / 1e3:.0f} us late"
            + ("" if margin_ns >= usual_ns else ", so some cycles begin late"),
        )

    def set_period(self, period_ns: int) -> None:
        """Limit the measured polling time again for a new loop period, ns."""
        most_ns = period_ns // AUTO_SHARE if self._most_ns is None else self._most_ns
        self._clock.spin_ns = min(self.measured_ns, most_ns, period_ns // MOST_SHARE)


# Limits of this process

IPC_LOCK, SYS_NICE = 14, 23
"""Bit numbers of the Linux capabilities CAP_IPC_LOCK and CAP_SYS_NICE (linux/capability.h)."""
LIMITS = Path("/etc/security/limits.d/dxlrun.conf")
UNLIMITED = -1
_STATUS = Path("/proc/self/status")


def has_capability(bit: int, status: Path = _STATUS) -> bool:
    """Return whether this process has an effective Linux capability, by bit; False on other systems."""
    try:
        text = status.read_text()
    except OSError:
        return False
    masks = (line.split()[1] for line in text.splitlines() if line.startswith("CapEff:"))
    return any(int(mask, 16) >> bit & 1 for mask in masks)


def highest_priority() -> int:
    """Return the highest real-time priority that this process may request (RLIMIT_RTPRIO).

    Returns:
        99 with CAP_SYS_NICE; 0 if none is permitted or the system lacks this limit.
    """
    import resource

    if has_capability(SYS_NICE):
        return 99
    limit = getattr(resource, "RLIMIT_RTPRIO", None)
    return 0 if limit is None else _finite(resource.getrlimit(limit)[0], 99)


def missing_priority(plan: SchedulerPlan) -> str:
    """Return the shell command that permits this user the plan's real-time priorities; empty if permitted."""
    needed = guardian_priority(plan)
    return "" if highest_priority() >= needed else allow("rtprio", needed)


def lowest_nice() -> int:
    """Return the lowest nice value that this process may request (RLIMIT_NICE, getrlimit(2)).

    Returns:
        -20 with CAP_SYS_NICE; 20 if the process may not lower its value.
    """
    import resource

    if has_capability(SYS_NICE):
        return -20
    limit = getattr(resource, "RLIMIT_NICE", None)
    return 20 if limit is None else 20 - _finite(resource.getrlimit(limit)[0], 40)


def lockable_bytes() -> int:
    """Return how many bytes of memory this process may lock (RLIMIT_MEMLOCK); UNLIMITED with CAP_IPC_LOCK."""
    import resource

    if has_capability(IPC_LOCK):
        return UNLIMITED
    return _finite(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], UNLIMITED)


def allow(limit: str, value: int | str, account: str = "") -> str:
    """Return the shell command that raises a limit of a user from the next login on, limits.conf(5).

    Args:
        limit: `rtprio` or `memlock`.
        value: New limit.
        account: Name of the user; empty: the current user.
    """
    return f"echo '{account or user()} - {limit} {value}' | sudo tee -a {LIMITS}"


def user() -> str:
    """Return the current user's name as in limits.conf(5), or `UID:UID` for a user without a name."""
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
