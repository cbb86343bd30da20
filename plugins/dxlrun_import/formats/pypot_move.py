"""pypot moves: recorded motions in JSON.

Source: pypot's documentation ("Move recorder") and what its code writes: `framerate` in Hz, and `positions`,
in degrees: by time a pair of position and speed for each motor; in older files a list of positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import Step, mapping_at, number_at, value_at
from dxlrun_import.motion_text import MotionPoint, motion_conversion

LEAD_S = 1.0
"""Time of the way to the first position, s, because a move begins with it."""


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the recorded positions; speeds are those of the spline through them."""
    rate = number_at(content, "framerate")
    if rate <= 0:
        raise content.refusal(f"framerate is {rate:g}", "write a rate above 0 Hz", "framerate")
    moments = list(_moments(content, rate))
    first = min((time for time, _ in moments), default=0.0)
    points = []
    for time, at in sorted(moments):
        pose = {}
        for motor, value in mapping_at(content, *at).items():
            place = (*at, motor, 0) if isinstance(value, list) else (*at, motor)
            pose[motor] = math.radians(number_at(content, *place))
        points.append(MotionPoint(LEAD_S + time - first, pose))
    return motion_conversion(content, options, FORMAT.name, points)


def _moments(content: FileContent, rate: float) -> Iterator[tuple[float, tuple[Step, ...]]]:
    """Yield time and place of the positions of each moment."""
    positions = value_at(content, "positions")
    if isinstance(positions, list):
        yield from ((index / rate, ("positions", index)) for index in range(len(positions)))
        return
    for key in mapping_at(content, "positions"):
        try:
            yield float(key), ("positions", key)
        except ValueError:
            fix = "write the time in s"
            raise content.refusal(f"{key:.40} is not a time", fix, "positions", key) from None


def _matches(content: FileContent) -> bool:
    return {"framerate", "positions"} <= content.values.keys()


FORMAT = FileFormat("a move of pypot", _matches, convert=f"{__name__}:convert", makes="motion")
