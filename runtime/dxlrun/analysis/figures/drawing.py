"""How figures are drawn: sizes, colours by role, and SVG that takes its colours from the page.

matplotlib is imported here and in the other modules of this room only, because it takes seconds; `Figure` is
used without pyplot, so nothing global is kept and no display is needed.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

WIDTH = 9.0
"""Inches of 72 points; the page scales it."""

INK, MUTED, GRID, PAPER = "#0a0a01", "#0a0a02", "#0a0a03", "#0a0a04"
BLUE, ORANGE, GREEN, PURPLE = "#0a0a05", "#0a0a06", "#0a0a07", "#0a0a08"
WARNING, ERROR = "#0a0a09", "#0a0a0a"
DASHED = (0, (4, 3))
ROLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAPER: "paper",
    BLUE: "blue",
    ORANGE: "orange",
    GREEN: "green",
    PURPLE: "purple",
    WARNING: "warning",
    ERROR: "error",
}
"""Each colour drawn is a role; the page's style sheet says what it looks like, in light and in dark."""

_STYLE: dict[str, object] = {
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.xmargin": 0.01,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.5,
    "figure.facecolor": "none",
    "font.family": ["DejaVu Sans"],  # comes with matplotlib: the same layout everywhere
    "font.size": 8,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "svg.fonttype": "none",  # text stays text: it can be read aloud, searched and copied
    "svg.hashsalt": "dxlrun",  # the same log gives the same bytes
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 7.5,
}

_NAMESPACE = re.compile(r"^\{.*\}")
_REFERENCE = re.compile(r"(?<=url\(#)[\w.-]+|(?<=href=\"#)[\w.-]+")


@dataclass(frozen=True, slots=True)
class Words:
    """What is said about a figure."""

    name: str
    """Unique in the page; letters, digits and dashes."""
    title: str
    alt: str
    """What a person who does not see it has to know: the axes with their units, and the finding."""
    caption: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """One figure of the report."""

    words: Words
    svg: ET.Element
    """Without a namespace; each colour is a variable of the page's style sheet."""


def draw(words: Words, height: float, fill: Callable[[Figure], None]) -> Drawing:
    """Return the drawing that `fill` makes on an empty figure of `height` inches."""
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]  # the stubs want one literal type for all keys
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        fill(figure)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Drawing(words, _svg(stream.getvalue(), words))


def _svg(text: str, words: Words) -> ET.Element:
    """Return matplotlib's SVG as part of a page: own identifiers, title, description, the page's colours."""
    for colour, role in ROLES.items():
        text = text.replace(colour, f"var(--{role})")
    root = ET.fromstring(text)  # noqa: S314  written by matplotlib, a moment ago
    used = set(_REFERENCE.findall(text))
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        old = dict(element.attrib)
        element.attrib.clear()
        for key, value in old.items():
            if key != "id" or value in used:
                element.set(_NAMESPACE.sub("", key), _named(key, value, words.name))
    for parent in [root, *root.iter("defs")]:
        for child in [child for child in parent if child.tag in {"metadata", "style"}]:
            parent.remove(child)  # a style here would hold for the whole page, which has it in its own sheet
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)
    root.set("role", "img")
    root.set("aria-labelledby", f"{words.name}-title {words.name}-desc")
    for number, (tag, said) in enumerate((("title", words.title), ("desc", words.alt))):
        element = ET.Element(tag, {"id": f"{words.name}-{tag}"})
        element.text = said
        root.insert(number, element)
    return root


def _named(key: str, value: str, name: str) -> str:
    """Return an attribute whose identifier, or reference to one, is the one of the page."""
    if key == "id":
        return f"{name}-{value}"
    if key.endswith("href"):
        return f"#{name}-{value[1:]}"
    return value.replace("url(#", f"url(#{name}-")


def time_axis(axes: Axes) -> None:
    """Label the time of the run."""
    axes.set_xlabel("time since the loop's first deadline, s")


def duration_ticks(axes: Axes, which: str) -> None:
    """Write the ticks of a logarithmic axis in us as a person does: 100 us, 1 ms."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(FuncFormatter(lambda value, _: _decade(value)))
    axis.set_minor_formatter(NullFormatter())


def _decade(us: float) -> str:
    if us >= 1e6:
        return f"{us / 1e6:g} s"
    return f"{us / 1e3:g} ms" if us >= 1e3 else f"{us:g} us"


def reference(axes: Axes, us: float, words: str, *, vertical: bool, colour: str = MUTED) -> None:
    """Draw a dashed line at a duration that readers compare with, and name it."""
    (axes.axvline if vertical else axes.axhline)(us, color=colour, linewidth=0.8, linestyle=DASHED)
    axes.annotate(
        words,
        xy=(us, 1.0) if vertical else (1.0, us),
        xycoords=("data", "axes fraction") if vertical else ("axes fraction", "data"),
        xytext=(3, -2) if vertical else (-2, 2),
        textcoords="offset points",
        ha="left" if vertical else "right",
        va="top" if vertical else "bottom",
        color=colour,
        fontsize=7.5,
    )
