"""Tracking experiment: one run of the same motion per set-up, each evaluated from its log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
from rich.console import Console

from dxlrun import DxlrunError, Log
from dxlrun.tooling.logs import read_log
from dxlrun.tooling.output import show_parts
from dxlrun.tooling.plans import Plan
from dxlrun.tooling.records import EventCode, SchedulerGrant, Severity
from dxlrun.tooling.runs import RunOptions, run_robot
from dxlrun_lab.stress import Stress
from dxlrun_lab.tracking.desired_motion import DesiredMotion
from dxlrun_lab.tracking.motion_evaluation import SetupResult, measure_tracking
from dxlrun_lab.tracking.setups import Setup
from dxlsim import read_ledger

_INTERRUPTED = 130


@dataclass(slots=True)
class TrackingExperiment:
    """Result of the tracking experiment so far: one measurement per set-up, and failures"""

    robot: str
    period_ns: int
    """Period of the loop, ns"""
    motion: DesiredMotion
    load: str
    """Description of the load on the machine; empty without one"""
    measured: list[SetupResult] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    """Failures of runs, one sentence each"""
    interrupted: bool = False

    @property
    def exit_code(self) -> int:
        """Exit code: 0 success, 1 a run failed, 130 interrupted"""
        return _INTERRUPTED if self.interrupted else 1 if self.failures else 0


def run_experiment(
    plan: Plan, motion: DesiredMotion, setups: Sequence[Setup], stress: Stress, console: Console
) -> TrackingExperiment:
    """Run a robot's plan in each set-up under a load, and evaluate the logs. Progress is printed.

    A failed run is evaluated up to its failure, and the next set-up follows. Each run ends by the policy of
    the robot.
    """
    experiment = TrackingExperiment(plan.robot, plan.loop.period_ns, motion, stress.text)
    try:
        for number, setup in enumerate(setups, 1):
            show_parts(f"{number} of {len(setups)}: {setup.title}", console=console)
            _one(experiment, setup, plan, stress, console)
            if experiment.interrupted:
                break
    except KeyboardInterrupt:
        experiment.interrupted = True
    except DxlrunError as error:
        experiment.failures += error.sentences
    return experiment


def _one(experiment: TrackingExperiment, setup: Setup, plan: Plan, stress: Stress, console: Console) -> None:
    with stress, TemporaryDirectory(prefix="dxlrun-experiment-") as folder:
        path = Path(folder, "ledger.jsonl")
        summary = run_robot(setup.plan(plan), RunOptions(gateway=False, ledger=path), console)
        remarks = stress.ended()
        ledger = read_ledger(path) if path.is_file() else None
    experiment.interrupted = summary.exit_code == _INTERRUPTED
    if summary.log is not None:
        log = read_log(summary.log)
        found = measure_tracking(log, setup, experiment.motion, ledger, (*_refused(log), *remarks))
        if found is not None:
            experiment.measured.append(found)
    if summary.exit_code and not experiment.interrupted:
        sentences = summary.sentences or (summary.reason,)
        experiment.failures += [f"{setup.name}: {sentence}" for sentence in sentences]


def _refused(log: Log) -> list[str]:
    """Return the log's warnings about scheduler settings that were not granted, which change the set-up."""
    return [
        event.text
        for event in log.events
        if event.code == EventCode.SCHEDULER
        and event.severity >= Severity.WARNING
        and msgspec.json.decode(event.data, type=SchedulerGrant).request == "scheduler"
    ]
