"""Dynamixel hardware: joints on serial lines of either protocol, all lines at once in one thread."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, SourceStates, States
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.dynamixel.bus_part import FeatureParts, SafeEnd
from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.desired import RegisterDone
from dxlrun.dynamixel.servo.life import Done
from dxlrun.dynamixel.servo.offline import ignore
from dxlrun.dynamixel.servo.servos import Servos
from dxlrun.dynamixel.servo.startup import StartUp, report_failures
from dxlrun.dynamixel.servo.torque_limits import reduced_torque_limits, restore_torque_limits
from dxlrun.dynamixel.servo.torque_off import LimpOutcome, limp
from dxlrun.dynamixel.wire_reports import WireReports
from dxlrun.errors import PortError, StartUpError
from dxlrun.features import FEATURES
from dxlrun.plan.loop_plan import ServoLimit
from dxlwire.exchange.bus import LATE_NS, NEVER, Bus, Lines
from dxlwire.exchange.cyclic_reads import MOST_BROKEN
from dxlwire.exchange.idle import LEAST_MARGIN_NS, IdleScheduler
from dxlwire.exchange.kernel import AWAITING, Answer, Kernel, KernelGoals
from dxlwire.exchange.samples import Samples
from dxlwire.packets import PacketLog
from dxlwire.plan.retry import limit_patience, pause

STOP_LIMIT_NS = 1_000_000_000  # Retries of torque off end here; half of the default exit timeout
LINE_TIMEOUT_NS = 300_000_000  # An adapter that is pulled in the last moment may be back by then
LINE_STEP_NS = 10_000_000
TAKEN_BACK = "torque was switched off again on every servo"
"""Note of what `start` raises when every servo confirmed that."""
FIRST_READS_NS = (0, 60_000_000, 240_000_000)
"""Pauses before the readings of the first states, which must all be fresh: noise, or a host or an adapter
that stands still, may spoil one or two."""
IDLE_MARGIN_NS = 150_000
"""The gap is left so long before the deadline: a stock kernel wakes some 50-100 us late."""


@dataclass(frozen=True, slots=True)
class ServoArrays:
    """Arrays of a robot as its servos have them: those of the cycle's record, or those below a layer."""

    states: States
    goals: Commands
    sources: SourceStates = field(default_factory=SourceStates.empty)
    """Of devices."""


