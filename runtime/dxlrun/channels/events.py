"""Events: what happened beside the regular cycle, for the log and for clients."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from enum import IntEnum, unique
from typing import Protocol

import msgspec
from msgspec import structs

from dxlrun.channels.ring import RING_SECONDS, Appender, RecordKind, record_size
from dxlwire.clock import Clock


@unique
class Severity(IntEnum):
    """Levels of rcl_interfaces/msg/Log, so that /rosout needs no translation."""

    INFO = 20
    WARNING = 30
    ERROR = 40
    FATAL = 50


@unique
class EventCode(IntEnum):
    """What kind of thing happened; the number is in the log and is never used for something else."""

    LOOP_STARTED = 1
    LOOP_STOPPED = 2
    OVERRUN = 3
    SCHEDULER = 4
    """A request about scheduler, memory or collector, and whether it was granted."""
    SIMULATION_STALLED = 5
    """The process of simulated servos did not run, and the loop waited for it; the data are Waited."""
    SETUP = 10
    TORQUE_ON = 11
    TORQUE_OFF = 12
    SHUTDOWN_FAILED = 13
    REGISTER_DIFFERS = 14
    REGISTER_WRITTEN = 15
    """A register was written because the robot file declares it or a client wants it; read back, too."""
    SERVO_LIMITS = 16
    """Registers of a joint's servo limit its goals further than the manual; the data are ServoLimit."""
    READ_LOST = 20
    """The first of a row of missed replies of one servo."""
    READ_BACK = 21
    """The servo answers again; the text counts what was missed."""
    SERVO_ERROR = 22
    """The error byte of a status packet changed."""
    SERVO_LIMP = 23
    """Torque enable reads 0 where 1 was expected: the servo was reset or its torque was cut."""
    BUS_NOISE = 24
    PORT_LOST = 25
    PORT_BACK = 26
    SERVO_LOST = 27
    """A servo missed several replies in a row: it leaves the exchange and is asked once a second."""
    SERVO_BACK = 28
    """A servo that was lost was looked at as at the start, and takes part again."""
    DEVICE_LOST = 18
    """A device on a bus missed several replies in a row; it is asked once a second until it is back."""
    DEVICE_BACK = 19
    """A device that was lost is read again."""
    SERVO_REBOOTED = 29
    COMMAND = 30
    """A command was handed to a controller."""
    COMMAND_REFUSED = 31
    CONTROLLER_ACTIVATED = 32
    CONTROLLER_DEACTIVATED = 33
    CONTROLLER_FAULT = 34
    CONTROLLER_SAYS = 35
    """Free text of a controller: goal reached, goal preempted, tolerance violated."""
    STEERED = 36
    """The loop did what a client asked of it: switch, rate, pause, resume, load, unload, stop."""
    STALE_COMMAND = 37
    """A stream of commands ended without a word; the policy for it begins."""
    CONTROLLER_LOADED = 38
    """A controller came or went while the loop was paused; the text has the time that it took."""
    POLICY = 39
    """A policy of the robot file begins or ends: what for, and what it does."""
    GATE = 40
    """A command was clamped at the last gate; the text names joint, controller and limit."""
    MODE = 45
    """A joint goes into another mode, or controllers wait until theirs have."""
    IMPLAUSIBLE = 41
    """A servo's position jumped further than it can turn: the sample is not valid."""
    SERVO_HOT = 42
    """A servo is near its Temperature Limit, or has cooled down again."""
    WATCHDOG = 43
    """The Bus Watchdog of servos was armed, disarmed, or has stopped them."""
    UNREQUESTED = 46
    """Packets came that answer no request of this run: another host writes on the line."""
    GOAL_ACCEPTED = 47
    """A controller has a new goal; the data are a GoalReport."""
    GOAL_ENDED = 48
    """A goal was reached, missed, aborted, cancelled or preempted; the data are a GoalReport."""
    PARAMETERS = 49
    """Live parameters of a controller were changed, all of one request in one cycle."""
    SERVOS_DISAGREE = 59
    """Servos that move one joint stand further apart than its tolerance, or agree again."""
    GUARDIAN = 50
    KEPT = 51
    """A controller begins with the state that it kept in an earlier run, or anew, and why."""
    SENSOR = 52
    """A sensor, or its process, reports: it cannot be opened, ended, was opened again, or has a sentence."""
    SENSOR_LOST = 53
    """A sensor brought nothing new for its timeout, or values that are not finite: its row is not valid."""
    SENSOR_BACK = 54
    """A sensor that was lost brings samples again."""
    TAKEOVER = 58
    """A controller requested that others take over; the text has why."""
    RECORDER_GAP = 61


