"""Data that a page shows in addition to curves: joints, controllers, events, marks on the time line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import msgspec

from dxlrun_view.curves import Curve, Moment


class Controller(msgspec.Struct, frozen=True):
    """Controller of a robot, a row of RobotInfo"""

    name: str
    type: str
    active: bool
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    into: tuple[str, ...] = ()
    """Controllers whose references it commands"""
    fallback: str = ""
    goals: tuple[str, ...] = ()
    """Kinds of its commands that are goals"""


class RobotInfo(msgspec.Struct, frozen=True):
    """Part of `RemoteRobot.info` that a page uses, also filled from logs"""

    robot: str
    rate: float = 0.0
    """Nominal rate, Hz"""
    began: float | None = None
    """Time of the first cycle on the clock of the curves, s; None if unknown"""
    paused: bool = False
    skipped: int = 0
    """Number of skipped periods"""
    joints: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = {}
    units: Mapping[str, str] = {}
    """Units of positions by joint: rad or m"""
    effort_units: Mapping[str, str] = {}
    """Units of efforts by joint; an empty text for the fraction of the servo's maximum"""
    limits: Mapping[str, tuple[float, float]] = {}
    """Position limits by joint. Continuous joints are not included."""
    controllers: tuple[Controller, ...] = ()
    file: str = ""


class LiveEvent(msgspec.Struct, frozen=True):
    """Event of `RemoteRobot.events`"""

    number: int
    time: float
    """Time on the clock of the curves, s"""
    severity: int
    """Level of Python's logging: 20 information, 30 warning, 40 error"""
    source: str
    text: str
    run_time: float = 0.0
    """Time since the first cycle of the run, s; negative during the set-up of the servos"""


class Mark(msgspec.Struct, frozen=True):
    """Point of interest in a log"""

    time: float
    what: str


class Shown(msgspec.Struct, frozen=True, kw_only=True):
    """Properties of a robot or a log that rarely change"""

    info: RobotInfo
    live: bool
    columns: tuple[str, ...]
    span: tuple[float, float]
    """Times of the oldest and the newest moment, s"""
    run: int = 1
    """Counter of runs. The page is rebuilt when it changes."""
    problem: str = ""
    """Reason for missing data: the robot does not run, or has ended"""
    every: int = 1
    """Downsampling factor of the cycles of a long log"""
    units: Mapping[str, str] = {}
    """SI units of the states of sources, by column"""
    fields: tuple[str, ...] = ()
    """Numbers in messages of topics that can be drawn, such as `/arm/state:error[0]`"""
    marks: tuple[Mark, ...] = ()
    """Cycles of a log with the latest wake-ups"""
    control: bool = False
    """True if the page may steer the robot"""
    motions: tuple[str, ...] = ()
    """Motion files that the page may play"""
    imu: str = ""
    """Source of the orientation of the body"""
    imu_link: str = ""


class Source(Protocol):
    """Running robot or log"""

    @property
    def folder(self) -> Path | None:
        """Directory of the robot file; None if unknown"""

    def shown(self) -> Shown:
        """Return the properties that rarely change."""

    def at(self, time_s: float | None) -> Moment:
        """Return all columns at a time. Without a time, poll a running robot and return the newest values."""

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a span of a curve. Raises KeyError for an unknown curve."""

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        """Return the events with a number greater than `after`."""

    def urdf(self) -> str:
        """Return the robot's URDF, or an empty text."""

    def close(self) -> None:
        """Release the connection, if there is one."""
