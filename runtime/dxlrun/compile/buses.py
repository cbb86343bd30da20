"""Buses: compiles `buses` of the robot file into plans with prepared packets, time budget and monitoring."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from functools import reduce

from msgspec.structs import replace

from dxlrun.compile.contribution import Contribution
from dxlrun.compile.joints.compiled_joints import CompiledJoint, moving_servos
from dxlrun.compile.joints.compiled_servos import CompiledServo, SettingsStage
from dxlrun.compile.joints.described_servos import described_servos, first_joints, used_features
from dxlrun.compile.joints.limits import Interval, limits_of
from dxlrun.compile.problems import RobotFile
from dxlrun.description.bus import HIGHEST_BAUD_RATE
from dxlrun.description.reading import Description
from dxlrun.errors import help_link, suggestion
from dxlrun.features import stages
from dxlwire.bus_plan import SIMULATED, Budget, BusPlan
from dxlwire.control_table import ControlTable, find_table
from dxlwire.control_table.device_table import DeviceTable
from dxlwire.modes import Mode
from dxlwire.plan.bus_watchdog import LEAST_PERIODS, MOST_TICKS, UNIT_NS, has_watchdog
from dxlwire.plan.planning import Wiring, bus_plan
from dxlwire.plan.reads import slow_items
from dxlwire.wire.dialect import ONE_PROTOCOL

FAST_LATENCY_NS = 1_000_000  # shortest latency timer of an FTDI adapter (protocol.md, Time budget)
_COMFORTABLE = 0.9
"""Share of the loop's period; a bus cycle that takes more causes a warning, as controllers lack time."""
_LEAST_DEVICE_MARGIN_NS, _MOST_DEVICE_MARGIN_NS = 100_000, 5_000_000
"""Bounds of the extra time (ns) to wait for devices: a stock kernel wakes about 50-100 us late."""
WATCHDOG_NS = 200_000_000  # default Bus Watchdog of servos of Protocol 2.0 (failures.md)


def compile_buses(
    file: RobotFile,
    joints: Mapping[str, CompiledJoint],
    contributions: Collection[Contribution],
    modes: Mapping[str, Mode],
) -> list[BusPlan]:
    """Compile the buses that have servos or devices into plans, in file order; others cause a warning.

    Args:
        file: Robot file; collects the problems.
        joints: Compiled joints, by name.
        contributions: Contributions of the features.
        modes: Start mode of each joint, by name.
    """
    _own_ports(file)
    plans: list[BusPlan] = []
    servos = moving_servos(joints.values())
    for name, bus in file.robot.buses.items():
        mark = file.key("buses", name)
        used = {servo.bus for servo in described_servos(file.description)}
        used.update(*(each.buses for each in contributions))
        if name not in used:
            file.warning(mark, f"bus {name} has no joint or device, and is not opened", "remove it")
        wirings = [
            _wiring(servo, row, joints, modes)
            for row, servo in enumerate(servos)
            if servo.described.bus == name and servo.table.protocol == bus.protocol
        ]
        attached = [device for each in contributions for device in each.devices if device.bus == name]
        if not wirings and not attached:
            continue
        _check_baud_rate(file, name, [*(each.table for each in wirings), *(each.table for each in attached)])
        try:
            plan = bus_plan(
                name=name,
                port=bus.port,
                baud_rate=bus.baud_rate,
                latency_ns=bus.latency,
                return_delay_ns=bus.return_delay_time,
                joints=wirings,
                devices=[(device.plan, device.table) for device in attached],
                protocol=bus.protocol,
            )
        except ValueError as error:
            file.error(mark, str(error), f"correct the joints or devices of bus {name}")
            continue
        _check_ticks(file, plan)
        for _, stage in stages(SettingsStage, used_features(file.description)):
            stage.check(file, plan)
        _check_budget(file, plan)
        plans.append(_with_monitoring(file, plan))
    return plans


