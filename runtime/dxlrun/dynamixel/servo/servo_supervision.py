"""Servos of one bus in every cycle: lost replies, errors, alerts, and reads in idle time.

Each of them becomes an event of the state machine in `life.py`, and an event of the log if a person should
know.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES, Commands, States
from dxlrun.channels.event_records import EventSink
from dxlrun.dynamixel import texts
from dxlrun.dynamixel.bus_part import FeatureParts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import IN_DOUBT, Life, ServoEvent, ServoState
from dxlrun.dynamixel.servo.mode_switches import servo_limits
from dxlrun.dynamixel.servo.offline import OfflineRecovery
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.requests import Requests
from dxlrun.dynamixel.servo.slow_registers import SlowReads
from dxlrun.dynamixel.servo.watchdog_monitor import WatchdogMonitor
from dxlrun.plan.loop_plan import ServoLimit
from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import find_table
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.goal_writes import GoalArrays
from dxlwire.exchange.idle import IdleScheduler
from dxlwire.exchange.samples import BusSamples
from dxlwire.transaction import Program, Reply, Transaction
from dxlwire.wire.dialect import dialect_of

NOISE_EVENT_NS = 1_000_000_000  # shortest time between two events about a noisy line
UNREQUESTED_EVENT_NS = 10_000_000_000
LEAST_UNREQUESTED = 2
"""Number of unexplained packets that causes an event: an instruction of another host, and the reply to that.
A single one can be noise that looks like a packet: the checksum of Protocol 1.0 is one byte [i].
"""
ALERT_AGAIN = 50
"""Cycles between two reads of the hardware error while an alert bit stays set: a second error does not change
the bit.
"""
_RESTING = frozenset((ServoState.TORQUED, ServoState.LIMP, ServoState.RELEASED))
CAUGHT_UP = 0.05  # rad; a returning servo this close to its goal has caught up


class Servos:
    """Supervises the servos of one bus: creates and owns their state machine, cyclic reads, goals and desired
    state.
    """

    def __init__(
        self,
        idle: IdleScheduler,
        states: States,
        samples: BusSamples,
        parts: FeatureParts,
        events: EventSink,
    ) -> None:
        """Create the objects of the bus and its features' parts, from `parts`, the features of the robot."""
        plan, count = idle.plan, len(idle.plan.servos)
        self._bus = idle.bus
        self._events = events
        self._samples = samples
        # Hardware errors of the robot: the model's error item, or the error byte of Protocol 1.0.
        self._shown = states.hardware_error
        self._hardware_errors = [find_table(servo.model, plan.protocol).errors for servo in plan.servos]
        self._rows = [servo.row for servo in plan.servos]
        self._dialect = dialect_of(plan.protocol)
        self._every_fresh = b"\1" * count
        self.goals = GoalArrays(plan)  # builds the sync write
        self.reads = CyclicReads(plan, samples, idle.bus.owed)
        """Reads the states of all servos and devices once a cycle."""
        self._parts = parts.attach(idle, self.reads, samples, events)
        """Parts that features have on this bus, in the order of the features."""
        self.life = Life(idle, self.reads, events, self._parts)  # The state of each servo
        self._reboots = Reboots(self.life)
        self.desired = DesiredState(self.life, self.goals, self._reboots, states.mode)
        """Modes and registers that the servos should have."""
        self.watchdogs = WatchdogMonitor(self.life, self.desired)
        """Detects pauses that trip the servos' Bus Watchdogs."""
        self._offline = OfflineRecovery(self.life, self._reboots, self.desired)
        self.requests = Requests(self._offline)  # clients' requests: torque and reboots
        self._slow = SlowReads(self.life, self._reboots, states)
        self._reported_errors = [0] * count  # error byte of each servo
        self._read_errors = [0] * count  # value of each servo's error item as last read
        self._alerts: list[int] = []  # servos with an alert whose hardware error was not read yet
        self._alert_cycles = 0
        self._strained: list[int] = []  # servos of Protocol 1.0 that may have shut down
        self._reading = False  # a read of `_due` waits for idle time
        self._read_last = 0
        self._noise_seen = 0
        self._noise_at_ns = -NOISE_EVENT_NS
        self._unrequested_seen = 0
        self._unrequested_at_ns = -UNREQUESTED_EVENT_NS
        self._lone, self._lone_ns = 0, 0
        self._line_lost = False

    @property
    def _plan(self) -> BusPlan:
        return self.life.bus.plan

    @property
    def silent(self) -> list[str]:
        """Labels of the servos whose newest read got no valid reply."""
        servos = zip(self._plan.servos, self.reads.missed, strict=False)  # the devices follow the servos
        return [self._plan.label(servo) for servo, missed in servos if missed]

    # Start and end

    @property
    def limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """Registers that limit the goals of each servo, in joint units, by row of the servo's joint."""
        return {
            row: servo_limits(self.life.access_servo(index), self.goals.own_limits[index])
            for index, row in enumerate(self._rows)
        }

    def engaged(self) -> None:
        """Mark each servo as HOLDING or, if the robot file starts it limp, RELEASED, after torque was
        switched on at start-up.
        """
        for index, servo in enumerate(self._plan.servos):
            self.life.on(index, ServoEvent.ENGAGED if servo.torque_at_start else ServoEvent.RELEASE)

    def confirmed(self) -> None:
        """Start sending goals to every servo that start-up gave torque; call it after a second read confirmed
        the torque.
        """
        for index, servo in enumerate(self._plan.servos):
            if servo.torque_at_start:
                self.life.on(index, ServoEvent.TORQUE_ON)
            self.desired.entered(index, servo.start_mode)

    def begin_watching(self, found: Findings) -> Program[None]:
        """Read every servo's Realtime Tick for the first time, and arm the Bus Watchdogs; problems go to
        `found`.

        This is the last step of start-up: from now on the exchange must not stop.
        """
        for index in range(len(self._rows)):
            yield from self._reboots.tick(index)
        yield from self.watchdogs.arm(found)

    def withhold_goals(self) -> None:
        """Stop sending goals to all servos of the bus, because torque is being switched off."""
        for index in range(len(self._rows)):
            self.life.on(index, ServoEvent.DOUBT)

    def show_torque(self, torque: NDArray[np.uint8]) -> None:
        """Copy the Torque value of each servo into its row of `torque`, the array of the robot's states,
        shape (joints,).
        """
        torque[self._rows] = self.life.torque
        self.life.torque_changed = False

    # The line

    def lost(self, text: str) -> None:
        """Report that the serial line is lost, once until `found`; `text` names bus and error."""
        if not self._line_lost:
            self._line_lost = True
            self._events.emit_event(self._plan.name, texts.line_lost(text))

    def found(self) -> None:
        """Report that the serial line is back, and treat all its servos as lost: they had no host, and may
        have had no power.
        """
        self._line_lost = False
        for index in range(len(self._rows)):
            self.life.lose(index).kept_goal = False
        for part in self._parts:
            part.recover_line()
        self._events.emit_event(self._plan.name, texts.line_back(self._plan.name))

    def _report_noise(self, now_ns: int) -> None:
        name = self._plan.name
        count = self._bus.noise_bytes - self._noise_seen
        if count and now_ns - self._noise_at_ns >= NOISE_EVENT_NS:
            self._noise_seen, self._noise_at_ns = self._bus.noise_bytes, now_ns
            self._events.emit_event(name, texts.noise_received(count))
        count = self._bus.unrequested - self._unrequested_seen
        if count < LEAST_UNREQUESTED:
            if self._lone != self._bus.unrequested:
                self._lone, self._lone_ns = self._bus.unrequested, now_ns
            # A single packet for so long was a very late reply, not another host.
            elif now_ns - self._lone_ns >= UNREQUESTED_EVENT_NS:
                self._unrequested_seen = self._lone
        elif now_ns - self._unrequested_at_ns >= UNREQUESTED_EVENT_NS:
            self._unrequested_seen, self._unrequested_at_ns = self._bus.unrequested, now_ns
            self._events.emit_event(name, texts.other_host_found(name, count))

    # A cycle

    def report_changes(self, now_ns: int) -> None:
        """Evaluate the replies of a cycle: count lost replies, report error bytes, and call the features'
        parts.
        """
        if self._samples.fresh.tobytes() != self._every_fresh or any(self.reads.missed):
            self._count_losses(now_ns)
        for part in self._parts:
            part.judge_replies(now_ns)
        if self.reads.errors[: len(self._rows)] != self._reported_errors:
            self._report_errors()

    def prepare_goals(self, goals: Commands, states: States) -> None:
        """Remove the speed limit of returning servos that are closer than CAUGHT_UP to their goals.

        A servo that follows no position counts as close.
        """
        if ServoState.RETURNING not in self.life.states:
            return
        for index, (row, servo) in enumerate(zip(self._rows, self._plan.servos, strict=True)):
            off = abs(goals.position[row] - states.position[row])
            if self.life.states[index] is ServoState.RETURNING and not off >= CAUGHT_UP * servo.ratio:
                self.life.on(index, ServoEvent.CAUGHT_UP)

    def enable_goals(self, index: int) -> None:
        """Resume sending goals to a servo that was given torque, once its torque enable has been read
        again."""
        if self.life.states[index] is ServoState.GIVEN:
            self.life.on(index, ServoEvent.ANCHORED)

    def _count_losses(self, now_ns: int) -> None:
        life, missed = self.life, self.reads.missed
        for index, fresh in enumerate(self._samples.fresh.tolist()):
            if life.offline(index):
                continue
            if fresh:
                if missed[index]:
                    life.report_event(index, texts.servo_answers_again(life.servo_name(index), missed[index]))
                    missed[index] = 0
                continue
            missed[index] += 1
            life.on(index, ServoEvent.DOUBT)
            if missed[index] == 1:
                text = texts.reply_garbled if self.reads.garbled[index] else texts.reply_missed
                life.report_event(index, text(life.servo_name(index)))
            # Require an age, too: at a high rate a few cycles are too short to call a servo lost.
            elif missed[index] >= LOST_CYCLES and now_ns - self._samples.at_ns[index] >= LOST_AGE_NS:
                life.report_event(index, texts.servo_lost(life.servo_name(index), missed[index]))
                self._offline.lose(index)

    def _report_errors(self) -> None:
        for index, before in enumerate(self._reported_errors):
            error = self.reads.errors[index]
            if error == before:
                continue
            if self._dialect.ALERT:
                if error & ~before & self._dialect.ALERT and index not in self._alerts:
                    self._alerts.append(index)
                    self.life.on(index, ServoEvent.DOUBT)  # the servo may have shut down
                elif not error & self._dialect.ALERT:
                    self._shown[self._rows[index]] = self._read_errors[index] = 0
            else:
                self._shown[self._rows[index]] = error & self._hardware_errors[index].mask
                if error & ~before and index not in self._strained:
                    # Any error can be in Shutdown (18), and a goal that is a torque limit would revive the
                    # servo.
                    self._strained.append(index)
                    self.life.on(index, ServoEvent.DOUBT)
            self._reported_errors[index] = error
            text = texts.error_byte_set if error else texts.error_byte_cleared
            self.life.report_event(
                index, text(self.life.servo_name(index), self._dialect.describe_error(error))
            )

    # Idle time

    @property
    def at_rest(self) -> bool:
        """True if this bus needs no work beyond plain reads and writes before `due_ns`, as long as replies
        come as planned.

        Always False with a feature's part, which is called in each cycle because it may have commands.
        """
        return not (
            self._bus.failure is not None
            or self._bus.receiver.pending
            or self._parts
            or self.life.torque_changed
            or not _RESTING.issuperset(self.life.states)
            or self._alerts
            or self._strained
            or self._alert_cycles
            or self._noise_waits
            or any(error & self._dialect.ALERT for error in self._reported_errors)
        )

    @property
    def due_ns(self) -> int:
        """Time (ns) at which the next read of a slow register is due."""
        return self._slow.due_ns

    @property
    def _noise_waits(self) -> bool:
        bus = self._bus
        return bus.noise_bytes > self._noise_seen or bus.unrequested > self._unrequested_seen

    def abandon(self) -> None:
        """Fail clients' reboot requests that have timed out, while the line is lost and no other work can
        run.
        """
        if not self.life.calm:
            self._offline.expire_reboots()

    def schedule_reads(self, time_ns: int) -> None:
        """Report noise, and schedule the reads and probes that are due in idle time, one servo at a time.

        The reads are the hardware error of a servo that raised an alert, the torque limit of a servo that may
        have shut down, torque enable of a servo that waits for its goals, and slow registers. Only a servo
        that answers is read.

        Args:
            time_ns: Controllers' time of the coming cycle, for the parts of features.
        """
        self._report_noise(self.life.now_ns())
        if not self.life.calm:
            self._offline.schedule_probes()
        self._slow.schedule_read()
        for part in self._parts:
            part.schedule_idle_work(time_ns)
        if not self._reading and (due := self._due()) is not None:
            index, what, program = due
            self._reading, self._read_last = True, index
            self.life.do(index, program, what)

    def _due(self) -> tuple[int, str, Program[None]] | None:
        """Return (servo, name of the item, program) of the most urgent extra read; None: nothing is due."""
        if any(self._reported_errors) or self._alert_cycles:
            self._repeat_alerts()
        servos, fresh = self._plan.servos, self._samples.fresh
        for index in self._alerts:
            address = servos[index].hardware_error_address
            if address is not None and fresh[index]:
                read = self.life.access_servo(index).reading(address, 1)
                return index, "hardware error status", self._read_hardware_error(index, read)
        for index in self._strained:
            limit = servos[index].torque_limit
            if limit is not None and fresh[index]:
                read = self.life.access_servo(index).reading(limit.address, limit.size)
                return index, limit.name, self._read_torque_limit(index, read, limit.name)
        if not self.life.calm:
            for offset in range(1, len(servos) + 1):
                index = (self._read_last + offset) % len(servos)
                if self.life.states[index] in IN_DOUBT and fresh[index]:
                    return index, "torque enable", self._read_torque(index)
        return None

    def _repeat_alerts(self) -> None:
        """Request another read of the hardware error of servos whose alert bit stays set, every `ALERT_AGAIN`
        cycles.
        """
        bit = self._dialect.ALERT
        standing = [index for index, error in enumerate(self._reported_errors) if error & bit]
        self._alert_cycles = self._alert_cycles + 1 if standing else 0
        if self._alert_cycles >= ALERT_AGAIN:
            self._alert_cycles = 0
            self._alerts += [index for index in standing if index not in self._alerts]

    def _await_reply(self, transaction: Transaction) -> Generator[Transaction, Reply, Reply]:
        reply = yield transaction
        self._reading = False
        return reply

    def _read_torque(self, index: int) -> Program[None]:
        """Read torque enable of a servo in doubt: with 1 it gets goals again, otherwise it counts as limp or
        lost.
        """
        read = self.life.access_servo(index).reading(self._plan.servos[index].torque_address, 1)
        reply = yield from self._await_reply(read)
        if not reply.answered or index in self._strained or self.life.states[index] not in IN_DOUBT:
            return  # It shut down, was lost or was released since: its torque limit or its return decides.
        enabled = reply.parameters[0]
        if enabled == 1:
            self.life.on(index, ServoEvent.TORQUE_ON)
            return
        alert = self._dialect.ALERT
        if alert and (self._shown[self._rows[index]] or self._reported_errors[index] & alert):
            self.life.on(index, ServoEvent.TORQUE_OFF)  # a shutdown, whose reason was reported
        else:
            self.life.lose(index).limp_reported = True  # it may have rebooted
        self.life.report_limp(index, enabled)

    def _read_torque_limit(self, index: int, read: Transaction, name: str) -> Program[None]:
        """Read the torque limit of a servo of Protocol 1.0 after an error: 0 means a shutdown, although
        torque enable stays 1.
        """
        reply = yield from self._await_reply(read)
        if not reply.answered:
            return
        self._strained.remove(index)
        if not any(reply.parameters) and not self.life.offline(index):
            self.life.on(index, ServoEvent.DOUBT)
            self.life.on(index, ServoEvent.TORQUE_OFF)
            self.life.report_event(index, texts.servo_shut_down(self.life.servo_name(index), name))

    def _read_hardware_error(self, index: int, read: Transaction) -> Program[None]:
        """Read the hardware error of a servo with an alert and report it if it is new; its shutdown may have
        cut the torque.
        """
        reply = yield from self._await_reply(read)
        if not reply.answered:
            return
        self._alerts.remove(index)
        value, errors = reply.parameters[0], self._hardware_errors[index]
        if value == self._read_errors[index]:
            return
        self._read_errors[index] = value
        title = self.life.access_servo(index).items[errors.item].title
        about = self.life.servo_name(index), title, value, errors.describe_errors(value)
        # A warning is not in the states: a joint with an error there gets no torque.
        if errors.is_warning(value):
            self._shown[self._rows[index]] = 0
            self.life.report_event(index, texts.hardware_warning(*about))
            return
        self._shown[self._rows[index]] = value
        self.life.on(index, ServoEvent.DOUBT)
        self.life.report_event(index, texts.hardware_error(*about))
