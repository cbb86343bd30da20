"""`dxlrun analyze LOG`: say what happened in a run."""

from __future__ import annotations

from pathlib import Path

from dxlrun.cli.flags import Flag, JsonFlag
from dxlrun.cli.terminal import out
from dxlrun.errors import InputError


def analyze(log: Path, /, *, as_json: JsonFlag = False, debug: Flag = False) -> int:
    """Analyze a log: wake-up latency, duration of each step, skipped periods, packets and errors per servo.

    Parameters
    ----------
    log
        The log of a run, an .mcap file.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    if not log.is_file():
        raise InputError(f"there is no log {log}; a run says at its end where its log is")
    from dxlrun.analysis.report import analyze_log, to_json
    from dxlrun.analysis.terminal import render

    report = analyze_log(log)
    console = out()
    if as_json:
        console.file.write(to_json(report).decode() + "\n")
    else:
        console.print(render(report))
    return 0
