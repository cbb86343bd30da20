"""Running robot as the source of the page. It is polled at 25 Hz, and only while a page is open."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from dxlrun import DxlrunError, Refused, RemoteRobot, connect, running
from dxlrun.tooling.live import RobotStates
from dxlrun.tooling.records import Torque
from dxlrun.tooling.robots import read_motion
from dxlrun.tooling.topics import LogTopic
from dxlrun_view.curves import JOINT_COLUMNS, Curve, History, Moment, Values, columns_of, numbers_in
from dxlrun_view.shown import LiveEvent, SourceProperties, ViewedHandle, ViewedRobot
from dxlwire import Mode

PERIOD_S = 0.04
"""Period of polling the robot for its newest cycle, s. A faster rate would not be visible."""
SLOW_S = 0.5
"""Polling period of values that rarely change (controllers, rate, events), s"""
KEPT_S = 300.0
"""Time for which curves are kept, s"""
_KEPT = round(KEPT_S / PERIOD_S)
DRAWN_S = 3.0
"""A topic whose curves no page has requested for this time is no longer polled, s."""
GAP_S = 1.0
"""Time between two cycles above which a curve has a gap, s: no page was open, or the robot did not run"""
_MOST_EVENTS = 400
"""Number of events that are kept for pages"""
_TORQUE = {torque.word: torque for torque in reversed(Torque)}
"""Number of each torque state in the log, by the name in `RobotStates.torque`"""
NOT_DRAWN = (LogTopic.EVENT, LogTopic.JOINT_STATES, "/goals")
"""Topics that offer no curves: they have no numbers, or their numbers are columns of the cycles already."""


class LiveRobot:
    """Cached state of a running robot, which pages read.

    A page's request also polls the robot, unless another request does. After the run ends, the curves remain,
    and the next run of the robot continues.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._robot: RemoteRobot | None = None
        self._info = ViewedRobot(name)
        self._urdf, self._imu, self._imu_link = "", "", ""
        self._motions: tuple[str, ...] = ()
        self._handles: tuple[ViewedHandle, ...] = ()
        self._units: Mapping[str, str] = {}
        self._history = History((), 1)
        self._cycle = -1
        self._run = 0
        self._events: deque[LiveEvent] = deque(maxlen=_MOST_EVENTS)
        """Newest events of all runs since the start of the page, with consecutive numbers"""
        self._last_event, self._known_until_s = 0, -1.0
        """Number of the last event in the present run; time of the last event before the connection, s"""
        self._fields: dict[str, tuple[str, ...]] = {}
        self._drawn: dict[str, DrawnTopic] = {}
        self._problem = ""
        self._looked_s = self._looked_slowly_s = -SLOW_S
        self._asking, self._lock = threading.Lock(), threading.Lock()
        """Lock of the request that polls the robot, and lock of the curves"""
        self.moment_at(None)

    def close(self) -> None:
        """Close the connection to the robot."""
        with self._asking:
            self._gone("")

    # Requests of the page

    def describe_page(self) -> SourceProperties:
        """Return the cached properties of the robot that rarely change, without polling it."""
        return SourceProperties(
            info=self._info,
            live=True,
            columns=self._history.columns,
            span=self._history.span,
            run=self._run,
            problem=self._problem,
            units=self._units,
            fields=tuple(name for names in self._fields.values() for name in names),
            motions=self._motions,
            handles=self._handles,
            imu=self._imu,
            imu_link=self._imu_link,
        )

    def moment_at(self, time_s: float | None) -> Moment:
        """Return all columns at a time. Without a time, poll the robot and return the newest values."""
        if time_s is None and self._asking.acquire(blocking=False):
            try:
                self._poll_robot(time.monotonic())
            finally:
                self._asking.release()
        with self._lock:
            return self._history.at(time_s)

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a column, or a number of a topic such as `/arm/state:error[0]`, between two times (s).

        The first request for a number starts the polling of its topic. Raises KeyError for an unknown curve.
        """
        topic, of_topic, _ = name.partition(":")
        if of_topic and name not in self._fields.get(topic, ()):
            raise KeyError(name)
        with self._lock:
            if not of_topic:
                return self._history.curve(name, begin, end, points)
            drawn = self._drawn.setdefault(topic, DrawnTopic())
            drawn.asked_s = time.monotonic()
            return drawn.history.curve(name, begin, end, points)

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        """Return the events with a number greater than `after`."""
        return tuple(event for event in list(self._events) if event.number > after)

    def urdf(self) -> str:
        """Return the URDF of the newest run; empty if the robot has none."""
        return self._urdf

    @property
    def folder(self) -> Path | None:
        """Directory of the robot file, in which meshes are searched; None if unknown"""
        return Path(self._info.file).parent if self._info.file else None

    def asking(self) -> RemoteRobot:
        """Open a new connection to the robot. Raises DxlrunError if it does not run."""
        return connect(self._name, "dxlrun view")

    # Polling the robot

    def _poll_robot(self, now_s: float) -> None:
        """Poll the robot's newest cycle, and every SLOW_S the values that rarely change. Connects first if
        necessary, and disconnects with a reason for the page after an error."""
        slowly = now_s - self._looked_slowly_s > SLOW_S
        if now_s - self._looked_s < PERIOD_S / 2 or not (self._robot or slowly):
            return
        self._looked_s = now_s
        try:
            if self._robot is None:
                self._robot = self._begun()
            if slowly:
                self._looked_slowly_s = now_s
                self._look_slowly(self._robot)
            # Refused: the first cycle is still to come, or the controller of a topic was unloaded.
            with suppress(Refused):
                self._note_cycle(self._robot.states())
                self._note_topics(self._robot, now_s)
        except DxlrunError as error:
            self._looked_slowly_s = now_s
            waits = (
                f"{self._name} is not running; start it again with `dxlrun {self._info.file or 'ROBOT.yaml'}`"
            )
            self._gone(str(error) if self._name in running() else waits)

    def _begun(self) -> RemoteRobot:
        """Connect to the robot's run, and read its constants: URDF, IMU, motions. Raises DxlrunError."""
        robot = self.asking()
        self._info = info_of(robot)
        self._urdf = robot.urdf()
        tree = robot.frames() if self._urdf else None
        self._imu, self._imu_link = (tree.imu, tree.imu_link) if tree is not None else ("", "")
        self._motions = tuple(offered_motions(self._info))
        self._handles = tuple(_handles(robot)) if self._urdf else ()
        self._fields = {}
        self._last_event, self._known_until_s = 0, self._events[-1].time if self._events else -1.0
        self._cycle = -1
        return robot

    def _look_slowly(self, robot: RemoteRobot) -> None:
        self._info = info_of(robot)
        self._note_events(robot)
        self._note_fields(robot)
        self._problem = ""

    def _note_cycle(self, states: RobotStates) -> None:
        """Append a cycle's states to the curves, unless it is there. A new run can clear the curves."""
        if states.cycle == self._cycle:
            return
        columns = columns_of(states.joints, states.source_states, states.references)
        head = (states.cycle, states.late_ns * 1e-9)
        row = np.concatenate([head, *_of_joints(states), states.source_state, states.reference])
        time_s = states.time_ns * 1e-9
        with self._lock:
            newest_s = self._history.span[1]
            # Another run can have other columns and an earlier clock. Its curves start again.
            if self._history.columns != columns or time_s <= newest_s:
                self._history = History(columns, _KEPT)
            elif time_s - newest_s > GAP_S:
                # A row of NaN interrupts the line of each curve.
                self._history.append(newest_s, np.full(len(columns), np.nan))
            self._history.append(time_s, row)
        self._units = states.source_units
        self._run += self._cycle < 0
        self._cycle = states.cycle

    def _note_events(self, robot: RemoteRobot) -> None:
        began_s = self._info.began
        if began_s is None:
            return  # event times are relative to the first cycle, which is still to come
        found = msgspec.convert(robot.events(self._last_event)["events"], list[LiveEvent])
        for event in found:
            self._last_event = event.number
            if event.time > self._known_until_s:
                number = self._events[-1].number + 1 if self._events else 1
                run_time_s = event.time - began_s
                self._events.append(msgspec.structs.replace(event, number=number, run_time=run_time_s))

    def _note_fields(self, robot: RemoteRobot) -> None:
        """Find the numbers of each new topic that can be drawn, from its newest message."""
        for topic in robot.topics():
            if topic.name in self._fields or topic.name in NOT_DRAWN or not topic.count:
                continue
            message = robot.newest(topic.name)
            if message is not None:
                numbers = numbers_in(message.message, f"{topic.name}:")
                # A new mapping, because another thread may be reading the old one.
                self._fields = {**self._fields, topic.name: tuple(numbers)}

    def _note_topics(self, robot: RemoteRobot, now_s: float) -> None:
        """Append the newest message of each topic whose curves were requested in the last DRAWN_S."""
        with self._lock:
            drawn_now = {name: one for name, one in self._drawn.items() if now_s - one.asked_s < DRAWN_S}
            self._drawn = drawn_now.copy()
        for name, drawn in drawn_now.items():
            message = robot.newest(name)
            if message is not None and message.time_ns != drawn.time_ns:
                numbers = numbers_in(message.message, f"{name}:")
                with self._lock:
                    drawn.append_numbers(message.time_ns, numbers)

    def _gone(self, why: str) -> None:
        self._problem = why
        if self._robot is not None:
            with suppress(OSError):
                self._robot.close()
        self._robot = None


