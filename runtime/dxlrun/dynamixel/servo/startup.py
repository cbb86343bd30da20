"""Start-up: the stages from the first packet to torque on, on all lines of a robot in parallel.

Everything is checked first (`checks.py`). Then registers and modes are set, and the return delays are read.
Then torque is switched on in groups, the first states are read, torque is confirmed, and the Bus Watchdogs
are armed. A stage begins only after the previous one succeeded on every line. The order and its reasons are
in failures.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeAlias

import msgspec
import numpy as np

from dxlrun.channels.cycle import Commands
from dxlrun.channels.event_records import EventSink
from dxlrun.dynamixel import texts
from dxlrun.dynamixel.bus_part import BusStage
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import choose_remedy, describe_late_start
from dxlrun.dynamixel.servo import mode_switches, watchdog
from dxlrun.dynamixel.servo.checks import find_turns, survey
from dxlrun.dynamixel.servo.item_access import Access, access_servo, first_reach
from dxlrun.dynamixel.servo.registers import settle_bus
from dxlrun.dynamixel.servo.servo_supervision import Servos
from dxlrun.errors import PortError, StartUpError
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.control_table import find_table
from dxlwire.exchange.bus_engine import Lines
from dxlwire.modes import Mode
from dxlwire.plan.line import TIMEOUT_MARGIN_NS, listen_transaction
from dxlwire.plan.planning import plan_line
from dxlwire.plan.reads import state_read
from dxlwire.plan.retry import (
    LONGER_NS,
    ReplyLateness,
    extend_timeouts,
    limit_patience,
    retry,
    setup_line,
)
from dxlwire.transaction import Program, Result

GROUP = 3
"""Number of servos that get torque between two pauses: eight at once could pull the supply down."""
GROUP_PAUSE_NS = 20_000_000
RETURN_DELAY_STEP_NS = 2_000  # unit of Return Delay Time (e-Manual AX-12A (5), XM430-W350 (9))
_SOME = 8
"""Fewest replies from which a bus's usual lateness is judged: three pings per servo, and its model."""


Stage: TypeAlias = Callable[[BusPlan, Findings], Program[Result]]
"""Creates the program of one start-up stage for one bus; the program adds its problems and events to the
findings.
"""


class ProbeResult(msgspec.Struct):
    """Properties of the cyclic reads of one bus that start-up has measured."""

    return_delays: dict[int, int] = {}  # return delay of each servo, by ID, ns
    refused: dict[int, str] = {}
    """Groups that do not answer the fast sync or bulk read, by number in the plan, with the reason, a
    sentence without its subject.
    """


