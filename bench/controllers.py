"""How long update() of each standard controller takes with 20 joints, in motion.

    python bench/controllers.py [--updates 5000] [--joints 20]

Prints the median and the 99th percentile in us: of update() alone, without gathering and gate, with states
that change each time. Processor time: on a busy machine the percentile of the time that passes is that of the
other programs. The bound is a median of 60 us.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.laws import Case, cases

PERIOD_NS = 1_000_000


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


if __name__ == "__main__":
    main()
