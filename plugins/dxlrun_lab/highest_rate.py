"""The highest rate that a robot keeps, found by running it at one rate after another: `dxlrun bench rate`.

The first run has nearly the rate that the buses allow by computation. A run that overran is followed by one
at the rate that nearly all its cycles would have kept. Everything is as in a run: all processes, the
controllers, each in its share of the cycles, and the recording; the robot holds its position.
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
"""Share of cycles that may overrun: one in a thousand."""
_STEP = 0.95
_COMFORT = 0.98
_INTERRUPTED = 130
_LEDGER = "ledger.jsonl"

Run = Callable[[Plan], Path]
"""Runs a plan and returns its log; the ledger of simulated buses lies beside it."""


class Tried(msgspec.Struct, frozen=True):
    """One run."""

    rate_hz: float
    cycles: int
    overruns: int
    by_simulation: int
    """Of them, those that the simulated servos caused."""
    median_us: float
    """From a cycle's deadline to its last write."""
    p999_us: float
    kept: bool
    """At most one cycle in a thousand overran by the robot's own fault."""


class HighestRate(msgspec.Struct, frozen=True):
    """The rate that a robot keeps on this machine, and the runs that led to it."""

    robot: str
    computed_hz: float
    """What the buses allow when they do nothing else."""
    kept_hz: float | None
    """None: no rate that was tried was kept."""
    tries: tuple[Tried, ...]


def highest_rate(
    description: Description,
    seconds: float,
    run: Run,
    progress: Callable[[float], None] = lambda _: None,
) -> HighestRate:
    """Run a robot at falling rates, each for some seconds, until one is kept.

    `progress` is called with each rate before its run.
    Raises InputError when the robot file cannot be compiled, ProcessFault when a run left no cycle.
    """
    plan = compile_robot(description, [], round(seconds * 1e9)).plan
    computed = 1e9 / plan.loop.least_period_ns
    rate, tries = _round(min(_COMFORT * computed, HIGHEST_HZ)), list[Tried]()
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
    """Give runs of a robot with all its processes, in real time; their logs last until the context ends."""
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


def _try(plan: Plan, rate: float, run: Run) -> Tried:
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
    return Tried(
        rate_hz=rate,
        cycles=len(log.cycles),
        overruns=overruns,
        by_simulation=simulated,
        median_us=round(median(*seen) / 1e3, 1),
        p999_us=round(quantile(*seen, 0.999) / 1e3, 1),
        kept=overruns - simulated <= ALLOWED * len(log.cycles),
    )
