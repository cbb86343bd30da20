"""Plots of a page: Bokeh figures, which share the time axis of the run, and the script that draws them.

Only this room imports Bokeh, because the import takes a second. The page embeds Bokeh's script and loads
nothing; it needs only a short script of ours that starts Bokeh.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxAnnotation,
    BoxZoomTool,
    ColumnDataSource,
    FixedTicker,
    GlyphRenderer,
    HoverTool,
    LinearScale,
    Range1d,
    Span,
)
from bokeh.plotting import figure as bokeh_figure
from bokeh.resources import Resources
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun.tooling.html import data, figure, script
from dxlrun_analysis.page.run_curves import Curves

PAPER = "#ffffff"
INK, MUTED, GRID = "#1a1f26", "#5a6472", "#e1e5ea"
BLUE, ORANGE, GREEN, PURPLE = "#1f66cc", "#d9620a", "#12896b", "#8248b8"
WARNING, ERROR = "#a86a00", "#c0241b"
MANY = (BLUE, ORANGE, GREEN, PURPLE, ERROR, "#0e8aa8", "#8a5a2b", "#c23c86", "#6b7f00", INK)
_DASHES = ("solid", "dashed", "dotted", "dotdash")
TIME = "time"  # Name of the range that all plots over the time of the run share
_TIME_LABEL = "time since the first deadline, s"
_TOOLS = "xpan,xwheel_zoom,reset,save"
_LEFT = 78  # Pixels left of all plots, which aligns their time axes
_ALIKE = 0.95  # Share of common samples from which curves are compared
_DURATIONS = tuple(10**exponent for exponent in range(8))  # us, from 1 us to 10 s
_FEW_BANDS = 5  # More overlapping bands would hide the curves
_FEW_ROWS = 60  # With at most this many rows, each row is drawn as a dot
_FONT = "DejaVu Sans, Verdana, system-ui, sans-serif"
_START = """
const plots = JSON.parse(document.getElementById("plots").textContent);
Bokeh.embed.embed_items(plots.documents, plots.items);
document.addEventListener("click", ({target}) => {
  if (!target.matches(".legend button")) return;
  const visible = !target.classList.toggle("hidden"), name = target.closest("figure").id;
  const plot = Bokeh.documents[0].roots().find(root => root.name === name);
  for (const drawn of plot.renderers) if (drawn.name === target.textContent) drawn.visible = visible;
});
"""


@dataclass(frozen=True, slots=True)
class PlotLine:
    """Appearance of one curve in a plot: legend, colour, dashes and width."""

    curve: str  # Name of the curve in `Curves`
    name: str  # Text in the legend
    colour: str
    dash: str = "solid"
    width: float = 1.2


def many_lines(curves: Curves, named: Iterable[tuple[str, str]]) -> list[PlotLine]:
    """Return a line for each curve that has values, in ten colours, then the same ones dashed; `named` are
    pairs of curve and legend.

    Equal curves become one line with all their names, because they would hide each other.
    """
    found: dict[str, list[str]] = {}
    for curve, name in named:
        if curve in curves:
            same = next((one for one in found if _alike(curves, one, curve)), curve)
            found.setdefault(same, []).append(name)
    return [
        PlotLine(
            curve, ", ".join(names), MANY[number % len(MANY)], _DASHES[number // len(MANY) % len(_DASHES)]
        )
        for number, (curve, names) in enumerate(found.items())
    ]


def _alike(curves: Curves, one: str, other: str) -> bool:
    """Return whether two curves have values at nearly the same times, and equal ones there."""
    known = np.isfinite([curves.low(one), curves.low(other)])
    both = known.all(axis=0)
    equal = (np.array_equal(side(one)[both], side(other)[both]) for side in (curves.low, curves.high))
    return bool(both.sum() > _ALIKE * known.any(axis=0).sum()) and all(equal)


@dataclass(slots=True)
class Plot:
    """One plot of a page: Bokeh figure, title, caption and legend."""

    name: str
    title: str
    label: str
    """Description for screen readers if the plot has no title; by default the label of the vertical axis."""
    text: str  # Caption: content of the plot and results
    model: bokeh_figure
    _legend: list[Element] = field(default_factory=list)

    def ticks(self, axis: str, names: Mapping[float, str], minor: Sequence[float] = ()) -> None:
        """Put named ticks at their positions on the axis `x` or `y`."""
        (one,) = getattr(self.model, f"{axis}axis")
        one.ticker = FixedTicker(ticks=list(names), minor_ticks=list(minor))
        one.major_label_overrides = dict(names)

    def rows(self, names: Sequence[str]) -> None:
        """Make the vertical axis a list of named rows, the first at the top."""
        self.model.y_range = Range1d(len(names) - 0.5, -0.5)
        self.ticks("y", dict(enumerate(names)))
        self.model.ygrid.grid_line_color = None

    def durations(self, axis: str) -> None:
        """Label the ticks of a logarithmic axis (`x` or `y`) in us with readable units: 100 us, 1 ms."""
        names = {
            us: f"{us // 10**6} s" if us >= 10**6 else f"{us // 1000} ms" if us >= 1000 else f"{us} us"
            for us in _DURATIONS
        }
        self.ticks(axis, names, [part * us for us in _DURATIONS for part in (2, 5)])

    def reference(self, at: float, dimension: str, colour: str = MUTED) -> None:
        """Draw a dashed line at a value, across the plot's `width` or `height`."""
        self.model.add_layout(Span(location=at, dimension=dimension, line_color=colour, line_dash="dashed"))

    def hover(self, drawn: GlyphRenderer, *tips: tuple[str, str]) -> None:
        """Show a tooltip over a drawn element; each tip is a pair of name and Bokeh format."""
        self.model.add_tools(HoverTool(renderers=[drawn], tooltips=list(tips)))

    def named(self, name: str, *drawn: GlyphRenderer) -> None:
        """Add a legend entry, in the colour of the first, that hides drawn elements by a click."""
        for one in drawn:
            one.name = name
        glyph = drawn[0].glyph
        kind = f"{type(glyph).__name__.lower()}{' dashed' if getattr(glyph, 'line_dash', None) else ''}"
        self._legend.append(Element("button", {"class": kind, "style": f"color: {glyph.line_color}"}))
        self._legend[-1].text = name

    @property
    def place_name(self) -> str:
        """Identifier of the HTML element that the plot is drawn in."""
        return f"plot-{self.name}"

    def build_placeholder(self) -> Element:
        """Return the HTML element with the legend, and the empty element that the plot is drawn in."""
        about = {
            "id": self.place_name,
            "class": "plot",
            "role": "img",
            "aria-label": ". ".join(words for words in (self.title or self.label, self.text) if words),
            "style": f"min-height: {self.model.height}px",
        }
        place = Element("div")
        if self._legend:
            ET.SubElement(place, "p", {"class": "legend"}).extend(self._legend)
        ET.SubElement(place, "div", about)
        return place


