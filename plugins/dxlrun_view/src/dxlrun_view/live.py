"""A running robot for the page: asked 25 times a second while a page looks, and not at all otherwise."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np

from dxlrun import DxlrunError, RemoteRobot, connect, running
from dxlrun.channels.cycle import Torque
from dxlrun.description.modes import Mode
from dxlrun.description.motion import read_motion
from dxlrun.log.schemas import EVENT_TOPIC, JOINT_STATES_TOPIC
from dxlrun.remote.live.states import RobotStates
from dxlrun_view.curves import JOINT_COLUMNS, Curve, History, Moment, Values, columns_of, numbers_in
from dxlrun_view.shown import Controller, Happening, Joint, Shown

PERIOD_S = 0.04
"""Between two looks at the robot; what a screen shows need not come more often."""
SLOW_S = 0.5
"""Between two looks at what changes seldom: controllers, rate, events."""
KEPT_S = 300.0
"""Curves reach back so far."""
AWAKE_S = 3.0
"""After so long without a question of a page the robot is left alone."""
_MOST_EVENTS = 400
NOT_DRAWN = (EVENT_TOPIC, JOINT_STATES_TOPIC, "/goals")
"""Topics whose numbers are columns already, or none."""
Row = Mapping[str, object]


class LiveRobot:
    """What is known of a running robot, by a thread that asks it while a page looks."""

    live = True

    def __init__(self, name: str | None) -> None:
        self._name = name
        self._robot: RemoteRobot | None = None
        self._history = History((), 1)
        self._drawn: dict[str, DrawnTopic] = {}
        self._fields: dict[str, tuple[str, ...]] = {}
        self._info: Row = {}
        self._imu = ("", "")
        self._motions: tuple[str, ...] = ()
        self._events: deque[Happening] = deque(maxlen=_MOST_EVENTS)
        self._last_event = 0
        self._cycle = -1
        self._problem = ""
        self._asked_s = 0.0
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._ended = threading.Event()
        self._look_slowly()
        self._thread.start()

    def close(self) -> None:
        """Leave the robot alone for good."""
        self._ended.set()
        self._thread.join()
        if self._robot is not None:
            self._robot.close()
        for drawn in self._drawn.values():
            drawn.close()

    # What the page asks for

    def shown(self) -> Shown:
        """Return what the page has around the curves."""
        self._asked_s = time.monotonic()
        info = self._info
        joints = cast("list[str]", info.get("joints", []))
        units = cast("Mapping[str, str]", info.get("units", {}))
        efforts = cast("Mapping[str, str]", info.get("effort_units", {}))
        limits = cast("Mapping[str, tuple[float | None, float | None]]", info.get("limits", {}))
        return Shown(
            robot=str(info.get("robot", self._name or "")),
            live=True,
            problem=self._problem,
            rate=float(cast("float", info.get("rate", 0.0))),
            skipped=int(cast("int", info.get("skipped", 0))),
            paused=bool(info.get("paused")),
            columns=self._history.columns,
            joints=tuple(
                Joint(
                    joint, units.get(joint, "rad"), efforts.get(joint, ""), *limits.get(joint, (None, None))
                )
                for joint in joints
            ),
            controllers=tuple(map(controller_of, cast("list[Row]", info.get("controllers", [])))),
            span=self._history.span,
            fields=tuple(name for names in self._fields.values() for name in names),
            motions=self._motions,
            imu=self._imu[0],
            imu_link=self._imu[1],
        )

    def at(self, time_s: float | None) -> Moment:
        """Return all columns at a time, by default the newest."""
        self._asked_s = time.monotonic()
        with self._lock:
            return self._history.at(time_s)

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a part of a curve; raises KeyError for one that there is not."""
        topic, of_topic, _ = name.partition(":")
        if not of_topic:
            with self._lock:
                return self._history.curve(name, begin, end, points)
        if name not in self._fields.get(topic, ()):
            raise KeyError(name)
        drawn = self._drawn.get(topic)
        if drawn is None or not drawn.alive:
            drawn = self._drawn[topic] = DrawnTopic(topic, self.asking())
        return drawn.curve(name, begin, end, points)

    def events(self, after: int) -> tuple[Happening, ...]:
        """Return the events behind this number."""
        return tuple(event for event in list(self._events) if event.number > after)

    def urdf(self) -> str:
        """Return the robot's URDF; empty: it has none."""
        with self.asking() as robot:
            return robot.urdf()

    @property
    def folder(self) -> Path | None:
        """Where its robot file is, from which meshes are looked up."""
        file = self._info.get("file")
        return Path(str(file)).parent if file else None

    def asking(self) -> RemoteRobot:
        """Return a connection of its own, for a request; raises DxlrunError."""
        return connect(str(self._info.get("robot", self._name or "")) or None, "dxlrun view")

    # The thread

    def _follow(self) -> None:
        slow_s = 0.0
        while not self._ended.wait(PERIOD_S):
            now = time.monotonic()
            if now - self._asked_s > AWAKE_S:
                continue
            if self._robot is None or now - slow_s > SLOW_S:
                slow_s = now
                self._look_slowly()
            if self._robot is not None:
                self._look(self._robot)

    def _look_slowly(self) -> None:
        """Connect where there is no connection, and look at what changes seldom."""
        try:
            if self._robot is None:
                self._robot = self._found()
            robot = self._robot
            info = robot.info()
            self._note_events(robot)
            self._note_fields(robot)
        except DxlrunError as error:
            self._gone(str(error))
            return
        if not self._info or info.get("sources") != self._info.get("sources"):
            states = robot.states()
            columns = columns_of(states.joints, states.source_states, states.references)
            self._history = History(columns, round(KEPT_S / PERIOD_S))
            self._motions = tuple(_motions(info))
            tree = robot.frames() if robot.urdf() else None
            self._imu = (tree.imu, tree.imu_link) if tree is not None else ("", "")
        self._info, self._problem = info, ""

    def _found(self) -> RemoteRobot:
        names = running()
        if self._name is None and len(names) > 1:
            raise DxlrunError(f"several robots run: {', '.join(names)}; name one")
        return connect(self._name, "dxlrun view")

    def _look(self, robot: RemoteRobot) -> None:
        """Append the newest cycle to the curves."""
        try:
            states = robot.states()
        except DxlrunError as error:
            if getattr(error, "code", "") != "no_cycle":
                self._gone(str(error))
            return
        cycle = states.cycle
        if cycle == self._cycle:
            return
        if cycle < self._cycle:  # another run of the robot
            self._history = History(self._history.columns, round(KEPT_S / PERIOD_S))
        self._cycle = cycle
        with self._lock:
            self._history.append(states.time_ns * 1e-9, self._row(states))

    def _row(self, states: RobotStates) -> Values:
        """Return a cycle as a row of the columns."""
        of_joints = [_numbers(column, getattr(states, column)) for column in JOINT_COLUMNS]
        head = (float(states.cycle), states.late_ns * 1e-9)
        return np.concatenate([head, *of_joints, states.source_state, states.reference])

    def _note_events(self, robot: RemoteRobot) -> None:
        found = robot.events(self._last_event)
        self._last_event = int(cast("int", found["last"]))
        for event in cast("list[Row]", found["events"]):
            self._events.append(
                Happening(
                    int(cast("int", event["number"])),
                    float(cast("float", event["time"])),
                    int(cast("int", event["severity"])),
                    str(event["source"]),
                    str(event["text"]),
                )
            )

    def _note_fields(self, robot: RemoteRobot) -> None:
        """Note what can be drawn of the topics' messages, by the first message that each has."""
        for topic in robot.topics():
            if topic.name in self._fields or topic.name in NOT_DRAWN or not topic.count:
                continue
            message = robot.newest(topic.name)
            if message is not None:
                self._fields[topic.name] = tuple(numbers_in(message.message, f"{topic.name}:"))

    def _gone(self, why: str) -> None:
        self._problem = why
        if self._robot is not None:
            with suppress(OSError):
                self._robot.close()
        self._robot = None
        self._cycle = -1
        self._last_event = 0


