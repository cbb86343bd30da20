"""Processor cores: how many, how awake, how fast."""

from __future__ import annotations

from dxlrun.control.realtime.grants import IDLE_LATENCY, allow_idle_latency
from dxlrun.run.doctor.finding import Finding
from dxlrun.run.doctor.machine import Machine

_GOVERNORS = "sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"


def cores(machine: Machine) -> Finding:
    """Look whether the loop can have a core for itself."""
    why = "guardian, recorder and gateway work beside the loop"
    if machine.cores < 2:
        return Finding(
            "cores",
            "worse",
            "there is one core for all processes",
            why,
            "use a machine, or allow this process, two cores or more",
        )
    isolated = machine.read("sys/devices/system/cpu/isolated")
    also = f"; isolated: {isolated}, give them to the loop by loop.scheduler.cores" if isolated else ""
    return Finding("cores", "good", f"{machine.cores} cores{also}", why)


def governor(machine: Machine) -> Finding:
    """Look whether the cores always run at their full clock rate."""
    why = "a core that has to speed up first makes the first milliseconds of work slow"
    found = sorted({path.read_text().strip() for path in machine.glob(_GOVERNORS)})
    if not found:
        return Finding("CPU governor", "good", "this machine has none, or hides it", why)
    if found == ["performance"]:
        return Finding("CPU governor", "good", "performance on all cores", why)
    return Finding(
        "CPU governor",
        "worse",
        f"{', '.join(found)} where performance is meant",
        why,
        f"echo performance | sudo tee /{_GOVERNORS.replace('[0-9]', '')}",
    )


def idle_latency(machine: Machine) -> Finding:
    """Look whether a run may keep the cores from deep idle states."""
    why = (
        "a core in a deep idle state wakes up to some 100 us late; loop.scheduler.idle_latency keeps it awake"
    )
    device = machine.root / IDLE_LATENCY.relative_to("/")
    if not device.exists():
        return Finding("idle latency", "good", "this machine has no such states, or hides them", why)
    if machine.may_write(device):
        return Finding("idle latency", "good", "runs may keep cores awake", why)
    return Finding(
        "idle latency", "worse", "runs may not keep cores awake", why, allow_idle_latency(machine.user)
    )
