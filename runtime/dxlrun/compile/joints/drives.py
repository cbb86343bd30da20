"""Drives: how the servos of each joint move it, in figures at the joint, as features compile them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import msgspec

from dxlrun.compile.joints.limits import Interval
from dxlrun.compile.joints.servos import CompiledServo
from dxlrun.compile.problems import RobotFile
from dxlwire.modes import Mode


class JointDrive(msgspec.Struct, frozen=True):
    """How its servos move a joint; positions and speeds in rad, or m of a linear joint."""

    servos: tuple[CompiledServo, ...]
    together: tuple[str, ...]
    """The joints that these servos move, itself among them"""
    levers: tuple[float, ...]
    """Travel of each servo, after its gear, while the joint moves by 1 and the others of `together` rest"""
    reach: Interval
    """Positions that the servos reach, with the others of `together` where it is widest"""
    allowed: Interval | None
    """Positions that the gate allows; None: a mistake in the file, which was reported"""
    modes: tuple[Mode, ...]
    top_speed: float | None
    """Highest speed while the others of `together` rest; None: not known"""
    shared_speed: float | None
    """Highest speed while all of `together` move as fast; None: not known"""
    top_effort: float | None
    """Highest effort while the others of `together` have none; None: a servo follows no effort"""
    excluded: Mapping[Mode, str] = {}
    """Modes of the servos in which they do not move the joint, each with the reason"""

    @property
    def own(self) -> bool:
        """True when the joint has one servo, which the file describes with the keys of the joint."""
        return self.servos[0].described.name in self.together


@dataclass(frozen=True)
class DriveStage:
    """`STAGE` of `drives.py`: called when the models of all servos are known, before joints are compiled.

    Takes the servos by name and returns the drive of each joint that they move. A joint without a drive has a
    mistake, which the stage adds to the file.
    """

    FILE: ClassVar[str] = "drives"

    compile: Callable[[RobotFile, Mapping[str, CompiledServo]], Mapping[str, JointDrive]]
