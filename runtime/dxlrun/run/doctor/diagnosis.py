"""Diagnosis: every check of the doctor, in the order in which a person should mend."""

from __future__ import annotations

from dxlrun.run.doctor.finding import Finding
from dxlrun.run.doctor.kernel import clock_source, exchange, kernel, real_time_share, system
from dxlrun.run.doctor.machine import Machine
from dxlrun.run.doctor.ports import latency_timers, ports
from dxlrun.run.doctor.processor import cores, governor, idle_latency
from dxlrun.run.doctor.rights import locked_memory, priority


def diagnose(machine: Machine) -> tuple[Finding, ...]:
    """Return what was found; on a system that cannot run robots, that alone."""
    first = system(machine)
    if first.state == "missing":
        return (first,)
    return (
        first,
        exchange(machine),
        *ports(machine),
        *latency_timers(machine),
        priority(machine),
        locked_memory(machine),
        kernel(machine),
        real_time_share(machine),
        clock_source(machine),
        cores(machine),
        governor(machine),
        idle_latency(machine),
    )
