"""Parts of the report about cycles: periods, wake-ups, steps, controllers, causes of long cycles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dxlrun.tooling.output import Column, Columns, Table, Value, flagged, microseconds
from dxlrun_analysis.causes.cause_tables import causes_table
from dxlrun_analysis.cycles.punctuality import Durations, Periods, StepDuration
from dxlrun_analysis.parts.part import Report, ReportPart, listing


def _loop(report: Report, periods: Periods) -> Table:
    """Return the table about the loop: recorded and skipped periods, and lateness of the wake-ups."""
    late = report.totals.latency
    paused = sum(pause.periods for pause in report.totals.pauses)
    rows: list[tuple[str, Value]] = [
        ("periods elapsed", periods.elapsed),
        ("cycles recorded", periods.records),
        ("periods skipped", flagged(periods.skipped)),
        *([("periods paused", paused)] if paused else []),
        ("recorded + skipped = elapsed", "yes" if periods.agree else f"no, {periods.missing} missing"),
    ]
    if late is not None:
        rows += [
            ("wake-up latency, maximum", microseconds(late.max_us)),
            ("  99.9 %", microseconds(late.p999_us)),
            ("  99 %", microseconds(late.p99_us)),
            ("  median", f"{late.median_us:.1f} us"),
            ("  mean", f"{late.mean_us:.2f} us"),
            ("  standard deviation", f"{late.deviation_us:.2f} us"),
            ("  mode", f"{late.mode_us} us"),
            ("  later than 150 us", f"{late.share_over_150_us:.3%}"),
            ("  later than 1 ms", f"{late.share_over_1_ms:.3%}"),
            ("  later than one period", f"{late.share_over_period:.3%}"),
        ]
    unfinished = "no, a run is writing it" if report.about.being_written else "no"
    rows += [
        ("records lost", report.totals.gaps),
        ("log complete", "yes" if report.about.complete else unfinished),
    ]
    title = f"{report.robot}, {periods.rates}, {periods.seconds:.1f} s"
    return Table.from_rows(title, [Column("loop", "name"), Column("")], rows)


def _controllers(_: Report, updates: Sequence[StepDuration]) -> Table:
    # On virtual time updates take no time.
    shown = updates if any(item.cycles for item in updates) else ()
    return Table.listing("Controllers", [(Column("update of", "name"), "name"), *_DURATION], shown)


def _time(name: str) -> Callable[[StepDuration], Value]:
    return lambda item: microseconds(getattr(item, name)) if item.cycles else "-"


_DURATION: Columns[StepDuration] = (
    (Column("cycles"), "cycles"),
    (Column("median"), _time("median_us")),
    (Column("99 %"), _time("p99_us")),
    (Column("maximum"), _time("max_us")),
)

PERIODS = ReportPart("periods", lambda report: report.totals.periods, _loop, section="latency")
LATENCY = ReportPart("latency", lambda report: report.totals.latency)
STEPS = ReportPart(
    "steps",
    lambda report: report.tally.find_collector(Durations).compute_durations()[0],
    listing("Steps of a cycle", ((Column("step", "name"), "name"), *_DURATION)),
    Durations,
    section="budget",
)
CONTROLLERS = ReportPart(
    "controllers",
    lambda report: report.tally.find_collector(Durations).compute_durations()[1],
    _controllers,
    Durations,
    section="budget",
)
CAUSES = ReportPart(
    "causes", lambda report: report.totals.causes, lambda _, causes: causes_table(causes), section="budget"
)
