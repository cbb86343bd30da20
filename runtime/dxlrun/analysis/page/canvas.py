"""How the zoomable plots are drawn: Bokeh figures that share the time of the run, and their script.

Bokeh is imported in this room only, because it takes a second. Its script is a part of the page, so the page
loads nothing; the one line that starts it is all that it needs of ours.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxAnnotation,
    BoxZoomTool,
    ColumnDataSource,
    GlyphRenderer,
    HoverTool,
    Legend,
    LegendItem,
    LinearScale,
    Range1d,
    Span,
)
from bokeh.plotting import figure as bokeh_figure
from bokeh.resources import Resources
from numpy.typing import NDArray

from dxlrun.analysis.page.curves import Curves
from dxlrun.output.html import Element, data, figure, script
from dxlrun.run.channels.cycle import Floats

PAPER = "#ffffff"
INK, MUTED, GRID = "#1a1f26", "#5a6472", "#e1e5ea"
BLUE, ORANGE, GREEN, PURPLE = "#1f66cc", "#d9620a", "#12896b", "#8248b8"
WARNING, ERROR = "#a86a00", "#c0241b"
_MANY = (BLUE, ORANGE, GREEN, PURPLE, ERROR, "#0e8aa8", "#8a5a2b", "#c23c86", "#6b7f00", INK)
_DASHES = ("solid", "dashed", "dotted", "dotdash")
TIME = "time"
"""Name of the range that all plots of the run's time share."""
_TIME_LABEL = "time since the loop's first deadline, s"
_TOOLS = "xpan,xwheel_zoom,reset,save"
_LEFT = 78
"""Pixels left of all plots, so that their times stand above one another."""
_FEW_ROWS = 400
"""So few rows are drawn with a dot each."""
_FEW_NAMES, _NAMES_A_ROW = 6, 4
"""So many names stand in one row above a plot; more of them in several rows of so many."""
_NAME_HEIGHT = 15
_FONT = "DejaVu Sans, Verdana, system-ui, sans-serif"
_START = """
const plots = JSON.parse(document.getElementById("plots").textContent);
Bokeh.embed.embed_items(plots.documents, plots.items);
"""


@dataclass(frozen=True, slots=True)
class Line:
    """A curve in a plot."""

    curve: str
    """Its name among the curves."""
    name: str
    """For the legend."""
    colour: str
    dash: str = "solid"
    width: float = 1.2


