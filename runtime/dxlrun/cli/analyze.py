"""`dxlrun analyze LOG`: say what happened in a run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.cli.flags import Flag, JsonFlag
from dxlrun.cli.terminal import out
from dxlrun.errors import InputError, LogError

if TYPE_CHECKING:
    from dxlrun.analysis.report import Report
    from dxlrun.recording.reader import Log


def analyze(
    log: Path,
    /,
    *,
    report: Path | None = None,
    ledger: Path | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Analyze a log: wake-up latency, duration of each step, skipped periods, packets and errors per servo.

    Parameters
    ----------
    log
        The log of a run, an .mcap file.
    report
        Also write a page with all numbers and plots to this file, such as report.html; it loads nothing
        from anywhere, and prints well. Needs matplotlib: `pip install 'dxlrun[report]'`.
    ledger
        Compare the log with the ledger of the simulated buses instead, byte by byte; the exit code is 1
        when they differ, 2 when one of them cannot be read.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    if not log.is_file():
        raise InputError(f"there is no log {log}; a run says at its end where its log is")
    if report is not None:
        _check_target(report)
    if ledger is not None:
        if report is not None:
            raise InputError("a report does not hold a comparison; give --report and --ledger one at a time")
        return _compare(log, ledger, as_json=as_json)
    from dxlrun.analysis import report as analysis
    from dxlrun.analysis.terminal import render
    from dxlrun.recording.reader import read_log

    read = read_log(log)
    result = analysis.analyze(read)
    if report is not None:
        _write(read, result, report)
    console = out()
    if as_json:
        console.file.write(analysis.to_json(result).decode() + "\n")
        return 0
    console.print(render(result))
    if report is not None:
        console.print(f"\nreport: {report}", markup=False, soft_wrap=True)
    return 0


def _compare(log: Path, ledger: Path, *, as_json: bool) -> int:
    """Say where a log and a ledger differ; return 1 when they do."""
    if not ledger.is_file():
        raise InputError(
            f"there is no ledger {ledger}; a run on simulated buses in real time leaves one beside its log, "
            f"here {log.with_suffix('.ledger.jsonl')}, and `dxlrun sim` writes where its --ledger says"
        )
    from dxlrun.analysis.ledger_report import compare, to_json
    from dxlrun.analysis.ledger_tables import render_comparison
    from dxlrun.recording.reader import read_log
    from dxlrun.simulation import read_ledger

    try:
        result = compare(read_log(log), read_ledger(ledger), ledger)
    except LogError as error:
        raise InputError(str(error)) from error  # 1 says that they differ
    console = out()
    if as_json:
        console.file.write(to_json(result).decode() + "\n")
    else:
        console.print(render_comparison(result))
    return 0 if result.same else 1


def _check_target(target: Path) -> None:
    """Raise InputError with what is wrong with a report's file, before the log is read."""
    if target.suffix.lower() not in {".html", ".htm"}:
        raise InputError(f"a report is an HTML file, so its name ends in .html, not as {target} does")
    if not target.parent.is_dir():
        raise InputError(f"there is no directory {target.parent} for the report; make it first")
    if find_spec("matplotlib") is None:
        raise InputError(
            "a report needs matplotlib for its plots; `pip install 'dxlrun[report]'` installs it"
        )


def _write(log: Log, result: Report, target: Path) -> None:
    from dxlrun.analysis.page import page

    text = page(log, result)
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"the report {target} cannot be written: {error.strerror or error}") from error
