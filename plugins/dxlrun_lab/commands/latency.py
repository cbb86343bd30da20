"""`dxlrun latency`: measures how late this machine wakes up a loop, without a robot."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dxlrun import InputError
from dxlrun.tooling.output import (
    check_target,
    out,
    print_error,
    progress_bar,
    show_json,
    show_parts,
    unwritable,
)
from dxlrun.tooling.verbs import (
    DebugFlag,
    Flag,
    JsonFlag,
    RecordFlag,
    StressFlag,
    check_report,
    terminated_as_interrupted,
    write_report,
)

if TYPE_CHECKING:
    from dxlrun_analysis.latency.conditions import Settings
    from dxlrun_lab.latency.latency_measurement import LatencyMeasurement

_INTERRUPTED = 130


def latency(
    *,
    count: int = 10_000,
    period: str = "1ms",
    policy: Literal["other", "round_robin", "fifo"] | None = None,
    priority: int = 31,
    compare: str | None = None,
    blocks: int = 5,
    stress: StressFlag = False,
    polling: str = "auto",
    cores: str | None = None,
    idle_latency: Flag = False,
    log: Path | None = None,
    record: RecordFlag = True,
    report: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Measure the wake-up latency of a loop on this machine.

    The loop waits like that of a run. No robot is used. Ctrl-C ends the measurement and shows the results so
    far.

    Parameters
    ----------
    count
        Number of wake-ups of each condition, in all blocks together.
    period
        Time between two deadlines, 10 us to 1 s.
    policy
        Scheduling policy. Default: other. With --compare, it is the policy of c, by default that of its
        neighbour in the list.
    priority
        Real-time priority of round_robin and fifo.
    compare
        Conditions to measure in alternating blocks, such as other,round_robin,c. A condition is a policy, or
        c: a small C program that sleeps until each deadline, and that is compiled first. c alone is compared
        with round_robin, or with --policy.
    blocks
        Number of blocks of each condition.
    stress
        Load all cores, memory and disk, as other programs would.
    polling
        Longest time for which the clock is polled before a deadline; auto: a tenth of the period.
    cores
        Processor cores to measure on, such as 1 or 2,3. Default: all.
    idle_latency
        Keep the processor cores out of deep idle states during the measurement.
    log
        New log file (.mcap), or directory for a new one. Default: the directory logs, as for runs.
    record
        Write a log.
    report
        HTML file for a report with all numbers and plots. Needs bokeh: `pip install 'dxlrun[report]'`.
    """
    import os

    from dxlrun_analysis.latency.conditions import Settings, conditions

    settings = Settings(
        iterations=count,
        period_ns=_duration("--period", period),
        priority=priority,
        conditions=conditions(compare, policy),
        blocks=blocks,
        cores=_cores(cores),
        polling_ns=None if polling == "auto" else _duration("--polling", polling),
        idle_latency=idle_latency,
    )
    settings.validate_settings(frozenset(os.sched_getaffinity(0)))
    if report is not None:
        check_report(report, "bokeh")
    if log is not None and not record:
        raise InputError("--log and --no-record exclude each other; omit one")
    return _measured(settings, stress, _log_place(log, record), report, as_json=as_json)


def _measured(
    settings: Settings, stress: bool, place: Path | None, report: Path | None, *, as_json: bool
) -> int:
    """Measure, then write log and report and show the results. Return the exit code. `place` is the file or
    directory of the log; None for no log."""
    from dxlrun_lab.latency.latency_measurement import (
        LatencyMeasurement,
        compiled_yardstick,
        keep_cores_awake,
        measure_blocks,
        require_grants,
    )
    from dxlrun_lab.stress import Stress

    load = Stress(wanted=stress)
    measured = LatencyMeasurement()
    with compiled_yardstick(settings) as yardstick:
        measured.remarks += require_grants(settings, yardstick)
        keep_cores_awake(settings)
        target = None if place is None else _new_log(place)
        if not as_json:
            show_parts(_announced(settings, load.text))
        with progress_bar(hidden=as_json) as progress, terminated_as_interrupted():
            try:
                with load:
                    measure_blocks(settings, yardstick, load, progress, measured)
            except KeyboardInterrupt:  # while the load was starting or ending
                measured.interrupted = True
            except BaseException:
                _discard(target)
                raise
    return _show(settings, measured, load.text, target, report, as_json=as_json)


