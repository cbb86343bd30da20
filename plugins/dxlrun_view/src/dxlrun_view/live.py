"""A running robot for the page: asked 25 times a second while a page looks, and not at all otherwise."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np

from dxlrun import DxlrunError, RemoteRobot, connect, running
from dxlrun.channels.cycle import Torque
from dxlrun.description.modes import Mode
from dxlrun_view.curves import JOINT_COLUMNS, Curve, History, Moment, columns_of
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
Row = Mapping[str, object]


class LiveRobot:
    """What is known of a running robot, by a thread that asks it while a page looks."""

    live = True

    def __init__(self, name: str | None) -> None:
        self._name = name
        self._robot: RemoteRobot | None = None
        self._history = History((), 1)
        self._topics: dict[str, tuple[float, History]] = {}
        self._info: Row = {}
        self._imu = ("", "")
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
        with self._lock:
            return self._history.curve(name, begin, end, points)

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
        except DxlrunError as error:
            self._gone(str(error))
            return
        if not self._info or info.get("sources") != self._info.get("sources"):
            joints = cast("list[str]", info["joints"])
            states = robot.states()
            sources, references = (list(cast("Row", states[name])) for name in ("sources", "references"))
            self._history = History(columns_of(joints, sources, references), round(KEPT_S / PERIOD_S))
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
        cycle = int(cast("int", states["cycle"]))
        if cycle == self._cycle:
            return
        if cycle < self._cycle:  # another run of the robot
            self._history = History(self._history.columns, round(KEPT_S / PERIOD_S))
        self._cycle = cycle
        with self._lock:
            self._history.append(float(cast("float", states["time"])), self._row(states))

    def _row(self, states: Row) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        values = np.full(len(self._history.columns), np.nan)
        joints = cast("Mapping[str, Mapping[str, object]]", states["joints"])
        values[0], values[1] = cast("float", states["cycle"]), cast("float", states["late"])
        place = 2
        for column in JOINT_COLUMNS:
            for joint in joints.values():
                values[place] = _number(column, joint.get(column))
                place += 1
        for kind in ("sources", "references"):
            for value in cast("Mapping[str, float | None]", states[kind]).values():
                values[place] = np.nan if value is None else value
                place += 1
        return values

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

    def _gone(self, why: str) -> None:
        self._problem = why
        if self._robot is not None:
            with suppress(OSError):
                self._robot.close()
        self._robot = None
        self._cycle = -1
        self._last_event = 0


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


def _number(column: str, value: object) -> float:
    """Return a value of a joint as the log's cycles have it."""
    if value is None:
        return np.nan
    if column == "torque":
        return float(Torque[str(value).upper()])
    if column == "mode":
        return float(Mode[str(value).upper()])
    return float(cast("float", value))
