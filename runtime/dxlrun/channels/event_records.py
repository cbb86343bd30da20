"""Events: reports of processes, joints and controllers, for the log and for clients."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping
from enum import IntEnum, unique
from functools import cache
from typing import ClassVar, Generic, NamedTuple, ParamSpec, Protocol

import msgspec
from msgspec import structs

from dxlrun.channels.ring import RING_SECONDS, Appender, RecordKind, record_size
from dxlrun.features import FEATURES, stages
from dxlwire.clock import Clock


@unique
class Severity(IntEnum):
    """Severity of an event; the numbers of rcl_interfaces/msg/Log, so that /rosout needs no translation."""

    INFO = 20
    WARNING = 30
    ERROR = 40
    FATAL = 50


@unique
class EventCode(IntEnum):
    """Kind of an event. The log has the number, which is never used again for another kind.

    A feature can have its own kinds in `events.py`.
    """

    LOOP_STARTED = 1
    LOOP_STOPPED = 2
    OVERRUN = 3
    SCHEDULER = 4
    """Result of a real-time setting requested from the operating system; the data are Granted."""
    SIMULATION_STALLED = 5
    """The process of simulated servos did not run, and the loop waited for it; the data are Waited."""
    SETUP = 10
    TORQUE_ON = 11
    TORQUE_OFF = 12
    SHUTDOWN_FAILED = 13
    REGISTER_DIFFERS = 14
    REGISTER_WRITTEN = 15
    """A register that the robot file declares or a client requested was written and read back."""
    SERVO_LIMITS = 16
    """Registers of a joint's servo limit its goals further than the manual; the data are ServoLimit."""
    READ_LOST = 20
    """First of several consecutive missing replies of one servo."""
    READ_BACK = 21
    """The servo replies again; the text has the number of missing replies."""
    SERVO_ERROR = 22
    """The error byte of a status packet changed."""
    SERVO_LIMP = 23
    """Torque enable reads 0 where 1 was expected: the servo was reset or its torque was cut."""
    BUS_NOISE = 24
    PORT_LOST = 25
    PORT_BACK = 26
    SERVO_LOST = 27
    """Several consecutive replies of a servo were missing. It is only probed once a second."""
    SERVO_BACK = 28
    """A lost servo replied, was checked as at the start, and is read again."""
    DEVICE_LOST = 18
    """Several consecutive replies of a device on a bus were missing. It is probed once a second."""
    DEVICE_BACK = 19
    """A lost device is read again."""
    SERVO_REBOOTED = 29
    COMMAND = 30
    """A command was passed to a controller."""
    COMMAND_REFUSED = 31
    CONTROLLER_ACTIVATED = 32
    CONTROLLER_DEACTIVATED = 33
    CONTROLLER_FAULT = 34
    CONTROLLER_SAYS = 35
    """Free text of a controller: goal reached, goal preempted, tolerance violated."""
    STEERED = 36
    """The loop executed a client's request: switch, rate, pause, resume, load, unload, stop."""
    STALE_COMMAND = 37
    """The lease of a command stream or pause expired, and the policy `on_stale_command` begins; the data of a
    stream are a StreamEnd."""
    CONTROLLER_LOADED = 38
    """A controller was loaded or unloaded while the loop was paused; the text has the duration."""
    POLICY = 39
    """A policy of the robot file begins or ends; the text has its reason and its actions."""
    GATE = 40
    """The gate clamped a command; the text names joint, controller and limit."""
    MODE = 45
    """A joint changes its mode, or controllers wait for the modes of their joints."""
    IMPLAUSIBLE = 41
    """A servo's position jumped further than it can turn: the sample is not valid."""
    SERVO_HOT = 42
    """A servo is near its Temperature Limit, or has cooled down again."""
    WATCHDOG = 43
    """The Bus Watchdog of servos was armed, disarmed, or has stopped them."""
    UNREQUESTED = 46
    """Packets arrived that do not answer a request of this run: another host writes to the line."""
    GOAL_ACCEPTED = 47
    """A controller has a new goal; the data are a GoalReport."""
    GOAL_ENDED = 48
    """A goal was reached, missed, aborted, cancelled or preempted; the data are a GoalReport."""
    PARAMETERS = 49
    """Live parameters of a controller were changed in one cycle."""
    SERVOS_DISAGREE = 59
    """The positions of servos that move one joint differ by more than its tolerance, or agree again."""
    GUARDIAN = 50
    KEPT = 51
    """A controller starts with its state from an earlier run, or without it for the reason in the text."""
    TAKEOVER = 58
    """A controller requested a takeover; the text has the reason."""
    RECORDER_GAP = 61


