"""HTML page of the report on a log, with plots, style and numbers inside; it loads nothing from a network."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import NamedTuple
from xml.etree.ElementTree import Element

from dxlrun import Log, LogReader
from dxlrun.tooling.html import document, folded, footer, header, paragraph, section, table_element
from dxlrun.tooling.output import Cell, Column, Columns, Table, microseconds
from dxlrun.tooling.records import Event, Severity
from dxlrun_analysis.cycles.punctuality import on_virtual_time
from dxlrun_analysis.page.canvas import Canvas
from dxlrun_analysis.page.event_plots import EventCollector, events_plot
from dxlrun_analysis.page.joint_plots import joint_plots, state_plots
from dxlrun_analysis.page.loop_plots import controllers_plot, latency_plots, steps_plot, typical_plot
from dxlrun_analysis.page.machine_plots import MachineCollector, machine_plots
from dxlrun_analysis.page.reply_collector import ReplyCollector
from dxlrun_analysis.page.reply_plots import reply_plots
from dxlrun_analysis.page.run_curves import CurveCollector, Curves, CurvesOfRun
from dxlrun_analysis.page.worst_plots import worst_plots
from dxlrun_analysis.parts.cycles import CONTROLLERS, STEPS
from dxlrun_analysis.parts.history import EVENTS, tone_of
from dxlrun_analysis.parts.part import Report
from dxlrun_analysis.report import analyze, began, facts, tables

_MOST_EVENTS = 100  # Above this number the table has only warnings and errors
_MARKED = ("switch", "rate", "load", "unload", "policy")  # Kinds of commands that the plots mark
_FEW_CHANGES = 60  # More lines would hide the curves
_PLOTS = {
    "machine-busy": "busy_machine",
    "lateness": "kept_rate",
    "steps": "skipped own_work",
    "replies": "late_replies slow_servo replies",
    "lost": "lossy_servo lossy_line broken_replies invalid_states noise",
    "all-voltage": "supply power_lost",
    "events-timeline": "servo_error errors_logged another_host",
}
"""Plots of the page to which findings link: name, and codes of the findings that the plot shows."""


def analyzed_page(reader: LogReader | Log, *watching: Callable[[Log], None]) -> tuple[Report, str]:
    """Analyze a log; return the report and its HTML page. `watching` also receive each slice. Needs bokeh.

    Raises:
        LogError: As in `analyze`.
    """
    replies = ReplyCollector()
    report = analyze(reader, *watching, exchanges=replies.add_exchanges)
    return report, page(reader, report, replies.build_curves())


def page(reader: LogReader | Log, report: Report, replies: Curves) -> str:
    """Return the HTML page of a log and its report: well-formed, self-contained and reproducible to the byte.

    This reads the cycles of the log once more, slice by slice.

    Args:
        reader: The log.
        report: Report on the log.
        replies: Curves of a ReplyCollector.
    """
    run = _drawn(reader, report, replies)
    when = began(run.log, report)
    sections = _sections(run, report)
    return document(
        f"{report.robot}, {when or run.log.path.name}: report of a run",
        _header(report, when, run.canvas.names),
        sections,
        _footer(run.log),
        report.numbers,
        run.canvas.scripts(),
    )


class _PageContent(NamedTuple):
    """Data of one log for the page: curves, events, and the canvas for its plots."""

    log: Log  # Without cycles, with the events that the page can name
    curves: CurvesOfRun
    replies: Curves
    machine: Curves
    cores: tuple[int, ...]  # Cores that are drawn
    canvas: Canvas


def _drawn(reader: LogReader | Log, report: Report, replies: Curves) -> _PageContent:
    curves = CurveCollector(worst.scheduled_ns for worst in report.totals.causes.worst)
    events, machine = EventCollector(), MachineCollector()
    for part in reader.slices(packets=False):
        for collector in (curves, events, machine):
            collector.add_slice(part)
    log = replace(reader.about, cycles=reader.about.cycles[:0], events=events.sort_events())
    drawn = curves.build_curves()
    shown = drawn.begin_ns, drawn.end_ns
    if not report.totals.periods.records and log.events:
        shown = log.events[0].t_ns, log.events[-1].t_ns
    changes = [act.time_s for act in report.totals.acts if act.kind in _MARKED and not act.refusal]
    canvas = Canvas(
        report.totals.periods.begin_ns,
        *shown,
        pauses=[(pause.begin_s, pause.end_s) for pause in report.totals.pauses],
        changes=changes if len(changes) <= _FEW_CHANGES else (),
    )
    return _PageContent(log, drawn, replies, *machine.build_curves(), canvas)


def _header(report: Report, when: str, plots: Collection[str]) -> Element:
    """Return the header: summary of the robot, verdict with links to the plots of this page, key numbers."""
    first, *others = report.verdict.findings
    rows = {joint.name: f"joint-{row}" for row, joint in enumerate(report.totals.tracking)}
    sentences = []
    for one in others:
        wanted = _plot_of(one.code), rows.get(one.subject, "")
        sentences.append((one.sentence, one.remedy, next((name for name in wanted if name in plots), "")))
    return header(
        first.sentence,
        f"{report.robot}, run of {when}" if when else report.robot,
        "",
        sentences,
        report.verdict.good,
        _key_numbers(report),
    )


def _plot_of(code: str) -> str:
    """Return the name of the plot that shows findings with this code, or an empty string."""
    return next((plot for plot, codes in _PLOTS.items() if code in codes.split()), "")


def _key_numbers(report: Report) -> list[tuple[str, str]]:
    """Return the numbers below the header, with names, that a reader compares between runs."""
    account, late = report.totals.periods, report.totals.latency
    numbers = [
        ("rate", account.rates),
        ("lasted", f"{account.seconds:.1f} s"),
        ("periods skipped", f"{account.skipped} of {account.elapsed}"),
    ]
    if late is not None:
        numbers.append(("worst wake-up", microseconds(late.max_us)))
    if STEPS.numbers_of(report):
        numbers.append(("99 % of cycles take", microseconds(STEPS.numbers_of(report)[-1].p99_us)))
    if report.totals.servos:
        lost, asked = sum(s.lost for s in report.totals.servos), sum(s.asked for s in report.totals.servos)
        numbers.append(("replies lost", f"{lost} of {asked}"))
    return numbers


def _sections(run: _PageContent, report: Report) -> list[Element]:
    """Return the sections of the page, in their order, as HTML elements."""
    canvas, totals = run.canvas, report.totals

    def build_tables(section: str) -> list[Element]:
        return [table_element(table) for table in tables(report, section).values()]

    return [
        section("joints", "Joints", [*build_tables("joints"), *_joints(run, report)]),
        section("steering", "Requests of clients", [*build_tables("steering"), *_marks(canvas)]),
        section("events", "Events", _events(run, report, build_tables("events"))),
        section(
            "buses",
            "Buses and servos",
            [*build_tables("buses"), *canvas.elements(reply_plots(canvas, run.replies, totals.servos))],
        ),
        section(
            "budget",
            "Where the time of a cycle goes",
            _budget(run, report, build_tables("budget")),
        ),
        section("latency", "Wake-up latency", [*build_tables("latency"), *_latency(run, report)]),
        section(
            "worst", "The worst cycles", canvas.elements(worst_plots(canvas, report.totals.causes.worst))
        ),
        folded(
            "machine",
            "Machine and versions",
            [
                *map(table_element, facts(run.log, report)),
                *canvas.elements(machine_plots(canvas, run.machine, run.cores)),
            ],
        ),
    ]


def _budget(run: _PageContent, report: Report, tables: list[Element]) -> list[Element]:
    if not STEPS.numbers_of(report):
        return tables
    canvas, cycles = run.canvas, run.curves.cycles
    period_us = 1e6 / report.totals.periods.rate_hz
    plots = [typical_plot(canvas, STEPS.numbers_of(report), period_us), steps_plot(canvas, cycles)]
    updates = controllers_plot(canvas, cycles, CONTROLLERS.numbers_of(report))
    return [*canvas.elements(plots), *tables, *canvas.elements([updates] if updates else [])]


def _latency(run: _PageContent, report: Report) -> list[Element]:
    if on_virtual_time(run.log):
        text = "The run was on virtual time: every wake-up is exact, so there is no latency to show."
        return [paragraph(text)]
    if report.totals.latency is None:
        return []
    return run.canvas.elements(latency_plots(run.canvas, run.curves, report.totals.latency))


def _joints(run: _PageContent, report: Report) -> list[Element]:
    if not (STEPS.numbers_of(report) and report.totals.tracking):
        return []
    canvas, cycles = run.canvas, run.curves.cycles
    parts = [
        paragraph(
            "Desired is the controllers' command, sent is the goal after the gate, read is the value "
            "reported by the servo. The error is the read position minus the previous goal, and includes "
            "the servo's delay. Ticks mark cycles without an intact reply, and cycles with a command "
            "changed by the gate (clamped). A click on a name hides its curve."
        )
    ]
    for row, joint in enumerate(report.totals.tracking):
        parts.append(Element("div", {"class": "joint"}))
        parts[-1].extend(canvas.elements(joint_plots(canvas, cycles, row, joint)))
    names = [joint.name for joint in report.totals.tracking]
    return [*parts, *canvas.elements(state_plots(canvas, cycles, names))]


def _marks(canvas: Canvas) -> list[Element]:
    marks = ["Shaded: the loop was paused."] if canvas.pauses else []
    marks += ["Dotted lines: controllers, rate or policy were changed."] if canvas.changes else []
    return [paragraph(f"In the plots over the time of the run: {' '.join(marks)}")] if marks else []


def _events(run: _PageContent, report: Report, table: list[Element]) -> list[Element]:
    if not run.log.events:
        return table
    number = sum(one.count for one in EVENTS.numbers_of(report))
    plot = events_plot(run.canvas, run.log.events, number)
    return [*run.canvas.elements([plot]), *table, *_each_event(run, number)]


def _each_event(run: _PageContent, number: int) -> list[Element]:
    """Return the table of single events; of more than a hundred, only the first warnings and errors."""
    chosen, title = run.log.events, "Each event"
    if number > _MOST_EVENTS:
        severe = [event for event in chosen if event.severity >= Severity.WARNING]
        chosen = tuple(severe[:_MOST_EVENTS])
        title = f"The first {len(chosen)} warnings and errors (the log holds all {number} events)"
    start = run.canvas.start_ns
    columns: Columns[Event] = (
        (Column("s", form="{:.3f}"), lambda one: (one.t_ns - start) / 1e9),
        (Column("event", "name"), lambda one: Cell(one.name, tone_of(one.severity))),
        (Column("source", "name"), "source"),
        (Column("text", "text"), "text"),
    )
    return [table_element(Table.listing(title, columns, chosen))] if chosen else []


def _footer(log: Log) -> Element:
    version = log.metadata.get("versions", {}).get("dxlrun", "of an unknown version")
    return footer(
        f"Made by dxlrun analyze from {log.path.name}, recorded by dxlrun {version}. The element "
        "with id='report' contains the numbers of this page as JSON."
    )
