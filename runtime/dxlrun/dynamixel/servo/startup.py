"""Start-up: the stages from silence to torque, on all lines of a robot side by side.

Check everything first (`checks.py`), set registers and modes, learn how each servo answers; then torque on in
groups, first states, torque confirmed, Bus Watchdogs armed. No stage begins before the one before succeeded
on every line. The order and its reasons are in failures.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Protocol, TypeVar

import msgspec

from dxlrun.channels.cycle import Commands
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.device.device_checks import survey_devices
from dxlrun.dynamixel.exchange.bus import Lines
from dxlrun.dynamixel.plan.line import TIMEOUT_MARGIN_NS, listen
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.reads import state_read
from dxlrun.dynamixel.plan.retry import LONGER_NS, extend_timeouts, retry, setup_line
from dxlrun.dynamixel.port.latency_timer import late_replies
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.checks import survey
from dxlrun.dynamixel.servo.registers import restore_torque_limits, settle_bus
from dxlrun.dynamixel.servo.servos import Servos
from dxlrun.errors import PortError, StartUpError
from dxlrun.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.plan.transaction import Program, Result

GROUP = 3
"""Servos that get torque before the next ones do: eight at once could pull the supply down."""
GROUP_PAUSE_NS = 20_000_000
RETURN_DELAY_STEP_NS = 2_000  # Unit of Return Delay Time (e-Manual AX-12A (5), XM430-W350 (9))
_SOME = 8
"""Replies, from which on it is known how late they usually come: three pings a servo, and its model."""


class _Stage(Protocol):
    """What a stage found on one bus."""

    @property
    def problems(self) -> list[str]:
        """Why the robot must not start, one sentence each."""
        ...


_Found = TypeVar("_Found", bound=_Stage)


class Engagement(msgspec.Struct):
    """What came of torque on."""

    problems: list[str] = []
    goals: list[int | None] = []
    """Goal position in ticks as it was written, in the order of the plan's servos; None: there is none."""
    limp: list[str] = []  # Joints that the robot file wants without torque


class Probed(msgspec.Struct):
    """What was found out about the cyclic reads of one bus."""

    return_delays: dict[int, int] = {}  # What each servo waits before it answers, by ID, ns
    refused: dict[int, str] = {}
    """Groups that do not answer the fast form, and why, in a sentence without its subject."""


