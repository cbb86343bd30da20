"""`dxlrun analyze LOG`: say what happened in a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dxlrun.cli.terminal import out
from dxlrun.errors import InputError


def analyze(log: Path, /, *, as_json: Annotated[bool, Parameter(name="--json", negative=())] = False) -> int:
    """Analyze a log: wake-up latency, duration of each step, skipped periods, packets and errors per servo.

    Parameters
    ----------
    log
        The log of a run, an .mcap file.
    as_json
        Print the result as JSON.
    """
    if not log.is_file():
        raise InputError(f"there is no log {log}; a run says at its end where its log is")
    raise NotImplementedError
