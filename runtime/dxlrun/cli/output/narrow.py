"""Tables on terminals that are too narrow for them."""

from __future__ import annotations

import io
import textwrap

from rich.console import Console, Group, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

_UNBOUNDED = Console(file=io.StringIO(), width=10_000)  # no terminal: a dumb one has 80 columns, always

_FOLDED = 28
"""Columns that are left to what may be folded, where a table is too wide."""


def fitting(table: Table, width: int) -> RenderableType:
    """Return a table as it is where it fits, else with short heads, else paragraphs: nothing is cut."""
    names = [str(column.header) for column in table.columns]
    if _fits(table, width):
        return table
    for column in table.columns:
        if column.overflow == "fold":
            column.max_width = _FOLDED
    if _fits(table, width):
        return table
    for column, name in zip(table.columns, names, strict=True):
        column.header = name.replace(" ", "\n")
    table.pad_edge = table.show_edge = False
    table.padding = 0 if table.box else (0, 1, 0, 0)  # a box has blanks of its own between its columns
    if _fits(table, width):
        return Group(table, "") if table.title else table
    lines = [str(table.title)] if table.title else []
    for first, *rest in zip(*(column.cells for column in table.columns), strict=True):
        cells = [" ".join(str(cell).split()) for cell in rest]
        of = f"{names[0]} {first}" if str(first).isdigit() else str(first)
        facts = ", ".join(f"{name} {cell}" for name, cell in zip(names[1:], cells, strict=True) if cell)
        lines.append(
            textwrap.fill(
                f"{of}: {facts}", max(width - 1, 20), subsequent_indent="  ", break_on_hyphens=False
            )
        )
    return Text("\n".join(lines) + "\n" * bool(table.title))


def _fits(table: Table, width: int) -> bool:
    return Measurement.get(_UNBOUNDED, _UNBOUNDED.options, table).maximum <= width
