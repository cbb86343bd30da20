"""Drives: relation between a joint and its servos, in figures at the joint; features compile them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import msgspec

from dxlrun.compile.joints.limits import Interval
from dxlrun.compile.joints.servos import CompiledServo
from dxlrun.compile.problems import RobotFile
from dxlwire.modes import Mode


class JointDrive(msgspec.Struct, frozen=True):
    """Drive of a joint by its servos; positions and speeds in rad, or m for a linear joint."""

    servos: tuple[CompiledServo, ...]
    together: tuple[str, ...]
    """Joints that these servos move, including this one."""
    levers: tuple[float, ...]
    """Travel of each servo, after its gear, per unit of the joint; the other joints of `together` rest."""
    reach: Interval
    """Positions that the servos reach, with the other joints of `together` where the range is widest."""
    allowed: Interval | None
    """Positions that the gate allows; None: a mistake in the file, which has been reported."""
    modes: tuple[Mode, ...]
    top_speed: float | None
    """Highest speed while the other joints of `together` rest; None: not known."""
    shared_speed: float | None
    """Highest speed while all joints of `together` move equally fast; None: not known."""
    top_effort: float | None
    """Highest effort while the other joints of `together` have none; None: a servo has no effort goal."""
    excluded: Mapping[Mode, str] = {}
    """Modes of the servos that do not move the joint, each with the reason."""

    @property
    def own(self) -> bool:
        """True if the joint has one servo, described by the keys of the joint."""
        return self.servos[0].described.name in self.together


class DriveStage(msgspec.Struct, frozen=True):
    """`STAGE` of `drives.py`: called when the models of all servos are known, before joints are compiled.

    Receives the servos by name and returns the drive of each joint that they move. A joint without a drive
    has a mistake, which the stage adds to the file.
    """

    FILE: ClassVar[str] = "drives"

    compile: Callable[[RobotFile, Mapping[str, CompiledServo]], Mapping[str, JointDrive]]
