"""Plots of the worst cycles: timelines of loop and packets, with the planned times of replies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, Range1d

from dxlrun_analysis.causes.cause_tables import worst_title
from dxlrun_analysis.cycles.worst_cycles import TimelinePacket, WorstCycle
from dxlrun_analysis.page.canvas import BLUE, ERROR, GREEN, INK, MUTED, ORANGE, WARNING, Canvas, Plot
from dxlwire import BROADCAST_ID

MOST_CYCLES = 5  # Number of cycles with a plot
MOST_PACKETS = 400  # Per cycle, because the number of noise packets is unlimited
_ROW = 17  # Pixels per row
_MS = 10_000  # us; longer cycles are drawn in ms
_KINDS = (
    ("instruction", "instruction", ORANGE),
    ("status", "reply", BLUE),
    ("late", "late reply", WARNING),
    ("noise", "noise", INK),
    ("other host", "another host's instruction", ERROR),
    ("echo", "echo", MUTED),
)


def worst_plots(canvas: Canvas, worst: Sequence[WorstCycle]) -> list[Plot]:
    """Return the timeline plots of the five worst cycles, the worst first."""
    return [_timeline(canvas, number, one) for number, one in enumerate(worst[:MOST_CYCLES])]


def _timeline(canvas: Canvas, number: int, one: WorstCycle) -> Plot:
    packets = one.packets[:MOST_PACKETS]
    rows: dict[tuple[str, int], int] = {}
    for packet in packets:
        rows.setdefault((packet.bus, packet.servo_id), len(rows) + 1)
    joints = {(packet.bus, packet.servo_id): packet.joint for packet in packets if packet.joint}
    names = ["loop", *(_name(bus, servo, joints.get((bus, servo), "")) for bus, servo in rows)]
    ends = [one.woken_us, one.written_us, one.period_us]
    ends += [time for packet in packets for time in (packet.begin_us, packet.end_us, packet.planned_us or 0)]
    begin, end = min(0.0, *ends), max(ends)
    scale, unit = (1e3, "ms") if end - begin > _MS else (1.0, "us")
    axes = (f"time since the cycle was due, {unit}", "")
    plot = canvas.free(f"worst-{number}", worst_title(one), axes, 80 + _ROW * len(names))
    plot.reference(0.0, "height")
    plot.reference(one.period_us / scale, "height", ERROR)
    _loop(plot, one, scale, unit)
    _packets(plot, packets, [rows[packet.bus, packet.servo_id] for packet in packets], scale, unit)
    plot.rows(names)
    margin = 0.02 * (end - begin) or 1.0
    plot.model.x_range = Range1d((begin - margin) / scale, (end + margin) / scale)
    plot.text = _caption(one, len(packets))
    return plot


def _name(bus: str, servo: int, joint: str) -> str:
    return f"{bus}, all" if servo == BROADCAST_ID else f"{joint or bus} {servo}"


def _loop(plot: Plot, one: WorstCycle, scale: float, unit: str) -> None:
    """Draw the steps of the loop as bars in the top row of a timeline."""
    steps = (
        ("late wake-up", 0.0, one.woken_us, WARNING),
        ("read", one.woken_us, one.read_us, BLUE),
        ("update", one.read_us, one.updated_us, GREEN),
        ("write", one.updated_us, one.written_us, ORANGE),
    )
    for name, begin, end, colour in steps:
        if end <= begin:
            continue
        source = ColumnDataSource({"y": [0], "begin": [begin / scale], "end": [end / scale], "what": [name]})
        style = {"source": source, "height": 0.7, "color": colour, "fill_alpha": 0.45}
        drawn = plot.model.hbar("y", left="begin", right="end", **style)
        plot.hover(drawn, ("", "@what"), *_span(unit))
        plot.named(name, drawn)


def _packets(
    plot: Plot, packets: Sequence[TimelinePacket], rows: Sequence[int], scale: float, unit: str
) -> None:
    """Draw packets into a timeline, in the rows of their servos: a bar with a tick at the last byte, and
    the planned time."""
    for kind, name, colour in _KINDS:
        mine = [(packet, row) for packet, row in zip(packets, rows, strict=True) if packet.kind == kind]
        if not mine:
            continue
        planned = [np.nan if one.planned_us is None else one.planned_us / scale for one, _ in mine]
        source = ColumnDataSource(
            {
                "y": [row for _, row in mine],
                "begin": [one.begin_us / scale for one, _ in mine],
                "end": [one.end_us / scale for one, _ in mine],
                "planned": planned,
                "of": [_name(one.bus, one.servo_id, one.joint) for one, _ in mine],
                "bytes": [one.size for one, _ in mine],
            }
        )
        bars = plot.model.segment("begin", "y", "end", "y", source=source, color=colour, line_width=7)
        ticks = plot.model.scatter(
            "end", "y", source=source, marker="dash", angle=np.pi / 2, size=11, line_width=2, color=colour
        )
        tips = [(name, "@of, @bytes bytes"), *_span(unit)]
        if kind == "status":
            tips.append(("planned", f"@planned{{0.[000]}} {unit}"))
            late = plot.model.segment("planned", "y", "end", "y", source=source, color=MUTED)
            due = plot.model.scatter(
                "planned", "y", source=source, marker="diamond", size=8, fill_color=None, line_color=INK
            )
            plot.named("reply as planned", due, late)
        plot.named(name, bars, ticks)
        plot.hover(ticks, *tips)


def _span(unit: str) -> tuple[tuple[str, str], ...]:
    return ("begins", f"@begin{{0.[000]}} {unit}"), ("ends", f"@end{{0.[000]}} {unit}")


def _caption(one: WorstCycle, drawn: int) -> str:
    text = (
        "Dashed: due time of the cycle, and end of its period. A reply's bar goes from its first byte to "
        "its last as read; the diamond is the planned time of the last byte."
    )
    more = len(one.packets) - drawn
    return f"{text} {more} more packets are not drawn." if more else text
