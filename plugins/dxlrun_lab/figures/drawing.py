"""Drawing of the figures of HTML reports: SVG by matplotlib with the colours of the page, downsampling.

matplotlib is only imported in this package, because the import takes seconds. `Figure` is used without
pyplot, so nothing is kept globally and no display is needed.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from xml.etree import ElementTree as ET

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from dxlrun import Floats
from dxlrun.tooling import html

_COLUMNS = 900  # about the width of a figure in pixels
WIDTH = 9.0  # inches; the page scales the figure

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
"""Roles of the placeholder colours above. In the SVG, each becomes the CSS variable of its role, which the
page's style sheet defines for light and dark mode."""

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


def draw_figure(  # noqa: PLR0917  what the figure shows, from its name to its size
    name: str, title: str, alt: str, text: str, height: float, fill: Callable[[Figure], None]
) -> ET.Element:
    """Draw a figure with matplotlib, and return it as an element of an HTML report.

    Args:
        name: Identifier, unique in the page, of letters, digits and dashes.
        title: Title of the figure.
        alt: Description for screen readers: the axes with their units, and the finding.
        text: Caption.
        height: Height of the figure, inches.
        fill: Function that draws on the empty figure.
    """
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]  # the stubs want one literal type for all keys
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        fill(figure)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return html.figure(name, title, _svg(stream.getvalue(), name, (("title", title), ("desc", alt))), text)


def _svg(text: str, name: str, about: Sequence[tuple[str, str]]) -> ET.Element:
    """Convert matplotlib's SVG text for a page: unique identifiers, the page's colours, title, description.
    `name` is the figure's identifier; `about` has the tags and texts of title and description."""
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
                element.set(_NAMESPACE.sub("", key), _named(key, value, name))
    for parent in [root, *root.iter("defs")]:
        for child in [child for child in parent if child.tag in {"metadata", "style"}]:
            parent.remove(child)  # a style here would apply to the whole page
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)
    root.set("role", "img")
    root.set("aria-labelledby", " ".join(f"{name}-{tag}" for tag, _ in about))
    for number, (tag, content) in enumerate(about):
        element = ET.Element(tag, {"id": f"{name}-{tag}"})
        element.text = content
        root.insert(number, element)
    return root


def _named(key: str, value: str, name: str) -> str:
    """Return the value of an SVG attribute, with `name` before an identifier in it."""
    if key == "id":
        return f"{name}-{value}"
    if key.endswith("href"):
        return f"#{name}-{value[1:]}"
    return value.replace("url(#", f"url(#{name}-")


def reduced(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Downsample a series to the minimum and the maximum in each of 900 columns; return x and y.

    Args:
        x: Shape (samples,).
        y: Shape (samples,); NaN for a missing sample.
    """
    width = max(1, math.ceil(len(y) / _COLUMNS))
    if width == 1:
        return x, y
    first = np.arange(0, len(y), width)
    low = [start + int(np.argmin(_known(y[start : start + width], np.inf))) for start in first]
    high = [start + int(np.argmax(_known(y[start : start + width], -np.inf))) for start in first]
    picked = np.sort(np.stack([low, high], axis=1), axis=1).ravel()
    return x[picked], y[picked]


def _known(y: Floats, otherwise: float) -> Floats:
    return np.where(np.isnan(y), otherwise, y)