class StartUp:
    """Runs each stage on all lines.

    Each raises StartUpError with all problems of its stage, PortError when a line is gone.
    """

    def __init__(self, lines: Lines, servos: Sequence[Servos], events: EventSink) -> None:
        self._plans = lines.plans
        self._lines = lines
        self._servos = servos
        self._events = events
        self._late_ns: list[list[int]] = [[] for _ in lines.plans]
        """How much later than by the wire the replies on each bus came."""

    def look(self, take_over: bool) -> None:
        """Check every servo; bring registers and modes to those of the plan; learn how each answers."""
        surveys = self._run([survey(plan, take_over) for plan in self._plans])
        devices = self._run([survey_devices(plan) for plan in self._plans])
        for one in surveys:
            self._log(EventCode.SETUP, Severity.INFO, one.servos)
            self._log(EventCode.REGISTER_DIFFERS, Severity.WARNING, one.differences)
        for found in devices:
            self._log(EventCode.SETUP, Severity.INFO, found.devices)
        _judge([*surveys, *devices])
        _refuse(self._late_replies())
        self._settle_registers()
        self._settle_modes()
        self._probe_reads()
        self.carry_out([watchdog.disarm_all(plan) for plan in self._plans])

    def engage(self, goals: Commands) -> None:
        """Hold every servo where it stands, and let the goals be that."""
        engaged = self._run([_engage(plan) for plan in self._plans])
        _judge(engaged)
        for plan, servos, one in zip(self._plans, self._servos, engaged, strict=True):
            servos.engaged()
            for servo, raw in zip(plan.servos, one.goals, strict=True):
                _first_goals(goals, servo, raw)
            # servos of one joint are next to one another, and it is named once
            names = ", ".join(dict.fromkeys(servo.joint for servo in plan.servos if servo.torque_at_start))
            if names:
                self._events.emit(EventCode.TORQUE_ON, Severity.INFO, plan.name, f"torque is on: {names}")
            if one.limp:
                text = f"limp, as the robot file says: {', '.join(one.limp)}"
                self._events.emit(EventCode.TORQUE_OFF, Severity.INFO, plan.name, text)

    def restore_limits(self) -> list[list[int]]:
        """Give the servos the torque again that a policy of an earlier run may have left them without.

        Returns each servo's own limit in ticks, by bus.
        """
        limits = self._run([restore_torque_limits(plan) for plan in self._plans])
        _judge(limits)
        for one in limits:
            self._log(EventCode.SETUP, Severity.INFO, one.restored)
        return [one.full for one in limits]

    def confirm(self) -> None:
        """Read torque enable of every servo again, and let them get goals.

        Torque on draws current: a servo that browned out meanwhile answers again, limp, and may get no goal.
        """
        self.carry_out([_confirm(plan) for plan in self._plans])
        for servos in self._servos:
            servos.confirmed()

    def carry_out(self, programs: Sequence[Program[list[str]]]) -> None:
        """Run one program a bus that returns what went wrong."""
        _refuse_any(self._run_all(programs))

    def watch(self) -> None:
        """Arm the Bus Watchdogs, which stop the servos where a reply is awaited for too long."""
        programs = [servos.watch() for servos in self._servos]
        longer_ns = [watchdog.longer_ns(plan) or LONGER_NS for plan in self._plans]
        _refuse_any(self._run_all(programs, longer_ns))

    def pause(self, duration_ns: int) -> None:
        """Let a moment pass, and take what still comes."""
        self.carry_out([_pause(duration_ns) for _ in self._plans])

    def raise_failures(self) -> None:
        """Raise PortError when a line is gone: there is no start without it."""
        if error := report_failures(self._lines, self._servos):
            raise error

    def _settle_registers(self) -> None:
        """Write what the robot file declares and a servo has otherwise, before torque is switched on."""
        settled = self._run([settle_bus(plan) for plan in self._plans])
        for one in settled:
            self._log(EventCode.REGISTER_WRITTEN, Severity.INFO, one.written)
        _judge(settled)

    def _settle_modes(self) -> None:
        """Bring every servo into its first mode, before torque is switched on, and learn its own limits."""
        settled = self._run([modes.settle_modes(plan) for plan in self._plans])
        for one in settled:
            self._log(EventCode.MODE, Severity.WARNING, one.switched)
        _judge(settled)
        for servos, one in zip(self._servos, settled, strict=True):
            for index, limits in enumerate(one.limits):
                servos.goals.set_limits(index, limits)

    def _probe_reads(self) -> None:
        """Find out when replies are due, and read each group plainly that does not answer the fast form."""
        probes = self._run_all([_probe_reads(plan) for plan in self._plans])
        for plan, servos, probed in zip(self._plans, self._servos, probes, strict=True):
            if probed is None:
                continue
            servos.reads.learn(probed.return_delays)
            for group in probed.refused:
                servos.reads.plain(group)
            if probed.refused:
                total_ns = plan.budget.total_ns + _extra_ns(plan, probed.refused)
                why = "; ".join(probed.refused.values())
                text = (
                    f"bus {plan.name} is not read by a fast form, {why}: a cycle "
                    f"takes {total_ns / 1e6:.2f} ms instead of {plan.budget.total_ns / 1e6:.2f} ms, at most "
                    f"{1e9 / total_ns:.0f} Hz"
                )
                self._events.emit(EventCode.SETUP, Severity.WARNING, plan.name, text)

    def _run(self, programs: Sequence[Program[_Found]]) -> list[_Found]:
        """Run one program a bus; `_judge` comes when everything that they found was logged."""
        return [one for one in self._run_all(programs) if one is not None]

    def _run_all(
        self, programs: Sequence[Program[Result]], most_ns: Sequence[int] = ()
    ) -> list[Result | None]:
        """Run one program a bus with longer timeouts, as nothing else waits; `most_ns`: for a reply."""
        most_ns = most_ns or [LONGER_NS] * len(programs)
        slow = [
            extend_timeouts(program, most, late_ns)
            for program, most, late_ns in zip(programs, most_ns, self._late_ns, strict=True)
        ]
        found = self._lines.run(slow)
        self.raise_failures()
        return found

    def _late_replies(self) -> Iterable[str]:
        """Name the buses whose replies usually come when the cyclic reads have given them up."""
        for plan, late_ns in zip(self._plans, self._late_ns, strict=True):
            usual_ns = median(late_ns) if len(late_ns) >= _SOME else 0.0
            if usual_ns > plan.latency_ns + TIMEOUT_MARGIN_NS:
                what, fix = late_replies(plan.name, plan.port, usual_ns, plan.latency_ns)
                yield f"every servo answers too late: {'; '.join(filter(None, (what, fix)))}"

    def _log(self, code: EventCode, severity: Severity, texts: Iterable[tuple[str, str]]) -> None:
        for joint, text in texts:
            self._events.emit(code, severity, joint, text)


def report_failures(lines: Lines, servos: Sequence[Servos]) -> PortError | None:
    """Report each line that is gone, once; return the first of them."""
    first: PortError | None = None
    for plan, bus, mine in zip(lines.plans, lines.buses, servos, strict=True):
        if bus.failure is not None:
            text = f"bus {plan.name} on {plan.port}: {bus.failure}"
            mine.lost(text)
            first = first or PortError(text)
    return first


