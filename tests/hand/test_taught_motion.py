"""Recordings of a hand: trimmed, smoothed, slowed, and joined with poses."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dxlrun import ROTARY
from dxlrun_hand.taught_motion import TaughtJoints, TaughtMotion


def motion_of(seconds: float, position: Callable[[np.ndarray], np.ndarray]) -> TaughtMotion:
    """Return a recording of two joints, at 50 Hz."""
    time = np.arange(0.0, seconds, 0.02)
    return TaughtMotion(time, np.stack([position(time), np.zeros_like(time)], axis=1))


def two(speed: float = math.inf, way_speed: float = 1.0) -> TaughtJoints:
    ends = np.array([-1.0, -1.0])
    return TaughtJoints(("a", "b"), (ROTARY, ROTARY), ends, -ends, np.array([speed, math.inf]), way_speed)


def test_standstill_is_cut_off_at_both_ends() -> None:
    kept = two().trimmed(motion_of(10.0, lambda t: np.clip(t - 4.0, 0.0, 1.0)))
    assert kept.time_s[-1] == pytest.approx(1.4, abs=0.05)
    assert (kept.position[0, 0], kept.position[-1, 0]) == (0.0, 1.0)
    still = two().trimmed(motion_of(3.0, lambda t: 0.01 * np.sin(t)))
    assert still.time_s.tolist() == [0.0]


def test_trembling_is_taken_out_and_the_motion_stays() -> None:
    shown = motion_of(4.0, lambda t: 0.5 * np.sin(t) + 0.02 * np.sin(2 * np.pi * 10 * t))
    smooth = two().smoothed(shown)
    off = np.abs(smooth.position[:, 0] - 0.5 * np.sin(smooth.time_s))
    assert off[20:-20].max() < 0.004


def test_a_motion_that_is_too_fast_takes_longer() -> None:
    motion = two().joined([motion_of(1.0, lambda t: 0.9 * np.sin(6 * t))], Path("m.yaml"))
    slowed, longer = two(speed=2.0).slowed(motion)
    assert longer > 2.5
    assert np.abs(np.diff(slowed.position[:, 0]) / np.diff(slowed.time_s)).max() < 2.0
    assert two(speed=9.0).slowed(motion)[1] == 1.0


def test_the_way_between_poses_is_as_fast_as_it_is_to_be() -> None:
    poses = [TaughtMotion(np.zeros(1), np.array([[angle, 0.0]])) for angle in (0.0, 0.8, 1.4)]
    motion = two(way_speed=0.4).joined(poses, Path("m.yaml"))
    assert motion.time_s.tolist() == pytest.approx([0.0, 0.2, 2.2, 2.7, 2.9])
    assert motion.position[:, 0].tolist() == [0.0, 0.0, 0.8, 1.0, 1.0]
    assert two().beyond(poses) == ["a"]
