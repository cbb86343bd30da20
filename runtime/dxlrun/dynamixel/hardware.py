"""Dynamixel hardware: joints on serial lines of either protocol, all lines at once in one thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from dxlrun.clock import Clock
from dxlrun.dynamixel import bus_watchdog, startup, torque_limit
from dxlrun.dynamixel.bus import NEVER, Bus
from dxlrun.dynamixel.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.exchange import MOST_BROKEN
from dxlrun.dynamixel.gaps import Gaps
from dxlrun.dynamixel.health import Servos
from dxlrun.dynamixel.jumps import Jumps
from dxlrun.dynamixel.limp import LimpOutcome, limp_buses
from dxlrun.dynamixel.modes import settle_modes
from dxlrun.dynamixel.port import Ports
from dxlrun.dynamixel.probing import extra_ns, probe_reads
from dxlrun.dynamixel.pump import pump, run
from dxlrun.dynamixel.registers import settle_bus
from dxlrun.dynamixel.torque_limit import reduced
from dxlrun.dynamixel.transaction import Program
from dxlrun.dynamixel.units import joint_position
from dxlrun.dynamixel.wanted import Wanted
from dxlrun.errors import PortError, StartUpError
from dxlrun.events import EventCode, EventSink, Severity
from dxlrun.interfaces import Commands, States
from dxlrun.mode import Mode
from dxlrun.packets import PacketSink

STOP_LIMIT_NS = 1_000_000_000
"""Retries of torque off end here; half of the default exit timeout."""
TAKEN_BACK = "torque was switched off again on every servo"
"""Note of what `start` raises when every servo confirmed that."""
FIRST_READS = 3
"""The first states must all be fresh; noise may spoil a reading or two."""
IDLE_MARGIN_NS = 150_000
"""The gap is left so long before the deadline: a stock kernel wakes some 50-100 us late."""


class DynamixelHardware:
    """Reads all servos, writes all goals, once a cycle; see `dxlrun.hardware.Hardware` for the contract.

    States and goals are the robot's arrays, one row a joint. A row whose reply was lost is invalid and keeps
    its values while its age grows. A servo that missed a read, or whose torque enable was not read as 1, gets
    no goal until it was, because writing a goal switches torque on (protocol.md).
    """

    def __init__(  # noqa: PLR0917  the order is the contract of the composition roots
        self,
        plans: Sequence[BusPlan],
        ports: Ports,
        clock: Clock,
        states: States,
        goals: Commands,
        packets: PacketSink,
        events: EventSink,
        beat: Callable[[], None],
        take_over: bool = False,
        restore_torque: bool = False,
    ) -> None:
        self._plans = tuple(plans)
        self._ports = ports
        self._clock = clock
        self._states = states
        self._goals = goals
        self._events = events
        self._beat = beat
        self._take_over = take_over
        self._restore_torque = restore_torque
        self._full_torque: list[list[int]] = []
        self._asked = [False] * len(self._plans)
        """Whose reads began behind the goals of the cycle before."""
        self._buses = tuple(
            Bus(index, plan, port, clock, packets)
            for index, (plan, port) in enumerate(zip(self._plans, ports.ports, strict=True))
        )
        self._gaps = tuple(Gaps(plan, events, clock.now_ns) for plan in self._plans)
        wanted = [
            Wanted.of(plan, gaps, states.mode, events)
            for plan, gaps in zip(self._plans, self._gaps, strict=True)
        ]
        self._registers = tuple(one.registers for one in wanted)
        self._modes = tuple(one.modes for one in wanted)
        self._servos = tuple(
            Servos(plan, bus, gaps, one, events, states)
            for plan, bus, gaps, one in zip(self._plans, self._buses, self._gaps, wanted, strict=True)
        )
        self._jumps = Jumps(self._plans, len(states.position), events)

    def start(self) -> None:
        """Look at every servo, hold each where it stands, fill the first states and goals.

        Raises StartUpError with every problem of every servo, PortError when a line is gone; torque that was
        given is taken back, and a note of the exception says whether every servo confirmed that.
        """
        self._survey()
        self._settle_registers()
        self._settle_modes()
        self._probe_reads()
        self._carry_out([bus_watchdog.disarm_all(plan) for plan in self._plans])
        try:
            self._engage()
            if self._restore_torque:
                self._restore_limits()
            self._first_states()
            self._carry_out([servos.watch() for servos in self._servos])
        except BaseException as error:  # also an interrupt: nothing may leave here with torque on
            for sentence in self.stop() or (TAKEN_BACK,):
                error.add_note(sentence)
            raise

    def read(self) -> None:
        """Read every servo once, on all lines at once; of a line that is gone every row is invalid.

        A split bus was asked behind the goals before: only what is not there yet is waited for.
        """
        for index, (bus, servos) in enumerate(zip(self._buses, self._servos, strict=True)):
            if not self._asked[index]:
                servos.feeding.feed()
                servos.reads.begin()
                bus.load(servos.reads, servos.reads.lane)
            self._asked[index] = False
        pump(self._buses, self._ports, self._clock, self._beat)
        now = self._clock.now_ns()
        for servos in self._servos:
            servos.settle(self._states, now)
            if servos.reads.given_up:
                self._tell_plain_reads()
        self._jumps.sift(self._states, now)
        self._tell_failures()

    def write(self) -> None:
        """Send the goals, one sync write a line and layout, on every line that is there.

        Of a split bus the servos are asked at once for their next states.
        """
        for index, (plan, bus, servos) in enumerate(zip(self._plans, self._buses, self._servos, strict=True)):
            for packet in servos.goal_packets(self._goals, self._states):
                if bus.failure is None:
                    with suppress(PortError):  # told below; the other lines shall have their goals
                        bus.send(packet)
            if plan.split and bus.failure is None:
                servos.feeding.feed()
                servos.reads.begin()
                bus.load(servos.reads)
                bus.begin_behind()
                self._asked[index] = True
        self._tell_failures()

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Bring joints into modes in the gaps between cycles; UNKNOWN leaves one as it is."""
        for changes in self._modes:
            changes.want(modes)

    def set_register(self, row: int, item: str, value: int, done: Callable[[str], None]) -> None:
        """Write a RAM item of a joint's servo in the gaps, and read it back; see `steered_registers`."""
        for plan, registers in zip(self._plans, self._registers, strict=True):
            for index, servo in enumerate(plan.servos):
                if servo.row == row:
                    registers.write(index, item, value, done)

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; `restore_torque` takes that back."""
        for servos in self._servos:
            servos.goals.weaken(fraction)
        for plan, bus, servos, full in zip(
            self._plans, self._buses, self._servos, self._full_torque, strict=False
        ):
            for packet in reduced(plan, full, fraction, servos.goals.modes):
                with suppress(PortError):  # as with goals: the next read names the bus
                    bus.send(packet)

    def idle(self, until_ns: int) -> None:
        """Do on each line what waits for a gap and fits this one; see `gaps` for what is done even so.

        On a split bus the states come first.
        """
        self._ask_for_lines()
        latest = until_ns - IDLE_MARGIN_NS
        if any(self._asked):
            pump(self._buses, self._ports, self._clock, self._beat, latest)
        end = latest if any(bus.busy for bus in self._buses) else NEVER  # states that are late may be awaited
        working: list[Bus] = []
        for bus, servos, gaps in zip(self._buses, self._servos, self._gaps, strict=True):
            if bus.failure is not None:
                gaps.abandon()
                continue
            servos.ask()
            if not bus.busy and gaps.begin(latest):
                bus.load(gaps)
                working.append(bus)
        if working:
            pump(self._buses, self._ports, self._clock, self._beat, end)
            for bus in working:
                if bus.busy:
                    bus.drop()

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, and read it back; return a sentence per failure."""
        failures = tuple(f"{one}" for one in self._limp() if not one.confirmed)
        self._disarm()
        for sentence in failures:
            self._events.emit(EventCode.SHUTDOWN_FAILED, Severity.ERROR, "hardware", sentence)
        if not failures:
            count = sum(len(plan.servos) for plan in self._plans)
            self._events.emit(
                EventCode.TORQUE_OFF,
                Severity.INFO,
                "hardware",
                f"torque is off on {'the servo' if count == 1 else f'all {count} servos'}",
            )
        return failures

    def let_go(self, rows: Sequence[int]) -> None:
        """Switch the torque of these joints off in the coming gaps; they get no goals in this run."""
        for servos in self._servos:
            servos.let_go(rows)

    def release(self) -> None:
        """Leave the robot with its torque on: nobody sends any more, and nothing may stop it for that."""
        self._disarm()
        run(
            [bus_watchdog.disarm_all(plan) for plan in self._plans],
            self._buses,
            self._ports,
            self._clock,
            self._beat,
        )

    def _disarm(self) -> None:
        for plan, bus in zip(self._plans, self._buses, strict=True):
            for packet in bus_watchdog.disarming(plan):
                with suppress(PortError):  # a servo that stops without a host stays as it is
                    bus.send(packet)

    def _ask_for_lines(self) -> None:
        """Go on with every line that was gone and is back."""
        for index, (bus, servos) in enumerate(zip(self._buses, self._servos, strict=True)):
            if bus.failure is not None and self._ports.reopen(index):
                bus.renew(self._ports.ports[index])
                servos.found()

    def _limp(self) -> tuple[LimpOutcome, ...]:
        self._ask_for_lines()
        for bus, servos in zip(self._buses, self._servos, strict=True):
            servos.torqued[:] = False
            bus.failure = None  # a line that is back, or was only stuck, gets its chance
        deadline = self._clock.now_ns() + STOP_LIMIT_NS
        return limp_buses(
            self._plans, self._buses, self._ports, self._clock, deadline_ns=deadline, beat=self._beat
        )

    def _survey(self) -> None:
        programs = [startup.survey(plan, self._take_over) for plan in self._plans]
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        problems: list[str] = []
        for survey in found:
            if survey is not None:
                problems += survey.problems
                for joint, text in survey.servos:
                    self._events.emit(EventCode.SETUP, Severity.INFO, joint, text)
                for joint, text in survey.differences:
                    self._events.emit(EventCode.REGISTER_DIFFERS, Severity.WARNING, joint, text)
        if problems:
            raise StartUpError("\n".join(problems))

    def _settle_registers(self) -> None:
        """Write what the robot file declares and a servo has otherwise, before anybody gets torque."""
        programs = [settle_bus(plan) for plan in self._plans]
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        settled = [one for one in found if one is not None]
        for joint, text in (written for one in settled for written in one.written):
            self._events.emit(EventCode.REGISTER_WRITTEN, Severity.INFO, joint, text)
        if problems := [problem for one in settled for problem in one.problems]:
            raise StartUpError("\n".join(problems))

    def _settle_modes(self) -> None:
        """Bring every servo into its first mode, before anybody gets torque, and learn its own limits."""
        programs = [settle_modes(plan) for plan in self._plans]
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        settled = [one for one in found if one is not None]
        for joint, text in (switched for one in settled for switched in one.switched):
            self._events.emit(EventCode.MODE, Severity.WARNING, joint, text)
        if problems := [problem for one in settled for problem in one.problems]:
            raise StartUpError("\n".join(problems))
        for servos, one in zip(self._servos, settled, strict=True):
            for index, limits in enumerate(one.limits):
                servos.goals.set_limits(index, limits)

    def _probe_reads(self) -> None:
        """Find out when replies are due, and read plainly whoever does not answer the fast forms."""
        programs = [probe_reads(plan) for plan in self._plans]
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        for plan, servos, probed in zip(self._plans, self._servos, found, strict=True):
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

    def _tell_plain_reads(self) -> None:
        for plan, servos in zip(self._plans, self._servos, strict=True):
            for group in servos.reads.given_up:
                names = ", ".join(plan.servos[index].joint for index in plan.groups[group])
                text = (
                    f"bus {plan.name}: {MOST_BROKEN} fast reads in a row stayed incomplete, so {names} are "
                    "read without them from now on: does one have another firmware, or a loose contact?"
                )
                self._events.emit(EventCode.SETUP, Severity.WARNING, plan.name, text)
            servos.reads.given_up.clear()

    def _restore_limits(self) -> None:
        """Give the servos the torque again that a policy of an earlier run may have left them without."""
        programs = [torque_limit.restore(plan) for plan in self._plans]
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        limits = [one for one in found if one is not None]
        if problems := [problem for one in limits for problem in one.problems]:
            raise StartUpError("\n".join(problems))
        self._full_torque = [one.full for one in limits]
        for joint, text in (restored for one in limits for restored in one.restored):
            self._events.emit(EventCode.SETUP, Severity.INFO, joint, text)

    def _engage(self) -> None:
        programs = [startup.engage(plan) for plan in self._plans]
        engaged = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        problems = [problem for one in engaged if one is not None for problem in one.problems]
        if problems:
            raise StartUpError("\n".join(problems))
        for plan, one in zip(self._plans, engaged, strict=True):
            assert one is not None  # noqa: S101  no line has failed
            for servo, raw in zip(plan.servos, one.goals, strict=True):
                self._first_goals(servo, raw)
            names = ", ".join(servo.joint for servo in plan.servos)
            self._events.emit(EventCode.TORQUE_ON, Severity.INFO, plan.name, f"torque is on: {names}")

    def _first_goals(self, servo: ServoPlan, raw: int | None) -> None:
        """Let the goals be what the servo was given: where it stands, without a speed, or 0."""
        row, mode = servo.row, servo.start_mode
        self._goals.position[row] = float("nan") if raw is None else joint_position(servo, raw)
        self._goals.velocity[row] = 0.0 if mode is Mode.VELOCITY else float("nan")
        self._goals.effort[row] = 0.0 if mode is Mode.EFFORT else float("nan")
        self._goals.pwm[row] = 0.0 if mode is Mode.PWM else float("nan")

    def _first_states(self) -> None:
        for _ in range(FIRST_READS):
            self.read()
            self._raise_failures()
            if all(servos.all_fresh for servos in self._servos):
                break
        silent = [name for servos in self._servos for name in servos.silent]
        if silent:
            raise StartUpError(
                f"{', '.join(silent)} did not answer after torque was switched on: check cable and power"
            )
        self._torque_lasts()
        for servos in self._servos:
            servos.torqued[:] = True
        for plan, changes in zip(self._plans, self._modes, strict=True):
            for index, servo in enumerate(plan.servos):
                changes.entered(index, servo.start_mode)

    def _torque_lasts(self) -> None:
        """Read torque enable of everybody again: who was reset by the inrush of others may get no goal."""
        self._carry_out([startup.confirm(plan) for plan in self._plans])

    def _carry_out(self, programs: Sequence[Program[list[str]]]) -> None:
        """Run one program a bus; raise StartUpError with all that went wrong."""
        found = run(programs, self._buses, self._ports, self._clock, self._beat)
        self._raise_failures()
        if problems := [problem for one in found if one is not None for problem in one]:
            raise StartUpError("\n".join(problems))

    def _tell_failures(self) -> PortError | None:
        """Tell of each line that is gone, once; return the first of them."""
        first: PortError | None = None
        for plan, bus, servos in zip(self._plans, self._buses, self._servos, strict=True):
            if bus.failure is not None:
                text = f"bus {plan.name} on {plan.port}: {bus.failure}"
                servos.lost(text)
                first = first or PortError(text)
        return first

    def _raise_failures(self) -> None:
        """Raise PortError when a line is gone: there is no set-up without it."""
        if error := self._tell_failures():
            raise error
