"""Tracking counted slice by slice equals that over a whole log at once; and the fit of the delay."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.joints import goal_tracking as module
from dxlrun_analysis.joints.delay import DelayFit
from dxlrun_analysis.joints.goal_tracking import JointTracking, TrackingCollector, tracking

ROBOTS = Path(__file__).parents[2] / "robots"
NAMES = (
    *("invalid", "oldest_ms", "clamped", "rms_rad", "worst_rad"),
    *("lag_ms", "delay_ms", "settling_ms", "rest_rad"),
)


def in_slices(log: Log, size: int) -> tuple[JointTracking, ...]:
    collected = TrackingCollector()
    for start in range(0, len(log.cycles), size):
        collected.add_slice(replace(log, cycles=log.cycles[start : start + size]))
    return collected.evaluate_joints(log)


@pytest.fixture(scope="module")
def torso(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("torso") / "run.mcap"
    play = [ROBOTS / "motions/three_parts.yaml"]
    simulated_robot(ROBOTS / "bioloid_torso.yaml", play=play, duration_s=9.0, log=path).run()
    return read_log(path)


def changed(log: Log, seed: int) -> Log:
    """Return a log with steps of its goals, speeds that do not reach them in a cycle, and missing states."""
    chance = np.random.default_rng(seed)
    cycles = log.cycles.copy()
    count, joints = cycles["goal_position"].shape
    steps = np.repeat(chance.uniform(-1, 1, (count // 25 + 1, joints)), 25, axis=0)[:count]
    cycles["goal_position"] += np.where(chance.random(joints) < 0.5, steps, 0.0)
    cycles["goal_velocity"] = np.where(chance.random(joints) < 0.5, chance.uniform(0.2, 3.0, joints), np.nan)
    cycles["goal_position"][chance.random((count, joints)) < 0.002] = np.nan
    cycles["valid"] &= chance.random((count, joints)) > 0.02
    plan = log.attachments["plan.json"]
    if seed % 2:
        register = b'"registers":[{"name":"goal_acceleration","value":3}]'
        plan = plan.replace(b'"registers":[]', register).replace(b"AX-12A", b"MX-64")
    return replace(log, cycles=cycles, attachments={**log.attachments, "plan.json": plan})


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [1, 37, 10_000])
def test_slices_give_what_the_whole_log_gives(
    torso: Log, seed: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = changed(torso, seed) if seed else torso
    whole = tracking(log)  # shorter than a block
    assert any(joint.lag_ms is not None for joint in whole)
    monkeypatch.setattr(module, "_BLOCK", 100)
    for found, expected in zip(in_slices(log, size), whole, strict=True):
        for name in NAMES:
            value = getattr(expected, name)
            close = value if value is None else pytest.approx(value, rel=1e-9, abs=1e-12)
            assert getattr(found, name) == close, name


def test_what_rests_for_very_long_is_kept_in_bounded_memory(
    torso: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LONGEST_REST_S", 0.5)
    found = module._OpenRest()
    times = np.arange(10_000) * 0.02
    rested = []
    for start in range(0, len(times), 50):
        piece = times[start : start + 50]
        rested += list(found.find_rests(piece, np.zeros(50), np.full(50, 0.01), 1e-3, final=False))
        assert len(found.times) <= 76
    assert len(rested) > 100
    assert {rest.error_rad for rest in rested} == {0.01}


def fitted(delay_cycles: float, noise: float = 0.0, period_s: float = 0.02, size: int = 100) -> float | None:
    """The delay of a joint that follows a swing by so many cycles."""
    fit = DelayFit()
    number = np.arange(2000)
    goal = np.sin(number * 0.05)
    position = np.sin((number - delay_cycles) * 0.05)
    position += noise * np.random.default_rng(1).standard_normal(len(number))
    times = number * period_s
    for start in range(0, len(number), size):
        first = max(0, start - 2)
        part = slice(first, start + size)
        fit.add_cycles(times[part], goal[part], position[part], start - first)
    return fit.best_s(0.01)


@pytest.mark.parametrize("cycles", [1.0, 3.0, 4.5, 11.0, 20.25])
@pytest.mark.parametrize("size", [100, 2000])
def test_the_delay_is_found_to_a_tenth_of_a_cycle(cycles: float, size: int) -> None:
    assert fitted(cycles, size=size) == pytest.approx(cycles * 0.02, abs=0.002)
    assert fitted(cycles, noise=0.05, size=size) == pytest.approx(cycles * 0.02, abs=0.003)


def test_the_delay_is_refused_where_none_explains_the_difference() -> None:
    assert fitted(60.0) is None  # beyond the longest
    fit = DelayFit()
    number = np.arange(2000)
    fit.add_cycles(number * 0.02, np.sin(number * 0.05), np.full(2000, 0.3), 0)  # a joint that is blocked
    assert fit.best_s(0.01) is None
    still = DelayFit()
    still.add_cycles(number * 0.02, np.full(2000, 0.5), np.full(2000, 0.5), 0)
    assert still.best_s(0.01) is None
    assert DelayFit().best_s(0.01) is None


def test_joints_of_a_run_have_a_delay_where_they_moved(torso: Log) -> None:
    delays = {joint.name: joint.delay_ms for joint in tracking(torso)}
    assert delays["right_elbow_joint"] is not None
    assert 0 < delays["right_elbow_joint"] < 100
    assert not any(value is not None and math.isnan(value) for value in delays.values())