def many_lines(curves: Iterable[tuple[str, str]]) -> list[Line]:
    """Return lines for curves and their names: ten colours, then the same ones dashed."""
    return [
        Line(curve, name, _MANY[number % len(_MANY)], _DASHES[number // len(_MANY) % len(_DASHES)])
        for number, (curve, name) in enumerate(curves)
    ]


@dataclass(slots=True)
class Plot:
    """One plot, with the words around it."""

    name: str
    title: str
    label: str
    """What it shows, for readers who cannot see it, where it has no title: at first its vertical axis'."""
    text: str
    """Its caption: what is drawn and what is found."""
    model: bokeh_figure
    _legend: list[LegendItem] = field(default_factory=list)

    def named(self, name: str, *drawn: GlyphRenderer) -> None:
        """Give what was drawn a name in the legend; a click on it hides them."""
        self._legend.append(LegendItem(label=name, renderers=list(drawn)))

    def finish(self) -> None:
        """Lay out the legend."""
        if not self._legend:
            return
        many = len(self._legend) > _FEW_NAMES
        columns = min(len(self._legend), _NAMES_A_ROW if many else _FEW_NAMES)
        legend = Legend(
            items=self._legend,
            orientation="horizontal",
            ncols=columns,
            click_policy="hide",
            location="right" if not many else "left",
            border_line_color=None,
            background_fill_alpha=0,
            label_text_font=_FONT,
            label_text_font_size="11px",
            label_text_color=MUTED,
            glyph_height=_NAME_HEIGHT,
            label_height=_NAME_HEIGHT,
            spacing=14,
            padding=0,
            margin=0,
        )
        self.model.add_layout(legend, "above")
        self.model.height += _NAME_HEIGHT * -(-len(self._legend) // columns)


@dataclass(slots=True)
class Canvas:
    """The plots of one page. Times are ns of the run's clock; plots show s since the first deadline."""

    start_ns: int
    """The first deadline."""
    begin_ns: int
    end_ns: int
    """From `begin_ns` to `end_ns` the plots show the run at first."""
    pauses: Sequence[tuple[float, float]] = ()
    """Shaded: begin and end, s."""
    changes: Sequence[float] = ()
    """When the run was steered, s: a dotted line each."""
    time: Range1d = field(init=False)
    _plots: list[Plot] = field(default_factory=list)
    _sources: list[tuple[Curves, ColumnDataSource]] = field(default_factory=list)

    def __post_init__(self) -> None:
        begin, end = self.seconds(np.array([self.begin_ns, self.end_ns])).tolist()
        margin = (end - begin) * 0.01 or 0.5
        self.time = Range1d(begin - margin, end + margin, name=TIME)

    def seconds(self, t_ns: NDArray[np.int64]) -> Floats:
        """Return times as the plots show them."""
        since: Floats = (t_ns - self.start_ns) / 1e9
        return since

    def timed(self, name: str, title: str, label: str, height: int, *, log: bool = False) -> Plot:
        """Return an empty plot over the time of the run; the caption is to be filled in."""
        plot = self._plot(name, title, (_TIME_LABEL, label), height, "y" if log else "", self.time)
        for begin, end in self.pauses:
            box = BoxAnnotation(left=begin, right=end, fill_color=MUTED, fill_alpha=0.13, line_color=None)
            plot.model.add_layout(box)
        for at in self.changes:
            span = Span(location=at, dimension="height", line_color=PURPLE, line_dash="dotted")
            plot.model.add_layout(span)
        return plot

    def free(self, name: str, title: str, axes: tuple[str, str], height: int, *, log: str = "") -> Plot:
        """Return an empty plot with labelled axes of its own; `log`: which of `xy` are logarithmic."""
        return self._plot(name, title, axes, height, log, None)

    def _plot(  # noqa: PLR0917  what the callers above fill in
        self, name: str, title: str, axes: tuple[str, str], height: int, log: str, time: Range1d | None
    ) -> Plot:
        model = bokeh_figure(
            name=name,
            height=height,
            sizing_mode="stretch_width",
            tools=_TOOLS,
            x_axis_type="log" if "x" in log else "linear",
            y_axis_type="log" if "y" in log else "linear",
            **({"x_range": time} if time is not None else {}),
        )
        zoom = BoxZoomTool(dimensions="auto")
        model.add_tools(zoom)
        model.toolbar.active_drag = zoom
        model.toolbar.logo = None
        model.toolbar.autohide = True
        model.toolbar_location, model.toolbar_inner = "above", True  # beside a low plot it has no room
        model.xaxis.axis_label, model.yaxis.axis_label = axes
        model.outline_line_color = None
        model.background_fill_color = model.border_fill_color = PAPER  # the ink is dark, pages may be, too
        model.min_border_left, model.min_border_right, model.min_border_top = _LEFT, 12, 6
        for axis in model.axis:
            axis.axis_label_text_font_style = "normal"
            axis.axis_label_text_font_size, axis.major_label_text_font_size = "11px", "10.5px"
            axis.axis_label_text_font = axis.major_label_text_font = _FONT
            axis.axis_label_text_color = axis.major_label_text_color = INK
            axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = MUTED
        model.grid.grid_line_color = GRID
        plot = Plot(name, title, axes[1], "", model)
        self._plots.append(plot)
        return plot

    # What is drawn

    def curves(
        self, plot: Plot, curves: Curves, lines: Sequence[Line], unit: str, least: float, *, band: bool = True
    ) -> None:
        """Draw the lines that have values; between the smallest and the largest value of a row a band.

        The axis spans at least so much: a joint at rest is a calm line, not the ticks of its servo.
        """
        shown = [line for line in lines if line.curve in curves]
        if not shown:
            plot.text = "Nothing was recorded."
            return
        source = self._source(curves)
        tips = []
        for line in shown:
            low, high = (self._column(source, curves, line.curve, side) for side in ("low", "high"))
            style = {"source": source, "color": line.colour, "line_dash": line.dash, "line_width": line.width}
            drawn = [plot.model.line("x", low, **style)]
            if high != low:
                drawn.append(plot.model.line("x", high, **style))
                if band:
                    drawn.append(
                        plot.model.varea("x", low, high, source=source, color=line.colour, alpha=0.25)
                    )
            if len(curves.rows.t_ns) <= _FEW_ROWS:
                drawn.append(plot.model.scatter("x", low, source=source, size=3, color=line.colour))
            plot.named(line.name, *drawn)
            to = f" to @{high}{{0.[0000]}}" if high != low else ""
            tips.append((line.name, f"@{low}{{0.[0000]}}{to} {unit}"))
        hover = HoverTool(
            renderers=[plot.model.renderers[0]], tooltips=[("time", "@x{0.0000} s"), *tips], mode="vline"
        )
        plot.model.add_tools(hover)
        low_end = min(float(np.nanmin(curves.low(line.curve))) for line in shown)
        high_end = max(float(np.nanmax(curves.high(line.curve))) for line in shown)
        missing = max(0.0, least - (high_end - low_end)) / 2 + 0.06 * (high_end - low_end)
        plot.model.y_range = Range1d(low_end - missing, high_end + missing)

    def marks(self, plot: Plot, curves: Curves, lines: Sequence[Line]) -> None:
        """Draw a row of ticks at the bottom of a plot for each line that marks some rows."""
        shown = [line for line in lines if line.curve in curves]
        if not shown:
            return
        plot.model.extra_y_ranges = {"marks": Range1d(0, 1)}
        plot.model.extra_y_scales = {"marks": LinearScale()}
        source = self._source(curves)
        for number, line in enumerate(shown):
            there = np.isfinite(curves.low(line.curve))
            column = f"m{curves.columns[line.curve]}"
            level = np.where(there, np.float32(0.04 + 0.07 * number), np.float32(np.nan))
            source.add(level.astype(np.float32), column)
            style = {"marker": "dash", "angle": np.pi / 2, "size": 7, "line_width": 1.5, "color": line.colour}
            drawn = plot.model.scatter("x", column, source=source, y_range_name="marks", **style)
            plot.named(line.name, drawn)

    def _source(self, curves: Curves) -> ColumnDataSource:
        for known, source in self._sources:
            if known is curves:
                return source
        source = ColumnDataSource({"x": self.seconds(curves.rows.t_ns)})
        self._sources.append((curves, source))
        return source

    def _column(self, source: ColumnDataSource, curves: Curves, name: str, side: str) -> str:
        """Return the column of a curve's smallest or largest values, the same one where they agree."""
        if side == "high" and curves.only_samples(name):
            side = "low"
        column = f"{side}{curves.columns[name]}"
        if column not in source.data:
            source.add((curves.low if side == "low" else curves.high)(name), column)
        return column

    # Into the page

    def elements(self, plots: Iterable[Plot]) -> list[Element]:
        """Return the places of plots in the page, each with its title and caption."""
        return [figure(plot.name, plot.title, _place(plot), plot.text) for plot in plots]

    def scripts(self) -> list[Element]:
        """Return what the page has at its end: the plots as JSON, Bokeh's script, and the line that draws."""
        if not self._plots:
            return []
        document = Document()
        with document.models.freeze():
            for plot in self._plots:
                plot.finish()
                document.add_root(plot.model)
        found = document.to_json(deferred=False)
        names: dict[str, str] = {}
        renamed = _renamed(found, names)
        roots = {names[plot.model.id]: _place_name(plot) for plot in self._plots}
        items = [{"docid": "run", "roots": roots, "root_ids": list(roots)}]
        text = json.dumps({"documents": {"run": renamed}, "items": items}, separators=(",", ":"))
        library = "\n".join(Resources(mode="inline", components=["bokeh"], minified=True).js_raw)
        return [data(text, "plots"), script(library), script(_START)]


def _place_name(plot: Plot) -> str:
    return f"plot-{plot.name}"


def _place(plot: Plot) -> Element:
    about = {
        "id": _place_name(plot),
        "class": "plot",
        "role": "img",
        "aria-label": ". ".join(words for words in (plot.title or plot.label, plot.text) if words),
    }
    return Element("div", {**about, "style": f"min-height: {plot.model.height}px"})


def _renamed(value: object, names: dict[str, str]) -> object:
    """Return a document with the identifiers of its models counted from 0: Bokeh counts on in a process."""
    if isinstance(value, Mapping):
        return {
            key: names.setdefault(one, f"m{len(names)}") if key == "id" else _renamed(one, names)
            for key, one in value.items()
        }
    return [_renamed(one, names) for one in value] if isinstance(value, list | tuple) else value