class EventStage(msgspec.Struct, frozen=True):
    """Kinds of events of a feature: the object `STAGE` of its `events.py`.

    No other kind has their numbers.
    """

    FILE: ClassVar[str] = "events"

    codes: type[IntEnum]


@cache
def event_names() -> Mapping[int, str]:
    """Return the names of all kinds of events by number, in lower case."""
    kinds: tuple[type[IntEnum], ...] = (
        EventCode,
        *(stage.codes for _, stage in stages(EventStage, FEATURES)),
    )
    return {code.value: code.name.lower() for kind in kinds for code in kind}


class LostRecords(msgspec.Struct, frozen=True):
    """Data of RECORDER_GAP: records of a ring that were overwritten before the recorder read them."""

    ring: str
    lost: int
    """Number of lost records in this ring."""


class SimulationStall(msgspec.Struct, frozen=True):
    """Data of SIMULATION_STALLED: duration and number of waits since the last event of this kind."""

    waited_ns: int
    times: int


class SchedulerGrant(msgspec.Struct, frozen=True):
    """Data of SCHEDULER: name of a real-time setting, and whether the operating system granted it."""

    request: str
    granted: bool


class StreamEnd(msgspec.Struct, frozen=True):
    """Data of STALE_COMMAND of a controller: True if it holds its joints, False if a policy acts."""

    held: bool


RUN_ENDED = "the run ended"
"""Text of a goal that was aborted by the end of the run."""


class GoalReport(msgspec.Struct, frozen=True):
    """Data of GOAL_ACCEPTED and GOAL_ENDED: a goal of a controller and its status."""

    goal: int
    """Number of the goal in the run, from 1."""
    controller: str
    kind: str
    """Kind of the command that started the goal, such as `trajectory`."""
    origin: str
    """Client that sent the goal, or its position in a motion file."""
    status: str
    """`accepted`, or the outcome: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    text: str = ""
    """Reason of the outcome, for people; empty for an accepted goal."""
    joint: str = ""
    """Joint with the largest error at the end; empty: none."""
    error: float | None = None
    """Distance of that joint from its target, rad or m; None: not known."""
    refused: bool = False
    """True if the controller aborted the goal before it began, so that its client got a refusal."""

    @property
    def cut(self) -> bool:
        """True if the goal was aborted because the run ended."""
        return self.status == "aborted" and self.text == RUN_ENDED

    @property
    def failed(self) -> bool:
        """True if the goal was missed, or was aborted for another reason than the end of the run."""
        return self.status in ("missed", "aborted") and not self.cut

    @property
    def sentence(self) -> str:
        """Text about a failed goal: `arm missed the goal of its trajectory: after 2 s, joint ...`."""
        verb = "missed" if self.status == "missed" else "aborted"
        return f"{self.controller} {verb} the goal of its {self.kind}: {self.text}"


MOST_FAILED = 100
"""Most failed goals that are stored for the summary, of motion files and of clients each."""


class GoalTotals(msgspec.Struct, frozen=True):
    """Counts and failures of all goals of a run, for the summary."""

    counts: dict[str, int] = {}
    """Number of goals by status, such as `accepted`, `reached` or `missed`."""
    begun: dict[str, int] = {}
    """Number of accepted goals of motion files, by their position in the file."""
    failed: tuple[GoalReport, ...] = ()
    """Missed and aborted goals, without those refused to a client: the first hundred of motion files, and the
    first hundred of clients.
    """
    allowed: dict[str, float] = {}
    """Largest distance from the target at the end of a reached goal, by joint, rad or m."""

    @property
    def asked(self) -> int:
        """Number of accepted goals that were not cancelled, replaced by another, or refused to a client."""
        counts = self.counts
        withdrawn = (counts.get(each, 0) for each in ("preempted", "cancelled", "refused"))
        return counts.get("accepted", 0) - sum(withdrawn)

    @property
    def reached(self) -> int:
        """Number of goals that ended as reached."""
        return self.counts.get("reached", 0)


class GoalHistory:
    """Counts a run's goals from their events.

    Failed goals of clients and of motion files have separate limits.
    """

    def __init__(self) -> None:
        self.planned: Container[str] = ()
        """Origins (positions in motion files) that identify goals of the plan."""
        self._counts: Counter[str] = Counter()
        self._begun: Counter[str] = Counter()
        self._failed: list[GoalReport] = []
        self._kept: Counter[bool] = Counter()
        self._allowed: dict[str, float] = {}

    def count_report(self, report: GoalReport) -> None:
        """Count a goal's event by its status, and store a failed goal, up to MOST_FAILED."""
        planned = report.origin in self.planned
        refused = report.refused and not planned
        self._counts[report.status] += 1
        self._counts["refused"] += refused
        if report.status == "accepted" and planned:
            self._begun[report.origin] += 1
        if report.status == "reached" and report.joint and report.error is not None:
            before = self._allowed.get(report.joint, 0.0)
            self._allowed[report.joint] = max(before, report.error)
        if report.status in ("missed", "aborted") and not refused and self._kept[planned] < MOST_FAILED:
            self._kept[planned] += 1
            self._failed.append(report)

    @property
    def totals(self) -> GoalTotals:
        """Counts and failures of the goals so far."""
        return GoalTotals(dict(self._counts), dict(self._begun), tuple(self._failed), self._allowed.copy())


