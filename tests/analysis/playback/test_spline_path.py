"""The path of a recorded motion: within the tolerance everywhere, without noise."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dxlrun import ROTARY
from dxlrun_analysis.playback.recorded_motion import RecordedMotion, Series
from dxlrun_analysis.playback.spline_path import STATE_TOLERANCE, fit


def motion(times: np.ndarray, *columns: np.ndarray) -> RecordedMotion:
    names = tuple(f"j{index}" for index in range(len(columns)))
    return RecordedMotion(
        Path("a.mcap"),
        names,
        ("states",) * len(names),
        times,
        np.stack(columns, 1),
        0.0,
        (ROTARY,) * len(names),
    )


def test_of_several_positions_at_one_time_the_last_counts():
    series = Series(np.array([2.0, 1.0, 1.0, 0.0]), np.array([4.0, 1.0, 2.0, 3.0]), "states").ordered()
    assert (series.time_s.tolist(), series.position.tolist()) == ([0.0, 1.0, 2.0], [3.0, 2.0, 4.0])


numbers = st.floats(-3, 3, allow_nan=False)


@given(
    st.lists(st.tuples(st.floats(1e-3, 0.5), numbers, numbers), min_size=2, max_size=60), st.floats(1e-3, 0.2)
)
def test_it_is_within_the_tolerance(moments, tolerance):
    widths, first, second = (np.array(column) for column in zip(*moments, strict=True))
    times = np.cumsum(widths) - widths[0]
    path = fit(motion(times, first, second), np.array([tolerance, 2 * tolerance]))
    recorded = np.stack([first, second], axis=1)
    assert (np.abs(path.positions_at(times) - recorded).max(axis=0) <= (tolerance, 2 * tolerance)).all()
    # between two moments it goes no farther than half the tolerance beyond both, here of the larger one
    dense = np.linspace(0.0, times[-1], 2000)
    assert path.positions_at(dense).max() <= recorded.max() + 2 * tolerance
    assert path.positions_at(dense).min() >= recorded.min() - 2 * tolerance


def test_noise_below_the_tolerance_disappears():
    """An AX-12A measures in steps of 0.29 deg: between two cycles that looks like 0.26 rad/s, or nothing."""
    times = np.arange(0.0, 10.0, 0.02)
    tick = np.radians(300 / 1023)
    true = 0.8 * np.sin(times)
    path = fit(motion(times, np.round(true / tick) * tick), np.array([STATE_TOLERANCE]))
    assert len(path.time_s) < 60
    played, measured = path.positions_at(times)[:, 0], np.round(true / tick) * tick
    worst = [np.abs(np.diff(each, 2)).max() / 0.02**2 for each in (played, measured)]
    assert worst[1] > 12  # rad/s^2
    assert worst[0] < 4


def test_a_step_is_not_swung_beyond():
    times = np.arange(0.0, 1.0, 0.01)
    step = np.where(times < 0.5, 0.0, 1.0)
    path = fit(motion(times, step), np.array([0.002]))
    dense = path.positions_at(np.linspace(0, times[-1], 5000))
    assert dense.min() == pytest.approx(0.0, abs=0.002)
    assert dense.max() == pytest.approx(1.0, abs=0.002)
