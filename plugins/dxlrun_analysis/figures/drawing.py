"""How figures are drawn: SVG with the page's colours, many samples on few columns.

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
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats

WIDTH = 9.0
"""Inches of 72 points; the page scales it."""

INK, MUTED, GRID, PAPER = "#0a0a01", "#0a0a02", "#0a0a03", "#0a0a04"
BLUE, ORANGE, GREEN, PURPLE = "#0a0a05", "#0a0a06", "#0a0a07", "#0a0a08"
WARNING, ERROR = "#0a0a09", "#0a0a0a"
DASHED = (0, (4, 3))
ROLES = dict(
    zip(
        (INK, MUTED, GRID, PAPER, BLUE, ORANGE, GREEN, PURPLE, WARNING, ERROR),
        ["ink", "muted", "grid", "paper", "blue", "orange", "green", "purple", "warning", "error"],
        strict=True,
    )
)
"""Each colour drawn is a role; the page's style sheet defines it, in light and in dark."""

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
class Caption:
    """Title and caption of a figure."""

    name: str
    """Unique in the page; letters, digits and dashes."""
    title: str
    alt: str
    """For readers who cannot see it: the axes with their units, and the finding."""
    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """One figure of the report."""

    caption: Caption
    svg: ET.Element
    """Without a namespace; each colour is a variable of the page's style sheet."""


def draw(caption: Caption, height: float, fill: Callable[[Figure], None]) -> Drawing:
    """Return the drawing that `fill` makes on an empty figure of `height` inches."""
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]  # the stubs want one literal type for all keys
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        fill(figure)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Drawing(caption, _svg(stream.getvalue(), caption))


def _svg(text: str, caption: Caption) -> ET.Element:
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
                element.set(_NAMESPACE.sub("", key), _named(key, value, caption.name))
    for parent in [root, *root.iter("defs")]:
        for child in [child for child in parent if child.tag in {"metadata", "style"}]:
            parent.remove(child)  # a style here would hold for the whole page, which has it in its own sheet
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)
    root.set("role", "img")
    root.set("aria-labelledby", f"{caption.name}-title {caption.name}-desc")
    for number, (tag, content) in enumerate((("title", caption.title), ("desc", caption.alt))):
        element = ET.Element(tag, {"id": f"{caption.name}-{tag}"})
        element.text = content
        root.insert(number, element)
    return root


def _named(key: str, value: str, name: str) -> str:
    """Return an attribute with its identifier, or the reference to one, made unique in the page."""
    if key == "id":
        return f"{name}-{value}"
    if key.endswith("href"):
        return f"#{name}-{value[1:]}"
    return value.replace("url(#", f"url(#{name}-")


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


# Columns


COLUMNS = 900
"""About as many as a figure has pixels across."""


@dataclass(frozen=True, slots=True)
class Columns:
    """How `count` samples are laid on columns of `width` samples each, the last one perhaps shorter."""

    count: int
    most: int = COLUMNS

    @property
    def width(self) -> int:
        """Samples a column."""
        return max(1, -(-self.count // self.most))

    @property
    def number(self) -> int:
        """Columns."""
        return -(-self.count // self.width)

    @property
    def whole(self) -> bool:
        """True where each sample has a column of its own: nothing is left out."""
        return self.width == 1

    def envelope(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the samples to draw: all, or the smallest and the largest of each column; NaN = no sample.

        x, y: shape (count,). A column without any number is NaN.
        """
        if self.whole:
            return x, y
        low = self._rows(np.where(np.isnan(y), np.inf, y), np.inf).argmin(axis=1)
        high = self._rows(np.where(np.isnan(y), -np.inf, y), -np.inf).argmax(axis=1)
        first = np.arange(self.number) * self.width
        picked = np.sort(np.stack([first + low, first + high], axis=1), axis=1).ravel()
        return x[picked], y[picked]

    def largest(self, y: Floats) -> NDArray[np.intp]:
        """Return the index of the largest sample of each column."""
        first = np.arange(self.number) * self.width
        picked: NDArray[np.intp] = first + self._rows(y, -np.inf).argmax(axis=1)
        return picked

    def bounds(self, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the smallest sample of each column, the median, and the largest; y has no NaN."""
        rows = self._rows(y, np.nan)
        return np.nanmin(rows, axis=1), np.nanmedian(rows, axis=1), np.nanmax(rows, axis=1)

    def note(self, what: str) -> str:
        """Return how the figure was drawn, in a sentence; empty where every sample is shown."""
        return "" if self.whole else f"Each column of the figure shows {what} of {self.width} cycles."

    def _rows(self, y: Floats, filler: float) -> Floats:
        missing = self.number * self.width - self.count
        return np.concatenate([y, np.full(missing, filler)]).reshape(self.number, self.width)
