"""What a page shows around the curves: joints, controllers, events, marks on the time line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import msgspec

from dxlrun_view.curves import Curve, Moment


class Controller(msgspec.Struct, frozen=True):
    """A controller of the graph, a row of RobotInfo."""

    name: str
    type: str
    active: bool
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    into: tuple[str, ...] = ()
    """Controllers whose references it commands."""
    fallback: str = ""
    goals: tuple[str, ...] = ()
    """Commands that are goals, by their kinds."""


class RobotInfo(msgspec.Struct, frozen=True):
    """The part of `RemoteRobot.info` that a page uses; a log has the same."""

    robot: str
    rate: float = 0.0
    """Hz, nominal."""
    began: float | None = None
    """The run's first cycle, s as the curves' times; None: not known."""
    paused: bool = False
    skipped: int = 0
    """Periods."""
    joints: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = {}
    units: Mapping[str, str] = {}
    """Of positions: rad or m."""
    effort_units: Mapping[str, str] = {}
    """Empty: the fraction of the servo's maximum."""
    limits: Mapping[str, tuple[float, float]] = {}
    """Of positions; a joint that turns without end has none."""
    controllers: tuple[Controller, ...] = ()
    file: str = ""


class LiveEvent(msgspec.Struct, frozen=True):
    """An event as `RemoteRobot.events` has it."""

    number: int
    time: float
    """s, as the curves'."""
    severity: int
    """As in Python's logging: 20 is information, 30 a warning, 40 an error."""
    source: str
    text: str
    run_time: float = 0.0
    """s since the run's first cycle, as in its log; servos are set up before."""


class Mark(msgspec.Struct, frozen=True):
    """A place in a log that is worth a jump."""

    time: float
    what: str


class Shown(msgspec.Struct, frozen=True, kw_only=True):
    """A robot or a log, as far as it changes seldom."""

    info: RobotInfo
    live: bool
    columns: tuple[str, ...]
    span: tuple[float, float]
    """s, of the oldest and the newest moment."""
    run: int = 1
    """Greater by one for each run of the robot: all of the page is built anew."""
    problem: str = ""
    """Why there is nothing new: the robot does not run, or has ended."""
    every: int = 1
    """Of a long log every so manieth cycle is shown."""
    units: Mapping[str, str] = {}
    """SI units of the states of sources that have one, by column."""
    fields: tuple[str, ...] = ()
    """Numbers in messages of topics, which can be drawn: `/arm/state:error[0]`."""
    marks: tuple[Mark, ...] = ()
    """Of a log: its worst cycles."""
    control: bool = False
    """The page may steer."""
    motions: tuple[str, ...] = ()
    """Motion files of the robot's folder that a page may play."""
    imu: str = ""
    """The source whose orientation turns the body."""
    imu_link: str = ""


class Source(Protocol):
    """A running robot or a log."""

    @property
    def folder(self) -> Path | None:
        """Where the robot file is; None: not known."""

    def shown(self) -> Shown:
        """Return what changes seldom."""

    def at(self, time_s: float | None) -> Moment:
        """Return all columns at a time, by default the newest, for which a running robot is asked."""

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a part of a curve; raises KeyError for one that there is not."""

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        """Return the events behind this number."""

    def urdf(self) -> str:
        """Return the robot's URDF; empty: it has none."""

    def close(self) -> None:
        """Leave it alone."""
