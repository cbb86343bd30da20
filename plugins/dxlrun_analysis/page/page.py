"""The report as one page: HTML with zoomable plots, style and numbers inside; it loads nothing."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

from dxlrun.channels.events import Severity
from dxlrun.log.reader import Log, LogReader
from dxlrun.output.html import Element, document, folded, footer, header, paragraph, section, table_element
from dxlrun.output.table import Cell, Column, Table, microseconds
from dxlrun_analysis.causes.tables import causes_table
from dxlrun_analysis.cycles.latency import begins, first_deadline_ns, on_virtual_time
from dxlrun_analysis.page.canvas import Canvas, Plot
from dxlrun_analysis.page.curves import CurveCollector, Curves, CurvesOfRun
from dxlrun_analysis.page.events import EventCollector, events_plot
from dxlrun_analysis.page.findings import finding_plots, plot_of
from dxlrun_analysis.page.joints import joint_plots, state_plots
from dxlrun_analysis.page.loop import controllers_plot, latency_plots, steps_plot, typical_plot
from dxlrun_analysis.page.machine import MachineCollector, machine_plots
from dxlrun_analysis.page.replies import ReplyCollector
from dxlrun_analysis.page.servos import reply_plots
from dxlrun_analysis.page.worst import worst_plots
from dxlrun_analysis.report import (
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

_MOST_EVENTS = 100
_MARKED = ("switch", "rate", "load", "unload", "policy")
_FEW_CHANGES = 60
"""More lines would bury the curves."""


def page(reader: LogReader | Log, report: Report) -> str:
    """Return the page of a log and its report: well-formed, self-contained, the same bytes each time.

    It goes through the log once more, slice by slice. Takes bokeh. Raises LogError when a packet of the log
    cannot be read.
    """
    run = _drawn(reader, report)
    when = began(run.log)
    sections = _sections(run, report)
    return document(
        f"{report.robot}, {when or run.log.path.name}: report of a run",
        _header(report, when, run.canvas.names),
        sections,
        _footer(run.log),
        report,
        run.canvas.scripts(),
    )


@dataclass(frozen=True, slots=True)
class _Run:
    """What the page shows of a log."""

    log: Log
    """Its first cycle, and the events that a page can name."""
    curves: CurvesOfRun
    replies: Curves
    machine: Curves
    cores: tuple[int, ...]
    """Those that are drawn."""
    canvas: Canvas


def _drawn(reader: LogReader | Log, report: Report) -> _Run:
    curves = CurveCollector(worst.scheduled_ns for worst in report.causes.worst)
    replies, events, machine = ReplyCollector(), EventCollector(), MachineCollector()
    first: Log | None = None
    for part in reader.slices():
        if first is None or not begins(first):
            first = part
        curves.take(part)
        replies.take(part)
        events.take(part)
        machine.take(part)
    log = replace(reader.about, cycles=reader.about.cycles[:0], events=events.finish())
    if first is not None:
        log = replace(log, cycles=first.cycles[:1], activation=first.activation)
    drawn = curves.finish()
    start_ns = first_deadline_ns(log)
    shown = (drawn.begin_ns, drawn.end_ns) if len(log.cycles) else _span_of_events(log)
    changes = [act.time_s for act in report.steering if act.kind in _MARKED and not act.refusal]
    canvas = Canvas(
        start_ns,
        *shown,
        pauses=[(pause.begin_s, pause.end_s) for pause in report.pauses],
        changes=changes if len(changes) <= _FEW_CHANGES else (),
    )
    return _Run(log, drawn, replies.finish(), *machine.finish(), canvas)


def _span_of_events(log: Log) -> tuple[int, int]:
    return (log.events[0].t_ns, log.events[-1].t_ns) if log.events else (0, 0)


def _header(report: Report, when: str, plots: Collection[str]) -> Element:
    """Return the verdict, the robot's line first, with links to the plots of this page."""
    first, *others = report.verdict.findings
    rows = {joint.name: f"joint-{row}" for row, joint in enumerate(report.joints)}
    sentences = []
    for number, one in enumerate(others, start=1):
        wanted = f"finding-{number}", plot_of(one.code), rows.get(one.subject, "")
        sentences.append((one.sentence, one.remedy, next((name for name in wanted if name in plots), "")))
    return header(
        first.sentence,
        f"{report.robot}, run of {when}" if when else report.robot,
        "",
        sentences,
        report.verdict.good,
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


def _sections(run: _Run, report: Report) -> list[Element]:
    return [
        _findings(run, report),
        _joints(run, report),
        _steering(run, report),
        _events(run, report),
        _wires(run, report),
        _budget(run, report),
        _latency(run, report),
        _worst(run, report),
        _machine(run, report),
    ]


def _tables(tables: Iterable[Table]) -> list[Element]:
    return [table_element(table) for table in tables if table.rows]


def _plots(run: _Run, plots: Iterable[Plot | None]) -> list[Element]:
    return run.canvas.elements(plot for plot in plots if plot is not None)


def _findings(run: _Run, report: Report) -> Element:
    plots = finding_plots(run.canvas, report.verdict.findings, report.trends, report.joints, report.servos)
    return section("findings", "What the verdict names", _plots(run, plots))


def _latency(run: _Run, report: Report) -> Element:
    parts = [table_element(loop_table(report))]
    if on_virtual_time(run.log):
        parts.append(
            paragraph("The run was on virtual time: every wake-up is exact, so there is no latency to show.")
        )
    elif report.latency is not None:
        parts += _plots(run, latency_plots(run.canvas, run.curves, report.latency))
    return section("latency", "Wake-up latency", parts)


def _budget(run: _Run, report: Report) -> Element:
    parts = _tables((steps_table(report), controllers_table(report), causes_table(report.causes)))
    if report.steps:
        canvas, cycles = run.canvas, run.curves.cycles
        period_us = 1e6 / report.periods.rate_hz
        parts = (
            _plots(run, (typical_plot(canvas, report.steps, period_us), steps_plot(canvas, cycles))) + parts
        )
        parts += _plots(run, [controllers_plot(canvas, cycles, report.controllers)])
    return section("budget", "Where the time of a cycle goes", parts)


def _worst(run: _Run, report: Report) -> Element:
    return section("worst", "The worst cycles", _plots(run, worst_plots(run.canvas, report.causes.worst)))


def _machine(run: _Run, report: Report) -> Element:
    parts = [
        *_tables(facts(run.log, report)),
        *_plots(run, machine_plots(run.canvas, run.machine, run.cores)),
    ]
    return folded("machine", "The machine and all versions", parts)


def _joints(run: _Run, report: Report) -> Element:
    parts = _tables([joints_table(report)])
    if report.steps and report.joints:
        canvas, cycles = run.canvas, run.curves.cycles
        parts.append(
            paragraph(
                "Desired is the controllers' command, sent is the goal after the gate, read is what the "
                "servo reported. The error is the position that was read minus the goal of the cycle before, "
                "with the servo's delay in it. Ticks mark cycles without an intact reply, and those whose "
                "command the gate changed (clamped). A click on a name hides its curve."
            )
        )
        for row, joint in enumerate(report.joints):
            parts.append(Element("div", {"class": "joint"}))
            parts[-1].extend(_plots(run, joint_plots(canvas, cycles, row, joint)))
        parts += _plots(run, state_plots(canvas, cycles, [joint.name for joint in report.joints]))
    return section("joints", "Joints", parts)


def _wires(run: _Run, report: Report) -> Element:
    parts = _tables((buses_table(report), servos_table(report)))
    parts += _plots(run, reply_plots(run.canvas, run.replies, report.servos))
    return section("buses", "Buses and servos", parts)


def _steering(run: _Run, report: Report) -> Element:
    parts = _tables([steering_table(report.steering)])
    marks = ["Shaded: the loop was paused."] if run.canvas.pauses else []
    marks += ["Dotted lines: it was steered otherwise."] if run.canvas.changes else []
    if marks:
        parts.append(paragraph(f"In the plots over the time of the run: {' '.join(marks)}"))
    return section("steering", "Steered from outside", parts)


def _events(run: _Run, report: Report) -> Element:
    parts = _tables([events_table(report.events)])
    if run.log.events:
        number = sum(one.count for one in report.events)
        plots = _plots(run, [events_plot(run.canvas, run.log.events, number)])
        parts = [*plots, *parts, *_each_event(run, number)]
    return section("events", "Events", parts)


def _each_event(run: _Run, number: int) -> list[Element]:
    """Return the events one by one; of very many only the first warnings and errors."""
    chosen, title = run.log.events, "Each event"
    if number > _MOST_EVENTS:
        severe = [event for event in chosen if event.severity >= Severity.WARNING]
        chosen = tuple(severe[:_MOST_EVENTS])
        title = f"The first {len(chosen)} warnings and errors (the log holds all {number} events)"
    start = run.canvas.start_ns
    rows = [
        ((one.t_ns - start) / 1e9, Cell(one.name, tone_of(one.severity)), one.source, one.text)
        for one in chosen
    ]
    names = (Column("event", "name"), Column("source", "name"), Column("text", "text"))
    columns = (Column("s", form="{:.3f}"), *names)
    return [table_element(Table.of(title, columns, rows))] if rows else []


def _footer(log: Log) -> Element:
    version = log.metadata.get("versions", {}).get("dxlrun", "of an unknown version")
    return footer(
        f"Made by dxlrun analyze from {log.path.name}, which dxlrun {version} recorded. The numbers of this "
        "page are in it as JSON, in the element with the identifier report."
    )
