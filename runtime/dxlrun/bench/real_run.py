"""Runs of a robot with all its processes, whose logs are thrown away afterwards."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from dxlrun.bench.rate import Run
from dxlrun.compile.plan import Plan
from dxlrun.errors import ProcessFault
from dxlrun.run.run_summary import RunOptions
from dxlrun.run.supervisor import run_robot

_INTERRUPTED = 130


@contextmanager
def runs() -> Iterator[Run]:
    """Give what runs a plan and returns its log, which lasts until the end of the context."""
    with tempfile.TemporaryDirectory(prefix="dxlrun-bench-") as folder:

        def run(plan: Plan) -> Path:
            summary = run_robot(
                replace(plan, recording_directory=folder), RunOptions(gateway=False), Console(quiet=True)
            )
            if summary.exit_code == _INTERRUPTED:
                raise KeyboardInterrupt
            if summary.exit_code or summary.log is None:
                raise ProcessFault("\n".join(summary.sentences) or f"the run failed: {summary.reason}")
            return Path(summary.log)

        yield run
