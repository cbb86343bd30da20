"""`dxlrun analyze [LOG ...]`: report what happened in a run, or in several with one line each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out, say_error
from dxlrun.errors import InputError, LogError

if TYPE_CHECKING:
    from rich.console import Console

    from dxlrun.analysis.report import Report
    from dxlrun.log.reader import Log


def analyze(
    *logs: Annotated[Path, Parameter(name="log")],
    report: Path | None = None,
    ledger: Path | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Analyze a log: wake-up latency, duration of each step, skipped periods, packets and errors per servo.

    The exit code is 1 when the run was not good.

    Parameters
    ----------
    logs
        The log of a run, an .mcap file; without one the newest in the directory logs. Several logs get one
        line each.
    report
        Also write a page with all numbers and plots to this file, such as report.html; it loads nothing
        from anywhere, and prints well. Needs matplotlib: `pip install 'dxlrun[report]'`.
    ledger
        Compare the log with the ledger of the simulated buses instead, byte by byte; the exit code is 1
        when they differ, when a lasting fault has no event or an event no cause, 2 when one of them cannot be
        read.
    as_json
        Print the result as JSON; with several logs a list.
    debug
        Print the traceback of an error.
    """
    if len(logs) > 1 and (report is not None or ledger is not None):
        option = "--report" if report is not None else "--ledger"
        raise InputError(f"{option} is for one log, and {len(logs)} are given; give it once for each")
    missing = [
        f"there is no log {log}; a run prints at its end where its log is"
        for log in logs
        if not log.is_file()
    ]
    if missing:
        raise InputError("\n".join(missing))
    if report is not None:
        _check_target(report)
    console = out()
    if len(logs) > 1:
        return _analyze_each(logs, console, as_json=as_json)
    log = logs[0] if logs else newest_log()
    if ledger is not None:
        if report is not None:
            raise InputError("a report does not hold a comparison; give --report and --ledger one at a time")
        return _compare(log, ledger, as_json=as_json)
    from dxlrun.analysis import report as analysis
    from dxlrun.analysis.output.terminal import render
    from dxlrun.log.reader import read_log

    read = read_log(log)
    result = analysis.analyze(read)
    if report is not None:
        _write(read, result, report)
    if as_json:
        console.file.write(analysis.to_json(result).decode() + "\n")
        return 0 if result.verdict.good else 1
    if not logs:
        console.print(f"log: {log}", markup=False, soft_wrap=True)
    console.print(render(result))
    if report is not None:
        console.print(f"\nreport: {report}", markup=False, soft_wrap=True)
    return 0 if result.verdict.good else 1


def newest_log() -> Path:
    """Return the newest log in the directory where runs that were started here leave theirs.

    It is the default of `recording: {directory: ...}`, from the working directory. Raises InputError when
    there is none.
    """
    from dxlrun.description.robot import Recording

    directory = Path(Recording().directory)
    logs = sorted(directory.glob("*.mcap"), key=lambda path: (path.stat().st_mtime_ns, path.name))
    if not logs:
        raise InputError(
            f"there is no log in {directory.absolute()}; give the path of one, or change to the directory "
            "where the robot was run"
        )
    return logs[-1]


def _analyze_each(logs: Sequence[Path], console: Console, *, as_json: bool) -> int:
    """Print a line for each log, or a JSON list; one that cannot be read does not hide the others."""
    from dxlrun.analysis import report as analysis

    code = 0
    results: list[str] = []
    for log in logs:
        try:
            result = analysis.analyze_log(log)
        except LogError as error:
            code = error.exit_code
            if as_json:
                results.append(json.dumps({"log": str(log), "ok": False, "errors": [{"what": str(error)}]}))
            else:
                say_error(f"dxlrun: {error}")
            continue
        verdict = result.verdict
        code = code if verdict.good else max(code, 1)
        if as_json:
            results.append(analysis.to_json(result).decode())
            continue
        first = " ".join(verdict.sentences[:1])
        console.print(f"{log}: {verdict.word}. {first}", markup=False, soft_wrap=True)
    if as_json:
        console.file.write(f"[{','.join(results)}]\n")
    return code


def _compare(log: Path, ledger: Path, *, as_json: bool) -> int:
    """Say where a log and a ledger differ; return 1 when they do, or do not answer each other."""
    if not ledger.is_file():
        raise InputError(
            f"there is no ledger {ledger}; a run on simulated buses in real time leaves one beside its log, "
            f"here {log.with_suffix('.ledger.jsonl')}, and `dxlrun sim` writes where its --ledger says"
        )
    from dxlrun.analysis.ledger.comparison import compare, to_json
    from dxlrun.analysis.ledger.ledger_tables import render_comparison
    from dxlrun.log.reader import read_log
    from dxlrun.simulation import read_ledger

    result = compare(read_log(log), read_ledger(ledger), ledger)
    console = out()
    if as_json:
        console.file.write(to_json(result).decode() + "\n")
    else:
        console.print(render_comparison(result))
    return 0 if result.good else 1


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
    from dxlrun.analysis.output.document import page

    text = page(log, result)
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"the report {target} cannot be written: {error.strerror or error}") from error
