"""How long update() of each standard controller takes with 20 joints, in motion, and the update of a robot.

    python bench/controllers.py [--updates 5000] [--joints 20]

Prints the median and the 99th percentile in us: of update() alone, without gathering and gate, with states
that change each time. Processor time: on a busy machine the percentile of the time that passes is that of the
other programs. The bound is a median of 60 us.

The last line is robots/humanoid_20.yaml at 1 kHz in its squat on virtual time: all that the loop does between
reading and writing, which are monitors, commands, five group controllers with their goals, and the gate. The
bound is a median of 80 us.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

from dxlrun.control.gate import Gate
from dxlrun.control.loop import ControlLoop
from dxlrun.testing import simulated_robot

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.laws import Case, cases

PERIOD_NS = 1_000_000
ROBOTS = Path(__file__).parents[1] / "robots"
ROBOT, MOTION = ROBOTS / "humanoid_20.yaml", ROBOTS / "motions" / "humanoid_20_squat.yaml"
WARM_UP = 500
"""Cycles of the robot that are not counted."""


def median_us(case: Case, updates: int) -> tuple[float, float]:
    """Return median and 99th percentile of update(), us; its last command comes every 0.1 s."""
    stage = case.stage(period_s=PERIOD_NS * 1e-9).activate()
    controller, states, references = stage.controller, stage.states, stage.context.references
    stage.context.reads[:] = 1e-3  # ages among them: all is fresh
    taken = []
    noise = np.random.default_rng(1).normal(scale=0.01, size=(64, 3, len(stage.context.joints)))
    for index in range(1, updates + 1):
        stage.time_ns = index * PERIOD_NS
        if case.asks and index % 100 == 1:
            kind, command = case.asks[-1]
            stage.send(None, kind, **command)
        states.motion[:] = noise[index % 64]
        if stage.interfaces.reference:
            references.position[:] = np.sin(stage.time_ns * 1e-9)
            references.velocity[:] = np.cos(stage.time_ns * 1e-9)
        begun = time.thread_time_ns()
        controller.update(stage.time_ns, PERIOD_NS)
        taken.append(time.thread_time_ns() - begun)
    return statistics.median(taken) * 1e-3, float(np.percentile(taken, 99)) * 1e-3


def robot_us(cycles: int) -> tuple[float, float]:
    """Return median and 99th percentile of a whole robot's update, us."""
    robot = simulated_robot(ROBOT, play=[MOTION], duration_s=(WARM_UP + cycles) * PERIOD_NS * 1e-9)
    taken: list[int] = []

    def timed(work: Callable[..., None], *, last: bool) -> Callable[..., None]:
        def call(*arguments: object) -> None:
            begun = time.thread_time_ns()
            work(*arguments)
            passed = time.thread_time_ns() - begun
            if last:
                taken[-1] += passed
            else:
                taken.append(passed)

        return call

    with (
        mock.patch.object(ControlLoop, "_update", timed(ControlLoop._update, last=False)),
        mock.patch.object(Gate, "move_goals", timed(Gate.move_goals, last=True)),
    ):
        robot.run()
    counted = taken[WARM_UP : WARM_UP + cycles]
    return statistics.median(counted) * 1e-3, float(np.percentile(counted, 99)) * 1e-3


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=5000)
    parser.add_argument("--joints", type=int, default=20)
    options = parser.parse_args()
    gc.disable()  # as in the loop
    for case in cases(tuple(f"j{index}" for index in range(options.joints))):
        median, late = median_us(case, options.updates)
        print(f"{case.name:40} {median:6.1f} us median {late:7.1f} us 99 %")
    median, late = robot_us(min(options.updates, 2500))
    print(f"{'humanoid_20, whole update':40} {median:6.1f} us median {late:7.1f} us 99 %")


if __name__ == "__main__":
    main()
