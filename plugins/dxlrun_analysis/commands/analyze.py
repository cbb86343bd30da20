"""`dxlrun analyze`: report on one log, or one line for each of several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import InputError, LogError
from dxlrun.tooling.output import counted, print_error, progress_bar, show_json, show_parts
from dxlrun.tooling.verbs import DebugFlag, JsonOfItsOwn, check_report, missing_extra, write_report

if TYPE_CHECKING:
    from cyclopts import Token

    from dxlrun import LogReader

MOST_WORST = 10  # Number of cycles whose packets the analysis keeps


def _log(_: object, tokens: Sequence[Token]) -> Path:
    """Return the path of a log on the command line. A log in a store is copied to a local file first."""
    place = tokens[0].value
    if "://" not in place:
        return Path(place)
    if missing := missing_extra("a log in a store", "store", "fsspec", "pyarrow"):
        raise InputError(missing)
    from dxlrun_analysis.season.store import fetch

    return fetch(place)


def analyze(
    *logs: Annotated[Path, Parameter(name="log", converter=_log)],
    report: Path | None = None,
    worst: int = 0,
    as_json: JsonOfItsOwn = False,
    debug: DebugFlag = False,
) -> int:
    """Analyze a log: latency, duration of each step, skipped periods, packets and errors per servo.

    Exit code: 0, or 1 if the verdict on the run is bad.

    Parameters
    ----------
    logs
        Log of a run: an .mcap file, or a directory of parts. s3://BUCKET/LOG downloads a whole log from a
        store. Several logs get one line each. Default: the newest log of a finished run in the directory
        logs.
    report
        HTML file for a report with all numbers and plots. A zoom in one plot applies to all plots. The page
        needs no network, and can be printed. Needs bokeh: `pip install 'dxlrun[report]'`.
    worst
        Number of the worst cycles to show as timelines, at most 10. A timeline has each packet, and the time
        at which the plan expected it.
    as_json
        Print the result as JSON. The results of several logs are in the list `logs`.
    """
    _check(logs, report=report, worst=worst)
    if report is not None:
        check_report(report, "bokeh")
    if len(logs) > 1:
        return _analyze_each(logs, as_json=as_json)
    log = logs[0] if logs else newest_log()
    from dxlrun import open_log
    from dxlrun.tooling.logs import TOOL_NAME
    from dxlrun_analysis import report as analysis
    from dxlrun_analysis.causes.cause_tables import worst_tables
    from dxlrun_analysis.latency.latency_log import is_measurement

    reader = open_log(log)
    if not logs and not as_json:
        show_parts(f"log: {log}")
    if is_measurement(reader):
        return _analyze_measurement(reader, report, as_json=as_json)
    tool = reader.metadata.get(TOOL_NAME)
    if tool is not None:
        packets = sum(len(part.packets) for part in reader.slices())
        command = tool.get("command", "a tool")
        if as_json:
            show_json({"command": command, "packets": packets})
        else:
            show_parts(f"{log}: traffic of `{command}`, not a run: {counted(packets, 'packet', 'packets')}")
        return 0
    with progress_bar(hidden=as_json) as draw:

        def reading(_: object) -> None:
            draw(f"reading {log.name}", reader.share)

        if report is None:
            result = analysis.analyze(reader, reading)
        else:
            from dxlrun_analysis.page.report_page import analyzed_page

            result, text = analyzed_page(reader, reading)
            write_report(report, text)
    code = 0 if result.verdict.good else 1
    if as_json:
        show_json(result.numbers, code=code, errors=result.verdict.sentences[:code])
        return code
    show_parts(*analysis.parts(result), *worst_tables(result.totals.causes.worst[:worst]))
    if report is not None:
        show_parts(f"\nreport: {report}")
    return code


def _check(logs: Sequence[Path], *, report: Path | None, worst: int) -> None:
    """Check the arguments before any file is read.

    Raises:
        InputError: Some options or logs cannot be used.
    """
    if not 0 <= worst <= MOST_WORST:
        raise InputError(f"--worst {worst}: out of range; give 1 to {MOST_WORST}")
    given = {"--report": report is not None, "--worst": worst > 0}
    if len(logs) > 1 and any(given.values()):
        option = next(name for name, there in given.items() if there)
        raise InputError(f"{option} is for one log, but {len(logs)} are given; analyze one at a time")
    missing = [
        f"log {log} not found; a run prints the path of its log when it ends"
        for log in logs
        if not log.exists()
    ]
    if missing:
        raise InputError("\n".join(missing))


def _analyze_measurement(log: LogReader, report: Path | None, *, as_json: bool) -> int:
    """Show the result of `dxlrun latency` from its log, in the same form as that command."""
    from dxlrun_analysis.latency.latency_log import machine_of, measurement
    from dxlrun_analysis.latency.latency_tables import parts

    blocks, result = measurement(log)
    if report is not None:
        check_report(report, "bokeh")
        from dxlrun_analysis.latency.latency_page import page

        write_report(report, page(result, blocks, machine_of(log)))
    if as_json:
        show_json(result)
        return 0
    show_parts(*parts(result))
    if report is not None:
        show_parts(f"\nreport: {report}")
    return 0


def newest_log() -> Path:
    """Return the newest log of a finished run, in the directory where runs that start here record.

    This is the default of `recording: {directory: ...}`, relative to the working directory.

    Raises:
        InputError: No finished run has a log there.
    """
    from dxlrun.tooling.logs import is_being_written, is_log_directory
    from dxlrun.tooling.plans import RecordingPlan

    directory = Path(RecordingPlan().directory)
    found = [*directory.glob("*.mcap"), *(path for path in directory.glob("*/") if is_log_directory(path))]
    logs = sorted(found, key=lambda path: (path.stat().st_mtime_ns, path.name), reverse=True)
    ended = next((log for log in logs if not is_being_written(log) and log.stat().st_size), None)
    if ended is not None:
        return ended
    if logs:
        raise InputError(f"{logs[0]} is being written; end its run, or give this path for a partial analysis")
    raise InputError(
        f"no log found in {directory.absolute()}; give the path of a log, or change to the working "
        "directory of the run"
    )


def _analyze_each(logs: Sequence[Path], *, as_json: bool) -> int:
    """Print a line for each log, or all as JSON; return the exit code.

    An unreadable log does not stop the analysis of later ones.
    """
    from dxlrun import open_log
    from dxlrun_analysis.latency.latency_log import is_measurement, measurement
    from dxlrun_analysis.latency.latency_tables import line
    from dxlrun_analysis.report import analyze as analyze_log

    code = 0
    results: list[object] = []
    failures: list[str] = []
    for log in logs:
        try:
            reader = open_log(log)
            if is_measurement(reader):
                _, measured = measurement(reader)
                results.append(measured)
                words = line(measured)
            else:
                report = analyze_log(reader)
                results.append(report.numbers)
                words = report.verdict.sentences[0]
                words = f"being written; so far: {words}" if report.about.being_written else words
                if not report.verdict.good:
                    code = max(code, 1)
                    failures.append(f"{log}: {words}")
        except LogError as error:
            code = error.exit_code
            failures.append(str(error))
            if not as_json:
                print_error(f"dxlrun: {error}")
            continue
        if not as_json:
            show_parts(f"{log}: {words}")
    if as_json:
        show_json({"logs": results}, code=code, errors=failures)
    return code