def _engage(plan: BusPlan) -> Program[Engagement]:
    """Hold every servo where it stands: goal := present, torque on, both read back, group by group.

    Those that the robot file wants limp get none, and lose what they have. Ends at the first problem; the
    caller takes back the torque.
    """
    result = Engagement()
    for index, servo in enumerate(plan.servos):
        if not servo.torque_at_start:
            if problem := (yield from _let_go(plan, index)):
                result.problems.append(f"{plan.label(servo)} {problem}")
                break
            result.limp.append(servo.joint)
            result.goals.append(None)
            continue
        given = index - len(result.limp)
        if given and given % GROUP == 0:
            yield listen(GROUP_PAUSE_NS)
        held = yield from modes.hold(plan, servo, servo.mode_plan(servo.start_mode))
        if held.problem:
            result.problems.append(f"{plan.label(servo)} {held.problem}")
            break
        result.goals.append(held.goal)
    return result


def _let_go(plan: BusPlan, index: int) -> Program[str]:
    servo = plan.servos[index]
    back = yield from retry(plan.torque_reads[index])
    if back.answered and back.parameters[0]:
        yield from retry(setup_line(plan).write(servo.servo_id, servo.torque_address, b"\0"))
        back = yield from retry(plan.torque_reads[index])
    if back.answered and not back.parameters[0]:
        return ""
    return "did not confirm that its torque is off"


def _confirm(plan: BusPlan) -> Program[list[str]]:
    """Read torque enable of every servo again, after the last one got torque; return what is wrong."""
    problems: list[str] = []
    for servo, read in zip(plan.servos, plan.torque_reads, strict=True):
        if not servo.torque_at_start:
            continue
        reply = yield from retry(read)
        if not reply.answered:
            problems.append(f"{plan.label(servo)} did not answer after torque was switched on")
        elif reply.parameters[0] != 1:
            problems.append(
                f"{plan.label(servo)} lost its torque again while the others got theirs (Torque Enable "
                f"({servo.torque_address}) is {reply.parameters[0]}): is its supply strong enough?"
            )
    return problems


def _probe_reads(plan: BusPlan) -> Program[Probed]:
    """Read the return delay of every servo, and try the fast form on every group that is to be read by it."""
    found = Probed()
    for servo in plan.servos:
        raw = yield from _read_item(plan, servo, "return_delay_time")
        if raw is not None:
            found.return_delays[servo.servo_id] = raw * RETURN_DELAY_STEP_NS
    line = setup_line(plan)
    for number, (group, fast) in enumerate(zip(plan.groups, plan.fast, strict=True)):
        if fast:
            reply = yield from retry(state_read(line, [plan.members[index] for index in group], fast=True))
            if not reply.answered:
                servos = [plan.servos[index] for index in group if index < len(plan.servos)]
                found.refused[number] = yield from _why_not_fast(plan, servos)
    return found


def _why_not_fast(plan: BusPlan, servos: list[ServoPlan]) -> Program[str]:
    old: list[str] = []
    needed: set[int] = set()
    for servo in servos:
        first = control_table(servo.model, plan.protocol).fast_sync_read_firmware
        found = yield from _read_item(plan, servo, "firmware_version")
        if first is not None and found is not None and found < first:
            old.append(f"{plan.label(servo)} has {found}")
            needed.add(first)
    if not old:
        return "though their firmware should know it"
    numbers = " or ".join(f"{number}" for number in sorted(needed))
    return f"as it needs firmware {numbers} and {', '.join(old)}"


def _extra_ns(plan: BusPlan, refused: Mapping[int, str]) -> int:
    """Return how much longer a cycle takes when these groups are read by the form that every servo knows."""
    line, extra_ns = plan_line(plan), 0
    for number in refused:
        members = [plan.members[index] for index in plan.groups[number]]
        extra_ns += state_read(line, members).due_ns - state_read(line, members, fast=True).due_ns
    return extra_ns


def _read_item(plan: BusPlan, servo: ServoPlan, name: str) -> Program[int | None]:
    item = control_table(servo.model, plan.protocol).items.get(name)
    if item is None:
        return None
    reply = yield from retry(setup_line(plan).read(servo.servo_id, item.address, item.size))
    return item.decode(reply.parameters) if reply.answered else None


def _pause(duration_ns: int) -> Program[list[str]]:
    yield listen(duration_ns)
    return []


def _judge(stage: Iterable[_Stage]) -> None:
    _refuse(problem for one in stage for problem in one.problems)


def _refuse_any(found: Iterable[list[str] | None]) -> None:
    _refuse(problem for one in found if one is not None for problem in one)


def _refuse(problems: Iterable[str]) -> None:
    if found := "\n".join(problems):
        raise StartUpError(found)


def _first_goals(goals: Commands, servo: ServoPlan, raw: int | None) -> None:
    """Let the goals be what the servo was given: where it stands, without a speed, or 0."""
    row, mode = servo.row, servo.start_mode
    goals.position[row] = float("nan") if raw is None else servo.joint_position(raw)
    goals.velocity[row] = 0.0 if mode is Mode.VELOCITY else float("nan")
    goals.effort[row] = 0.0 if mode is Mode.EFFORT else float("nan")
    goals.pwm[row] = 0.0 if mode is Mode.PWM else float("nan")
