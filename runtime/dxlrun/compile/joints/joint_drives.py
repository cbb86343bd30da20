"""Drives: range, speed and effort of a joint that follow from its servos and their gears."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import msgspec

from dxlrun.compile.joints.compiled_servos import CompiledServo
from dxlrun.compile.joints.limits import Interval
from dxlrun.compile.problems import RobotFile
from dxlwire.modes import Mode


class JointDrive(msgspec.Struct, frozen=True):
    """The servos of one joint and what they can do at the joint, in rad, or m for a linear joint."""

    servos: tuple[CompiledServo, ...]
    together: tuple[str, ...]
    """Names of all joints that the same servos move (more than one in a differential), including this one."""
    levers: tuple[float, ...]
    """Travel of each servo, after its gear, for one rad (m) of this joint while the other joints rest."""
    reach: Interval
    """Positions that the servos can reach, with coupled joints placed where this range is widest."""
    allowed: Interval | None
    """Position limits for the gate; None if the file has a mistake there, which has been reported."""
    modes: tuple[Mode, ...]
    top_speed: float | None
    """Highest speed at the joint, rad/s or m/s, while coupled joints rest; None: not known."""
    shared_speed: float | None
    """Highest speed at the joint, rad/s or m/s, if all coupled joints move equally fast; None: not known."""
    top_effort: float | None
    """Highest effort at the joint while coupled joints have none; None: a servo accepts no effort goal."""
    excluded: Mapping[Mode, str] = {}
    """Modes that the servos have but the joint cannot use, each with the reason."""

    @property
    def own(self) -> bool:
        """True if the joint's only servo is described by the joint's own keys, not by a transmission."""
        return self.servos[0].described.name in self.together


class DriveStage(msgspec.Struct, frozen=True):
    """Hook `STAGE` in a feature's `drives.py`, called after all servo models are known.

    It gets the servos by name and returns the drive of each joint that they move. A joint without a drive
    has a mistake, which the stage adds to the file.
    """

    FILE: ClassVar[str] = "drives"

    compile: Callable[[RobotFile, Mapping[str, CompiledServo]], Mapping[str, JointDrive]]
