"""Orientation checks: limits of angles and orientations in poses, both of commands and of the robot file.

The form of every robot file needs these checks, so this module imports neither numpy nor pydantic.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from dxlrun_space.chain import Quaternion, Vector

NORM: Final = 1e-3
"""Largest difference of a quaternion's length from 1: three decimals of each number."""


def at_most_a_turn(value: float) -> float:
    """Return an angle, rad; raise ValueError if it is more than a turn."""
    if abs(value) > 2 * math.pi:
        raise ValueError(
            f"{value:g} rad is more than a turn; write at most a turn, with its unit, such as 90deg"
        )
    return value


def check_turns(quaternion: Quaternion | None, *others: Vector | None) -> None:
    """Raise ValueError for more than one orientation, or a quaternion that is not of length 1."""
    if sum(each is not None for each in (quaternion, *others)) > 1:
        raise ValueError("give only one of rpy, drpy and quaternion; remove the others")
    if quaternion is not None and abs(math.hypot(*quaternion) - 1) > NORM:
        raise ValueError(f"the quaternion has length {math.hypot(*quaternion):.4g}; scale it to length 1")