class StartUp:
    """Start-up of all servos of a robot: runs each stage on all lines in parallel.

    A stage raises StartUpError with all of its problems, or PortError if a line is gone.
    """

    def __init__(
        self, lines: Lines, servos: Sequence[Servos], events: EventSink, features: Sequence[Feature]
    ) -> None:
        self._lines = lines
        self._servos = servos
        self._events = events
        self._features = features
        self._times = [ReplyLateness() for _ in lines.plans]
        """Lateness of the replies on each bus, from which slow adapters are found."""

    @property
    def _plans(self) -> tuple[BusPlan, ...]:
        return self._lines.plans

    def check_servos(self, take_over: bool) -> None:
        """Check every servo, write registers and modes as planned, and read the servos' return delays; torque
        is not switched on.
        """
        found = [Findings() for _ in self._plans]
        placed = self._run(lambda plan, found: survey(plan, take_over, found), found)
        for _, stage in stages(BusStage, self._features):
            self._run(stage.inspect, found)
        self._judge(found)
        # Refuse before any register is written.
        _refuse(self._late_replies(), for_replies=True)
        self._place(placed)
        self.stage(settle_bus)
        settled = self.stage(mode_switches.settle_modes)
        self._place(self.stage(find_turns))
        for servos, limits in zip(self._servos, settled, strict=True):
            for index, own in enumerate(limits):
                servos.goals.set_limits(index, own)
        self._probe_reads()
        self.stage(watchdog.disarm_all)

    def _place(self, placed: Sequence[Sequence[ServoPlan]]) -> None:
        for servos, plans in zip(self._servos, placed, strict=True):
            for index, plan in enumerate(plans):
                servos.desired.place_servo(index, plan)

    def engage_servos(self, goals: Commands) -> None:
        """Switch torque on at the present position of every servo that starts with torque, and set `goals` to
        these positions.
        """
        engaged = self.stage(_engage)
        for plan, servos, ticks in zip(self._plans, self._servos, engaged, strict=True):
            servos.engaged()
            for servo, raw in zip(plan.servos, ticks, strict=True):
                _first_goals(goals, servo, raw)
            # Servos of one joint are adjacent; name the joint once.
            names = ", ".join(dict.fromkeys(servo.joint for servo in plan.servos if servo.torque_at_start))
            if names:
                self._events.emit_event(plan.name, texts.torque_is_on(names))
            if limp := ", ".join(servo.joint for servo in plan.servos if not servo.torque_at_start):
                self._events.emit_event(plan.name, texts.joints_start_limp(limp))

    def confirm(self) -> None:
        """Read torque enable of every servo again, and start sending goals to those with torque.

        Torque on draws current. A servo that browned out answers again, but limp, and must not get a goal.
        """
        self.stage(_confirm)
        for servos in self._servos:
            servos.confirmed()

    def arm_watchdogs(self) -> None:
        """Arm the Bus Watchdogs, which stop the servos when the host sends no instruction for too long."""
        mine = dict(zip((plan.name for plan in self._plans), self._servos, strict=True))
        longer_ns = [watchdog.longer_ns(plan) or LONGER_NS for plan in self._plans]
        self.stage(
            lambda plan, found: limit_patience(mine[plan.name].begin_watching(found), any_age=True), longer_ns
        )

    def raise_failures(self) -> None:
        """Report lost lines, and raise PortError if there is one: a start needs every line."""
        if error := report_failures(self._lines, self._servos):
            raise error

    def _probe_reads(self) -> None:
        """Measure the return delays, and use plain reads for each group of servos that does not answer the
        fast form.
        """
        probes = self.stage(_probe_reads)
        for plan, servos, probed in zip(self._plans, self._servos, probes, strict=True):
            servos.reads.set_return_delays(probed.return_delays)
            for group in probed.refused:
                servos.reads.plain(group)
            if probed.refused:
                total_ns = plan.budget.total_ns + _extra_ns(plan, probed.refused)
                why = "; ".join(probed.refused.values())
                event = texts.fast_reads_refused(plan.name, why, total_ns, plan.budget.total_ns)
                self._events.emit_event(plan.name, event)

    def stage(self, stage: Stage[Result], most_ns: Sequence[int] = ()) -> list[Result]:
        """Run a stage on all lines and log its events; return its result on each line. Raise StartUpError if
        it found problems.

        Args:
            stage: The stage.
            most_ns: Additional timeout of a reply on each line; empty: `LONGER_NS`.
        """
        found = [Findings() for _ in self._plans]
        for times in self._times:
            times.missing = 0
        results = self._run(stage, found, most_ns)
        self._judge(found)
        return results

    def _run(
        self, stage: Stage[Result], found: Sequence[Findings], most_ns: Sequence[int] = ()
    ) -> list[Result]:
        """Run one program per bus with timeouts that are longer than in a cycle, which does not wait here;
        raise PortError for a lost line.
        """
        most_ns = most_ns or [LONGER_NS] * len(found)
        slow = [
            extend_timeouts(stage(plan, one), most, times)
            for plan, one, most, times in zip(self._plans, found, most_ns, self._times, strict=True)
        ]
        results = self._lines.run_programs(slow)
        self.raise_failures()
        return [result for result in results if result is not None]

    def _judge(self, found: Iterable[Findings]) -> None:
        for one in found:
            one.log(self._events)
        missing = any(times.missing for times in self._times)
        _refuse((problem for one in found for problem in one.problems), for_replies=missing)

    def _late_replies(self) -> Iterable[str]:
        """Yield a sentence for each bus whose median reply comes after the timeout of the cyclic reads."""
        for plan, times in zip(self._plans, self._times, strict=True):
            late_ns = times.late_ns
            # Use the median: a few late replies may be due to the machine's load.
            usual_ns = float(np.median(late_ns)) if len(late_ns) >= _SOME else 0.0
            if usual_ns > plan.latency_ns + TIMEOUT_MARGIN_NS:
                observed = describe_late_start(plan.name, plan.port, late_ns, plan.latency_ns)
                yield f"the loop would miss most replies: {observed}"


