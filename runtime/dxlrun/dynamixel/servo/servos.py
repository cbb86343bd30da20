"""Servos of one bus from cycle to cycle: lost replies, errors, alerts, and what is read in idle time.

Each becomes an event of the state machine in `life.py`, and an event of the log where a person should know.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES, Commands, States
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.dynamixel.bus_part import FeatureParts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import IN_DOUBT, Life, ServoEvent, ServoState
from dxlrun.dynamixel.servo.modes import servo_limits
from dxlrun.dynamixel.servo.offline import Offline
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.requests import Requests
from dxlrun.dynamixel.servo.slow_registers import SlowReads
from dxlrun.dynamixel.servo.watchdog_monitor import WatchdogMonitor
from dxlrun.errors import counted
from dxlrun.plan.loop_plan import ServoLimit
from dxlwire.control_table import find_table
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.goals import GoalArrays
from dxlwire.exchange.idle import IdleScheduler
from dxlwire.exchange.samples import BusSamples
from dxlwire.transaction import Program, Reply, Transaction
from dxlwire.wire.dialect import dialect_of

NOISE_EVENT_NS = 1_000_000_000  # A noisy line has at most one event in this time
UNREQUESTED_EVENT_NS = 10_000_000_000
LEAST_UNREQUESTED = 2
"""Packets that no request explains, for one event: an instruction of another host, and the reply to it. One
alone can be noise that looks like a packet: the checksum of Protocol 1.0 is a byte [i]."""
ALERT_AGAIN = 50
"""Cycles after which a standing alert is read again: a second error does not change the alert bit."""
_RESTING = frozenset((ServoState.TORQUED, ServoState.LIMP, ServoState.RELEASED))
CAUGHT_UP = 0.05  # rad of the servo from its goal: a returning one has caught up


class Servos:
    """The servos of one bus: their life, cyclic reads, goals and desired state."""

    def __init__(
        self,
        idle: IdleScheduler,
        states: States,
        samples: BusSamples,
        parts: FeatureParts,
        events: EventSink,
    ) -> None:
        """`parts`: the features that are on the bus, too."""
        plan, count = idle.plan, len(idle.plan.servos)
        self._plan = plan
        self._bus = idle.bus
        self._events = events
        self._samples = samples
        self._shown = states.hardware_error  # of the robot: the model's error item, or the error byte of 1.0
        self._hardware_errors = [find_table(servo.model, plan.protocol).errors for servo in plan.servos]
        self._rows = [servo.row for servo in plan.servos]
        self._dialect = dialect_of(plan.protocol)
        self._every_fresh = b"\1" * count
        self.goals = GoalArrays(plan)  # Builds the sync write
        self.reads = CyclicReads(plan, samples, idle.bus.owed)
        """The job that reads every servo and every device once."""
        self._parts = parts.attach(idle, self.reads, samples, events)
        """The share of features on this bus, in their order."""
        self.life = Life(idle, self.reads, events, self._parts)  # The state of each servo
        self._reboots = Reboots(self.life)
        self.desired = DesiredState(self.life, self.goals, self._reboots, states.mode)
        """Modes and registers that the servos shall have."""
        self.watchdogs = WatchdogMonitor(self.life, self.desired)
        """Whether the Bus Watchdogs receive enough instructions."""
        self._offline = Offline(self.life, self._reboots, self.desired)
        self.requests = Requests(self._offline)  # Torque and reboots that clients request
        self._slow = SlowReads(self.life, self._reboots, states)
        self._reported_errors = [0] * count  # error byte of each servo
        self._read_errors = [0] * count  # value of each servo's error item as last read
        self._alerts: list[int] = []  # servos with an alert whose hardware error was not read yet
        self._alert_cycles = 0
        self._strained: list[int] = []  # of Protocol 1.0, servos that may have shut down
        self._reading = False  # one of these waits for idle time
        self._read_last = 0
        self._noise_seen = 0
        self._noise_at_ns = -NOISE_EVENT_NS
        self._unrequested_seen = 0
        self._unrequested_at_ns = -UNREQUESTED_EVENT_NS
        self._lone, self._lone_ns = 0, 0
        self._line_lost = False

    @property
    def silent(self) -> list[str]:
        """Names of the servos whose newest reply did not arrive."""
        servos = zip(self._plan.servos, self.reads.missed, strict=False)  # devices come behind them
        return [self._plan.label(servo) for servo, missed in servos if missed]

    # Start and end

    @property
    def limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """The registers that limit the goals of each servo, by row of its joint."""
        return {
            row: servo_limits(self.life.reach(index), self.goals.own_limits[index])
            for index, row in enumerate(self._rows)
        }

    def engaged(self) -> None:
        """Take every servo for one that holds where it stands, or is limp, as the start-up has read back."""
        for index, servo in enumerate(self._plan.servos):
            self.life.on(index, ServoEvent.ENGAGED if servo.torque_at_start else ServoEvent.RELEASE)

    def confirmed(self) -> None:
        """Let every servo with torque get goals: it was read again behind the first states."""
        for index, servo in enumerate(self._plan.servos):
            if servo.torque_at_start:
                self.life.on(index, ServoEvent.TORQUE_ON)
            self.desired.entered(index, servo.start_mode)

    def watch(self, found: Findings) -> Program[None]:
        """Read every servo's clock for the first time, and arm the Bus Watchdogs.

        The last step of the start: from now on the exchange must not stop.
        """
        for index in range(len(self._rows)):
            yield from self._reboots.tick(index)
        yield from self.watchdogs.arm(found)

    def withhold_goals(self) -> None:
        """Send no goals any more: torque is being switched off."""
        for index in range(len(self._rows)):
            self.life.on(index, ServoEvent.DOUBT)

    def show_torque(self, torque: NDArray[np.uint8]) -> None:
        """Fill the rows of these servos with whether they have torque, shape (joints,), a Torque each."""
        torque[self._rows] = self.life.torque
        self.life.torque_changed = False

    # The line

    def lost(self, text: str) -> None:
        """Report once that the line is gone."""
        if not self._line_lost:
            self._line_lost = True
            self._events.emit(EventCode.PORT_LOST, Severity.ERROR, self._plan.name, text)

    def found(self) -> None:
        """Report that the line is back: its servos were without a host, and maybe without power."""
        self._line_lost = False
        for index in range(len(self._rows)):
            self.life.lose(index).kept_goal = False
        for part in self._parts:
            part.recover_line()
        text = f"bus {self._plan.name} is back; its servos count as rebooted"
        self._events.emit(EventCode.PORT_BACK, Severity.WARNING, self._plan.name, text)

    def _report_noise(self, now_ns: int) -> None:
        name = self._plan.name
        count = self._bus.noise_bytes - self._noise_seen
        if count and now_ns - self._noise_at_ns >= NOISE_EVENT_NS:
            self._noise_seen, self._noise_at_ns = self._bus.noise_bytes, now_ns
            text = f"{counted(count, 'byte', 'bytes')} belonged to no packet"
            self._events.emit(EventCode.BUS_NOISE, Severity.WARNING, name, text)
        count = self._bus.unrequested - self._unrequested_seen
        if count < LEAST_UNREQUESTED:
            if self._lone != self._bus.unrequested:
                self._lone, self._lone_ns = self._bus.unrequested, now_ns
            elif now_ns - self._lone_ns >= UNREQUESTED_EVENT_NS:  # a very late reply
                self._unrequested_seen = self._lone
        elif now_ns - self._unrequested_at_ns >= UNREQUESTED_EVENT_NS:
            self._unrequested_seen, self._unrequested_at_ns = self._bus.unrequested, now_ns
            text = (
                f"{count} packets on bus {name} answer no request of this run: another program or another "
                "computer writes on the line; stop it, or its commands move these servos too"
            )
            self._events.emit(EventCode.UNREQUESTED, Severity.WARNING, name, text)

    # A cycle

    def settle(self, now_ns: int) -> None:
        """Report what changed with this cycle's replies."""
        if self._samples.fresh.tobytes() != self._every_fresh or any(self.reads.missed):
            self._count_losses(now_ns)
        for part in self._parts:
            part.judge_replies(now_ns)
        if self.reads.errors[: len(self._rows)] != self._reported_errors:
            self._report_errors()

    def prepare_goals(self, goals: Commands, states: States) -> None:
        """Let the returning servos that have caught up follow their goals as fast as these say.

        A servo that follows no position has nothing to catch up with.
        """
        if ServoState.RETURNING not in self.life.states:
            return
        for index, (row, servo) in enumerate(zip(self._rows, self._plan.servos, strict=True)):
            off = abs(goals.position[row] - states.position[row])
            if self.life.states[index] is ServoState.RETURNING and not off >= CAUGHT_UP * servo.ratio:
                self.life.on(index, ServoEvent.CAUGHT_UP)

    def follow_goals(self, index: int) -> None:
        """Let a servo that was given torque get goals, as soon as its torque was read once more."""
        if self.life.states[index] is ServoState.GIVEN:
            self.life.on(index, ServoEvent.ANCHORED)

    def _count_losses(self, now_ns: int) -> None:
        life, missed = self.life, self.reads.missed
        for index, fresh in enumerate(self._samples.fresh.tolist()):
            if life.offline(index):
                continue
            if fresh:
                if missed[index]:
                    lost = "1 reply was" if missed[index] == 1 else f"{missed[index]} replies in a row were"
                    missed[index] = 0
                    text = f"answers again; {lost} lost"
                    life.report(EventCode.READ_BACK, Severity.INFO, index, text)
                continue
            missed[index] += 1
            life.on(index, ServoEvent.DOUBT)
            if missed[index] == 1:
                how = "sent a garbled reply" if self.reads.garbled[index] else "did not answer"
                life.report(EventCode.READ_LOST, Severity.WARNING, index, how)
            elif missed[index] >= LOST_CYCLES and now_ns - self._samples.at_ns[index] >= LOST_AGE_NS:
                text = f"missed {missed[index]} replies in a row; it is probed once a second until"
                life.report(EventCode.SERVO_LOST, Severity.ERROR, index, f"{text} it is in order")
                self._offline.lose(index)

    def _report_errors(self) -> None:
        for index, before in enumerate(self._reported_errors):
            error = self.reads.errors[index]
            if error == before:
                continue
            if self._dialect.ALERT:
                if error & ~before & self._dialect.ALERT and index not in self._alerts:
                    self._alerts.append(index)
                    self.life.on(index, ServoEvent.DOUBT)  # it may have shut down
                elif not error & self._dialect.ALERT:
                    self._shown[self._rows[index]] = self._read_errors[index] = 0
            else:
                self._shown[self._rows[index]] = error & self._hardware_errors[index].mask
                if error & ~before and index not in self._strained:
                    # Shutdown (18) may list any error, and a goal that is a torque limit would revive it
                    self._strained.append(index)
                    self.life.on(index, ServoEvent.DOUBT)
            self._reported_errors[index] = error
            severity = Severity.ERROR if error else Severity.INFO
            text = f"reports {self._dialect.describe_error(error)}"
            self.life.report(EventCode.SERVO_ERROR, severity, index, text)

    # Idle time

    @property
    def at_rest(self) -> bool:
        """True when nothing is to be looked at here before `due_ns`, as long as replies are as planned.

        A part of a feature is asked in each cycle, for its commands.
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
        """When idle time has something to do that waits for its time."""
        return self._slow.due_ns

    @property
    def _noise_waits(self) -> bool:
        bus = self._bus
        return bus.noise_bytes > self._noise_seen or bus.unrequested > self._unrequested_seen

    def abandon(self) -> None:
        """Answer what clients requested and waits for too long, while the line is gone."""
        if not self.life.calm:
            self._offline.expire()

    def look(self, time_ns: int) -> None:
        """Let the coming idle time read what is due beside the cyclic reads, one servo at a time.

        That is the hardware error of a servo that raised an alert, the torque limit of one that may have shut
        down, and torque enable of one that waits for its goals. Only a servo that answers is read.

        `time_ns`: the controllers' time of the coming cycle, for the parts of features.
        """
        self._report_noise(self.life.now_ns())
        if not self.life.calm:
            self._offline.look()
        self._slow.look()
        for part in self._parts:
            part.schedule_idle_work(time_ns)
        if not self._reading and (due := self._due()) is not None:
            index, what, program = due
            self._reading, self._read_last = True, index
            self.life.do(index, program, what)

    def _due(self) -> tuple[int, str, Program[None]] | None:
        """Return the servo that is read next, what of it, and the program; None: nothing is due."""
        if any(self._reported_errors) or self._alert_cycles:
            self._repeat_alerts()
        servos, fresh = self._plan.servos, self._samples.fresh
        for index in self._alerts:
            address = servos[index].hardware_error_address
            if address is not None and fresh[index]:
                read = self.life.reach(index).reading(address, 1)
                return index, "hardware error status", self._read_hardware_error(index, read)
        for index in self._strained:
            limit = servos[index].torque_limit
            if limit is not None and fresh[index]:
                read = self.life.reach(index).reading(limit.address, limit.size)
                return index, limit.name, self._read_torque_limit(index, read, limit.name)
        if not self.life.calm:
            for offset in range(1, len(servos) + 1):
                index = (self._read_last + offset) % len(servos)
                if self.life.states[index] in IN_DOUBT and fresh[index]:
                    return index, "torque enable", self._read_torque(index)
        return None

    def _repeat_alerts(self) -> None:
        """Read the hardware error of each servo whose alert stands again now and then."""
        bit = self._dialect.ALERT
        standing = [index for index, error in enumerate(self._reported_errors) if error & bit]
        self._alert_cycles = self._alert_cycles + 1 if standing else 0
        if self._alert_cycles >= ALERT_AGAIN:
            self._alert_cycles = 0
            self._alerts += [index for index in standing if index not in self._alerts]

    def _read(self, transaction: Transaction) -> Generator[Transaction, Reply, Reply]:
        reply = yield transaction
        self._reading = False
        return reply

    def _read_torque(self, index: int) -> Program[None]:
        """Give goals again to a servo with torque, and none to one without."""
        read = self.life.reach(index).reading(self._plan.servos[index].torque_address, 1)
        reply = yield from self._read(read)
        if not reply.answered or index in self._strained or self.life.states[index] not in IN_DOUBT:
            return  # shut down, lost or released meanwhile: its torque limit or its return decides
        enabled = reply.parameters[0]
        if enabled == 1:
            self.life.on(index, ServoEvent.TORQUE_ON)
            return
        alert = self._dialect.ALERT
        if alert and (self._shown[self._rows[index]] or self._reported_errors[index] & alert):
            self.life.on(index, ServoEvent.TORQUE_OFF)  # a shutdown, whose reason was reported
        else:
            self.life.lose(index).limp_reported = True  # it may have started anew
        self.life.report_limp(index, enabled)

    def _read_torque_limit(self, index: int, read: Transaction, name: str) -> Program[None]:
        """Give no more goals to a servo of Protocol 1.0 that shut down: its torque enable stays 1."""
        reply = yield from self._read(read)
        if not reply.answered:
            return
        self._strained.remove(index)
        if not any(reply.parameters) and not self.life.offline(index):
            self.life.on(index, ServoEvent.DOUBT)
            self.life.on(index, ServoEvent.TORQUE_OFF)
            text = f"has {name} = 0: it shut down, and gets no goals until the next run"
            self.life.report(EventCode.SERVO_LIMP, Severity.ERROR, index, text)

    def _read_hardware_error(self, index: int, read: Transaction) -> Program[None]:
        """Report a hardware error that is new; its shutdown may have cut the torque."""
        reply = yield from self._read(read)
        if not reply.answered:
            return
        self._alerts.remove(index)
        value, errors = reply.parameters[0], self._hardware_errors[index]
        if value == self._read_errors[index]:
            return
        self._read_errors[index] = value
        title = self.life.reach(index).items[errors.item].title
        text = f"has {title} = {value}: {errors.describe(value)}"
        if errors.is_warning(value):  # the states have none: a joint with an error gets no torque
            self._shown[self._rows[index]] = 0
            self.life.report(EventCode.SERVO_ERROR, Severity.WARNING, index, text)
            return
        self._shown[self._rows[index]] = value
        self.life.on(index, ServoEvent.DOUBT)
        self.life.report(EventCode.SERVO_ERROR, Severity.ERROR, index, text)
