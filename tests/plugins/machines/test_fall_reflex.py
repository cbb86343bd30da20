"""fall_reflex: bounds of roll and pitch; times and silence are in `scripts/fall_reflex.txt`."""

from __future__ import annotations

import math

import pytest
from tests.kit.stages import standing

from dxlrun_controllers.sensing.fall_reflex import FallReflex

KEYS: dict[str, object] = {
    "imu": "imu",
    "activate": ["curl"],
    "roll": ["-40 deg", "40 deg"],
    "pitch": ["-30 deg", "50 deg"],
}


def turned(heading: float, pitch: float, roll: float) -> tuple[float, ...]:
    """Return x, y, z, w of a body turned to a heading, pitched, and rolled, degrees: Z, then Y, then X."""
    a, b, c = (math.radians(angle) / 2 for angle in (roll, pitch, heading))
    return (
        math.sin(a) * math.cos(b) * math.cos(c) - math.cos(a) * math.sin(b) * math.sin(c),
        math.cos(a) * math.sin(b) * math.cos(c) + math.sin(a) * math.cos(b) * math.sin(c),
        math.cos(a) * math.cos(b) * math.sin(c) - math.sin(a) * math.sin(b) * math.cos(c),
        math.cos(a) * math.cos(b) * math.cos(c) + math.sin(a) * math.sin(b) * math.sin(c),
    )


@pytest.mark.parametrize("heading", [0.0, 80.0, -170.0])
@pytest.mark.parametrize(
    ("roll", "pitch", "falls"),
    [
        *((0, 49, 0), (0, 51, 1), (0, -29, 0), (0, -31, 1), (0, 89.9, 1), (0, -90, 1)),
        *((39, 49, 0), (39, -29, 0), (39, 51, 1), (-41, 49, 1)),
    ],
)
def test_roll_and_pitch_have_their_bounds_and_the_heading_none(
    heading: float, roll: float, pitch: float, falls: int
) -> None:
    for scale in (0.01, 1.0, 100.0):  # the length of a quaternion has no meaning
        stage = standing(FallReflex, KEYS).activate()
        stage.context.reads[:] = [*(scale * each for each in turned(heading, pitch, roll)), 0.0]
        stage.steps(10)
        assert len(stage.takeovers) == falls