def report_failures(lines: Lines, servos: Sequence[Servos]) -> PortError | None:
    """Report each lost line to the `Servos` of its bus, which logs it once; return the first failure, None if
    no line is lost.
    """
    first: PortError | None = None
    for plan, bus, mine in zip(lines.plans, lines.buses, servos, strict=True):
        if bus.failure is not None:
            text = f"bus {plan.name} on {plan.port}: {bus.failure}"
            mine.lost(text)
            first = first or PortError(text)
    return first


def _engage(plan: BusPlan, found: Findings) -> Program[list[int | None]]:
    """Switch torque on at every servo's present position: goal := present, torque on, both read back, GROUP
    servos at a time.

    A servo that the robot file declares limp gets no torque, and loses torque that it has. The program ends
    at the first problem; the caller then switches torque off again.

    Returns:
        Goal positions as written, in ticks, in the order of the plan's servos; None: the servo has no goal
            position.
    """
    goals: list[int | None] = []
    given = 0
    for servo in plan.servos:
        one = access_servo(plan, servo)
        if servo.torque_at_start:
            # Let the supply recover from the inrush of one group before the next.
            if given and given % GROUP == 0:
                yield listen_transaction(GROUP_PAUSE_NS)
            held = yield from mode_switches.hold_servo(one, servo.start_mode)
            problem, given = held.problem, given + 1
            goals.append(held.goal)
        else:
            problem = yield from _let_go(one)
            goals.append(None)
        if problem:
            found.problems.append(f"{one} {problem}")
            break
    return goals


def _let_go(one: Access) -> Program[str]:
    back = yield from one.read_torque()
    if back.answered and back.parameters[0]:
        yield from one.torque_off()
        back = yield from one.read_torque()
    return "" if back.answered and not back.parameters[0] else "did not confirm that its torque is off"


def _confirm(plan: BusPlan, found: Findings) -> Program[None]:
    """Read torque enable of every servo that starts with torque again; a value other than 1 is a problem."""
    for servo in plan.servos:
        if not servo.torque_at_start:
            continue
        reply = yield from access_servo(plan, servo).read_torque()
        if not reply.answered:
            found.problems.append(f"{plan.label(servo)} did not answer after torque was switched on")
        elif reply.parameters[0] != 1:
            remedy = choose_remedy(plan.port, "is its supply strong enough?")
            found.problems.append(
                f"{plan.label(servo)} lost its torque while the other servos were switched on (Torque "
                f"Enable ({servo.torque_address}) is {reply.parameters[0]}): {remedy}"
            )


def _probe_reads(plan: BusPlan, _: Findings) -> Program[ProbeResult]:
    """Read the return delay of every servo, and try the fast read on every group that is planned with it."""
    found = ProbeResult()
    for servo in plan.servos:
        raw = yield from first_reach(plan, servo).read_one("return_delay_time")
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
        first = find_table(servo.model, plan.protocol).fast_sync_read_firmware
        found = yield from first_reach(plan, servo).read_one("firmware_version")
        if first is not None and found is not None and found < first:
            old.append(f"{plan.label(servo)} has {found}")
            needed.add(first)
    if not old:
        return "the servos do not answer them despite suitable firmware"
    numbers = " or ".join(f"{number}" for number in sorted(needed))
    return f"they need firmware {numbers}, but {', '.join(old)}"


def _extra_ns(plan: BusPlan, refused: Mapping[int, str]) -> int:
    """Return the additional time (ns) of a cycle if these groups are read with plain instead of fast
    reads."""
    line, extra_ns = plan_line(plan), 0
    for number in refused:
        members = [plan.members[index] for index in plan.groups[number]]
        extra_ns += state_read(line, members).due_ns - state_read(line, members, fast=True).due_ns
    return extra_ns


def _refuse(problems: Iterable[str], *, for_replies: bool) -> None:
    if found := "\n".join(problems):
        raise StartUpError(found, for_replies=for_replies)


def _first_goals(goals: Commands, servo: ServoPlan, raw: int | None) -> None:
    """Set the goals of a servo, in its joint's row, for its start mode: present position without a speed, or
    velocity, effort or PWM 0.
    """
    row, mode = servo.row, servo.start_mode
    goals.position[row] = float("nan") if raw is None else servo.joint_position(raw)
    goals.velocity[row] = 0.0 if mode is Mode.VELOCITY else float("nan")
    goals.effort[row] = 0.0 if mode is Mode.EFFORT else float("nan")
    goals.pwm[row] = 0.0 if mode is Mode.PWM else float("nan")
