"""How fast the torso runs on virtual time, physics, log and ledger included, and whether two runs are one.

    python tests/bench/virtual_time.py [--seconds 600] [--twice] [--profile]

The bound: ten minutes at 50 Hz in less than 60 s of one core. `--twice` runs it again and compares the logs.
"""

from __future__ import annotations

import argparse
import cProfile
import hashlib
import os
import pstats
import resource
import tempfile
import time
from pathlib import Path

from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.simulation import Ledger
from dxlrun.testing import plan_of

ROBOTS = Path(__file__).parents[2] / "robots"


def run(seconds: float, log: Path) -> tuple[float, float, int]:
    """Return wall time, processor time (s) and cycles of one run; the thesis' motions are its first 36 s."""
    plan = plan_of(
        ROBOTS / "bioloid_torso.yaml", play=[ROBOTS / "motions/three_parts.yaml"], duration_s=seconds
    )
    with Ledger(log.with_suffix(".ledger.jsonl"), keep=False) as ledger:
        robot = VirtualRobot(plan, log=log, ledger=ledger)
        wall, processor = time.perf_counter(), time.process_time()
        result = robot.run()
        return time.perf_counter() - wall, time.process_time() - processor, result.cycles


def main() -> None:
    """Run, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="of virtual time")
    parser.add_argument("--twice", action="store_true")
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core, whatever libraries would like
    with tempfile.TemporaryDirectory() as directory:
        logs = [Path(directory) / f"{number}.mcap" for number in range(2 if options.twice else 1)]
        for log in logs:
            profile = cProfile.Profile()
            if options.profile:
                profile.enable()
            wall, processor, cycles = run(options.seconds, log)
            profile.disable()
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
            print(
                f"{options.seconds:g} s of virtual time, {cycles} cycles: {wall:.1f} s, {processor:.1f} s of "
                f"the processor, {processor / cycles * 1e3:.2f} ms a cycle; log of "
                f"{log.stat().st_size >> 20} MiB, most memory {memory} MiB"
            )
            if options.profile:
                pstats.Stats(profile).sort_stats("tottime").print_stats(30)
        hashes = {hashlib.sha256(log.read_bytes()).hexdigest() for log in logs}
        if options.twice:
            print("the logs are identical" if len(hashes) == 1 else "THE LOGS DIFFER")
        for name in sorted(hashes):
            print(f"sha256 {name}")


if __name__ == "__main__":
    main()