def _check_baud_rate(file: RobotFile, name: str, tables: Sequence[ControlTable | DeviceTable]) -> None:
    """Add an error if no servo or device on the bus supports its baud rate, a warning if some do not.

    A rate above those of all servos is accepted: it describes a bus without a wire, used to measure hosts.
    """
    rate, mark = file.robot.buses[name].baud_rate, file.at("buses", name, "baud_rate")
    if rate > HIGHEST_BAUD_RATE:
        return
    lacking = {table.model: table for table in tables if not table.has_baud_rate(rate)}
    if not lacking:
        return
    common = set.intersection(*(set(table.baud_rates.values()) for table in lacking.values()))
    known = ", ".join(f"{each:_}" for each in sorted(common))
    fix = f"write another rate: {known}" if known else "put these models on separate buses"
    what = f"{' and '.join(sorted(lacking))} on bus {name} cannot run at {rate:_} bit/s"
    if all(table.model in lacking for table in tables):
        file.error(mark, what, fix)
    else:
        file.warning(mark, what, fix)


def _own_ports(file: RobotFile) -> None:
    owners: dict[str, str] = {}
    for name, bus in file.robot.buses.items():
        owner = owners.setdefault(bus.port, name)
        if owner != name and bus.port != SIMULATED:
            alike = bus.protocol == file.robot.buses[owner].protocol
            file.error(
                file.at("buses", name, "port"),
                f"port {bus.port} of bus {name} belongs to bus {owner} already",
                "one port is one bus" if alike else f"give {name} an adapter of its own: {ONE_PROTOCOL}",
            )


def _wiring(
    servo: CompiledServo, row: int, joints: Mapping[str, CompiledJoint], modes: Mapping[str, Mode]
) -> Wiring:
    described = servo.described
    within = _servo_range(servo, [joints[name] for name in described.joints])
    return Wiring(
        joint=described.title,
        row=row,
        servo_id=described.id,
        table=servo.table,
        reference=described.reference,
        direction=described.direction,
        lower=within.lower,
        upper=within.upper,
        settings=servo.settings,
        continuous=described.continuous,
        start_mode=modes[described.joints[0]],
        ratio=described.ratio,
        unit=described.unit,
        name="" if described.name in described.joints else described.name,
    )


def _servo_range(servo: CompiledServo, joints: Sequence[CompiledJoint]) -> Interval:
    """Return the servo positions (after its gear) that occur while all its joints are within their limits."""
    ranges = [
        limits_of(joint.plan).scaled(joint.drive.levers[joint.servos.index(servo)], joint.plan.unit)
        for joint in joints
    ]
    first, *others = ranges
    return reduce(Interval.plus, others, first)


def _check_ticks(file: RobotFile, plan: BusPlan) -> None:
    joints = first_joints(file.description)
    for servo in plan.servos:
        if servo.lower_tick > servo.upper_tick:
            file.error(
                file.at("joints", joints[servo.own_name], "limits", "position"),
                f"the position limits of {servo.joint} contain no tick of the {servo.model}",
                f"widen the limits to more than one tick ({servo.position_text(servo.position_per_tick)})",
            )


def _check_budget(file: RobotFile, plan: BusPlan) -> None:
    rate = file.robot.loop.rate
    budget = plan.budget
    share = budget.total_ns * 1e-9 * rate
    mark = file.at("loop", "rate")
    origin = file.marks.origins.get(("loop", "rate"))
    given = f" (argument {origin})" if origin else ""
    link = help_link("the-rate-is-too-high-for-the-bus")
    cycle = f"one cycle on bus {plan.name} takes {budget.total_ns * 1e-6:.1f} ms"
    if share > 1.0:
        lower = f"lower the rate to at most {_floor(budget.highest_rate_hz)} Hz"
        file.error(
            mark,
            f"{cycle}, but the period at {rate:g} Hz{given} is {1e3 / rate:.3g} ms",
            "; ".join([lower, *_improvements(plan), link]),
        )
    elif share > _COMFORTABLE:
        file.warning(
            mark,
            f"{cycle}, {share:.0%} of the period: little time is left for controllers and the system",
            "; ".join(["lower the rate, or expect skipped periods", *_improvements(plan)]),
        )


def _improvements(plan: BusPlan) -> list[str]:
    """Return texts that name a change of the bus (latency, delay, second bus) and the loop rate it allows."""
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
        found.append("a second bus would shorten the cycle")
    return found


def _rate(budget: Budget, *, latency_ns: int | None = None, return_delay_ns: int | None = None) -> str:
    total = (
        budget.wire_ns
        + (budget.latency_ns if latency_ns is None else latency_ns)
        + (budget.return_delay_ns if return_delay_ns is None else return_delay_ns)
    )
    return _floor(1e9 / total)


