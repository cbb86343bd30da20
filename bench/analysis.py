"""Analysis: processor time of `dxlrun analyze` on a log, as a multiple of a plain pass over the same columns.

    python bench/analysis.py [LOG] [--cycles 100000] [--rounds 5]

Without LOG, a log of robots/humanoid_20.yaml is made on virtual time, with the squat all the time. A plain
pass reads the log, and computes minimum, maximum and sum of each column of its cycles and packets. Both take
turns; the ratio is the median of all rounds. The last table is where the time of the analysis goes: what the
log's reader and each accumulator take during the pass, and the rules afterwards.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import yaml
from numpy.typing import NDArray

from dxlrun import Log, open_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.report import analyze
from dxlrun_analysis.tally import Tally

ROBOTS = Path(__file__).parents[1] / "robots"
ROBOT, MOTION = ROBOTS / "humanoid_20.yaml", ROBOTS / "motions" / "humanoid_20_squat.yaml"
SQUAT_S, SQUATS = (
    2,
    100,
)  # Duration of a squat; squats of one motion file, which has a limited number of targets
PAUSE_S = 5  # Joints settle before the next file
RATE_HZ = 1000


def record(folder: Path, cycles: int) -> Path:
    """Record a run of the humanoid that squats all the time, and return its log."""
    squat, motions, log = yaml.safe_load(MOTION.read_text())["motions"], [], folder / "humanoid.mcap"
    longer = {"duration": f"{SQUATS * SQUAT_S} s", "samples": 100 * SQUATS}
    for start_s in range(0, -(-cycles // RATE_HZ), PAUSE_S + SQUATS * SQUAT_S):
        parts = [{**one, "start": f"{start_s} s"} | (longer if "samples" in one else {}) for one in squat]
        motions.append(folder / f"from_{start_s}_s.yaml")
        motions[-1].write_text(yaml.safe_dump({"name": motions[-1].stem, "motions": parts}))
    simulated_robot(ROBOT, play=motions, duration_s=cycles / RATE_HZ, log=log).run()
    return log


def columns(log: Log) -> Iterator[NDArray[np.generic]]:
    """Yield the columns of a slice: fields of the cycles, and of the packets."""
    yield from (log.cycles[name] for name in log.cycles.dtype.names or ())
    yield from (getattr(log.packets, one.name) for one in fields(log.packets))


def plain_pass(path: Path) -> None:
    """Read a log; compute minimum, maximum and sum of each column."""
    for log in open_log(path).slices():
        for column in columns(log):
            if column.size:
                column.min(), column.max(), column.sum()


def spent_s(work: Callable[[], object]) -> float:
    """Return the processor time of a call, s."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def stages(path: Path) -> dict[str, float]:
    """Analyze a log once more; return the processor time of each stage, s."""
    found: dict[str, float] = defaultdict(float)

    def timed(name: str, method: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object) -> object:
            begun = time.process_time()
            result = method(*arguments)
            found[name] += time.process_time() - begun
            return result

        return call

    tally = analyze(open_log(path)).tally
    with ExitStack() as patches:
        for kind in map(type, tally._collectors.values()):
            patch = mock.patch.object(kind, "add_slice", timed(kind.__name__, kind.add_slice))
            patches.enter_context(patch)
        patches.enter_context(mock.patch.object(Tally, "totals", timed("rules", Tally.totals)))
        whole = spent_s(lambda: analyze(open_log(path)))
    found["reading, and the rest"] = whole - sum(found.values())
    return found


def main() -> None:
    """Print the times of analysis and plain pass, their ratio, and the shares of the stages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path, nargs="?")
    parser.add_argument("--cycles", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        path = options.log or record(Path(folder), options.cycles)
        rounds = []
        for _ in range(options.rounds):
            rounds.append((spent_s(lambda: analyze(open_log(path))), spent_s(lambda: plain_pass(path))))
        analysis, plain = map(statistics.median, zip(*rounds, strict=True))
        ratio = statistics.median(one / other for one, other in rounds)
        print(f"analysis {analysis:.2f} s, plain pass {plain:.2f} s, ratio {ratio:.2f}")
        found = stages(path)
        for name, seconds in sorted(found.items(), key=lambda item: -item[1]):
            print(f"  {name:24} {seconds:6.2f} s {seconds / sum(found.values()):6.1%}")


if __name__ == "__main__":
    main()
