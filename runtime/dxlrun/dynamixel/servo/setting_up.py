"""Setting up: the stages from silence to torque, on all lines of a robot side by side; see `startup`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Protocol, TypeVar

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.pump import run
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.line import PATIENCE_NS, listen
from dxlrun.dynamixel.plan.units import joint_position
from dxlrun.dynamixel.port.latency_timer import late_replies
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.registers import bus_watchdog, torque_limit
from dxlrun.dynamixel.registers.declared import settle_bus
from dxlrun.dynamixel.registers.modes import settle_modes
from dxlrun.dynamixel.registers.patience import LONGER_NS, patient
from dxlrun.dynamixel.registers.probing import extra_ns, probe_reads
from dxlrun.dynamixel.servo import startup
from dxlrun.dynamixel.servo.health import Servos
from dxlrun.dynamixel.wire.transaction import Program, Result
from dxlrun.errors import PortError, StartUpError
from dxlrun.interfaces import Commands
from dxlrun.mode import Mode
from dxlrun.run.channels.events import EventCode, EventSink, Severity

_SOME = 8
"""Replies, from which on it is known how late they usually come: three pings a servo, and what it is."""


class _Stage(Protocol):
    """What a stage found on one bus."""

    @property
    def problems(self) -> list[str]:
        """Why the robot must not start, one sentence each."""
        ...


_Found = TypeVar("_Found", bound=_Stage)


class SetUp:
    """Runs each stage on all lines, and goes no further than a stage in which anything was wrong.

    Each raises StartUpError with all problems of its stage, PortError when a line is gone.
    """

    def __init__(  # noqa: PLR0917  what a robot's lines consist of
        self,
        plans: Sequence[BusPlan],
        buses: Sequence[Bus],
        servos: Sequence[Servos],
        ports: Ports,
        clock: Clock,
        events: EventSink,
        beat: Callable[[], None],
    ) -> None:
        self._plans = plans
        self._buses = buses
        self._servos = servos
        self._ports = ports
        self._clock = clock
        self._events = events
        self._beat = beat
        self._late_ns: list[list[int]] = [[] for _ in plans]
        """How much later than by the wire the replies on each bus came."""

    def look(self, take_over: bool) -> None:
        """Look at every servo; bring registers and modes to what the plan says; learn how each answers."""
        surveys = self._run([startup.survey(plan, take_over) for plan in self._plans])
        for one in surveys:
            self._tell(EventCode.SETUP, Severity.INFO, one.servos)
            self._tell(EventCode.REGISTER_DIFFERS, Severity.WARNING, one.differences)
        _judge(surveys)
        _refuse(self._late_replies())
        self._settle_registers()
        self._settle_modes()
        self._probe_reads()
        self.carry_out([bus_watchdog.disarm_all(plan) for plan in self._plans])

    def engage(self, goals: Commands) -> None:
        """Hold every servo where it stands, and let the goals be that."""
        engaged = self._run([startup.engage(plan) for plan in self._plans])
        _judge(engaged)
        for plan, one in zip(self._plans, engaged, strict=True):
            for servo, raw in zip(plan.servos, one.goals, strict=True):
                _first_goals(goals, servo, raw)
            names = ", ".join(servo.joint for servo in plan.servos)
            self._events.emit(EventCode.TORQUE_ON, Severity.INFO, plan.name, f"torque is on: {names}")

    def restore_limits(self) -> list[list[int]]:
        """Give the servos the torque again that a policy of an earlier run may have left them without.

        Returns each servo's own limit in ticks, by bus.
        """
        limits = self._run([torque_limit.restore(plan) for plan in self._plans])
        _judge(limits)
        for one in limits:
            self._tell(EventCode.SETUP, Severity.INFO, one.restored)
        return [one.full for one in limits]

    def torque_lasts(self) -> None:
        """Read torque enable of everybody again: who was reset by the inrush of others may get no goal."""
        self.carry_out([startup.confirm(plan) for plan in self._plans])

    def carry_out(self, programs: Sequence[Program[list[str]]]) -> None:
        """Run one program a bus that returns what went wrong."""
        found = self._patiently(programs)
        _refuse(problem for one in found if one is not None for problem in one)

    def watch(self) -> None:
        """Arm the Bus Watchdogs, which stop the servos where anybody is awaited for too long."""
        found = self._patiently(
            [servos.watch() for servos in self._servos],
            [bus_watchdog.patience_ns(plan) or LONGER_NS for plan in self._plans],
        )
        _refuse(problem for one in found if one is not None for problem in one)

    def pause(self, duration_ns: int) -> None:
        """Let a moment pass, and hear what still comes."""
        self.carry_out([_pause(duration_ns) for _ in self._plans])

    def raise_failures(self) -> None:
        """Raise PortError when a line is gone: there is no set-up without it."""
        if error := tell_failures(self._plans, self._buses, self._servos):
            raise error

    def _settle_registers(self) -> None:
        """Write what the robot file declares and a servo has otherwise, before anybody gets torque."""
        settled = self._run([settle_bus(plan) for plan in self._plans])
        for one in settled:
            self._tell(EventCode.REGISTER_WRITTEN, Severity.INFO, one.written)
        _judge(settled)

    def _settle_modes(self) -> None:
        """Bring every servo into its first mode, before anybody gets torque, and learn its own limits."""
        settled = self._run([settle_modes(plan) for plan in self._plans])
        for one in settled:
            self._tell(EventCode.MODE, Severity.WARNING, one.switched)
        _judge(settled)
        for servos, one in zip(self._servos, settled, strict=True):
            for index, limits in enumerate(one.limits):
                servos.goals.set_limits(index, limits)

    def _probe_reads(self) -> None:
        """Find out when replies are due, and read plainly whoever does not answer the fast forms."""
        probes = self._patiently([probe_reads(plan) for plan in self._plans])
        for plan, servos, probed in zip(self._plans, self._servos, probes, strict=True):
            if probed is None:
                continue
            servos.reads.learn(probed.return_delays)
            for group in probed.refused:
                servos.reads.plain(group)
            if probed.refused:
                total_ns = plan.budget.total_ns + extra_ns(plan, probed.refused)
                why = "; ".join(probed.refused.values())
                text = (
                    f"bus {plan.name} is not read by a fast form, {why}: a cycle "
                    f"takes {total_ns / 1e6:.2f} ms instead of {plan.budget.total_ns / 1e6:.2f} ms, at most "
                    f"{1e9 / total_ns:.0f} Hz"
                )
                self._events.emit(EventCode.SETUP, Severity.WARNING, plan.name, text)

    def _run(self, programs: Sequence[Program[_Found]]) -> list[_Found]:
        """Run one program a bus; `_judge` comes when everything that they found was told."""
        return [one for one in self._patiently(programs) if one is not None]

    def _patiently(
        self, programs: Sequence[Program[Result]], most_ns: Sequence[int] = ()
    ) -> list[Result | None]:
        """Run one program a bus with the patience of somebody who is in no hurry; `most_ns`: for a reply."""
        most_ns = most_ns or [LONGER_NS] * len(programs)
        slow = [
            patient(program, most, late_ns)
            for program, most, late_ns in zip(programs, most_ns, self._late_ns, strict=True)
        ]
        found = run(slow, self._buses, self._ports, self._clock, self._beat)
        self.raise_failures()
        return found

    def _late_replies(self) -> Iterable[str]:
        """Name the buses whose replies usually come when the cyclic reads have given them up."""
        for plan, late_ns in zip(self._plans, self._late_ns, strict=True):
            usual_ns = median(late_ns) if len(late_ns) >= _SOME else 0.0
            if usual_ns > plan.latency_ns + PATIENCE_NS:
                told = late_replies(plan.name, plan.port, usual_ns, plan.latency_ns)
                yield f"every servo answers too late: {told}"

    def _tell(self, code: EventCode, severity: Severity, told: Iterable[tuple[str, str]]) -> None:
        for joint, text in told:
            self._events.emit(code, severity, joint, text)


def tell_failures(
    plans: Sequence[BusPlan], buses: Sequence[Bus], servos: Sequence[Servos]
) -> PortError | None:
    """Tell of each line that is gone, once; return the first of them."""
    first: PortError | None = None
    for plan, bus, mine in zip(plans, buses, servos, strict=True):
        if bus.failure is not None:
            text = f"bus {plan.name} on {plan.port}: {bus.failure}"
            mine.lost(text)
            first = first or PortError(text)
    return first


def _pause(duration_ns: int) -> Program[list[str]]:
    yield listen(duration_ns)
    return []


def _judge(stage: Iterable[_Stage]) -> None:
    _refuse(problem for one in stage for problem in one.problems)


def _refuse(problems: Iterable[str]) -> None:
    found = "\n".join(problems)
    if found:
        raise StartUpError(found)


def _first_goals(goals: Commands, servo: ServoPlan, raw: int | None) -> None:
    """Let the goals be what the servo was given: where it stands, without a speed, or 0."""
    row, mode = servo.row, servo.start_mode
    goals.position[row] = float("nan") if raw is None else joint_position(servo, raw)
    goals.velocity[row] = 0.0 if mode is Mode.VELOCITY else float("nan")
    goals.effort[row] = 0.0 if mode is Mode.EFFORT else float("nan")
    goals.pwm[row] = 0.0 if mode is Mode.PWM else float("nan")