class DynamixelHardware:
    """Reads all servos, writes all goals, once a cycle; `contract.hardware.Hardware` has the contract.

    States and goals are the robot's arrays, one row a joint. A row whose reply was lost is invalid and keeps
    its values while its age grows. A servo that missed a read, or whose torque enable was not read as 1, gets
    no goal until it was, because writing a goal switches torque on (protocol.md).
    """

    def __init__(
        self,
        lines: Lines,
        packets: PacketLog,
        arrays: ServoArrays,
        events: EventSink,
        *,
        parts: FeatureParts | None = None,
        refusals: Callable[[], Sequence[str]] | None = None,
        take_over: bool = False,
    ) -> None:
        """Plan the exchange; nothing is sent yet.

        Args:
            lines: The robot's lines.
            packets: Takes every packet, also those of `lines`.
            arrays: Where states go, and where goals are.
            events: Events for the log.
            parts: Features of the robot; None: ours, without commands.
            refusals: Called when the states have the positions of the servos, before any gets torque. Returns
                why the robot must not start, one sentence each.
            take_over: The servos may have torque already.

        Raises:
            NotCompiled: The exchange kernel was not compiled.
        """
        states, goals = arrays.states, arrays.goals
        self._lines = lines
        self._plans, self._buses = lines.plans, lines.buses
        self._clock = lines.clock
        self._now_ns = lines.clock.now_ns
        self._states = states
        self._goals = goals
        self._events = events
        self._take_over = take_over
        self._refusals = refusals
        self._full_torque: list[list[int]] = []
        self._by_kernel: bool | None = None
        """Whether the kernel reads the next states, or the parser; None: not planned yet."""
        self._look = True
        """There is something to look at in this cycle, beside reading and writing. `_rest` ends that; then
        the kernel's answers, requests, and `_due_ns` begin it again."""
        self._due_ns = 0  # when idle time has something to do,
        self._waiting: list[tuple[array[int], int]] = []
        """or where it is so long, ns, on a line, whose words these are."""
        reports = WireReports(events)
        self._idle = tuple(IdleScheduler(bus, reports) for bus in self._buses)
        self._samples = Samples(self._plans, states, arrays.sources, reports)
        parts = parts or FeatureParts(FEATURES, (), np.empty(0), {})
        self._safe_end = SafeEnd.of(parts.features, parts.plans)
        self._servos = tuple(
            Servos(idle, states, samples, parts, events)
            for idle, samples in zip(self._idle, self._samples.buses, strict=True)
        )
        self._pairs = tuple(zip(self._buses, self._servos, strict=True))
        self._places = {
            servo.row: (servos, index)
            for plan, servos in zip(self._plans, self._servos, strict=True)
            for index, servo in enumerate(plan.servos)
        }
        """Row of a joint -> where its servo is."""
        shared = [KernelGoals(one.goals, one.life.torqued, one.life.ceiling) for one in self._servos]
        self._kernel = Kernel(self._lines, shared, self._samples, goals.values, packets)
        self._read, self._write = self._kernel.read, self._kernel.write
        self._start_up = StartUp(self._lines, self._servos, events, parts.features)
        self.servo_limits: Mapping[int, Sequence[ServoLimit]] = {}

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Look at every servo, hold each where it stands, fill the first states and goals.

        `engaging` is called before any of them gets torque. Raises StartUpError with every problem of every
        servo, PortError when a line is gone; torque that was given is taken back, and a note of the exception
        says whether every servo confirmed that.
        """
        self._look = True
        self._start_up.look(self._take_over)
        self._kernel.poll_for_replies()
        try:
            if self._refusals is not None:
                self._await_states_of_all("when its position was read")
                if problems := self._refusals():
                    raise StartUpError("\n".join(problems))
            engaging()
            self._start_up.engage(self._goals)
            self._full_torque = self._start_up.stage(restore_torque_limits)
            self._first_states()
            self._start_up.watch()
            self._collect_limits()
            for bus in self._buses:
                bus.words[LATE_NS] = 0  # servos that write their EEPROM answer late: no cycle does that
        except BaseException as error:  # also an interrupt: nothing may leave here with torque on
            for sentence in self.stop() or (TAKEN_BACK,):
                error.add_note(sentence)
            raise

    def read(self) -> None:
        """Read every servo once, on all lines at once; of a line that is lost every row is invalid.

        The kernel reads as long as everything comes as planned; the parser continues where it does not.
        """
        if self._look:
            self._prepare_read()
        code = self._read() if self._by_kernel else Answer.UNEXPECTED
        if code or self._look:
            self._finish_read(code)

    def _prepare_read(self) -> None:
        if self._by_kernel is None:
            self._by_kernel = self._plan_reads()
        now_ns = self._clock.now_ns()
        for servos in self._servos:
            servos.watchdogs.sent(now_ns)
        self._show_torque()
        if self._states.mode.tobytes() != self._samples.modes:
            self._samples.follow_modes()

        if any(servos.goals.limits_changed for servos in self._servos):
            self._collect_limits()

    def _collect_limits(self) -> None:
        """Hand the registers that limit the servos' goals to the loop."""
        self.servo_limits = {row: own for servos in self._servos for row, own in servos.limits.items()}
        for servos in self._servos:
            servos.goals.limits_changed = False

    def _finish_read(self, code: int) -> None:
        while (answer := self._kernel.finish_read(code)) is Answer.SILENCE:
            self._look = True
            self._prepare_read()
            code = self._read()  # this process may have stood still again
        if answer is Answer.UNEXPECTED:
            self._look = True
            if self._by_kernel:
                self._interrupt()
            self._parse()
        else:
            for bus, servos in self._pairs:
                if bus.failure is not None:
                    self._settle(servos)
                    self._report_failures()
            if answer is Answer.LOOK:
                self._samples.judge(self._clock.now_ns())
        if self._look:
            self._by_kernel = None
            # A reply with an error puts torque in doubt: the states that it brought are not judged without.
            self._show_torque()

    def _show_torque(self) -> None:
        for servos in self._servos:
            if servos.life.torque_changed:
                servos.show_torque(self._states.torque)

    def _plan_reads(self) -> bool:
        """Plan the next reads, once a cycle and before any of them is sent.

        Return whether the kernel does them: every line that is there has a program for it.
        """
        kernel, ready = self._kernel, True
        for index, (bus, servos) in enumerate(self._pairs):
            cycle = servos.reads.plan() if servos.reads.stale else servos.reads.cycle
            program = cycle.program
            if bus.failure is None:
                known = program is not None and program is kernel.programs[index]
                ready &= known or (program is not None and kernel.plan(index, program))
                ready &= not bus.receiver.pending
        return ready

    def _interrupt(self) -> None:
        for index, (bus, servos) in enumerate(self._pairs):
            line, failure = self._kernel.line(index)
            if bus.failure is not None:
                continue
            if failure is not None:
                bus.fail(failure)
            if line.done or line.state or failure is not None:
                servos.reads.begin(line.done)
                bus.load(servos.reads, cyclic=True)
            if line.state == AWAITING:
                bus.resume(line.at_ns, line.sent_ns, line.deadline_ns)
            for data, at_ns in self._kernel.pieces(index):
                bus.take(data, at_ns)
        self._kernel.abandon()

    def _parse(self) -> None:
        """Read packet by packet what was not read in this cycle."""
        waiting = [(bus, servos) for bus, servos in self._pairs if not servos.reads.begun]
        self._lines.clear([bus for bus, _ in waiting])
        for bus, servos in waiting:
            servos.reads.begin()
            bus.load(servos.reads, cyclic=True)
        self._lines.pump()
        for servos in self._servos:
            self._settle(servos)
        self._samples.settle(self._clock.now_ns())
        self._report_failures()

    def _settle(self, servos: Servos) -> None:
        servos.settle(self._clock.now_ns())
        servos.reads.end()
        if servos.reads.given_up:
            self._report_plain_reads()

    def write(self) -> None:
        """Send the goals, one sync write a line and layout, on every line that is there."""
        if self._look:
            for servos in self._servos:
                servos.prepare_goals(self._goals, self._states)
            self._kernel.plan_writes()
        code = self._write()
        if code or self._look:
            for index, failure in self._kernel.finish_write(code).items():
                self._buses[index].fail(failure)
            self._report_failures()
            self._rest()

    def _rest(self) -> None:
        """Look at nothing any more where all is as planned, until that changes."""
        self._due_ns = min((servos.due_ns for servos in self._servos), default=NEVER)
        self._waiting = [
            (bus.words, work.least_ns)
            for bus, work in zip(self._buses, self._idle, strict=True)
            if work.tasks
        ]
        self._by_kernel = (
            all(servos.at_rest for servos in self._servos)
            and all(least_ns for _, least_ns in self._waiting)
            and self._states.mode.tobytes() == self._samples.modes
            and self._plan_reads()
        ) or None
        self._look = self._by_kernel is None

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Bring joints into modes in idle time; UNKNOWN leaves one as it is."""
        self._look = True
        for servos in self._servos:
            servos.desired.change_modes(modes)

    def set_register(self, row: int, item: str, value: int, done: RegisterDone) -> None:
        """Write a RAM item of a joint's servo in idle time, and read it back; see `DesiredState`."""
        servos, index = self._place(row)
        servos.desired.write_register(index, item, value, done)

    def read_register(self, row: int, item: str, done: RegisterDone) -> None:
        """Read an item of a joint's servo in idle time."""
        servos, index = self._place(row)
        servos.desired.read_register(index, item, done)

    def switch_torque(self, row: int, on: bool, done: Done = ignore) -> None:
        """Switch the torque of a joint's servo in idle time; see `Requests`."""
        servos, index = self._place(row)
        (servos.requests.torque_on if on else servos.requests.torque_off)(index, done)

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Let the servos of joints that were given torque get goals; see `Servos.follow_goals`."""
        for row in rows:
            servos, index = self._place(row)
            servos.follow_goals(index)

    def reboot(self, row: int, done: Done) -> None:
        """Reboot a joint's servo in idle time; see `Requests`."""
        servos, index = self._place(row)
        servos.requests.reboot(index, done)

    def _place(self, row: int) -> tuple[Servos, int]:
        """Return where the servo of a joint is, which is to be looked at."""
        self._look = True
        return self._places[row]

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; the next start restores it."""
        self._look = True
        for servos in self._servos:
            servos.goals.weaken(fraction)
        for plan, bus, servos, full in zip(
            self._plans, self._buses, self._servos, self._full_torque, strict=False
        ):
            for packet in reduced_torque_limits(plan, full, fraction, servos.goals.modes):
                with suppress(PortError):  # as with goals: the next read names the bus
                    bus.send(packet)

    def idle(self, until_ns: int, time_ns: int = 0) -> None:
        """Do on each line what waits for idle time and fits; see `IdleScheduler` for what is done even so."""
        if not self._look:
            now_ns = self._now_ns()
            left_ns = until_ns - IDLE_MARGIN_NS - now_ns
            self._look = now_ns >= self._due_ns
            for words, least_ns in self._waiting:
                if left_ns >= least_ns + max(words[LATE_NS], LEAST_MARGIN_NS):
                    self._look = True
            if not self._look:
                return
        for bus in self._buses:
            if bus.failure is not None:
                self._reopen_lines()
                break
        latest = until_ns - IDLE_MARGIN_NS
        working: list[Bus] = []
        for index, (bus, servos) in enumerate(self._pairs):
            work = self._idle[index]
            if bus.failure is not None:
                work.abandon()
                servos.abandon()
            else:
                servos.look(time_ns)
                if work.tasks and work.begin(latest):
                    bus.load(work)
                    working.append(bus)
        if working:
            self._lines.clear(self._buses)
            self._lines.pump()
        self._by_kernel = self._plan_reads()  # here nothing waits for it

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, and read it back; return a sentence per failure."""
        outcomes = self._limp()
        self._make_rest_safe()
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

    def release(self) -> None:
        """Leave the robot with its torque on: nothing is sent any more, and no servo may stop for that.
        Features leave the rest safe.

        A servo that its Bus Watchdog has stopped already stays stopped.
        """
        # first: the watchdogs stop the servos after a time in which a silent device may be awaited
        programs = [limit_patience(watchdog.release_all(plan), any_age=True) for plan in self._plans]
        for problems in self._lines.run(programs):
            for problem in problems or ():
                self._events.emit(EventCode.WATCHDOG, Severity.WARNING, "hardware", problem)
        self._make_rest_safe()

    def _make_rest_safe(self) -> None:
        for problem in self._safe_end.make_safe(self._lines):
            self._events.emit(EventCode.SHUTDOWN_FAILED, Severity.WARNING, "hardware", problem)

    def _disarm(self, limp: Set[tuple[str, int]]) -> None:
        """Disarm the Bus Watchdogs of servos without torque, by (bus, ID); the others stop by themselves."""
        for plan, bus in zip(self._plans, self._buses, strict=True):
            servos = [servo for servo in plan.servos if (plan.name, servo.servo_id) in limp]
            for packet in watchdog.to_all(plan, servos, 0):
                with suppress(PortError):  # a servo that stops without a host stays as it is
                    bus.send(packet)

    def _reopen_lines(self) -> None:
        """Open lines again that were lost, and continue on those that are back."""
        for index, (bus, servos) in enumerate(self._pairs):
            if bus.failure is not None and self._lines.ports.reopen(index):
                bus.renew(self._lines.ports.ports[index])
                servos.goals.renew()
                servos.found()
                servos.reads.plan()  # without its servos: none is read before it was found in order

    def _limp(self) -> tuple[LimpOutcome, ...]:
        """Torque off at once wherever there is a line, and once more when one that was gone is back soon."""
        now_ns = self._clock.now_ns()
        deadline_ns, timeout_ns = now_ns + STOP_LIMIT_NS, now_ns + LINE_TIMEOUT_NS
        while True:
            self._reopen_lines()
            for bus, servos in zip(self._buses, self._servos, strict=True):
                servos.withhold_goals()
                bus.retry()  # a line that is back, or was only stuck, gets its chance
            outcomes = limp(self._lines, deadline_ns)
            gone = [index for index, bus in enumerate(self._buses) if bus.failure is not None]
            if not gone or not self._wait_for_lines(gone, timeout_ns):
                return outcomes

    def _wait_for_lines(self, gone: Sequence[int], until_ns: int) -> bool:
        while (now_ns := self._clock.now_ns()) < until_ns:
            self._clock.wait_until(now_ns + LINE_STEP_NS)
            self._lines.beat()
            for index in gone:
                if self._lines.ports.reopen(index):
                    self._buses[index].renew(self._lines.ports.ports[index])
                    return True
        return False

    def _report_failures(self) -> None:
        for bus in self._buses:
            if bus.failure is not None:
                report_failures(self._lines, self._servos)
                return

    def _report_plain_reads(self) -> None:
        for plan, servos in zip(self._plans, self._servos, strict=True):
            for group in servos.reads.given_up:
                names = ", ".join(plan.member_name(index) for index in plan.groups[group])
                text = (
                    f"bus {plan.name}: {MOST_BROKEN} fast reads in a row stayed incomplete, so {names} are "
                    "read without them from now on: does one have another firmware, or a loose contact?"
                )
                self._events.emit(EventCode.SETUP, Severity.WARNING, plan.name, text)
            servos.reads.given_up.clear()

    def _first_states(self) -> None:
        self._await_states_of_all("after torque was switched on")
        self._start_up.confirm()

    def _await_states_of_all(self, when: str) -> None:
        """Read until the states of all servos are fresh; raises StartUpError when some stay silent."""
        for pause_ns in FIRST_READS_NS:
            if pause_ns:
                self._lines.run([pause(pause_ns) for _ in self._plans])
            self.read()
            self._start_up.raise_failures()
            if not any(servos.silent for servos in self._servos):
                break
        problems = [
            f"{', '.join(servos.silent)} did not answer {when}: {choose_remedy(plan.port, CHECK)}"
            for plan, servos in zip(self._plans, self._servos, strict=True)
            if servos.silent
        ]
        if problems:
            raise StartUpError("\n".join(problems), for_replies=True)
