"""The report as one page: HTML with figures, style and numbers inside; it loads nothing from anywhere."""

from __future__ import annotations

from dxlrun.analysis.causes.tables import causes_table
from dxlrun.analysis.cycles.latency import first_deadline_ns, on_virtual_time
from dxlrun.analysis.figures.drawing import Drawing
from dxlrun.analysis.figures.events import events_drawing, reply_drawing
from dxlrun.analysis.figures.joints import joint_drawings
from dxlrun.analysis.figures.timing import budget_drawings, latency_drawings
from dxlrun.analysis.report import (
    Report,
    began,
    buses_table,
    controllers_table,
    events_table,
    facts,
    joints_table,
    loop_table,
    servos_table,
    steering_table,
    steps_table,
    tone_of,
)
from dxlrun.log.reader import Log
from dxlrun.output.html import (
    Element,
    document,
    figure,
    footer,
    header,
    paragraph,
    section,
    table_element,
)
from dxlrun.output.table import Cell, Column, Table, microseconds
from dxlrun.run.channels.events import Severity

_MOST_EVENTS = 100


def page(log: Log, report: Report) -> str:
    """Return the page of a log and its report: well-formed, self-contained, the same bytes each time.

    Takes matplotlib. Raises LogError when a packet of the log cannot be read.
    """
    when = began(log)
    return document(
        f"{report.robot}, {when or log.path.name}: report of a run",
        _header(report, when),
        _sections(log, report),
        _footer(log),
        report,
    )


def _header(report: Report, when: str) -> Element:
    verdict = report.verdict
    return header(
        report.robot,
        f"Report of the run of {when}" if when else "Report of a run",
        f"Verdict: {verdict.word}",
        verdict.sentences,
        verdict.good,
        _key_numbers(report),
    )


def _key_numbers(report: Report) -> list[tuple[str, str]]:
    """Return the numbers that a reader compares between runs."""
    account, late = report.periods, report.latency
    numbers = [
        ("rate", account.rates),
        ("lasted", f"{account.seconds:.1f} s"),
        ("periods skipped", f"{account.skipped} of {account.elapsed}"),
    ]
    if late is not None:
        numbers.append(("worst wake-up", microseconds(late.max_us)))
    if report.steps:
        numbers.append(("99 % of cycles take", microseconds(report.steps[-1].p99_us)))
    if report.servos:
        lost, asked = sum(s.lost for s in report.servos), sum(s.asked for s in report.servos)
        numbers.append(("replies lost", f"{lost} of {asked}"))
    return numbers


def _sections(log: Log, report: Report) -> list[Element]:
    return [
        section("run", "The run", [table_element(table) for table in facts(log, report)]),
        _latency(log, report),
        _budget(log, report),
        _joints(log, report),
        _wires(report),
        _steering(report),
        _events(log, report),
    ]


def _latency(log: Log, report: Report) -> Element:
    parts = [table_element(loop_table(report))]
    if on_virtual_time(log):
        parts.append(
            paragraph("The run was on virtual time: every wake-up is exact, so there is no latency to show.")
        )
    elif report.latency is not None:
        parts += [_figure(drawing) for drawing in latency_drawings(log, report.latency)]
    return section("latency", "Wake-up latency", parts)


def _budget(log: Log, report: Report) -> Element:
    timing = (steps_table(report), controllers_table(report), causes_table(report.causes))
    tables = [table for table in timing if table.rows]
    parts = [table_element(table) for table in tables]
    if len(log.cycles):
        first, second = budget_drawings(log)
        parts = [_figure(first), *parts, _figure(second)]
    return section("budget", "Where the time of a cycle goes", parts)


def _joints(log: Log, report: Report) -> Element:
    parts = [table_element(joints_table(report))] if report.joints else []
    if len(log.cycles) and report.joints:
        parts.append(
            paragraph(
                "Desired is the controllers' command, sent is the goal after the gate, read is what the "
                "servo reported. Marked are cycles that woke later than 150 us (late), that follow skipped "
                "periods, that got no intact reply, or whose command the gate changed (clamped)."
            )
        )
        parts += [_figure(drawing) for drawing in joint_drawings(log, report.joints)]
    return section("joints", "Joints", parts)


def _wires(report: Report) -> Element:
    parts = [table_element(table) for table in (buses_table(report), servos_table(report)) if table.rows]
    drawing = reply_drawing(report.servos)
    if drawing is not None:
        parts.append(_figure(drawing))
    return section("buses", "Buses and servos", parts)


def _steering(report: Report) -> Element:
    table = steering_table(report.steering)
    return section("steering", "Steered from outside", [table_element(table)] if table.rows else [])


def _events(log: Log, report: Report) -> Element:
    parts = [table_element(events_table(report.events))] if report.events else []
    drawing = events_drawing(log)
    if drawing is not None:
        parts = [_figure(drawing), *parts, *_each_event(log)]
    return section("events", "Events", parts)


def _each_event(log: Log) -> list[Element]:
    """Return the events one by one; of very many only the first warnings and errors."""
    ordered = sorted(log.events, key=lambda event: event.t_ns)
    chosen, title = ordered, "Each event"
    if len(ordered) > _MOST_EVENTS:
        severe = [event for event in ordered if event.severity >= Severity.WARNING]
        chosen = severe[:_MOST_EVENTS]
        title = (
            f"Warnings and errors: {len(chosen)} of {len(severe)} (the log holds all {len(ordered)} events)"
        )
    start = first_deadline_ns(log)
    rows = [
        (
            (event.t_ns - start) / 1e9,
            Cell(event.name, tone_of(event.severity)),
            event.source,
            event.text,
        )
        for event in chosen
    ]
    columns = (
        Column("s", form="{:.3f}"),
        Column("event", "name"),
        Column("source", "name"),
        Column("text", "text"),
    )
    return [table_element(Table.of(title, columns, rows))] if rows else []


def _figure(drawing: Drawing) -> Element:
    about = drawing.caption
    return figure(about.name, about.title, drawing.svg, about.text)


def _footer(log: Log) -> Element:
    version = log.metadata.get("versions", {}).get("dxlrun", "of an unknown version")
    return footer(
        f"Made by dxlrun analyze from {log.path.name}, which dxlrun {version} recorded. The numbers of this "
        "page are in it as JSON, in the element with the identifier report."
    )