Fields = ParamSpec("Fields")


class EventBody(NamedTuple):
    """Code, severity and text of an event, without source and time; made by calling an `EventText`."""

    code: IntEnum
    """Kind of the event: an EventCode, or a kind that a feature defines."""
    severity: Severity
    text: str


class EventText(Generic[Fields]):
    """Template of an event: code, severity, and the function that writes the text from its arguments.

    A room has its rows in its `texts.py`, so that all its texts can be read at once. A call writes the text.
    """

    __slots__ = ("code", "severity", "write")

    def __init__(self, code: IntEnum, severity: Severity, write: Callable[Fields, str]) -> None:
        self.code = code
        self.severity = severity
        self.write = write

    def __call__(self, *args: Fields.args, **kwargs: Fields.kwargs) -> EventBody:
        """Return the event with these fields in its text."""
        return EventBody(self.code, self.severity, self.write(*args, **kwargs))


def event_text(code: IntEnum, severity: Severity) -> Callable[[Callable[Fields, str]], EventText[Fields]]:
    """Make a row of a table of texts from a function that writes the text.

    @event_text(EventCode.LOOP_STARTED, Severity.INFO)
    def loop_started(rate: float) -> str:
        return f"the loop has started at {rate:g} Hz"

    events.emit_event("loop", loop_started(100.0))
    """

    def decorate(write: Callable[Fields, str]) -> EventText[Fields]:
        return EventText(code, severity, write)

    return decorate


class EventSink(Protocol):
    """Destination of a process' events, such as the log. Never blocks and never raises."""

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        """Record an event with the current time.

        Args:
            source: Name of a joint, a controller or a process.
            event: Code, severity and text, from a row of a table of texts.
            data: JSON for programs.
        """
        ...


LONGEST_SOURCE = 64  # characters; longer names are cut
LONGEST_TEXT = 8192
"""Longest text of an event, characters; a longer one, such as a plug-in's traceback, is cut."""
LONGEST_DATA = 4096
"""Longest data of an event, bytes; longer data are omitted, as a part would not be valid JSON."""
LONGEST_EVENT = 4 * LONGEST_TEXT + 4 * LONGEST_SOURCE + LONGEST_DATA + 64
"""Longest record of an event, bytes: UTF-8 has up to 4 bytes a character."""
_GOALS = (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED)
_USUAL_EVENT = 192


