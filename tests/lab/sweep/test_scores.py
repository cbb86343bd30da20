"""Scores: the desired path is that of the controllers, and each figure is right where it is known."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dxlrun.compile.robot import compile_files
from dxlrun.description.motion import read_motion
from dxlrun.log.reader import read_log
from dxlrun.plan.robot_plan import Plan, to_json
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of
from dxlrun_lab.desired import DesiredPath, desired_paths, motion_samples
from dxlrun_lab.sweep.measuring import Task, measure
from dxlrun_lab.sweep.scores import CycleMemory, Scores

ROBOTS = Path(__file__).parents[3] / "robots"
STEP = ROBOTS / "motions/single_joint_step_position.yaml"
TRACKING = ROBOTS / "motions/single_joint_tracking.yaml"


def test_a_path_is_the_spline_through_its_points():
    from scipy.interpolate import BPoly, CubicHermiteSpline

    rng = np.random.default_rng(1)
    times, p, v, a = np.cumsum(rng.uniform(0.1, 0.5, 9)), *rng.normal(size=(3, 9))
    at = rng.uniform(times[0], times[-1], 200)
    of = (tuple(times), tuple(p))
    assert DesiredPath("j", False, *of, end_s=9).at(at) == pytest.approx(np.interp(at, times, p))
    cubic = DesiredPath("j", False, *of, tuple(v), end_s=9).at(at)
    assert cubic == pytest.approx(CubicHermiteSpline(times, p, v)(at))
    quintic = DesiredPath("j", False, *of, tuple(v), tuple(a), end_s=9).at(at)
    assert quintic == pytest.approx(BPoly.from_derivatives(times, np.stack([p, v, a], axis=1))(at))


def test_a_path_has_a_beginning_and_an_end():
    held = DesiredPath("j", True, (1.0, 2.0), (5.0, 6.0), end_s=3.0).at(
        np.array([0.9, 1.0, 1.9, 2.0, 3.0, 3.1])
    )
    np.testing.assert_array_equal(held, [np.nan, 5, 5, 6, 6, np.nan])
    ends = np.array([2.0, 2.5])
    np.testing.assert_array_equal(
        DesiredPath("j", False, (1.0, 2.0), (5.0, 6.0), (1.0, 0.0), end_s=3.0).at(ends), [6, 6]
    )
    moving = DesiredPath("j", False, (1.0, 2.0), (5.0, 6.0), (1.0, 1.0), end_s=3.0)
    np.testing.assert_array_equal(moving.at(ends), [6, np.nan])  # a joint that moves cannot stay


@pytest.mark.parametrize(
    ("motion", "arguments"),
    [
        (TRACKING, {"rate": "", "posvel_trajectory": "true"}),
        (STEP, {"position": "true"}),
    ],
)
def test_the_scores_are_those_of_the_log_and_the_path_that_of_the_controller(tmp_path, motion, arguments):
    given = {"position_trajectory": "false"} | {name: text for name, text in arguments.items() if text}
    short = tmp_path / "short.yaml"
    text = motion.read_text()
    short.write_text(text.replace("duration: 30 s", "duration: 2 s").replace("samples: 1000", "samples: 67"))
    robot = ROBOTS / "single_joint.yaml"
    compiled = compile_files(robot, given, [short])
    paths = desired_paths(compiled, motion_samples([read_motion(short)]))
    result = measure(Task("", to_json(compiled.plan), paths, 60.0))
    assert result.scores is not None
    run = VirtualRobot(plan_of(robot, arguments=given, play=[short]), log=tmp_path / "run.mcap")
    run.run()
    cycles = read_log(tmp_path / "run.mcap").cycles
    start = cycles["scheduled_ns"][0] - cycles["cycle"][0] * compiled.plan.loop.period_ns
    (path,) = paths
    # the controller commands at the time of the wake-up what is desired then
    woken = (cycles["woken_ns"] - start) * 1e-9
    desired, commanded = path.at(woken), cycles["command_position"][:, 0]
    both = np.isfinite(desired)
    assert both.sum() > 500
    assert commanded[both] == pytest.approx(desired[both], abs=1e-9)
    error = cycles["position"][:, 0] - path.at((cycles["read_ns"] - start) * 1e-9)
    error = error[np.isfinite(error)]
    assert result.scores.rms_rad == pytest.approx(math.sqrt(np.mean(error**2)), rel=1e-12)
    assert result.scores.worst_rad == pytest.approx(np.abs(error).max(), rel=1e-12)
    assert result.scores.cycles == run.cycles
    assert result.scores.clamped == int((cycles["clamped"] != 0).any(axis=1).sum())
    assert result.scores.goals == result.scores.goals_reached == 1


@pytest.fixture(scope="module")
def plan():
    """One MX-64 at 320 Hz."""
    return plan_of(ROBOTS / "single_joint.yaml", duration_s=1)


def scored(plan: Plan, path: DesiredPath, position: Any, servo: Any = None, lost: Any = ()) -> Scores:
    """Score a joint that is somewhere at each time; `servo` as it is all the time."""
    memory = CycleMemory(plan, [path])
    servos = [] if servo is None else [servo]
    period_ns = plan.loop.period_ns
    for cycle in range(round(path.end_s * 1e9) // period_ns):
        t_ns = cycle * period_ns
        states = SimpleNamespace(
            valid=np.array([cycle not in lost]), position=np.array([position(t_ns * 1e-9)])
        )
        record = SimpleNamespace(
            cycle=cycle, scheduled_ns=t_ns, read_ns=t_ns, skipped=0, states=states, clamped=np.zeros(1)
        )
        memory.take(record, servos)
    return memory.scores(0, 0)


def test_overshoot_and_settling_are_those_of_a_second_order_step(plan):
    """A step of 1 rad, damping ratio z: overshoot exp(-pi z / sqrt(1 - z^2)), settled at the last 2 %."""
    z, w = 0.4, 20.0
    damped = w * math.sqrt(1 - z * z)

    def step(t):
        phase = math.cos(damped * t) + z * w / damped * math.sin(damped * t)
        return 1 - math.exp(-z * w * t) * phase if t > 0 else 0.0

    found = scored(plan, DesiredPath("joint", True, (0.5,), (1.0,), end_s=3.0), lambda t: step(t - 0.5))
    assert found.overshoot_rad == pytest.approx(math.exp(-math.pi * z / math.sqrt(1 - z * z)), rel=0.01)
    outside = max(t for t in np.arange(0, 2.5, 1e-4) if abs(step(float(t)) - 1) > 0.02)
    assert found.settling_s == pytest.approx(outside, abs=2 * plan.loop.period_ns * 1e-9)
    down = scored(plan, DesiredPath("joint", True, (0.5,), (-1.0,), end_s=3.0), lambda t: -step(t - 0.5))
    assert (down.overshoot_rad, down.settling_s) == (found.overshoot_rad, found.settling_s)
    slow = scored(
        plan,
        DesiredPath("joint", True, (0.5,), (1.0,), end_s=3.0),
        lambda t: 1 - math.exp(-max(0, t - 0.5) * 4),
    )
    assert slow.overshoot_rad == 0.0


def test_errors_leave_out_what_was_not_read(plan):
    path = DesiredPath("joint", True, (0.0,), (0.0,), end_s=1.0)
    found = scored(plan, path, lambda t: 0.1 if t < 0.5 else -0.3)
    assert found.rms_rad == pytest.approx(math.sqrt((0.1**2 + 0.3**2) / 2))
    assert (found.worst_rad, found.worst_joint) == (pytest.approx(0.3), "joint")
    half = scored(plan, path, lambda t: 0.1 if t < 0.5 else -0.3, lost=range(160, 320))
    assert (half.rms_rad, half.worst_rad) == (pytest.approx(0.1), pytest.approx(0.1))
    none = scored(plan, path, lambda t: 0.1, lost=range(320))
    assert (none.rms_rad, none.worst_rad, none.worst_joint, none.settling_s) == (None, None, "", None)


def test_energy_is_what_the_motors_draw(plan):
    path = DesiredPath("joint", True, (0.0,), (0.0,), end_s=2.0)

    def servo(duty, current):
        return SimpleNamespace(
            voltage=12.0, temperature=41.5, shaft=SimpleNamespace(duty=duty, current=current)
        )

    drives = scored(plan, path, lambda t: 0.0, servo(-0.5, -0.8))
    assert drives.energy_j == pytest.approx(12 * 0.5 * 0.8 * 2, rel=0.01)
    assert drives.temperature_c == 41.5
    assert scored(plan, path, lambda t: 0.0, servo(0.5, -0.8)).energy_j == 0.0  # it brakes
