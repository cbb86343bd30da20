"""Dynamixel hardware: reads states from and writes goals to the servos of all serial lines, in one thread, in
each cycle.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, SourceStates, States
from dxlrun.channels.event_records import EventSink
from dxlrun.dynamixel import texts
from dxlrun.dynamixel.bus_part import FeatureParts, SafeEnd
from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.desired import RegisterDone
from dxlrun.dynamixel.servo.life import Done
from dxlrun.dynamixel.servo.offline import ignore
from dxlrun.dynamixel.servo.servo_supervision import Servos
from dxlrun.dynamixel.servo.startup import StartUp, report_failures
from dxlrun.dynamixel.servo.torque_limits import reduced_torque_limits, restore_torque_limits
from dxlrun.dynamixel.servo.torque_off import LimpOutcome, limp
from dxlrun.dynamixel.wire_reports import WireReports
from dxlrun.errors import PortError, StartUpError
from dxlrun.features import FEATURES
from dxlrun.plan.loop_plan import ServoLimit
from dxlwire.exchange.bus_engine import LATE_NS, NEVER, BusEngine, Lines
from dxlwire.exchange.cyclic_exchange import CyclicExchange
from dxlwire.exchange.cyclic_reads import MOST_BROKEN
from dxlwire.exchange.idle import LEAST_MARGIN_NS, IdleScheduler
from dxlwire.exchange.kernel import Answer, Kernel, KernelGoals
from dxlwire.exchange.samples import Samples
from dxlwire.packets import PacketLog
from dxlwire.plan.retry import limit_patience, pause

STOP_LIMIT_NS = 1_000_000_000  # deadline for retries of torque off: half of the default exit timeout
LINE_TIMEOUT_NS = 300_000_000  # an adapter that was just unplugged may be back by then
LINE_STEP_NS = 10_000_000
TAKEN_BACK = "torque was switched off again on every servo"
"""Note that `DynamixelHardware.start` adds to its exception if every servo confirmed torque off afterwards.
"""
FIRST_READS_NS = (0, 60_000_000, 240_000_000)
"""Pauses (ns) before the attempts to read the first states of all servos. Noise, or a host or adapter that
stalls, may spoil one or two attempts.
"""
IDLE_MARGIN_NS = 150_000
"""Part of the idle time that no work uses, before the next cycle: a stock kernel wakes about 50-100 us late.
"""


class ServoArrays(msgspec.Struct, frozen=True):
    """Arrays that the hardware fills with states and from which it sends goals: the record of the cycle, or
    the arrays below a `HardwareLayer`.
    """

    states: States
    goals: Commands
    sources: SourceStates = msgspec.field(default_factory=SourceStates.empty)
    """States of the devices that are not servos, such as IMUs."""


class DynamixelHardware:
    """Reads all servos and writes all goals once a cycle; implements `contract.hardware.Hardware`.

    States and goals are the robot's arrays, one row per joint. A row whose reply was lost is invalid: it
    keeps its values while its age grows. A servo gets no goal after a missed read, or while its torque enable
    has not been read as 1, because writing a goal switches torque on (protocol.md).
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
        """Create the objects for every bus without sending anything.

        Args:
            lines: The robot's lines.
            packets: Log of every packet, including those of `lines`.
            arrays: Destination of the states and source of the goals.
            events: Sink of events for the log.
            parts: Features of the robot; None: the built-in features, without commands.
            refusals: Called when the states have the positions of the servos, before any servo gets torque.
                Returns reasons to refuse the start, one sentence each.
            take_over: True if the servos may have torque already.

        Raises:
            NotCompiled: The exchange kernel was not compiled.
        """
        states, goals = arrays.states, arrays.goals
        self._lines = lines
        self._buses = lines.buses
        self._clock = lines.clock
        self._now_ns = lines.clock.now_ns
        self._states = states
        self._goals = goals
        self._events = events
        self._take_over = take_over
        self._refusals = refusals
        self._full_torque: list[list[int]] = []
        self._by_kernel: bool | None = None
        """True if the compiled kernel reads the next cycle, False if the packet parser does; None: not
        planned yet.
        """
        self._look = True
        """True while a cycle needs more than reading states and writing goals. `_rest` clears it; an answer
        of the kernel, a request, or `_due_ns` sets it again.
        """
        self._due_ns = 0  # time at which idle work is due
        self._waiting: list[tuple[array[int], int]] = []
        """For each bus with waiting idle work: the state words of the bus, and the shortest idle time (ns) in
        which that work fits.
        """
        reports = WireReports(events)
        self._idle = tuple(IdleScheduler(bus, reports) for bus in self._buses)
        self._samples = Samples(lines.plans, states, arrays.sources, reports)
        parts = parts or FeatureParts(FEATURES, (), np.empty(0), {})
        self._safe_end = SafeEnd.import_stages(parts.features, parts.plans)
        self._servos = tuple(
            Servos(idle, states, samples, parts, events)
            for idle, samples in zip(self._idle, self._samples.buses, strict=True)
        )
        self._pairs = tuple(zip(self._buses, self._servos, strict=True))
        self._places = {
            servo.row: (servos, index)
            for plan, servos in zip(lines.plans, self._servos, strict=True)
            for index, servo in enumerate(plan.servos)
        }
        """Index of each joint's servo on its bus, and the `Servos` of that bus, by row of the joint."""
        shared = [KernelGoals(one.goals, one.life.torqued, one.life.ceiling) for one in self._servos]
        self._kernel = Kernel(self._lines, shared, self._samples, goals.values, packets)
        self._read, self._write = self._kernel.read, self._kernel.write
        self._exchange = CyclicExchange(self._lines, [one.reads for one in self._servos], self._kernel)
        self._start_up = StartUp(self._lines, self._servos, events, parts.features)
        self.servo_limits: Mapping[int, Sequence[ServoLimit]] = {}

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Run the start-up: check every servo, switch torque on at the present positions, and fill the first
        states and goals.

        After a failure torque is switched off again. A note on the exception says whether every servo
        confirmed it.

        Args:
            engaging: Called before any servo gets torque.

        Raises:
            StartUpError: The servos' problems, all in one message.
            PortError: A line is gone.
        """
        self._look = True
        self._start_up.check_servos(self._take_over)
        self._kernel.poll_for_replies()
        try:
            if self._refusals is not None:
                self._await_states_of_all("when its position was read")
                if problems := self._refusals():
                    raise StartUpError("\n".join(problems))
            engaging()
            self._start_up.engage_servos(self._goals)
            self._full_torque = self._start_up.stage(restore_torque_limits)
            self._first_states()
            self._start_up.arm_watchdogs()
            self._collect_limits()
            for bus in self._buses:
                # A servo that writes its EEPROM answers late; no cycle writes EEPROM, so these delays must
                # not count.
                bus.words[LATE_NS] = 0
        except BaseException as error:  # Also on KeyboardInterrupt: `start` must not exit with torque on.
            for sentence in self.stop() or (TAKEN_BACK,):
                error.add_note(sentence)
            raise

    def read_states(self) -> None:
        """Read the states of every servo once, on all lines in parallel; all rows of a lost line become
        invalid.

        The compiled kernel reads while every reply comes as planned. The packet parser takes over at the
        first deviation from the plan.
        """
        if self._look:
            self._prepare_read()
        code = self._read() if self._by_kernel else Answer.UNEXPECTED
        if code or self._look:
            self._finish_read(code)

    def _prepare_read(self) -> None:
        if self._by_kernel is None:
            self._by_kernel = self._exchange.plan_reads()
        now_ns = self._clock.now_ns()
        for servos in self._servos:
            servos.watchdogs.sent(now_ns)
        self._show_torque()
        if self._states.mode.tobytes() != self._samples.modes:
            self._samples.follow_modes()

        if any(servos.goals.limits_changed for servos in self._servos):
            self._collect_limits()

    def _collect_limits(self) -> None:
        """Update `servo_limits`, from which the loop learns the registers that limit the servos' goals."""
        self.servo_limits = {row: own for servos in self._servos for row, own in servos.limits.items()}
        for servos in self._servos:
            servos.goals.limits_changed = False

    def _finish_read(self, code: int) -> None:
        while (answer := self._kernel.finish_read(code)) is Answer.SILENCE:
            self._look = True
            self._prepare_read()
            code = self._read()  # the process may have stalled again
        if answer is Answer.UNEXPECTED:
            self._look = True
            if self._by_kernel:
                self._exchange.interrupt_kernel()
            self._parse()
        else:
            for bus, servos in self._pairs:
                if bus.failure is not None:
                    self._settle(servos)
                    self._report_failures()
            if answer is Answer.LOOK:
                self._samples.accept_plausible(self._clock.now_ns())
        if self._look:
            self._by_kernel = None
            # A reply with an error puts torque in doubt; the loop must not judge the new states without that
            # doubt.
            self._show_torque()

    def _show_torque(self) -> None:
        for servos in self._servos:
            if servos.life.torque_changed:
                servos.show_torque(self._states.torque)

    def _parse(self) -> None:
        """Read packet by packet the lines that were not read yet in this cycle."""
        self._exchange.load_reads()
        self._lines.pump()
        for servos in self._servos:
            self._settle(servos)
        self._samples.fill_states(self._clock.now_ns())
        self._report_failures()

    def _settle(self, servos: Servos) -> None:
        servos.report_changes(self._clock.now_ns())
        servos.reads.end_cycle()
        if servos.reads.given_up:
            self._report_plain_reads()

    def write_goals(self) -> None:
        """Send the goals to the servos of every open line, one sync write per line and goal layout."""
        if self._look:
            for servos in self._servos:
                servos.prepare_goals(self._goals, self._states)
            self._kernel.plan_writes()
        code = self._write()
        if code or self._look:
            for index, failure in self._kernel.finish_write(code).items():
                self._buses[index].mark_lost(failure)
            self._report_failures()
            self._rest()

    def _rest(self) -> None:
        """Return to plain reading and writing if nothing else is due on any bus, until an event or
        `_due_ns`."""
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
            and self._exchange.plan_reads()
        ) or None
        self._look = self._by_kernel is None

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Request operating modes for joints, shape (joints,), which the servos enter in idle time; UNKNOWN
        keeps a joint's mode.
        """
        self._look = True
        for servos in self._servos:
            servos.desired.change_modes(modes)

    def write_register(self, row: int, item: str, value: int, done: RegisterDone) -> None:
        """Write a RAM item of a joint's servo in idle time and read it back; `done` receives the problem and
        the previous value.
        """
        servos, index = self._place(row)
        servos.desired.queue_write(index, item, value, done)

    def read_register(self, row: int, item: str, done: RegisterDone) -> None:
        """Read an item of a joint's servo in idle time; `done` receives the problem and the value."""
        servos, index = self._place(row)
        servos.desired.queue_read(index, item, done)

    def switch_torque(self, row: int, on: bool, done: Done = ignore) -> None:
        """Switch the torque of a joint's servo on or off in idle time; `done` receives the problem, empty on
        success.
        """
        servos, index = self._place(row)
        (servos.requests.torque_on if on else servos.requests.torque_off)(index, done)

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Resume sending goals to the servos of these joints, whose goals now equal the positions at which
        they got torque.
        """
        for row in rows:
            servos, index = self._place(row)
            servos.enable_goals(index)

    def reboot_servo(self, row: int, done: Done) -> None:
        """Reboot a joint's servo in idle time; `done` receives the problem, empty once the servo is back."""
        servos, index = self._place(row)
        servos.requests.queue_reboot(index, done)

    def _place(self, row: int) -> tuple[Servos, int]:
        """Return the servo of a joint as the `Servos` of its bus and the index there, and let the next cycle
        check all servos.
        """
        self._look = True
        return self._places[row]

    def limit_torque(self, fraction: float) -> None:
        """Limit the torque of every servo to a fraction (0 to 1) of its own limit until the next start."""
        self._look = True
        for servos in self._servos:
            servos.goals.weaken(fraction)
        for plan, bus, servos, full in zip(
            self._lines.plans, self._buses, self._servos, self._full_torque, strict=False
        ):
            for packet in reduced_torque_limits(plan, full, fraction, servos.goals.modes):
                with suppress(PortError):  # as for goals: the next read reports the bus
                    bus.send(packet)

    def idle(self, until_ns: int, time_ns: int = 0) -> None:
        """Execute waiting idle work, such as register reads and recovery of servos, on each line if it fits
        before the deadline.

        Also tries to reopen lost lines. `IdleScheduler` lists the work that it executes even if it does not
        fit.

        Args:
            until_ns: Deadline, the start of the next cycle.
            time_ns: Controllers' time of the next cycle.
        """
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
        working: list[BusEngine] = []
        for index, (bus, servos) in enumerate(self._pairs):
            work = self._idle[index]
            if bus.failure is not None:
                work.abandon()
                servos.abandon()
            else:
                servos.schedule_reads(time_ns)
                if work.tasks and work.begin_idle(latest):
                    bus.load_job(work)
                    working.append(bus)
        if working:
            self._lines.discard_input(self._buses)
            self._lines.pump()
        self._by_kernel = self._exchange.plan_reads()  # Plan here, where no deadline is near.

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, read it back, and make the features' outputs safe; return a
        sentence for each servo that did not confirm.
        """
        outcomes = self._limp()
        self._make_rest_safe()
        failures = tuple(f"{one}" for one in outcomes if not one.confirmed)
        # A servo that did not confirm torque off keeps its watchdog: without instructions it stops.
        self._disarm({(one.bus, one.servo_id) for one in outcomes if one.confirmed})
        for sentence in failures:
            self._events.emit_event("hardware", texts.torque_off_not_confirmed(sentence))
        if not failures:
            count = sum(len(plan.servos) for plan in self._lines.plans)
            self._events.emit_event("hardware", texts.torque_is_off(count))
        return failures

    def leave_torque_on(self) -> None:
        """End the exchange but leave torque on: disarm the Bus Watchdogs, and make the features' outputs
        safe.

        A servo that its Bus Watchdog has already stopped stays stopped.
        """
        # Disarm first: a silent device can delay the programs by more than the watchdogs' timeout.
        programs = [limit_patience(watchdog.release_all(plan), any_age=True) for plan in self._lines.plans]
        for problems in self._lines.run_programs(programs):
            for problem in problems or ():
                self._events.emit_event("hardware", texts.watchdog_not_disarmed(problem))
        self._make_rest_safe()

    def _make_rest_safe(self) -> None:
        for problem in self._safe_end.make_safe(self._lines):
            self._events.emit_event("hardware", texts.output_not_made_safe(problem))

    def _disarm(self, limp: Set[tuple[str, int]]) -> None:
        """Disarm the Bus Watchdogs of the servos in `limp`, (bus, ID), which have no torque. The other servos
        must still stop without a host.
        """
        for plan, bus in zip(self._lines.plans, self._buses, strict=True):
            servos = [servo for servo in plan.servos if (plan.name, servo.servo_id) in limp]
            for packet in watchdog.to_all(plan, servos, 0):
                with suppress(PortError):  # an armed servo without a host stops, which is safe
                    bus.send(packet)

    def _reopen_lines(self) -> None:
        """Try to reopen lost lines. The servos of a reopened line count as offline until they pass the
        checks.
        """
        for index, (bus, servos) in enumerate(self._pairs):
            if bus.failure is not None and self._lines.ports.reopen(index):
                bus.replace_port(self._lines.ports.ports[index])
                servos.goals.rebuild_writes()
                servos.found()
                # Plan without the line's servos: no servo is read before it was checked again.
                servos.reads.plan()

    def _limp(self) -> tuple[LimpOutcome, ...]:
        """Switch torque off on every open line, and repeat if a lost line comes back within
        LINE_TIMEOUT_NS."""
        now_ns = self._clock.now_ns()
        deadline_ns, timeout_ns = now_ns + STOP_LIMIT_NS, now_ns + LINE_TIMEOUT_NS
        while True:
            self._reopen_lines()
            for bus, servos in zip(self._buses, self._servos, strict=True):
                servos.withhold_goals()
                bus.retry()  # Give a line that is back, or was only blocked, another chance.
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
                    self._buses[index].replace_port(self._lines.ports.ports[index])
                    return True
        return False

    def _report_failures(self) -> None:
        for bus in self._buses:
            if bus.failure is not None:
                report_failures(self._lines, self._servos)
                return

    def _report_plain_reads(self) -> None:
        for plan, servos in zip(self._lines.plans, self._servos, strict=True):
            for group in servos.reads.given_up:
                names = ", ".join(plan.member_name(index) for index in plan.groups[group])
                self._events.emit_event(plan.name, texts.fast_reads_given_up(plan.name, MOST_BROKEN, names))
            servos.reads.given_up.clear()

    def _first_states(self) -> None:
        self._await_states_of_all("after torque was switched on")
        self._start_up.confirm()

    def _await_states_of_all(self, when: str) -> None:
        """Read states up to three times until every servo has answered; raise StartUpError, which names the
        servos that did not.
        """
        for pause_ns in FIRST_READS_NS:
            if pause_ns:
                self._lines.run_programs([pause(pause_ns) for _ in self._lines.plans])
            self.read_states()
            self._start_up.raise_failures()
            if not any(servos.silent for servos in self._servos):
                break
        problems = [
            f"{', '.join(servos.silent)} did not answer {when}: {choose_remedy(plan.port, CHECK)}"
            for plan, servos in zip(self._lines.plans, self._servos, strict=True)
            if servos.silent
        ]
        if problems:
            raise StartUpError("\n".join(problems), for_replies=True)