class Event(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=0):
    """Report of something that happened in a process, joint or controller, as a record for the log."""

    t_ns: int
    """Time of the event, ns of the run's clock."""
    code: int
    """Kind of the event; an unknown number in the log of a newer version."""
    severity: int
    source: str
    """Name of the joint, controller or process that the event is about."""
    text: str
    data: bytes = b""
    """JSON for programs; the text is for people."""

    @property
    def name(self) -> str:
        """Name of the event's kind in lower case, such as `servo_lost`; `code_N` for an unknown one."""
        return event_names().get(self.code, f"code_{self.code}")


class EventGroup(msgspec.Struct, frozen=True):
    """Events of the same kind, severity and source, counted; text and time are those of the first."""

    code: int
    severity: int
    source: str
    count: int
    t_ns: int
    """Time of the first event, ns of the run's clock."""
    text: str
    """Text of the first event."""

    @property
    def name(self) -> str:
        """Name of the events' kind in lower case, such as `servo_lost`."""
        return Event(self.t_ns, self.code, self.severity, self.source, self.text).name


class CommandOutside(msgspec.Struct, frozen=True):
    """Position commands of one joint outside of its limits, which the gate clamped."""

    row: int
    """Row of the joint in the plan."""
    farthest: float
    """The one farthest outside, rad or m."""
    cycles: int


class EventCounts:
    """Counts events by kind, severity and source, so that memory stays bounded."""

    __slots__ = ("_groups",)

    def __init__(self) -> None:
        self._groups: dict[tuple[int, int, str], EventGroup] = {}

    def count_event(self, event: Event) -> None:
        """Count an event in its group; the first one sets the group's text and time."""
        key = (event.code, event.severity, event.source)
        group = self._groups.get(key)
        if group is None:
            self._groups[key] = EventGroup(*key, 1, event.t_ns, event.text)
        else:
            self._groups[key] = structs.replace(group, count=group.count + 1)

    @property
    def groups(self) -> tuple[EventGroup, ...]:
        """All groups, in the order of their first events."""
        return tuple(self._groups.values())


class EventTotals(msgspec.Struct, frozen=True):
    """Events and goals of a run that its summary names."""

    named: tuple[EventGroup, ...] = ()
    """Errors, and two kinds of warnings: takeovers that controllers requested, and pauses that expired."""
    goals: GoalTotals | None = None
    """None: unknown, because the loop was killed before it could report them."""
    started_ns: int = 0
    """Time at which the loop started, ns of the run's clock; 0: it did not."""


class EventRing:
    """Event sink that appends the events of a process to its ring. Never blocks and never raises."""

    __slots__ = ("_clock", "_named", "_started_ns", "_writer", "goals")

    def __init__(self, writer: Appender, clock: Clock) -> None:
        self._writer = writer
        self._clock = clock
        self._named = EventCounts()
        self.goals = GoalHistory()
        self._started_ns = 0

    @property
    def totals(self) -> EventTotals:
        """Events and goals so far that the summary names."""
        return EventTotals(self._named.groups, self.goals.totals, self._started_ns)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        """Record an event with the current time; see `EventSink.emit_event`."""
        t_ns = self._clock.now_ns()
        code, severity, text = event
        expired_pause = code == EventCode.STALE_COMMAND and source == "loop"
        if severity >= Severity.ERROR or code == EventCode.TAKEOVER or expired_pause:
            self._named.count_event(Event(t_ns, code, severity, source, _writable(text)))
        if code in _GOALS and data:
            self.goals.count_report(msgspec.json.decode(data, type=GoalReport))
        elif code == EventCode.LOOP_STARTED:
            self._started_ns = t_ns
        record = Event(
            t_ns,
            code,
            severity,
            _writable(source[:LONGEST_SOURCE]),
            _writable(text[:LONGEST_TEXT]),
            data if len(data) <= LONGEST_DATA else b"",
        )
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(record))


def _writable(text: str) -> str:
    """Replace lone surrogates, which file names in tracebacks may contain."""
    return text.encode(errors="replace").decode()


def event_capacity(period_ns: int, servos: int) -> int:
    """Return the size of a ring for events, bytes: 10 s with an event per servo and four more a cycle.

    This is the worst case: all servos fail and recover in turn. Consecutive missing replies are one event.
    """
    events = max(1024, RING_SECONDS * 1_000_000_000 // period_ns * (servos + 4))
    return LONGEST_EVENT + events * record_size(_USUAL_EVENT)