def _motions(info: Row) -> Iterator[str]:
    """Yield the motion files beside the robot file that have no other controllers than this robot's."""
    file, controllers = info.get("file"), cast("list[Row]", info["controllers"])
    names = {str(row["name"]) for row in controllers}
    for path in sorted(Path(str(file)).parent.glob("motions/*.yaml")) if file else ():
        with suppress(DxlrunError, OSError):
            read = read_motion(path, cast("Mapping[str, tuple[str, ...]]", info.get("groups", {})))
            if {part.controller for part in read.motion.motions} <= names:
                yield str(path)


def controller_of(row: Row) -> Controller:
    """Return a controller as the page has it, from what a robot says of it."""
    return Controller(
        str(row["name"]),
        str(row["type"]),
        bool(row["active"]),
        tuple(cast("list[str]", row["joints"])),
        tuple(cast("list[str]", row["command"])),
        tuple(cast("list[str]", row["into"])),
        str(row["fallback"]),
        tuple(cast("Mapping[str, object]", row["takes"])),
    )


def _numbers(column: str, values: object) -> Values:
    """Return the values of a column of the joints as the log's cycles have them."""
    names = {"torque": Torque, "mode": Mode}.get(column)
    if names is not None:
        values = [names[str(name).upper()] for name in cast("Sequence[str]", values)]
    return np.asarray(values, np.float64)


class DrawnTopic:
    """Numbers in the messages of one topic, listened to while a page draws one of them."""

    def __init__(self, name: str, robot: RemoteRobot) -> None:
        self.asked_s = time.monotonic()
        self.history = History((), 1)
        self._name, self._robot = name, robot
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True while messages may come."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Listen no more; a topic that is silent lets go at its next message."""
        self.asked_s = -AWAKE_S
        self._thread.join(1.0)

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a part of a curve; raises KeyError for one that there is not."""
        self.asked_s = time.monotonic()
        with self._lock:
            return self.history.curve(name, begin, end, points)

    def _listen(self) -> None:
        with suppress(DxlrunError), self._robot as robot:
            for message in robot.listen(self._name, rate=1 / PERIOD_S):
                numbers = numbers_in(message.message, f"{self._name}:")
                with self._lock:
                    if tuple(numbers) != self.history.columns:
                        self.history = History(tuple(numbers), round(KEPT_S / PERIOD_S))
                    self.history.append(message.time_ns * 1e-9, np.array([*numbers.values()]))
                if time.monotonic() - self.asked_s > AWAKE_S:
                    return
