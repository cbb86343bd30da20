"""HTML page of a latency measurement with the thesis' three plots; needs bokeh."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element

import numpy as np

from dxlrun.tooling.html import document, footer, header, paragraph, section, table_element
from dxlrun.tooling.output import counted
from dxlrun_analysis.cycles.punctuality import late_bins
from dxlrun_analysis.latency.latency_tables import blocks_table, duration, statistics_table, title
from dxlrun_analysis.latency.statistics import Block, Figures, Result
from dxlrun_analysis.page.canvas import MANY, Canvas, PlotLine
from dxlrun_analysis.page.envelope import Envelope
from dxlrun_analysis.page.run_curves import LEAST_US, Curves
from dxlrun_analysis.page.wake_up_plots import WakeUps, wake_up_plots

_MOST_ROWS = 6000


def page(result: Result, blocks: Sequence[Block], machine: str) -> str:
    """Return the HTML page of a measurement that has wake-ups; `machine` describes the machine."""
    top = header(
        "Wake-up latency",
        machine,
        title(result),
        (*(_sentence(one) for one in result.conditions), *result.remarks),
        not result.remarks,
        [(f"mean, {one.label}", duration(one.mean_us)) for one in result.conditions],
    )
    due_ns = np.concatenate([block.times[:, 0] for block in blocks])
    canvas = Canvas(int(due_ns.min()), int(due_ns.min()), int(due_ns.max()))
    tables = [statistics_table(result), *([blocks_table(result)] if result.blocks > 1 else [])]
    sections = [
        section("statistics", "Statistics", [table_element(table) for table in tables]),
        section("wake-ups", "Each wake-up", [*_about(result), *_plots(canvas, result, blocks)]),
    ]
    made = "Made by dxlrun latency. The element with id='report' contains the numbers of this page as JSON."
    return document("Wake-up latency", top, sections, footer(made), result, canvas.scripts())


def _sentence(one: Figures) -> str:
    share = (
        "" if one.processor_share is None else f", and uses {one.processor_share:.1%} of a core while waiting"
    )
    return (
        f"{one.label} wakes {duration(one.median_us)} late in the median, {duration(one.mean_us)} on "
        f"average, at most {duration(one.max_us)}{share}."
    )


def _about(result: Result) -> list[Element]:
    text = (
        f"{counted(result.blocks, 'block', 'blocks')} of each condition in turn, so that the machine's drift "
        "affects all equally."
    )
    return [paragraph(text)] if len(result.conditions) > 1 else []


def _plots(canvas: Canvas, result: Result, blocks: Sequence[Block]) -> list[Element]:
    envelope, series = Envelope(len(result.conditions), _MOST_ROWS, round(result.period_us * 1e3)), []
    samples = []
    for number, one in enumerate(result.conditions):
        times = np.concatenate([block.times for block in blocks if block.condition == one.name])
        late_ns = times[:, 1] - times[:, 0]
        values = np.full((len(times), len(result.conditions)), np.nan, np.float32)
        values[:, number] = np.maximum(late_ns / 1e3, LEAST_US)
        samples.append((times[:, 0], values))
        series.append(WakeUps(PlotLine(one.name, one.label, MANY[number % len(MANY)]), late_bins(late_ns)))
    times, values = map(np.concatenate, zip(*samples, strict=True))
    order = np.argsort(times, kind="stable")
    envelope.add_samples(times[order], values[order])
    curves = Curves.from_rows(
        envelope.rows().with_gaps(2 * envelope.apart_ns), [one.line.curve for one in series]
    )
    summary = " ".join(
        f"{one.label}: {one.wake_ups} wake-ups, mean {one.mean_us:.2f} us, standard deviation "
        f"{one.deviation_us:.2f} us, mode {one.mode_us} us, maximum {duration(one.max_us)}."
        for one in result.conditions
    )
    return canvas.elements(wake_up_plots(canvas, curves, series, summary))