def _floor(rate: float) -> str:
    """Format a rate in Hz, rounded down so that it is certainly possible, with two digits at least."""
    return str(math.floor(rate)) if rate >= 10 else f"{math.floor(rate * 10) / 10:g}"


def _with_monitoring(file: RobotFile, plan: BusPlan) -> BusPlan:
    """Return a bus plan with Bus Watchdog, slow registers, adapter settings, and torque policies."""
    bus, joints = file.robot.buses[plan.name], first_joints(file.description)
    policies = file.robot.policies
    items = bus.slow_registers.items
    return replace(
        plan,
        rs485=bus.adapter.rs485,
        boot_ns=bus.adapter.boot_time,
        servos=tuple(
            replace(
                servo,
                slow=slow_items(find_table(servo.model, plan.protocol)) if items is None else items,
                torque_on_return=policies.of_joint("on_returned_servo", joints[servo.own_name]) == "hold",
                torque_at_start=file.robot.joints[joints[servo.own_name]].torque,
            )
            for servo in plan.servos
        ),
        watchdog_ticks=_watchdog_ticks(file, plan),
        slow_period_ns=_slow_period_ns(file, plan),
        device_margin_ns=_device_margin_ns(file.description, plan),
    )


def _device_margin_ns(description: Description, plan: BusPlan) -> int:
    """Return the extra time to wait for a device's reply, ns: half of the idle time, within bounds."""
    left_ns = round(1e9 / description.robot.loop.rate) - plan.budget.total_ns
    return max(min(_MOST_DEVICE_MARGIN_NS, left_ns // 2), _LEAST_DEVICE_MARGIN_NS)


def slowest_period_ns(buses: Sequence[BusPlan]) -> int:
    """Return the longest loop period, ns, at which no servo's Bus Watchdog trips; 0: no watchdog is armed."""
    armed = [bus.watchdog_ticks for bus in buses if any(has_watchdog(bus, servo) for servo in bus.servos)]
    return min(armed) * UNIT_NS // LEAST_PERIODS if armed else 0


def _watchdog_ticks(file: RobotFile, plan: BusPlan) -> int:
    written = file.robot.buses[plan.name].bus_watchdog
    least_ns = math.ceil(LEAST_PERIODS * 1e9 / file.robot.loop.rate)
    if written == "auto":
        default_ns = max(WATCHDOG_NS, least_ns)
        # Round up to whole steps of the register.
        return -(-default_ns // UNIT_NS) if plan.protocol == 2.0 and default_ns <= MOST_TICKS * UNIT_NS else 0
    if not written:
        return 0
    mark = file.at("buses", plan.name, "bus_watchdog")
    if plan.protocol != 2.0:
        fix = "remove it; the guardian disables torque if the loop exits"
        file.error(mark, f"Protocol 1.0 of bus {plan.name} has no Bus Watchdog", fix)
        return 0
    if written < least_ns:
        least_ms = -(-least_ns // UNIT_NS) * UNIT_NS * 1e-6
        file.error(
            mark,
            f"a Bus Watchdog of {written * 1e-6:g} ms stops the servos of bus {plan.name} "
            "after one failed cycle",
            f"write at least {least_ms:g} ms (three periods), or 0 ms to disable it",
        )
    if written > MOST_TICKS * UNIT_NS:
        what = f"a Bus Watchdog has at most {MOST_TICKS} steps of {UNIT_NS * 1e-6:g} ms"
        file.error(mark, what, f"write at most {MOST_TICKS * UNIT_NS * 1e-9:g} s, or 0 ms to disable it")
        return 0
    # Round up: the watchdog must not trip earlier than the file says.
    return -(-written // UNIT_NS)


def _slow_period_ns(file: RobotFile, plan: BusPlan) -> int:
    slow = file.robot.buses[plan.name].slow_registers
    tables = [find_table(servo.model, plan.protocol).items for servo in plan.servos]
    known = tuple(dict.fromkeys(name for items in tables for name in items))
    for index, name in enumerate(slow.items or ()):
        if name not in known:
            mark = file.at("buses", plan.name, "slow_registers", "items", index)
            file.error(mark, f"no servo of bus {plan.name} has the item {name}", suggestion(name, known))
    return round(1e9 / slow.rate)