@dataclass(slots=True)
class Canvas:
    """All plots of one page, with their common time axis. Times are ns of the run's clock; plots show s
    since the first deadline."""

    start_ns: int  # First deadline
    begin_ns: int
    end_ns: int  # Initially visible: from `begin_ns` to `end_ns`
    pauses: Sequence[tuple[float, float]] = ()  # Shaded intervals: begin and end, s
    changes: Sequence[float] = ()  # Times of steering, s, drawn as dotted lines
    time: Range1d = field(init=False)
    _plots: list[Plot] = field(default_factory=list)
    _sources: list[tuple[Curves, ColumnDataSource]] = field(default_factory=list)

    def __post_init__(self) -> None:
        begin, end = self.seconds(np.array([self.begin_ns, self.end_ns])).tolist()
        margin = (end - begin) * 0.01 or 0.5
        self.time = Range1d(begin - margin, end + margin, name=TIME)

    def seconds(self, t_ns: NDArray[np.int64]) -> Floats:
        """Convert times in ns of the run's clock to s since the first deadline."""
        since: Floats = (t_ns - self.start_ns) / 1e9
        return since

    @property
    def names(self) -> frozenset[str]:
        """Names of the plots that were added to the page."""
        return frozenset(plot.name for plot in self._plots)

    def timed(self, name: str, title: str, label: str, height: int, *, log: bool = False) -> Plot:
        """Add an empty plot over the time of the run, without a caption, to the page; with `log`, its
        vertical axis is logarithmic."""
        plot = self.free(name, title, (_TIME_LABEL, label), height, "y" if log else "", self.time)
        for begin, end in self.pauses:
            box = BoxAnnotation(left=begin, right=end, fill_color=MUTED, fill_alpha=0.13, line_color=None)
            plot.model.add_layout(box)
        for at in self.changes:
            span = Span(location=at, dimension="height", line_color=PURPLE, line_dash="dotted")
            plot.model.add_layout(span)
        return plot

    def free(  # noqa: PLR0917  what the plot is, from its name to its axes
        self,
        name: str,
        title: str,
        axes: tuple[str, str],
        height: int,
        log: str = "",
        time: Range1d | None = None,
    ) -> Plot:
        """Add an empty plot with axis labels for x and y to the page; `log` names the logarithmic axes
        (`x`, `y`, `xy`), `time` a shared x range."""
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
        # A low plot has no room for the toolbar next to it.
        model.toolbar_location, model.toolbar_inner = "above", True
        model.xaxis.axis_label, model.yaxis.axis_label = axes
        model.outline_line_color = None
        # The text is dark, and the page can be dark as well.
        model.background_fill_color = model.border_fill_color = PAPER
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

    # Content of plots

    def curves(  # noqa: PLR0917  what is drawn, and how its axis is laid out
        self,
        plot: Plot,
        curves: Curves,
        lines: Sequence[PlotLine],
        unit: str,
        least: float,
        scale: float = 1.0,
    ) -> None:
        """Draw curves into a plot, later ones on top, with a band from smallest to largest value.

        Args:
            plot: The plot.
            curves: The curves.
            lines: Lines to draw.
            unit: Unit of the drawn values.
            least: Least span of the axis. It makes a joint at rest a calm line, not the ticks of its
                servo.
            scale: Factor on the values.
        """
        shown = [line for line in lines if line.curve in curves]
        if not shown:
            plot.text = "Nothing was recorded."
            return
        source = self._source(curves)
        tips = []
        for line in shown:
            low, high = (self._column(source, curves, line.curve, side, scale) for side in ("low", "high"))
            style = {"source": source, "color": line.colour}
            edges = dict.fromkeys((low, high))
            drawn = [
                plot.model.line("x", y, line_dash=line.dash, line_width=line.width, **style) for y in edges
            ]
            if high != low and len(shown) <= _FEW_BANDS:
                drawn.append(plot.model.varea("x", low, high, fill_alpha=0.25, level="underlay", **style))
            if len(curves.rows.t_ns) <= _FEW_ROWS:
                drawn.append(plot.model.scatter("x", low, size=1 + line.width, **style))
            plot.named(line.name, *drawn)
            to = f" to @{high}{{0.[0000]}}" if high != low else ""
            tips.append((line.name, f"@{low}{{0.[0000]}}{to} {unit}"))
        hover = HoverTool(
            renderers=[plot.model.renderers[0]], tooltips=[("time", "@x{0.0000} s"), *tips], mode="vline"
        )
        plot.model.add_tools(hover)
        low_end = scale * min(float(np.nanmin(curves.low(line.curve))) for line in shown)
        high_end = scale * max(float(np.nanmax(curves.high(line.curve))) for line in shown)
        missing = max(0.0, least - (high_end - low_end)) / 2 + 0.06 * (high_end - low_end)
        plot.model.y_range = Range1d(low_end - missing, high_end + missing)

    def marks(self, plot: Plot, curves: Curves, lines: Sequence[PlotLine]) -> None:
        """Draw a row of ticks at the bottom of a plot for each line, where its curve has a value."""
        shown = [line for line in lines if line.curve in curves]
        if not shown:
            return
        plot.model.extra_y_ranges = {"marks": Range1d(0, 1)}
        plot.model.extra_y_scales = {"marks": LinearScale()}
        if isinstance(plot.model.y_range, Range1d):
            low, high = plot.model.y_range.start, plot.model.y_range.end
            plot.model.y_range.start = low - 0.08 * len(shown) * (high - low)
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

    def _column(self, source: ColumnDataSource, curves: Curves, name: str, side: str, scale: float) -> str:
        """Add the smallest (`low`) or largest (`high`) values of a curve to a Bokeh source, and return the
        column's name; equal ones share a column."""
        if side == "high" and curves.only_samples(name):
            side = "low"
        column = f"{side}{curves.columns[name]}"
        if column not in source.data:
            values = (curves.low if side == "low" else curves.high)(name)
            source.add(values * np.float32(scale), column)
        return column

    # Output

    def elements(self, plots: Iterable[Plot]) -> list[Element]:
        """Return the HTML elements of plots, each with its title and caption."""
        return [figure(plot.name, plot.title, plot.build_placeholder(), plot.text) for plot in plots]

    def scripts(self) -> list[Element]:
        """Return the script elements at the end of the page: plots as JSON, Bokeh's script, start script."""
        if not self._plots:
            return []
        document = Document()
        with document.models.freeze():
            for plot in self._plots:
                document.add_root(plot.model)
        found = document.to_json(deferred=False)
        names: dict[str, str] = {}
        renamed = _renamed(found, names)
        roots = {names[plot.model.id]: plot.place_name for plot in self._plots}
        items = [{"docid": "run", "roots": roots, "root_ids": list(roots)}]
        text = json.dumps({"documents": {"run": renamed}, "items": items}, separators=(",", ":"))
        library = "\n".join(Resources(mode="inline", components=["bokeh"], minified=True).js_raw)
        return [data(text, "plots"), script(library), script(_START)]


def _renamed(value: object, names: dict[str, str]) -> object:
    """Return Bokeh's JSON with models' identifiers counted from 0, so that the page is reproducible.

    Bokeh counts identifiers over the lifetime of a process.
    """
    if isinstance(value, Mapping):
        return {
            key: names.setdefault(one, f"m{len(names)}") if key == "id" else _renamed(one, names)
            for key, one in value.items()
        }
    return [_renamed(one, names) for one in value] if isinstance(value, list | tuple) else value
