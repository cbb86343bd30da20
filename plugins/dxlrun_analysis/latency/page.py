"""A measurement as one page with the thesis' three figures; takes matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlrun.errors import counted
from dxlrun.output.html import Element, document, figure, footer, header, paragraph, section, table_element
from dxlrun_analysis.figures.wake_ups import WakeUps, wake_up_drawings
from dxlrun_analysis.latency.statistics import Block, Figures, Result
from dxlrun_analysis.latency.tables import blocks_table, duration, statistics_table, title


def page(result: Result, blocks: Sequence[Block], machine: str) -> str:
    """Return the page of a measurement that has wake-ups; `machine` names the one it was made on."""
    top = header(
        "Wake-up latency",
        machine,
        title(result),
        (*(_sentence(one) for one in result.conditions), *result.remarks),
        not result.remarks,
        [(f"mean, {one.label}", duration(one.mean_us)) for one in result.conditions],
    )
    tables = [statistics_table(result), *([blocks_table(result)] if result.blocks > 1 else [])]
    sections = [
        section("statistics", "Statistics", [table_element(table) for table in tables]),
        section("plots", "Each wake-up", [*_about(result), *_figures(result, blocks)]),
    ]
    made = (
        "Made by dxlrun latency. The numbers of this page are in it as JSON, in the element with the "
        "identifier report."
    )
    return document("Wake-up latency", top, sections, footer(made), result)


def _sentence(one: Figures) -> str:
    share = (
        "" if one.processor_share is None else f", and takes {one.processor_share:.1%} of a core for waiting"
    )
    return (
        f"{one.label} wakes {duration(one.median_us)} late in the median, {duration(one.mean_us)} on "
        f"average, at most {duration(one.max_us)}{share}."
    )


def _about(result: Result) -> list[Element]:
    text = (
        f"{counted(result.blocks, 'block', 'blocks')} of each condition in turn, so that the machine's drift "
        "meets all alike; the iterations of all blocks are drawn one behind the other."
    )
    return [paragraph(text)] if len(result.conditions) > 1 else []


def _figures(result: Result, blocks: Sequence[Block]) -> list[Element]:
    series = []
    for one in result.conditions:
        own = [block.late_us for block in blocks if block.condition == one.name and len(block.times)]
        late = np.concatenate(own)
        label = one.label if len(result.conditions) > 1 else ""
        series.append(WakeUps(label, late, np.arange(len(late), dtype=np.float64)))
    summary = " ".join(
        f"{one.label}: {one.wake_ups} wake-ups, mean {one.mean_us:.2f} us, standard deviation "
        f"{one.deviation_us:.2f} us, mode {one.mode_us} us, maximum {duration(one.max_us)}."
        for one in result.conditions
    )
    drawings = wake_up_drawings(series, result.period_us, "one period", summary)
    return [
        figure(drawing.caption.name, drawing.caption.title, drawing.svg, drawing.caption.text)
        for drawing in drawings
    ]
