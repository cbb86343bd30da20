"""Totals of a made run, and findings for the verdict to judge."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from msgspec import structs

from dxlrun.channels.event_records import EventCode, EventGroup, Severity
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.machine_load import MachineLoad
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.cycles.punctuality import Latency, Periods
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan_excerpt import NO_LOOP, LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RunTotals

MS = 1_000_000
REAL, SIMULATED = "/dev/ttyUSB0", "sim"
BUSY = Causes(load=MachineLoad(10, busy_s=10, no_idle_core_s=9, waited_s=2))


def totals(**changed: Any) -> RunTotals:
    """Return the totals of a good run, changed."""
    periods = Periods(1000, 1000, 0, 0, True, 50.0, 20.0, (50.0,))
    good = RunTotals(periods, Latency(80.0, 10.0, 5.0, 9, 0.0, 0.0, 0.0), joints=("elbow", "wrist"))
    return replace(good, **changed)


def plan(*ports: str) -> LoggedPlan:
    """Return a plan with buses `bus0`, `bus1` ... that have one servo each, and a controller."""
    joints = (LoggedServo(joint, number) for number, joint in enumerate(("elbow", "wrist"), 1))
    buses = [LoggedBus(f"bus{n}", port, servos=[next(joints)]) for n, port in enumerate(ports)]
    arm = ControllerPlan("arm", "", "", "{}", (), (), (), active=True, every=1)
    return LoggedPlan(structs.replace(NO_LOOP, controllers=(arm,)), buses)


def on_bus(*joints: str, bus: str = "bus0") -> tuple[ServoTraffic, ...]:
    """Return the traffic of servos that answered every time."""
    return tuple(
        ServoTraffic(bus, n, joint, 9, 9, 0, 9, 0, (), 0.0, 0.0) for n, joint in enumerate(joints, 1)
    )


def accusing(code: str, subject: str = "bus0", share: float = 0.5, rank: Rank = Rank.CAUSE) -> Finding:
    """Return a finding whose remedy is left to the table."""
    return Finding(code, subject, f"{subject} has it.", rank=rank, share=share)


def lost(joint: str, at_ms: int = 5, count: int = 1, code: EventCode = EventCode.SERVO_LOST) -> EventGroup:
    """Return the event of a servo that was lost, or failed otherwise."""
    return EventGroup(code, Severity.ERROR, joint, count, at_ms * MS, "missed 3")
