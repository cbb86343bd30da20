"""Data that the page shows in addition to curves, and the interface that robots and logs share.

The structs are sent to the page as JSON. Times are s on the clock of the curves.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import msgspec

from dxlrun.tooling.live import JointServo
from dxlrun_view.curves import Curve, Moment
from dxlwire import find_table


class ViewedController(msgspec.Struct, frozen=True):
    """Controller of the robot, as a row of RobotInfo"""

    name: str
    type: str
    active: bool
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    """Quantities that it commands of its joints, such as position"""
    into: tuple[str, ...] = ()
    """Controllers whose references it commands in a chain; empty if it commands servos"""
    fallback: str = ""
    """Controller that takes over when this one fails; empty without one"""
    goals: tuple[str, ...] = ()
    """Kinds of its commands that are goals, which end when they are reached"""
    motions: Mapping[str, float | None] = {}
    """Duration of each of its own motions, s, by name; None: until it is cancelled"""


class ViewedRobot(msgspec.Struct, frozen=True):
    """Part of `RemoteRobot.info` that a page uses, also filled from logs"""

    robot: str
    rate: float = 0.0
    """Nominal rate of the control loop, Hz"""
    began: float | None = None
    """Time of the first cycle on the clock of the curves, s; None if unknown"""
    paused: bool = False
    skipped: int = 0
    """Number of periods of the loop that were skipped because a cycle overran"""
    joints: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = {}
    omitted: tuple[str, ...] = ()
    """Joints of the robot file that the run omits"""
    units: Mapping[str, str] = {}
    """Units of positions by joint: rad or m"""
    effort_units: Mapping[str, str] = {}
    """Units of efforts by joint; an empty text for the fraction of the servo's maximum"""
    limits: Mapping[str, tuple[float, float]] = {}
    """Lower and upper position limit by joint, rad or m. Continuous joints are not included."""
    controllers: tuple[ViewedController, ...] = ()
    file: str = ""
    """Path of the robot file"""
    servos: Mapping[str, JointServo] = {}
    """First servo of each joint"""


class ViewedHandle(msgspec.Struct, frozen=True):
    """Tip of an arm that can be dragged on the page"""

    controller: str
    """Controller that plans and moves the tip: it takes `plan` and `pose`"""
    tip: str
    """Link of the URDF"""
    base: str
    """Link in whose axes its poses are; empty: the root"""


class LiveEvent(msgspec.Struct, frozen=True):
    """Event of the run, a line of the page's list: error, warning or information"""

    number: int
    """Consecutive number, from 1"""
    time: float
    """Time on the clock of the curves, s"""
    severity: int
    """Level of Python's logging: 20 information, 30 warning, 40 error"""
    source: str
    text: str
    run_time: float = 0.0
    """Time since the first cycle of the run, s; negative during the set-up of the servos"""


class TimelineMark(msgspec.Struct, frozen=True):
    """Mark on the time line of a log, to which the user can jump"""

    time: float
    what: str
    """Label of the mark"""


def describe_error(servo: JointServo | None, value: int) -> str:
    """Return a hardware error in the words of the servo's control table, such as `overload error`."""
    if servo is not None:
        # A model of a plug-in that is not installed here has no table.
        with suppress(LookupError):
            return find_table(servo.model, servo.protocol).errors.describe_errors(value)
    return f"error 0x{value:02x}"


class SourceProperties(msgspec.Struct, frozen=True, kw_only=True):
    """Properties of a robot or a log that rarely change, which the page requests in addition to the curves"""

    info: ViewedRobot
    live: bool
    """True for a running robot, False for a log"""
    columns: tuple[str, ...]
    """Names of the columns of each moment, such as `pan/position`"""
    span: tuple[float, float]
    """Times of the oldest and the newest moment, s"""
    run: int = 1
    """Counter of runs. The page is rebuilt when it changes."""
    problem: str = ""
    """Reason for missing data: the robot does not run, or has ended; else empty"""
    every: int = 1
    """Number of cycles in a long log per cycle that the page has"""
    units: Mapping[str, str] = {}
    """SI unit of each column that is a state of a source (sensor or device)"""
    fields: tuple[str, ...] = ()
    """Names of curves that are numbers in messages of topics, such as `/arm/state:error[0]`"""
    marks: tuple[TimelineMark, ...] = ()
    """Cycles of a log with the latest wake-ups"""
    control: bool = False
    """True if the page may steer the robot"""
    motions: tuple[str, ...] = ()
    """Paths of the motion files that the page may play"""
    handles: tuple[ViewedHandle, ...] = ()
    """Tips that the page may drag"""
    imu: str = ""
    """Sensor whose orientation turns the robot's body in the 3-D view; empty without one"""
    imu_link: str = ""
    """Link of the URDF to which this sensor is fixed"""


class ViewSource(Protocol):
    """Source of the page's data: a running robot (LiveRobot) or a log (RecordedRobot)"""

    @property
    def folder(self) -> Path | None:
        """Directory of the robot file, from which meshes are searched; None if unknown"""

    def describe_page(self) -> SourceProperties:
        """Return the properties of the robot or the log that rarely change."""

    def moment_at(self, time_s: float | None) -> Moment:
        """Return all columns at a time. Without a time, poll a running robot and return the newest values."""

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return one curve between two times (s), downsampled to about `points` points.

        Raises KeyError for an unknown curve.
        """

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        """Return the events with a number greater than `after`."""

    def urdf(self) -> str:
        """Return the robot's URDF, or an empty text if it has none."""

    def close(self) -> None:
        """Close the connection to a robot."""
