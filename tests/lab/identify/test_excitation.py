"""The excitation stays within range and limits, and says what is too small for it."""

import math

import numpy as np
import pytest

from dxlrun.errors import InputError
from dxlrun_lab.identify.excitation import Room, excitation


@pytest.mark.parametrize("rate", [50, 320])
@pytest.mark.parametrize("acceleration", [math.inf, 100.0, 5.0])
@pytest.mark.parametrize("velocity", [math.inf, 4.0, 0.5])
@pytest.mark.parametrize(("middle", "half", "at"), [(0.0, 0.5, 0.0), (-1.5, 2.0, 0.9), (0.3, 0.1, -1.0)])
def test_goals_stay_within_range_and_limits(  # noqa: PLR0917  of pytest
    middle, half, at, velocity, acceleration, rate
):
    room = Room(middle - half, middle + half, velocity, acceleration)
    parts = excitation(room, 20.0, 1 / rate, start=middle + at * half, seed=3)
    for part in parts:
        goals = part.goals
        assert goals.min() >= room.lower - 1e-9
        assert goals.max() <= room.upper + 1e-9
        speeds = np.abs(np.diff(goals)) * rate
        if velocity < math.inf:
            assert speeds.max(initial=0.0) <= 1.02 * velocity
        # goals in a grid of time change their speed a little more than the way between them
        if acceleration < math.inf and len(goals) > 2:
            change = np.abs(np.diff(goals, 2)) * rate**2
            assert np.percentile(change, 99) <= 1.3 * acceleration
    assert sum(len(part.goals) for part in parts[2:]) / rate == pytest.approx(14.0, abs=0.1)
    assert abs(parts[0].goals[0] - (middle + at * half)) < 1e-9


def test_what_is_too_small():
    with pytest.raises(InputError, match=r"5 s are too short .* --duration 10"):
        excitation(Room(-1, 1), 5.0, 0.01, start=0.0)
    with pytest.raises(InputError, match="is too small to identify"):
        excitation(Room(-0.05, 0.05), 60.0, 0.01, start=0.0)