class LostRecords(msgspec.Struct, frozen=True):
    """Data of RECORDER_GAP."""

    ring: str
    lost: int
    """Records."""


class Waited(msgspec.Struct, frozen=True):
    """Data of SIMULATION_STALLED, since the event of this kind before."""

    waited_ns: int
    times: int


class Granted(msgspec.Struct, frozen=True):
    """Data of SCHEDULER: whether the operating system granted a request of a process."""

    request: str
    granted: bool


RUN_ENDED = "the run ended"
"""Text of a goal that was running when its run ended."""


class GoalReport(msgspec.Struct, frozen=True):
    """Data of GOAL_ACCEPTED and GOAL_ENDED."""

    goal: int
    """Its number in the run, from 1."""
    controller: str
    kind: str
    """The command that it came with."""
    origin: str
    """The client, or the place in a motion file."""
    status: str
    """`accepted`, or how it ended: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    text: str = ""
    """What its controller reported at the end, for people."""
    joint: str = ""
    """The worst one at the end; empty: none was named."""
    error: float | None = None
    """How far that joint was from the goal, SI units; None: not known."""

    @property
    def cut(self) -> bool:
        """True for a goal that was aborted because the run ended."""
        return self.status == "aborted" and self.text == RUN_ENDED

    @property
    def failed(self) -> bool:
        """True for a goal that was missed or aborted, but not because the run ended."""
        return self.status in ("missed", "aborted") and not self.cut

    @property
    def sentence(self) -> str:
        """How a failed goal ended: `arm missed the goal of its trajectory: after 2 s, joint elbow is ...`."""
        verb = "missed" if self.status == "missed" else "aborted"
        return f"{self.controller} {verb} the goal of its {self.kind}: {self.text}"


MOST_FAILED = 100
"""Failed goals that are kept of motion files, and of clients."""


class GoalTotals(msgspec.Struct, frozen=True):
    """The goals of a run."""

    counts: dict[str, int] = {}
    """Number of goals that were accepted, and that ended in each way."""
    begun: dict[str, int] = {}
    """Number of goals of motion files that were accepted, by their origins."""
    failed: tuple[GoalReport, ...] = ()
    """Goals that were missed or aborted: the first hundred of motion files, the first hundred of clients."""
    allowed: dict[str, float] = {}
    """Largest distance at which a goal was reached, by the joint that was farthest off, rad or m."""

    @property
    def asked(self) -> int:
        """Number of goals that were accepted and neither cancelled nor replaced by another goal."""
        counts = self.counts
        withdrawn = counts.get("preempted", 0) + counts.get("cancelled", 0)
        return counts.get("accepted", 0) - withdrawn

    @property
    def reached(self) -> int:
        """Number of goals that were reached."""
        return self.counts.get("reached", 0)


class GoalHistory:
    """Counts goals by their events; goals of clients never take the places of those of motion files."""

    def __init__(self) -> None:
        self.planned: Container[str] = ()
        """Origins of the goals of motion files."""
        self._counts: Counter[str] = Counter()
        self._begun: Counter[str] = Counter()
        self._failed: list[GoalReport] = []
        self._kept: Counter[bool] = Counter()
        self._allowed: dict[str, float] = {}

    def add(self, report: GoalReport) -> None:
        """Count a report, and keep it if the goal failed and few of its kind did before."""
        planned = report.origin in self.planned
        self._counts[report.status] += 1
        if report.status == "accepted" and planned:
            self._begun[report.origin] += 1
        if report.status == "reached" and report.joint and report.error is not None:
            before = self._allowed.get(report.joint, 0.0)
            self._allowed[report.joint] = max(before, report.error)
        if report.status in ("missed", "aborted") and self._kept[planned] < MOST_FAILED:
            self._kept[planned] += 1
            self._failed.append(report)

    @property
    def totals(self) -> GoalTotals:
        """The goals that were added until now."""
        return GoalTotals(dict(self._counts), dict(self._begun), tuple(self._failed), self._allowed.copy())


class EventSink(Protocol):
    """Takes events; never blocks, never raises."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        """Record an event of `source` (a joint, a controller, a process); `data`: JSON for programs."""
        ...


LONGEST_SOURCE = 64
LONGEST_TEXT = 8192
"""Characters; a longer text, such as a plug-in's traceback, is cut."""
LONGEST_DATA = 4096
"""Bytes; longer data are left out."""
LONGEST_EVENT = 4 * LONGEST_TEXT + 4 * LONGEST_SOURCE + LONGEST_DATA + 64
"""Bytes of an event's record."""
_GOALS = (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED)
_USUAL_EVENT = 192


