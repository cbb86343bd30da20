"""Rights of this user: real-time priority and locked memory, by limits or by capabilities."""

from __future__ import annotations

from dxlrun.control.realtime.rights import allow
from dxlrun.run.doctor.finding import Finding
from dxlrun.run.doctor.machine import Machine

WANTED = 32
"""The robot file's default priority for the loop, and one more for the guardian."""
_AGAIN = "then log in again"
_CONTAINER = "start the container with --cap-add SYS_NICE --ulimit rtprio=98 --ulimit memlock=-1"


def priority(machine: Machine) -> Finding:
    """Look whether a run may have real-time priority (RLIMIT_RTPRIO, CAP_SYS_NICE), and really gets it."""
    what = "real-time priority"
    why = "with ordinary priority any busy program delays the loop by milliseconds"
    highest = machine.highest_priority
    if highest < WANTED:
        found = f"up to {highest}, {WANTED} are wanted" if highest else "none is allowed"
        return Finding(what, "worse", found, why, _mend(machine, "rtprio", 98))
    if not machine.may_schedule():
        return Finding(
            what,
            "worse",
            "it is allowed, but the kernel refuses it: this group of processes has no share of it",
            why,
            _CONTAINER if machine.container else "sudo sysctl kernel.sched_rt_runtime_us=950000",
        )
    return Finding(what, "good", f"up to {highest}, {_by(machine, 'CAP_SYS_NICE', 'rtprio')}", why)


def locked_memory(machine: Machine) -> Finding:
    """Look whether a run may lock all of its memory (RLIMIT_MEMLOCK, CAP_IPC_LOCK)."""
    what, why = "locked memory", "a page that was swapped out delays the loop by milliseconds"
    if machine.locks_all:
        return Finding(what, "good", f"all of it, {_by(machine, 'CAP_IPC_LOCK', 'memlock')}", why)
    found = f"only {machine.lockable >> 10} KiB may be locked"
    return Finding(what, "worse", found, why, _mend(machine, "memlock", "unlimited"))


def _by(machine: Machine, capability: str, limit: str) -> str:
    return f"by {capability}" if capability in machine.capabilities else f"by the limit {limit}"


def _mend(machine: Machine, limit: str, value: int | str) -> str:
    return _CONTAINER if machine.container else f"{allow(limit, value, machine.user)}  # {_AGAIN}"
