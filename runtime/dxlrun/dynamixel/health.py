"""Health: what is known of each servo of one bus from cycle to cycle, and what of it is worth an event."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dxlrun.dynamixel.arrays import GoalArrays, StateArrays
from dxlrun.dynamixel.bus import Bus
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.exchange import CyclicReads
from dxlrun.dynamixel.line import SHORT_PATIENCE_NS
from dxlrun.dynamixel.protocol1 import describe_error
from dxlrun.dynamixel.transaction import Program, ProgramJob, Reply, Transaction
from dxlrun.events import EventCode, EventSink, Severity
from dxlrun.interfaces import States

NOISE_EVENT_NS = 1_000_000_000
"""A noisy line has at most one event in this time."""


class Servos:
    """The servos of one bus: their cyclic reads, their goals, and who may get a goal."""

    __slots__ = (
        "_bus",
        "_events",
        "_limp",
        "_lost",
        "_missed",
        "_noise_at_ns",
        "_noise_seen",
        "_plan",
        "_probe",
        "_probed",
        "_said_errors",
        "_states",
        "goals",
        "reads",
        "torqued",
    )

    def __init__(self, plan: BusPlan, bus: Bus, events: EventSink) -> None:
        count = len(plan.servos)
        self._plan = plan
        self._bus = bus
        self._events = events
        self._states = StateArrays(plan)
        self.goals = GoalArrays(plan)
        """Builds the sync write."""
        self.reads = CyclicReads(plan, self._states.replies)
        """The job that reads every servo once."""
        self.torqued = np.zeros(count, dtype=np.bool_)
        """Shape (servos,): who has torque for certain and missed no reply since; they get goals."""
        self._limp = [False] * count
        self._missed = self.reads.missed
        self._said_errors = [0] * count
        self._probe: ProgramJob[Reply] | None = None
        self._probed = 0
        self._noise_seen = 0
        self._noise_at_ns = -NOISE_EVENT_NS
        self._lost = False

    @property
    def all_fresh(self) -> bool:
        """True when every reply of the newest cycle arrived."""
        return bool(self.reads.fresh.all())

    @property
    def silent(self) -> list[str]:
        """Names of the servos whose newest reply did not arrive."""
        return [self._who(index) for index, missed in enumerate(self._missed) if missed]

    def settle(self, states: States, now_ns: int) -> None:
        """Fill the states from the replies of this cycle, and tell what changed."""
        reads = self.reads
        self._states.decode(states, reads.fresh, reads.arrived_ns, now_ns)
        if not reads.fresh.all() or any(self._missed):
            self._count_losses()
        if reads.errors != self._said_errors:
            self._say_errors()
        if self._bus.noise_bytes != self._noise_seen and now_ns - self._noise_at_ns >= NOISE_EVENT_NS:
            count = self._bus.noise_bytes - self._noise_seen
            self._noise_seen, self._noise_at_ns = self._bus.noise_bytes, now_ns
            self._emit(
                EventCode.BUS_NOISE, Severity.WARNING, self._plan.name, f"{count} bytes belonged to no packet"
            )

    def probe(self, bus: Bus, left_ns: int) -> bool:
        """Load the read of torque enable of one servo that waits for its goals; False when there is none.

        `left_ns`: how long the probe may take. Only a servo that answers is asked; a limp one is not.
        """
        if self.torqued.all():
            return False
        count = len(self._plan.servos)
        for offset in range(1, count + 1):
            index = (self._probed + offset) % count
            if self.torqued[index] or self._limp[index] or not self.reads.fresh[index]:
                continue
            read = self._plan.torque_reads[index]
            timeout = read.due_ns + self._plan.latency_ns + SHORT_PATIENCE_NS
            if timeout > left_ns:
                return False
            self._probe, self._probed = ProgramJob(_once(replace(read, timeout_ns=timeout))), index
            bus.load(self._probe)
            return True
        return False

    def probed(self) -> None:
        """Take what came of the probe: a servo with torque gets goals again, one without stays out."""
        reply = None if self._probe is None else self._probe.result
        self._probe = None
        if reply is None or not reply.answered:
            return
        index = self._probed
        if reply.parameters[0] == 1:
            self.torqued[index] = True
            return
        self._limp[index] = True
        self._emit(
            EventCode.SERVO_LIMP,
            Severity.ERROR,
            self._plan.servos[index].joint,
            f"{self._who(index)} has Torque Enable (24) = {reply.parameters[0]}: it was reset or its "
            "torque was cut; it gets no more goals in this run",
        )

    def lost(self, text: str) -> None:
        """Tell once that the line is gone."""
        if not self._lost:
            self._lost = True
            self._emit(EventCode.PORT_LOST, Severity.ERROR, self._plan.name, text)

    def _count_losses(self) -> None:
        for index, fresh in enumerate(self.reads.fresh.tolist()):
            if not fresh:
                self._missed[index] += 1
                self.torqued[index] = False
                if self._missed[index] == 1:
                    how = "sent a garbled reply" if self.reads.garbled[index] else "did not answer"
                    self._say(EventCode.READ_LOST, Severity.WARNING, index, how)
            elif self._missed[index]:
                text = f"answers again; {self._missed[index]} replies in a row were lost"
                self._missed[index] = 0
                self._say(EventCode.READ_BACK, Severity.INFO, index, text)

    def _say_errors(self) -> None:
        for index, error in enumerate(self.reads.errors):
            if error != self._said_errors[index]:
                self._said_errors[index] = error
                severity = Severity.ERROR if error else Severity.INFO
                self._say(EventCode.SERVO_ERROR, severity, index, f"reports {describe_error(error)}")

    def _say(self, code: EventCode, severity: Severity, index: int, text: str) -> None:
        self._emit(code, severity, self._plan.servos[index].joint, f"{self._who(index)} {text}")

    def _emit(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        self._events.emit(code, severity, source, text)

    def _who(self, index: int) -> str:
        servo = self._plan.servos[index]
        return f"{servo.joint} (ID {servo.servo_id} on bus {self._plan.name})"


def _once(transaction: Transaction) -> Program[Reply]:
    reply = yield transaction
    return reply
