"""Buses of the robot file: ports, prepared packets, and their time budget against the loop's rate."""

from __future__ import annotations

import math
from collections.abc import Mapping

from dxlrun.compile.checks.problems import Problems
from dxlrun.compile.health import with_health
from dxlrun.compile.joint.joints import CompiledJoint
from dxlrun.compile.joint.registers import check_position_limits
from dxlrun.description import Description
from dxlrun.dynamixel.plan.bus_plan import Budget, BusPlan
from dxlrun.dynamixel.plan.planning import Wiring, bus_plan
from dxlrun.mode import Mode

SIMULATED = "sim"
FAST_LATENCY_NS = 1_000_000
"""The shortest latency timer of an FTDI adapter (protocol.md, Time budget)."""
_COMFORTABLE = 0.9
"""Share of the period above which controllers and the operating system have too little left."""


def compile_buses(
    description: Description,
    joints: Mapping[str, CompiledJoint],
    modes: Mapping[str, Mode],
    problems: Problems,
) -> list[BusPlan]:
    """Return the plans of the buses that have joints, in the order of the file.

    `modes`: in which mode each joint begins a run, by its name.
    """
    _own_ports(description, problems)
    plans: list[BusPlan] = []
    rows = {name: row for row, name in enumerate(joints)}
    for name, bus in description.robot.buses.items():
        mark = description.marks.key("buses", name)
        if not any(joint.bus == name for joint in description.robot.joints.values()):
            problems.warning(mark, f"no joint stands on bus {name}", "it will not be opened; take it out")
        wirings = [
            _wiring(joint, rows, modes)
            for joint in joints.values()
            if joint.described.bus == name and joint.table.protocol == bus.protocol
        ]
        if not wirings:
            continue
        try:
            plan = bus_plan(
                name=name,
                port=bus.port,
                baud_rate=bus.baud_rate,
                latency_ns=bus.latency_timer if bus.port == SIMULATED else bus.adapter.assumed_latency,
                return_delay_ns=bus.return_delay_time,
                joints=wirings,
                protocol=bus.protocol,
                split=bus.read == "split",
            )
        except ValueError as error:
            problems.error(mark, str(error), "change the joints of this bus")
            continue
        _check_ticks(description, plan, problems)
        check_position_limits(description, plan, problems)
        _check_budget(description, plan, problems)
        plans.append(with_health(description, plan, problems))
    return plans


def _own_ports(description: Description, problems: Problems) -> None:
    owners: dict[str, str] = {}
    for name, bus in description.robot.buses.items():
        owner = owners.setdefault(bus.port, name)
        if owner != name and bus.port != SIMULATED:
            problems.error(
                description.marks.value("buses", name, "port"),
                f"port {bus.port} of bus {name} belongs to bus {owner} already",
                "one port is one bus",
            )


def _wiring(joint: CompiledJoint, rows: Mapping[str, int], modes: Mapping[str, Mode]) -> Wiring:
    return Wiring(
        joint=joint.plan.name,
        row=rows[joint.plan.name],
        servo_id=joint.described.id,
        table=joint.table,
        reference=joint.described.reference,
        direction=joint.described.direction,
        lower=joint.plan.lower,
        upper=joint.plan.upper,
        registers=joint.registers,
        continuous=joint.plan.continuous,
        start_mode=modes[joint.plan.name],
    )


def _check_ticks(description: Description, plan: BusPlan, problems: Problems) -> None:
    for servo in plan.servos:
        if servo.lower_tick > servo.upper_tick:
            problems.error(
                description.marks.value("joints", servo.joint, "limits", "position"),
                f"no position of an {servo.model} lies within the limits of {servo.joint}",
                f"make them wider than one tick ({math.degrees(servo.rad_per_tick):.2f} deg)",
            )


def _check_budget(description: Description, plan: BusPlan, problems: Problems) -> None:
    rate = description.robot.loop.rate
    budget = plan.budget
    share = budget.total_ns * 1e-9 * rate
    mark = description.marks.value("loop", "rate")
    origin = description.marks.origins.get(("loop", "rate"))
    given = f" (argument {origin})" if origin else ""
    cycle = f"one cycle on bus {plan.name} takes {budget.total_ns * 1e-6:.1f} ms"
    if share > 1.0:
        problems.error(
            mark,
            f"{cycle}, but {rate:g} Hz{given} leave {1e3 / rate:.3g} ms; the highest possible rate is "
            f"{_floor(budget.highest_rate_hz)} Hz, with read: split and without",
            "; ".join(["lower the rate", *_what_would_help(plan)]),
        )
    elif share > _COMFORTABLE:
        problems.warning(
            mark,
            f"{cycle}, {share:.0%} of the period; what is left is short for controllers and the system",
            "; ".join(["expect skipped periods, or lower the rate", *_what_would_help(plan)]),
        )


def _what_would_help(plan: BusPlan) -> list[str]:
    """Say what each change alone would allow."""
    budget = plan.budget
    now = _floor(budget.highest_rate_hz)
    found: list[str] = []
    if plan.latency_ns > FAST_LATENCY_NS:
        rate = _rate(budget, latency_ns=budget.latency_ns * FAST_LATENCY_NS // plan.latency_ns)
        old = f"{plan.latency_ns * 1e-6:g} ms"
        found.append(f"an adapter latency of 1 ms instead of {old} would allow {rate} Hz")
    elif plan.latency_ns and (rate := _rate(budget, latency_ns=0)) != now:
        found.append(f"an adapter without a latency timer would allow {rate} Hz")
    if (rate := _rate(budget, return_delay_ns=0)) != now:
        old = f"{plan.return_delay_ns * 1e-3:g} us"
        found.append(f"a return delay time of 0 us instead of {old} would allow {rate} Hz")
    if len(plan.servos) > 1:
        found.append("a second bus would share the servos")
    return found


def _rate(budget: Budget, *, latency_ns: int | None = None, return_delay_ns: int | None = None) -> str:
    total = (
        budget.wire_ns
        + (budget.latency_ns if latency_ns is None else latency_ns)
        + (budget.return_delay_ns if return_delay_ns is None else return_delay_ns)
    )
    return _floor(1e9 / total)


def _floor(rate: float) -> str:
    """Write a rate that is certainly possible, Hz, with two digits at least."""
    return str(math.floor(rate)) if rate >= 10 else f"{math.floor(rate * 10) / 10:g}"
