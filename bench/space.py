"""cartesian_controller: cost of a cycle, time until a pose is refused, and deviation from a straight line.

    python bench/space.py [--updates 3000] [--poses 200]

Costs are processor time of update() with six joints at 100 and 500 Hz: while it plans lines, plays them, and
follows twists. Times of searches and of lines are cycles of planning at 100 Hz. Searched are poses out of
reach, and tips turned over, which few arms can reach. Deviations are those of the measured tip of a simulated
OpenMANIPULATOR-X on lines of 20 cm.
"""

from __future__ import annotations

import argparse
import gc
import random
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.judged_arms import Arm, arms, as_pose
from tests.kit.stages import Stage

from dxlrun import RemoteRobot
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlrun_space.cartesian_controller import MOST_STEPS, STEP_NS, CartesianController
from dxlrun_space.path import MotionLimits, NoPath, plan_line

ROBOT = Path(__file__).parents[1] / "robots/open_manipulator_x_space.yaml"
EXAMPLES = ("open_manipulator_x", "koch", "op3", "six")
LINES = (
    ((0.2, -0.1, 0.15), {"dy": 0.2}),
    ((0.12, 0.0, 0.1), {"dz": 0.2}),
    ((0.1, 0.05, 0.2), {"dx": 0.2}),
)
READY = (0.2, -0.4, 0.8, 0.3, 0.6, -0.2)


def percentiles(values: list[float], unit: str) -> str:
    """Return median, 99th percentile and maximum as text."""
    return "  ".join(
        f"{name} {value:7.1f} {unit}"
        for name, value in zip(("50 %", "99 %", "most"), np.percentile(values, (50, 99, 100)), strict=True)
    )


def costs_us(arm: Arm, rate: int, updates: int) -> Iterator[tuple[str, list[float]]]:
    """Yield what the controller does, and the cost of each update, us."""
    limits = {"lower": arm.lower, "upper": arm.upper, "velocity": 4.0, "acceleration": 20.0}
    keys = {"joints": list(arm.joints), "tip": arm.tip, "base": arm.base}
    chance = random.Random(1)
    stage = Stage(CartesianController, keys, READY, limits, urdf=arm.urdf, period_s=1 / rate).activate()
    found: dict[str, list[float]] = {"plans": [], "plays": [], "twists": []}
    for name, taken in found.items():
        while len(taken) < updates:
            stage.states.position[:] = stage.commands.position
            if name == "twists":
                stage.give("twist", **{axis: chance.uniform(-0.2, 0.2) for axis in ("vx", "vy", "vz", "wz")})
            elif not stage.goals or stage.goal.outcome is not None or stage.goal.is_judged:
                stage.send(None, "pose", **{axis: chance.uniform(-0.2, 0.4) for axis in "xyz"})
            before = stage.commands.position.copy()
            begun = time.thread_time_ns()
            stage.step()
            spent = (time.thread_time_ns() - begun) * 1e-3
            if name == "twists" or (name == "plays") == bool((stage.commands.position != before).any()):
                taken.append(spent)
        yield name, taken


def refusals_ms(arm: Arm, poses: int, *, turned: bool) -> list[float]:
    """Return how long poses out of reach are searched for at 100 Hz, ms."""
    chance, dice, taken = random.Random(2), np.random.default_rng(2), []
    steps = min(MOST_STEPS, 10_000_000 // STEP_NS)
    for _ in range(poses):
        goal, way = arm.matrix(arm.drawn(chance)), dice.normal(size=3)
        if turned:
            goal[:3, :3] = goal[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
        else:
            goal[:3, 3] += way / np.linalg.norm(way) * arm.chain.length * 2
        search = arm.solver.search(as_pose(goal), arm.drawn(chance), exact=True)
        taken.append(sum(1 for _ in search) / steps * 10)
    return taken


def lines_ms(arm: Arm, poses: int) -> list[float]:
    """Return how long lines to poses near the start are planned at 100 Hz, ms, with those that end early."""
    chance, dice, taken = random.Random(3), np.random.default_rng(3), []
    count, steps = len(arm.joints), min(MOST_STEPS, 10_000_000 // STEP_NS)
    limits = MotionLimits((0.2, 1.5, *(4.0,) * count), (0.5, 6.0, *(20.0,) * count))
    for _ in range(poses):
        start, way = arm.drawn(chance, 0.6), dice.normal(size=3)
        goal = arm.matrix(start)
        goal[:3, 3] += 0.5 * chance.random() * arm.chain.length * way / np.linalg.norm(way)
        planned = 0
        with suppress(NoPath):
            for _ in plan_line(arm.solver, start, as_pose(goal), limits, exact=arm.exact):
                planned += 1
        taken.append(planned / steps * 10)
    return taken


def deviations_mm() -> Iterator[tuple[str, float, float]]:
    """Yield a line of 20 cm with the deviation of the commanded and of the measured tip, mm."""
    arm = arms()["open_manipulator_x"]
    for start, way in LINES:
        link = VirtualLink(plan_of(ROBOT))
        robot = RemoteRobot("arm", link)
        for goal in (dict(zip("xyz", start, strict=True)) | {"path": "joints"}, way):
            link.new()
            robot.send("arm", "pose", goal)
            for _ in range(500):
                link.run_cycle()
            cycles, _ = link.new()
        found = []
        for name in ("goal_position", "position"):
            tips = np.array([arm.matrix(row[: len(arm.joints)])[:3, 3] for row in cycles[name]])
            line = np.array([way.get(f"d{axis}", 0.0) for axis in "xyz"]) / 0.2
            off = tips - tips[0]
            found.append(float(np.linalg.norm(off - np.outer(off @ line, line), axis=1).max() * 1e3))
        status = robot.goals()[-1].status
        yield f"{start} {way} {status}", found[0], found[1]


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--poses", type=int, default=200)
    options = parser.parse_args()
    known = arms()
    gc.disable()  # as in the loop
    for rate in (100, 500):
        for name, taken in costs_us(known["six"], rate, options.updates):
            print(f"{rate} Hz, six joints, {name:8} {percentiles(taken, 'us')}")
    for name in EXAMPLES:
        for turned in (False, True):
            what = "orientation" if turned else "position"
            taken = refusals_ms(known[name], options.poses, turned=turned)
            print(f"{name:20} {what:12} searched in {percentiles(taken, 'ms')}")
        print(f"{name:20} {'line':12} planned in  {percentiles(lines_ms(known[name], options.poses), 'ms')}")
    for text, commanded, measured in deviations_mm():
        print(f"20 cm from {text}: commanded {commanded:.2f} mm off, measured {measured:.2f} mm off")


if __name__ == "__main__":
    main()