class Event(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=0):
    """One thing that happened."""

    t_ns: int
    """ns of the run's clock"""
    code: int
    """An EventCode; a plain number where a log was written by a newer version."""
    severity: int
    source: str
    """A joint, a controller, a process."""
    text: str
    data: bytes = b""
    """JSON for programs, where they need to know more than code and source; the text is for people."""

    @property
    def name(self) -> str:
        """The name of the code, in lower case."""
        try:
            return EventCode(self.code).name.lower()
        except ValueError:
            return f"code_{self.code}"


class EventGroup(msgspec.Struct, frozen=True):
    """Events of one kind and one source."""

    code: int
    severity: int
    source: str
    count: int
    t_ns: int
    """Of the first one; ns of the run's clock."""
    text: str
    """Of the first one."""

    @property
    def name(self) -> str:
        """The name of the code, in lower case."""
        return Event(self.t_ns, self.code, self.severity, self.source, self.text).name


class EventCounts:
    """Counts events by kind and source: no more is kept than there are joints, controllers and processes."""

    __slots__ = ("_groups",)

    def __init__(self) -> None:
        self._groups: dict[tuple[int, int, str], EventGroup] = {}

    def add(self, event: Event) -> None:
        """Count an event."""
        key = (event.code, event.severity, event.source)
        group = self._groups.get(key)
        if group is None:
            self._groups[key] = EventGroup(*key, 1, event.t_ns, event.text)
        else:
            self._groups[key] = structs.replace(group, count=group.count + 1)

    @property
    def groups(self) -> tuple[EventGroup, ...]:
        """All of them, in the order of the first of each."""
        return tuple(self._groups.values())


class EventTotals(msgspec.Struct, frozen=True):
    """What a run's events come to, for the summary at its end."""

    errors: tuple[EventGroup, ...] = ()
    """And takeovers that controllers requested."""
    goals: GoalTotals = GoalTotals()
    started_ns: int = 0
    """When the loop started; ns of the run's clock."""


class EventRing:
    """Takes events of one process and appends them to its ring; never blocks, never raises."""

    __slots__ = ("_clock", "_errors", "_started_ns", "_writer", "goals")

    def __init__(self, writer: Appender, clock: Clock) -> None:
        self._writer = writer
        self._clock = clock
        self._errors = EventCounts()
        self.goals = GoalHistory()
        self._started_ns = 0

    @property
    def totals(self) -> EventTotals:
        """What was emitted until now."""
        return EventTotals(self._errors.groups, self.goals.totals, self._started_ns)

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        """Record an event of `source` (a joint, a controller, a process), now."""
        t_ns = self._clock.now_ns()
        if severity >= Severity.ERROR or code == EventCode.TAKEOVER:
            self._errors.add(Event(t_ns, code, severity, source, _writable(text)))
        if code in _GOALS and data:
            self.goals.add(msgspec.json.decode(data, type=GoalReport))
        elif code == EventCode.LOOP_STARTED:
            self._started_ns = t_ns
        event = Event(
            t_ns,
            code,
            severity,
            _writable(source[:LONGEST_SOURCE]),
            _writable(text[:LONGEST_TEXT]),
            data if len(data) <= LONGEST_DATA else b"",
        )
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(event))


def _writable(text: str) -> str:
    """Replace what no UTF-8 has: a traceback may name a file with such a name."""
    return text.encode(errors="replace").decode()


def event_capacity(period_ns: int, servos: int) -> int:
    """Return how many bytes of a ring hold 10 s of the worst storm: one event a servo and four more a cycle.

    That is what a robot reports whose servos all fail and recover in turn; a row of misses is one event.
    """
    events = max(1024, RING_SECONDS * 1_000_000_000 // period_ns * (servos + 4))
    return LONGEST_EVENT + events * record_size(_USUAL_EVENT)
