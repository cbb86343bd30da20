"""Health: what is known of each servo of one bus from cycle to cycle, and what of it is worth an event."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import numpy as np

from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.cyclic_reads import CyclicReads
from dxlrun.dynamixel.exchange.gaps import Gaps, Urgency
from dxlrun.dynamixel.exchange.samples import BusSamples
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.registers.inspection1 import FORBIDDEN
from dxlrun.dynamixel.servo.absent import FIRST_PROBE_NS, Absent
from dxlrun.dynamixel.servo.feeding import Feeding
from dxlrun.dynamixel.servo.returning import Returning
from dxlrun.dynamixel.servo.slow_registers import SlowRegisters, once
from dxlrun.dynamixel.servo.startup import Rejoined
from dxlrun.dynamixel.servo.wanted import Wanted
from dxlrun.dynamixel.wire.dialect import dialect_of
from dxlrun.dynamixel.wire.protocol1 import StatusError
from dxlrun.dynamixel.wire.protocol2 import describe_hardware_error
from dxlrun.dynamixel.wire.transaction import Program, Reply, Transaction
from dxlrun.errors import counted
from dxlrun.interfaces import LOST_AGE_NS, LOST_CYCLES, Commands, Floats, States
from dxlrun.run.channels.events import EventCode, EventSink, Severity

NOISE_EVENT_NS = 1_000_000_000
"""A noisy line has at most one event in this time."""
UNREQUESTED_EVENT_NS = 10_000_000_000
LEAST_UNREQUESTED = 2
"""Packets that no request explains, for one event: an instruction of another host, and the reply to it. One
alone can be noise that looks like a packet: the checksum of Protocol 1.0 is a byte [i]."""

ALERT_AGAIN = 50
"""Cycles after which a standing alert is read again: a second error does not change the alert bit."""
_SHUTS_DOWN = StatusError.OVERHEATING | StatusError.OVERLOAD
"""After them Torque Limit may be 0 (e-Manual AX-12A, Alarm Shutdown (18))."""


class _Question(NamedTuple):
    """What one servo is asked in a gap, and who takes the answer."""

    servo: int
    what: str
    read: Transaction
    take: Callable[[int, Reply], None]


class Servos:
    """The servos of one bus: their cyclic reads, their goals, and who may get a goal."""

    __slots__ = (
        "_absent",
        "_alert_cycles",
        "_alerting",
        "_alerts",
        "_asking",
        "_bus",
        "_dialect",
        "_emit",
        "_everybody",
        "_gaps",
        "_gone",
        "_hardware_errors",
        "_limp",
        "_lost",
        "_missed",
        "_missing",
        "_modes",
        "_noise_at_ns",
        "_noise_seen",
        "_plan",
        "_probed",
        "_returning",
        "_rows",
        "_said_errors",
        "_samples",
        "_shown",
        "_slow",
        "_strained",
        "_unrequested_at_ns",
        "_unrequested_seen",
        "feeding",
        "goals",
        "reads",
        "torqued",
    )

    def __init__(  # noqa: PLR0917  what a bus has, and whom it tells
        self,
        plan: BusPlan,
        bus: Bus,
        gaps: Gaps,
        wanted: Wanted,
        events: EventSink,
        states: States,
        samples: BusSamples,
    ) -> None:
        count = len(plan.servos)
        self._plan = plan
        self._bus = bus
        self._gaps = gaps
        self._emit = events.emit
        self._samples = samples
        self.goals = wanted.goals
        """Builds the sync write."""
        self.reads = CyclicReads(plan, samples)
        """The job that reads every servo once."""
        self.torqued = np.zeros(count, dtype=np.bool_)
        """Shape (servos,): who has torque for certain and missed no reply since; they get goals."""
        self._rows = [servo.row for servo in plan.servos]
        self._everybody = b"\1" * count
        self._returning = Returning(self._rows)
        self._limp = [False] * count
        self._missed = self.reads.missed
        self._missing = False  # somebody's newest reply is
        self._said_errors = [0] * count
        self._dialect = dialect_of(plan.protocol)
        self._alerts: list[int] = []  # who has a hardware error that was not read yet
        self._alert_cycles = 0
        self._alerting = False  # somebody's alert stands
        self._hardware_errors = [0] * count
        self._shown = states.hardware_error
        self._strained: list[int] = []  # Protocol 1.0: who may have shut down
        self._asking = False
        self._probed = 0
        self._noise_seen = 0
        self._noise_at_ns = -NOISE_EVENT_NS
        self._unrequested_seen = 0
        self._unrequested_at_ns = -UNREQUESTED_EVENT_NS
        self._lost = False
        self._gone: set[int] = set()  # who gets no torque any more, as its group's policy says
        self.feeding = Feeding(
            plan,
            gaps,
            self.reads.away,
            events,
            self._stopped,
            lambda index: self._leave(index, 0),
            wanted.registers.wanted,
        )
        """Whether the Bus Watchdogs hear enough."""
        self._modes = wanted.modes
        self._absent = Absent(plan, gaps, wanted, self._say, self._back)
        self._slow = SlowRegisters(
            plan, gaps, self._absent, self.reads.away, self._say, states, lambda index: self._leave(index, 0)
        )

    @property
    def silent(self) -> list[str]:
        """Names of the servos whose newest reply did not arrive."""
        return [self._who(index) for index, missed in enumerate(self._missed) if missed]

    def settle(self, now_ns: int) -> None:
        """Report what changed with this cycle's replies."""
        reads = self.reads
        if self._missing or self._samples.fresh.tobytes() != self._everybody:
            self._count_losses(now_ns)
            self._missing = any(self._missed)
        elif self._rows:
            self.arrived(int(self._samples.at_ns[-1]), self._bus.due_ns)
        if reads.errors != self._said_errors:
            self._say_errors()

    def arrived(self, at_ns: int, due_ns: int) -> None:
        """Take note of when the last reply of a cycle came and when it was due; see `Gaps.came`."""
        self._gaps.came(at_ns, due_ns)

    def _report_noise(self, now_ns: int) -> None:
        if self._bus.noise_bytes != self._noise_seen and now_ns - self._noise_at_ns >= NOISE_EVENT_NS:
            count = self._bus.noise_bytes - self._noise_seen
            self._noise_seen, self._noise_at_ns = self._bus.noise_bytes, now_ns
            text = f"{counted(count, 'byte', 'bytes')} belonged to no packet"
            self._emit(EventCode.BUS_NOISE, Severity.WARNING, self._plan.name, text)
        if self._bus.unrequested != self._unrequested_seen:
            self._tell_unrequested(now_ns)

    def _tell_unrequested(self, now_ns: int) -> None:
        """Tell of another host on the line, now and then."""
        count = self._bus.unrequested - self._unrequested_seen
        if count >= LEAST_UNREQUESTED and now_ns - self._unrequested_at_ns >= UNREQUESTED_EVENT_NS:
            self._unrequested_seen, self._unrequested_at_ns = self._bus.unrequested, now_ns
            text = (
                f"{count} packets on bus {self._plan.name} answer no request of this run: another program or "
                "another computer writes on the line; stop it, or its commands move these servos too"
            )
            self._emit(EventCode.UNREQUESTED, Severity.WARNING, self._plan.name, text)

    def watch(self) -> Program[list[str]]:
        """Read every servo's clock for the first time, and arm the Bus Watchdogs; return what went wrong.

        The last step of the start: from now on the exchange must not stop.
        """
        for index in range(len(self._rows)):
            yield from self._absent.tick(index)
        return (yield from self.feeding.begin())

    def _stopped(self, index: int) -> None:
        """Send a servo that its watchdog stopped no goal before its torque was read again."""
        self.torqued[index] = False
        self._returning.slow_down(index)

    def prepare_goals(self, goals: Commands, states: States) -> None:
        """Bring up to date which servos may get goals, and how fast those that were lost may follow them."""
        if self._modes.doubtful:
            self.torqued[self._modes.doubtful] = False
            self._modes.doubtful.clear()
        if self._returning.anybody:
            self._returning.follow(goals, states, self.torqued)

    @property
    def ceiling(self) -> Floats:
        """The highest speed of each servo toward a position, rad/s; NaN: none."""
        return self._returning.ceiling

    def ask(self) -> None:
        """Let the next gap ask one servo what it is owed beside its cyclic reads, if one is owed anything.

        That is torque enable of a servo that waits for its goals, or the hardware error status of one that
        raised an alert. Only a servo that answers is asked; of a limp one the torque is known. Who left the
        exchange is asked by itself, see `absent`.
        """
        self._report_noise(self._gaps.now_ns())
        self._absent.look()
        self._slow.look()
        question = None if self._asking else self._owed()
        if question is None:
            return
        self._asking = True
        self._probed = question.servo
        what = f"{question.what} of {self._who(question.servo)}"
        self._gaps.add(
            once(question.read),
            partial(self._answered, question),
            Urgency.REPAIR,
            what,
            question.servo,
        )

    def _answered(self, question: _Question, reply: Reply) -> None:
        self._asking = False
        if reply.answered:
            question.take(question.servo, reply)

    def _alert_again(self) -> None:
        """Note now and then to read the hardware error of everybody whose alert stands."""
        bit = self._dialect.ALERT
        standing = [index for index, error in enumerate(self._said_errors) if error & bit]
        self._alert_cycles = self._alert_cycles + 1 if standing else 0
        if self._alert_cycles >= ALERT_AGAIN:
            self._alert_cycles = 0
            self._alerts += [index for index in standing if index not in self._alerts]

    def _owed(self) -> _Question | None:
        if self._alerting or self._alert_cycles:
            self._alert_again()
        for index in self._alerts:
            address = self._plan.servos[index].hardware_error_address
            if address is not None and self._samples.fresh[index]:
                read = plan_line(self._plan).read(self._plan.servos[index].servo_id, address, 1)
                return _Question(index, "hardware error status", read, self._take_hardware_error)
        for index in self._strained:
            limit = self._plan.servos[index].torque_limit
            if limit is not None and self._samples.fresh[index]:
                read = plan_line(self._plan).read(
                    self._plan.servos[index].servo_id, limit.address, limit.size
                )
                return _Question(index, limit.name, read, self._take_torque_limit)
        if self.torqued.tobytes() == self._everybody:
            return None
        count = len(self._plan.servos)
        for offset in range(1, count + 1):
            index = (self._probed + offset) % count
            if not (self.torqued[index] or self._limp[index]) and self._samples.fresh[index]:
                read = self._plan.torque_reads[index]
                return _Question(index, "torque enable", read, self._take_torque)
        return None

    def _take_torque(self, index: int, reply: Reply) -> None:
        """Give goals again to a servo with torque, leave one without out."""
        if reply.parameters[0] == 1:
            self.torqued[index] = True
            return
        if not (self._hardware_errors[index] or self._said_errors[index] & self._dialect.ALERT):
            self._leave(index, 0)  # a shutdown has a reason, this one may have started anew
        self._tell_limp(index, reply.parameters[0])

    def _take_torque_limit(self, index: int, reply: Reply) -> None:
        """Give no more goals to a servo of Protocol 1.0 that shut down: its torque enable stays 1."""
        self._strained.remove(index)
        limit = self._plan.servos[index].torque_limit
        if limit is not None and not any(reply.parameters):
            self.torqued[index], self._limp[index] = False, True
            text = f"has {limit.name} = 0: it shut down, and gets no goals until the next run"
            self._say(EventCode.SERVO_LIMP, Severity.ERROR, index, text)

    def _take_hardware_error(self, index: int, reply: Reply) -> None:
        self._alerts.remove(index)
        if reply.parameters[0] == self._hardware_errors[index]:
            return  # read again, and nothing is new
        self._hardware_errors[index] = reply.parameters[0]
        self._shown[self._rows[index]] = reply.parameters[0]
        address = self._plan.servos[index].hardware_error_address
        words = describe_hardware_error(reply.parameters[0])
        # shutdown may have cut the torque: no goal until it was read
        self.torqued[index] = False
        text = f"has Hardware Error Status ({address}) = {reply.parameters[0]}: {words}"
        self._say(EventCode.SERVO_ERROR, Severity.ERROR, index, text)

    def lost(self, text: str) -> None:
        """Tell once that the line is gone."""
        if not self._lost:
            self._lost = True
            self._emit(EventCode.PORT_LOST, Severity.ERROR, self._plan.name, text)

    def found(self) -> None:
        """Tell that the line is back: its servos were without a host, and maybe without power."""
        self._lost = False
        for index in range(len(self._missed)):
            self._leave(index, 0)
        text = f"bus {self._plan.name} is back; its servos count as rebooted"
        self._emit(EventCode.PORT_BACK, Severity.WARNING, self._plan.name, text)

    def _count_losses(self, now_ns: int) -> None:
        arrived_ns = self._samples.at_ns
        for index, fresh in enumerate(self._samples.fresh.tolist()):
            if self.reads.away[index]:
                continue
            if not fresh:
                if not self.reads.asks(index):
                    continue
                self._missed[index] += 1
                self.torqued[index] = False
                if self._missed[index] == 1:
                    how = "sent a garbled reply" if self.reads.garbled[index] else "did not answer"
                    self._say(EventCode.READ_LOST, Severity.WARNING, index, how)
                elif self._missed[index] >= LOST_CYCLES and now_ns - arrived_ns[index] >= LOST_AGE_NS:
                    text = f"missed {self._missed[index]} replies in a row; it is asked once a second until"
                    self._say(EventCode.SERVO_LOST, Severity.ERROR, index, f"{text} it is in order")
                    self._leave(index, FIRST_PROBE_NS)
            elif self._missed[index]:
                missed = self._missed[index]
                lost = "1 reply was" if missed == 1 else f"{missed} replies in a row were"
                text = f"answers again; {lost} lost"
                self._missed[index] = 0
                self._say(EventCode.READ_BACK, Severity.INFO, index, text)

    def _leave(self, index: int, probe_after_ns: int) -> None:
        """Take a servo out of the exchange until it was found in order."""
        self.reads.leave(index)
        self.torqued[index] = False
        self._returning.slow_down(index)
        self._absent.lose(index, not self._limp[index], probe_after_ns)

    def _back(self, index: int, rejoined: Rejoined) -> None:
        """Let a servo take part again that was looked at as at the start."""
        self.reads.join(index)
        self._modes.returned(index, rejoined.mode)
        for joint, text in rejoined.written:
            self._emit(EventCode.REGISTER_WRITTEN, Severity.INFO, joint, text)
        # the next states of a split bus were asked for without it: its torque is read again behind its state
        self.torqued[index] = rejoined.torqued and not self._plan.split
        holds = rejoined.torqued and index not in self._gone
        how = "holding where it stands" if holds else "limp: it gets no goals"
        self._say(EventCode.SERVO_BACK, Severity.INFO, index, f"is in order and takes part again, {how}")
        if rejoined.torqued:
            self._limp[index] = False
            if index in self._gone:
                self._switch_off(index)
        elif not self._limp[index]:
            self._tell_limp(index, 0)

    def let_go(self, rows: Collection[int]) -> None:
        """Switch the torque of joints off for the rest of the run, of who is lost as soon as it is back."""
        for index, row in enumerate(self._rows):
            if row in rows:
                self._gone.add(index)
                self._absent.latch(index)
                if not self.reads.away[index]:
                    self._switch_off(index)

    def _switch_off(self, index: int) -> None:
        self.torqued[index], self._limp[index] = False, True
        # who kept it is switched off again as soon as it is in order
        self._absent.switch_off(index, lambda: self._leave(index, 0))

    def _tell_limp(self, index: int, enabled: int) -> None:
        self._limp[index] = True
        item = f"Torque Enable ({self._plan.servos[index].torque_address})"
        text = f"has {item} = {enabled}: it was reset or its torque was cut; it gets no goals"
        self._say(EventCode.SERVO_LIMP, Severity.ERROR, index, text)

    def _say_errors(self) -> None:
        for index, error in enumerate(self.reads.errors):
            if error != self._said_errors[index]:
                if error & ~self._said_errors[index] & self._dialect.ALERT and index not in self._alerts:
                    self._alerts.append(index)
                if not self._dialect.ALERT:
                    self._shown[self._rows[index]] = error & FORBIDDEN
                    if error & ~self._said_errors[index] & _SHUTS_DOWN and index not in self._strained:
                        self._strained.append(index)
                elif not error & self._dialect.ALERT:
                    self._hardware_errors[index] = self._shown[self._rows[index]] = 0
                self._said_errors[index] = error
                self._alerting = any(said & self._dialect.ALERT for said in self._said_errors)
                severity = Severity.ERROR if error else Severity.INFO
                self._say(
                    EventCode.SERVO_ERROR, severity, index, f"reports {self._dialect.describe_error(error)}"
                )

    def _say(self, code: EventCode, severity: Severity, index: int, text: str) -> None:
        self._emit(code, severity, self._plan.servos[index].joint, f"{self._who(index)} {text}")

    def _who(self, index: int) -> str:
        servo = self._plan.servos[index]
        return f"{servo.joint} (ID {servo.servo_id} on bus {self._plan.name})"
