"""Dynamixel hardware: joints on serial lines of either protocol, all lines at once in one thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.bus import NEVER, Bus
from dxlrun.dynamixel.exchange.cyclic_reads import MOST_BROKEN
from dxlrun.dynamixel.exchange.gaps import Gaps
from dxlrun.dynamixel.exchange.kernel import Answer, Kernel, Library, LineState, holds
from dxlrun.dynamixel.exchange.pump import clear, pump, run
from dxlrun.dynamixel.exchange.samples import Samples
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.registers import reduced_torque_limits
from dxlrun.dynamixel.servo.servos import Servos
from dxlrun.dynamixel.servo.startup import StartUp, report_failures
from dxlrun.dynamixel.servo.torque_off import LimpOutcome, limp_buses
from dxlrun.errors import PortError, StartUpError
from dxlrun.interfaces import Commands, States
from dxlrun.run.channels.events import EventCode, EventSink, Severity
from dxlrun.run.channels.packets import PacketLog

STOP_LIMIT_NS = 1_000_000_000
"""Retries of torque off end here; half of the default exit timeout."""
LINE_PATIENCE_NS = 300_000_000
"""An adapter that is pulled in the last moment may be back by then."""
LINE_STEP_NS = 10_000_000
TAKEN_BACK = "torque was switched off again on every servo"
"""Note of what `start` raises when every servo confirmed that."""
FIRST_READS_NS = (0, 60_000_000, 240_000_000)
"""Pauses before the readings of the first states, which must all be fresh: noise, or a host or an adapter
that stands still, may spoil one or two."""
IDLE_MARGIN_NS = 150_000
"""The gap is left so long before the deadline: a stock kernel wakes some 50-100 us late."""


class DynamixelHardware:
    """Reads all servos, writes all goals, once a cycle; `control.hardware` has the contract.

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
        packets: PacketLog,
        events: EventSink,
        beat: Callable[[], None],
        take_over: bool = False,
        restore_torque: bool = False,
        library: Library | None = None,
    ) -> None:
        """`library`: the compiled kernel; without it every cycle goes through the parser."""
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
        """Lines whose reads of the next cycle began already, or are done."""
        self._prepared = False  # the next cycle is planned
        self._planned = False  # the kernel reads in it
        self._split = [index for index, plan in enumerate(self._plans) if plan.split]
        self._buses = tuple(
            Bus(index, plan, port, clock, packets)
            for index, (plan, port) in enumerate(zip(self._plans, ports.ports, strict=True))
        )
        self._gaps = tuple(Gaps(plan, events, clock.now_ns) for plan in self._plans)
        self._samples = Samples(self._plans, states, events)
        self._servos = tuple(
            Servos(plan, bus, gaps, events, states, arrays)
            for plan, bus, gaps, arrays in zip(
                self._plans, self._buses, self._gaps, self._samples.buses, strict=True
            )
        )
        self._lines = tuple(zip(self._buses, self._servos, strict=True))
        self._kernel: Kernel | None = None
        if library is not None and holds(self._plans, packets):
            self._kernel = Kernel(
                library,
                self._plans,
                self._samples,
                states,
                goals,
                [servos.torqued for servos in self._servos],
                [servos.ceiling for servos in self._servos],
                packets,
                ports,
                clock,
                beat,
            )
        self._start_up = StartUp(self._plans, self._buses, self._servos, ports, clock, events, beat)

    def start(self) -> None:
        """Look at every servo, hold each where it stands, fill the first states and goals.

        Raises StartUpError with every problem of every servo, PortError when a line is gone; torque that was
        given is taken back, and a note of the exception says whether every servo confirmed that.
        """
        self._start_up.look(self._take_over)
        if self._kernel is not None:
            self._kernel.poll_for_replies()
        try:
            self._start_up.engage(self._goals)
            if self._restore_torque:
                self._full_torque = self._start_up.restore_limits()
            self._first_states()
            self._start_up.watch()
        except BaseException as error:  # also an interrupt: nothing may leave here with torque on
            for sentence in self.stop() or (TAKEN_BACK,):
                error.add_note(sentence)
            raise

    def read(self) -> None:
        """Read every servo once, on all lines at once; of a line that is gone every row is invalid.

        The kernel does so as long as all goes as planned; from where it does not the parser goes on. A split
        bus was asked behind the goals before: only what is not there yet is awaited.
        """
        if not self._prepared:
            self._prepare()
        self._prepared = False
        now_ns = self._clock.now_ns()
        for servos in self._servos:
            servos.watchdogs.sent(now_ns)
        self._samples.follow_modes()
        if self._kernel is not None and self._planned:
            answer = self._kernel.read()
            if answer is not Answer.UNEXPECTED:
                for bus, servos in self._lines:
                    if bus.failure is not None:
                        servos.settle(self._clock.now_ns())
                if answer is Answer.LOOK:
                    self._samples.settle(self._clock.now_ns())
                return
            self._interrupt(self._kernel)
        self._parse()

    def _prepare(self) -> None:
        """Plan the next cycle, for the kernel if there is one and every line that is there has a plan."""
        self._prepared = True
        if self._planned and all(map(_is_steady, self._lines)):
            return
        for servos in self._servos:
            servos.reads.prepare()
        if self._kernel is not None:
            programs = [
                None if bus.failure is not None else servos.reads.program for bus, servos in self._lines
            ]
            self._planned = all(
                bus.failure is not None
                or (program is not None and not bus.pending and self._kernel.fits(program))
                for (bus, _), program in zip(self._lines, programs, strict=True)
            )
            for index, program in enumerate(programs):
                self._kernel.set_program(index, program if self._planned else None)

    def _interrupt(self, kernel: Kernel) -> None:
        """Let the parser go on where the kernel ended."""
        self._planned = False
        for index, line in enumerate(kernel.interrupt()):
            bus, servos = self._lines[index]
            bus.free_ns = kernel.free_at(index)
            self._asked[index] = True
            if line is None:
                continue
            if line.failure is not None:
                bus.fail(line.failure)
            elif line.state is LineState.AWAITING:
                bus.take_over(servos.reads, servos.reads.resume(line.done), line)
            else:
                bus.due_ns = line.due_ns
                bus.take_pieces(line)
                if line.state is LineState.IDLE and line.done:
                    servos.reads.begin_at(line.done)
                    bus.load(servos.reads)
                elif line.state is LineState.IDLE:
                    self._asked[index] = False

    def _parse(self) -> None:
        """Read packet by packet what was not read in this cycle."""
        clear(self._buses, self._ports, self._asked)
        for asked, (bus, servos) in zip(self._asked, self._lines, strict=True):
            if not asked:
                servos.reads.begin()
                bus.load(servos.reads)
        pump(self._buses, self._ports, self._clock, self._beat)
        self._asked = [False] * len(self._asked)
        now_ns = self._clock.now_ns()
        for servos in self._servos:
            servos.settle(now_ns)
            if servos.reads.given_up:
                self._tell_plain_reads()
        self._samples.settle(now_ns)
        self._report_failures()

    def write(self) -> None:
        """Send the goals, one sync write a line and layout, on every line that is there.

        Of a split bus the servos are asked at once for their next states.
        """
        for servos in self._servos:
            servos.prepare_goals(self._goals, self._states)
        if self._split:
            self._prepare()
        if self._kernel is not None:
            self._write_by_kernel(self._kernel)
        else:
            for bus, servos in self._lines:
                for packet in servos.goals.packets(self._goals, servos.torqued, servos.ceiling):
                    with suppress(PortError):  # reported below; the other lines get their goals
                        bus.send(packet)
        if self._split and not self._planned:
            self._ask_behind()
        self._report_failures()

    def _write_by_kernel(self, kernel: Kernel) -> None:
        for index, (bus, servos) in enumerate(self._lines):
            kernel.set_writes(index, servos.goals.sync_writes if bus.failure is None else ())
            kernel.occupy(index, bus.free_ns)
        answer = kernel.write()
        for index, bus in enumerate(
            self._buses
        ):  # what the gaps and the parser send goes out behind these goals
            bus.free_ns = kernel.free_at(index)
        if answer is Answer.LOOK:
            self._planned = False
        elif answer is Answer.UNEXPECTED:
            for index, failure in kernel.failures().items():
                self._buses[index].fail(failure)
                kernel.set_program(index, None)

    def _ask_behind(self) -> None:
        clear(self._buses, self._ports)
        for index in self._split:
            bus, servos = self._lines[index]
            if bus.failure is None:
                servos.reads.begin()
                bus.load(servos.reads)
                bus.step(self._clock.now_ns())
                self._asked[index] = True

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Bring joints into modes in the gaps between cycles; UNKNOWN leaves one as it is."""
        for servos in self._servos:
            servos.desired.change_modes(modes)

    def set_register(self, row: int, item: str, value: int, done: Callable[[str], None]) -> None:
        """Write a RAM item of a joint's servo in the gaps, and read it back; see `DesiredState`."""
        for plan, servos in zip(self._plans, self._servos, strict=True):
            for index, servo in enumerate(plan.servos):
                if servo.row == row:
                    servos.desired.write_register(index, item, value, done)

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; `restore_torque` takes that back."""
        for servos in self._servos:
            servos.goals.weaken(fraction)
        for plan, bus, servos, full in zip(
            self._plans, self._buses, self._servos, self._full_torque, strict=False
        ):
            for packet in reduced_torque_limits(plan, full, fraction, servos.goals.modes):
                with suppress(PortError):  # as with goals: the next read names the bus
                    bus.send(packet)

    def idle(self, until_ns: int) -> None:
        """Do on each line what waits for a gap and fits this one; see `gaps` for what is done even so.

        On a split bus the states come first.
        """
        self._reopen_lines()
        latest = until_ns - IDLE_MARGIN_NS
        self._await_states(latest)
        end = latest if any(map(self._busy, range(len(self._buses)))) else NEVER  # late states may be awaited
        working: list[Bus] = []
        for index, (bus, servos) in enumerate(self._lines):
            gaps = self._gaps[index]
            if bus.failure is not None:
                gaps.abandon()
                continue
            servos.look()
            if not self._busy(index) and gaps.begin(latest):
                bus.load(gaps)
                working.append(bus)
        if working:
            clear(self._buses, self._ports)
            pump(self._buses, self._ports, self._clock, self._beat, end)
            for bus in working:
                if bus.busy:
                    bus.drop()
        if not self._prepared:
            self._prepare()  # here nothing waits for it

    def _await_states(self, latest_ns: int) -> None:
        """Take note of when the states came, and await those of split buses until `latest_ns`."""
        kernel = self._kernel
        if kernel is not None and self._planned:
            for index, (bus, servos) in enumerate(self._lines):
                arrival = kernel.arrival(index)
                if bus.failure is None and index not in self._split and arrival is not None:
                    due_ns, at_ns = arrival
                    servos.arrived(at_ns, due_ns)
            if self._split and kernel.read(latest_ns, everything=False) is Answer.UNEXPECTED:
                self._interrupt(kernel)
        if any(self._asked):
            pump(self._buses, self._ports, self._clock, self._beat, latest_ns)

    def _busy(self, index: int) -> bool:
        """Say whether replies are awaited on a line."""
        return self._buses[index].busy or (self._kernel is not None and self._kernel.awaits(index))

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, and read it back; return a sentence per failure."""
        outcomes = self._limp()
        failures = tuple(f"{one}" for one in outcomes if not one.confirmed)
        self._disarm({(one.bus, one.servo_id) for one in outcomes if one.confirmed})
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
        """Leave the robot with its torque on: nothing is sent any more, and no servo may stop for that.

        A servo that its Bus Watchdog has stopped already stays stopped.
        """
        programs = [watchdog.release_all(plan) for plan in self._plans]
        for problems in run(programs, self._buses, self._ports, self._clock, self._beat):
            for problem in problems or ():
                self._events.emit(EventCode.WATCHDOG, Severity.WARNING, "hardware", problem)

    def _disarm(self, limp: Set[tuple[str, int]]) -> None:
        """Disarm the Bus Watchdogs of servos without torque, by (bus, ID); the others stop by themselves."""
        for plan, bus in zip(self._plans, self._buses, strict=True):
            servos = [servo for servo in plan.servos if (plan.name, servo.servo_id) in limp]
            for packet in watchdog.disarming(plan, servos):
                with suppress(PortError):  # a servo that stops without a host stays as it is
                    bus.send(packet)

    def _reopen_lines(self) -> None:
        """Go on with every line that was gone and is back."""
        for index, (bus, servos) in enumerate(zip(self._buses, self._servos, strict=True)):
            if bus.failure is not None and self._ports.reopen(index):
                bus.renew(self._ports.ports[index])
                servos.found()

    def _limp(self) -> tuple[LimpOutcome, ...]:
        """Torque off at once wherever there is a line, and once more when one that was gone is back soon."""
        now_ns = self._clock.now_ns()
        deadline_ns, patience_ns = now_ns + STOP_LIMIT_NS, now_ns + LINE_PATIENCE_NS
        while True:
            self._reopen_lines()
            for bus, servos in zip(self._buses, self._servos, strict=True):
                servos.withhold_goals()
                bus.failure = None  # a line that is back, or was only stuck, gets its chance
            outcomes = limp_buses(
                self._plans, self._buses, self._ports, self._clock, deadline_ns=deadline_ns, beat=self._beat
            )
            gone = [index for index, bus in enumerate(self._buses) if bus.failure is not None]
            if not gone or not self._wait_for_lines(gone, patience_ns):
                return outcomes

    def _wait_for_lines(self, gone: Sequence[int], until_ns: int) -> bool:
        """Wait for any line that is gone; say whether one is back."""
        while (now_ns := self._clock.now_ns()) < until_ns:
            self._clock.wait_until(now_ns + LINE_STEP_NS)
            self._beat()
            for index in gone:
                if self._ports.reopen(index):
                    self._buses[index].renew(self._ports.ports[index])
                    return True
        return False

    def _report_failures(self) -> None:
        for bus in self._buses:
            if bus.failure is not None:
                report_failures(self._plans, self._buses, self._servos)
                return

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

    def _first_states(self) -> None:
        for pause_ns in FIRST_READS_NS:
            if pause_ns:
                self._start_up.pause(pause_ns)
            self.read()
            self._start_up.raise_failures()
            if not any(servos.silent for servos in self._servos):
                break
        silent = [name for servos in self._servos for name in servos.silent]
        if silent:
            raise StartUpError(
                f"{', '.join(silent)} did not answer after torque was switched on: check cable and power"
            )
        self._start_up.confirm()


def _is_steady(line: tuple[Bus, Servos]) -> bool:
    """Say whether the next cycle of a line is planned as the one before."""
    bus, servos = line
    return not (servos.reads.changed or bus.pending) and bus.failure is None