class DrawnTopic:
    """Curves of all numbers in the messages of one topic, kept while a page draws one of them"""

    def __init__(self) -> None:
        self.asked_s = time.monotonic()
        """Time of the last request for one of the curves, s (monotonic)"""
        self.history = History((), 1)
        self.time_ns = 0
        """Time of the newest message, ns"""

    def append_numbers(self, time_ns: int, numbers: Mapping[str, float]) -> None:
        """Append a message's numbers. If names differ or the time is earlier, all curves start again."""
        if tuple(numbers) != self.history.columns or time_ns < self.time_ns:
            self.history = History(tuple(numbers), _KEPT)
        self.time_ns = time_ns
        self.history.append(time_ns * 1e-9, np.array([*numbers.values()]))


def info_of(robot: RemoteRobot) -> ViewedRobot:
    """Request `RemoteRobot.info` and convert the part that a page uses. Raises DxlrunError."""
    return msgspec.convert(robot.info(), ViewedRobot)


def offered_motions(info: ViewedRobot) -> Iterator[str]:
    """Yield the files `motions/*.yaml` next to the robot file that only use controllers of this robot, and
    `CONTROLLER/MOTION` for motions of controllers. Files that cannot be read are skipped."""
    names = {row.name for row in info.controllers}
    for path in sorted(Path(info.file).parent.glob("motions/*.yaml")):
        with suppress(DxlrunError, OSError):
            read = read_motion(path, info.groups, info.omitted)
            if {part.controller for part in read.motion.motions} <= names:
                yield str(path)
    for row in info.controllers:
        yield from (f"{row.name}/{motion}" for motion in row.motions)


class _Commanded(msgspec.Struct, frozen=True):
    """Controller with the kinds of its commands, as a row of RobotInfo."""

    name: str
    takes: Mapping[str, object]


def _handles(robot: RemoteRobot) -> Iterator[ViewedHandle]:
    """Yield the tip of each controller that plans and moves one."""
    for row in msgspec.convert(robot.info()["controllers"], list[_Commanded]):
        if {"plan", "pose"} <= row.takes.keys():
            given = robot.parameters(row.name)
            if "leader.tip" in given:
                continue  # the tip follows another one
            yield ViewedHandle(row.name, str(given["tip"]), str(given["base"]))


def _of_joints(states: RobotStates) -> Iterator[Values]:
    """Yield all joints' values for each of JOINT_COLUMNS. Mode and torque are numbers, as in the log."""
    special = {
        "mode": [Mode[name.upper()] for name in states.mode],
        "torque": [_TORQUE[word] for word in states.torque],
    }
    for column in JOINT_COLUMNS:
        yield np.asarray(special.get(column, getattr(states, column)), np.float64)