def _show(
    settings: Settings,
    measured: LatencyMeasurement,
    load: str,
    target: Path | None,
    report: Path | None,
    *,
    as_json: bool,
) -> int:
    import msgspec

    from dxlrun_analysis.latency.latency_log import machine, write_log
    from dxlrun_analysis.latency.latency_tables import parts
    from dxlrun_analysis.latency.statistics import figures

    code = _INTERRUPTED if measured.interrupted else 1 if measured.failure else 0
    why = (measured.failure, "interrupted" if measured.interrupted else "")
    failures = [f"{one}; the table has the earlier results" for one in why if one]
    result = figures(settings, measured.blocks, load, measured.remarks)
    if not result.conditions:
        _discard(target)
        if measured.interrupted:
            raise KeyboardInterrupt
        raise InputError(measured.failure or "nothing was measured")
    if not as_json:
        show_parts(*parts(result))  # writing the log takes long, and an interrupt must not lose the table
    with out().status("writing the log") if not as_json else nullcontext():
        if target is not None:
            summary = write_log(target, settings, measured.blocks, load, measured.remarks)
            if summary.error:
                code = code or 1
                failures.append(f"the log {target} is incomplete: {summary.error}")
        if report is not None:
            from dxlrun_analysis.latency.latency_page import page

            write_report(report, page(result, measured.blocks, machine()))
    if as_json:
        more = {"log": None if target is None else str(target), "failure": measured.failure}
        content = msgspec.to_builtins(result) | more | {"interrupted": measured.interrupted}
        show_json(content, code=code, errors=failures)
        return code
    if target is not None:
        show_parts(f"\nlog: {target}")
    if report is not None:
        show_parts(f"report: {report}")
    for failure in failures:
        print_error(failure if failure.startswith("interrupted") else f"dxlrun: {failure}")
    return code


def _announced(settings: Settings, load: str) -> str:
    from dxlrun.tooling.output import counted

    names = ", ".join(condition.label for condition in settings.conditions)
    seconds = settings.seconds
    lasts = f"{seconds / 60:.1f} min" if seconds >= 120 else f"{seconds:.1f} s"
    each = " each" if len(settings.conditions) > 1 else ""
    return (
        f"measuring {names}: {counted(settings.iterations, 'wake-up', 'wake-ups')}{each} in "
        f"{counted(settings.blocks, 'block', 'blocks')}, {lasts}"
    ) + (f"; load: {load}" if load else "")


def _duration(option: str, text: str) -> int:
    from dxlrun.tooling.verbs import duration

    try:
        return duration(text, bare="s")
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None


def _cores(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() and len(word) < 5 for word in words):
        raise InputError(f"--cores {text}: write numbers of cores, such as 1 or 2,3")
    return tuple(sorted({int(word) for word in words}))


def _log_place(log: Path | None, record: bool) -> Path | None:
    """Return the .mcap file, or the directory for a new log, from --log and --record; None without a log."""
    if not record:
        return None
    if log is None:
        from dxlrun.tooling.plans import RecordingPlan

        return Path(RecordingPlan().directory)
    if log.suffix == ".mcap":
        check_target(log)
    elif log.exists() and not log.is_dir():
        raise InputError(f"--log {log} is neither a directory nor a .mcap file; correct the path")
    return log


def _new_log(place: Path) -> Path:
    from dxlrun.tooling.plans import RecordingPlan
    from dxlrun.tooling.runs import new_log

    if place.suffix != ".mcap":
        return new_log(RecordingPlan(str(place)), "latency")
    try:
        place.touch()
    except OSError as error:
        raise unwritable(place, error) from None
    return place


def _discard(target: Path | None) -> None:
    if target is not None:
        target.unlink(missing_ok=True)
