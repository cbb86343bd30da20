"""Runs without a fault on simulated buses in real time while the machine is busy: is anything accused?

    python -m bench.fault_free [--runs 60] [--seconds 5]

Three robots take turns, and so do four loads: none, a compile job in a loop, a program that keeps the core of
the loop busy, and both. Prints the verdict on each run, and a table; ends with 1 if a servo, a cable or an
adapter was accused in any.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.analysis.verdicts.cases import HARDWARE, Case
from tests.analysis.verdicts.live import Run, compile_jobs, compiling, hog_on_the_core_of_the_loop
from tests.analysis.verdicts.rig import ROBOTS, Story

NAMES = ("mx_two", "ax_single", "x_three")


def idle(run: Run) -> str:
    """Leave the machine to the run."""
    run.wait(120)
    return "idle"


def compile_job(run: Run) -> str:
    """Compile beside it."""
    return compile_jobs(run, 1)


def both(run: Run) -> str:
    """Compile, and keep the loop's core busy."""
    with compiling(1):
        return hog_on_the_core_of_the_loop(run)


LOADS: dict[str, Callable[[Run], str]] = {
    "idle": idle,
    "compile job": compile_job,
    "pinned hog": hog_on_the_core_of_the_loop,
    "both": both,
}


def main() -> int:
    """Run them; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=5.0, help="of motion in each")
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    # three robots and four loads: each pair comes once in twelve runs
    turns = zip(range(options.runs), itertools.cycle(NAMES), itertools.cycle(LOADS), strict=False)
    for number, name, load in turns:
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as directory:
            story = Story(ROBOTS[name], f"fault free {number}", Path(directory))
            story.duration_s = options.seconds + 2
            story.motion = story.swing()
            story.disturb = LOADS[load]
            found = Case(load, (name,), spared=HARDWARE).compare(ROBOTS[name], story.run())
        counts[load, "runs"] += 1
        counts[load, "good"] += found.verdict.good
        counts[load, "accused"] += bool(found.accused)
        accused = f"; ACCUSED: {', '.join(found.accused)}" if found.accused else ""
        print(f"{number + 1} {name}, {load}: {found.verdict.word}{accused}", end=" ")
        print(f"[{time.monotonic() - began:.0f} s]", flush=True)
        for sentence in found.verdict.sentences[:2]:
            print(f"    {sentence}")
        for finding in found.verdict.findings if found.accused else ():
            print(f"    {finding.rank!r} {finding.subject!r}: {finding.sentence} -> {finding.remedy}")
    print(f"{'load':12} {'runs':>5} {'good':>5} {'accused':>8}")
    for load in LOADS:
        print(f"{load:12} {counts[load, 'runs']:5} {counts[load, 'good']:5} {counts[load, 'accused']:8}")
    return int(any(counts[load, "accused"] for load in LOADS))


if __name__ == "__main__":
    raise SystemExit(main())
