"""Highest rate that a robot keeps, found by runs at decreasing rates: `dxlrun bench rate`.

The first run has nearly the rate that the buses allow by computation. After a run with overruns, the next
rate is the one that nearly all of its cycles would have kept. All processes, controllers and the recording
work as in any run, and the robot holds its position.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from rich.console import Console

from dxlrun import ProcessFault
from dxlrun.tooling.logs import read_log
from dxlrun.tooling.plans import Plan, RecordingPlan
from dxlrun.tooling.robots import Description, compile_robot
from dxlrun.tooling.runs import RunOptions, run_robot
from dxlrun_analysis.counts import median, quantile
from dxlrun_lab.late_servos import overruns_by_servos
from dxlsim import read_ledger

HIGHEST_HZ = 2000.0
MOST_TRIES = 8
ALLOWED = 0.001
"""A rate counts as kept if at most this fraction of its cycles overrun."""
_STEP = 0.95
_COMFORT = 0.98
_INTERRUPTED = 130
_LEDGER = "ledger.jsonl"

Run = Callable[[Plan], Path]
"""Function that runs a plan and returns its log. The ledger of simulated buses (times of their packets) is in
the same directory."""


class RateTrial(msgspec.Struct, frozen=True):
    """Result of a run at one loop rate"""

    rate_hz: float
    cycles: int
    overruns: int
    """Cycles that took longer than their period, so that periods were skipped"""
    by_simulation: int
    """Overruns that the simulated servos caused"""
    median_us: float
    """Median time from a cycle's deadline to its last write, us"""
    p999_us: float
    """99.9 % quantile of this time, us"""
    kept: bool
    """True if at most one cycle in a thousand overran without being delayed by simulated servos"""


class HighestRate(msgspec.Struct, frozen=True):
    """Highest rate that a robot keeps on this machine, and the runs that led to it"""

    robot: str
    computed_hz: float
    """Highest rate that the buses allow by computation, Hz"""
    kept_hz: float | None
    """Highest rate that was kept, Hz; None if there is none"""
    tries: tuple[RateTrial, ...]


def highest_rate(
    description: Description,
    seconds: float,
    run: Run,
    progress: Callable[[float], None] = lambda _: None,
) -> HighestRate:
    """Run a robot at decreasing loop rates until one is kept, at most MOST_TRIES times.

    Args:
        description: Robot file.
        seconds: Duration of each run, s.
        run: Function that runs a plan.
        progress: Called with each rate before its run.

    Raises:
        InputError: The robot file is invalid.
        ProcessFault: A run has no cycle.
    """
    plan = compile_robot(description, [], round(seconds * 1e9)).plan
    computed = 1e9 / plan.loop.least_period_ns
    rate, tries = _round(min(_COMFORT * computed, HIGHEST_HZ)), list[RateTrial]()
    while len(tries) < MOST_TRIES and rate > 0:
        progress(rate)
        tries.append(_try(plan, rate, run))
        if tries[-1].kept:
            break
        rate = _round(min(_STEP * rate, 1e6 / tries[-1].p999_us))
    kept = tries[-1].rate_hz if tries and tries[-1].kept else None
    return HighestRate(description.robot.name, round(computed, 1), kept, tuple(tries))


@contextmanager
def runs_to_discard() -> Iterator[Run]:
    """Yield a function that runs a robot in real time. Its logs are deleted at the end of the context."""
    with tempfile.TemporaryDirectory(prefix="dxlrun-bench-") as folder:

        def run(plan: Plan) -> Path:
            ledger = Path(folder, _LEDGER)
            ledger.unlink(missing_ok=True)
            options = RunOptions(gateway=False, ledger=ledger)
            summary = run_robot(replace(plan, recording=RecordingPlan(folder)), options, Console(quiet=True))
            if summary.exit_code == _INTERRUPTED:
                raise KeyboardInterrupt
            if summary.exit_code or summary.log is None:
                raise ProcessFault("\n".join(summary.sentences) or f"the run failed: {summary.reason}")
            return Path(summary.log)

        yield run


def _round(rate: float) -> float:
    return float(math.floor(rate)) if rate >= 10 else math.floor(rate * 10) / 10


def _try(plan: Plan, rate: float, run: Run) -> RateTrial:
    path = run(replace(plan, loop=replace(plan.loop, period_ns=round(1e9 / rate))))
    log = read_log(path)
    if not len(log.cycles):
        raise ProcessFault(
            f"{plan.robot} ran no cycle at {rate:g} Hz; run `dxlrun` with the robot file to see why"
        )
    seen = np.unique(log.cycles["written_ns"] - log.cycles["scheduled_ns"], return_counts=True)
    overruns = int((log.cycles["skipped"] > 0).sum())
    ledger, simulated = path.with_name(_LEDGER), 0
    if overruns and ledger.is_file():
        simulated = min(overruns, overruns_by_servos(log, read_ledger(ledger)))
    return RateTrial(
        rate_hz=rate,
        cycles=len(log.cycles),
        overruns=overruns,
        by_simulation=simulated,
        median_us=round(median(*seen) / 1e3, 1),
        p999_us=round(quantile(*seen, 0.999) / 1e3, 1),
        kept=overruns - simulated <= ALLOWED * len(log.cycles),
    )
