"""Tables on terminals that are too narrow for them."""

from __future__ import annotations

import textwrap

from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

_UNBOUNDED = Console(width=10_000)


def fitting(table: Table, width: int) -> RenderableType:
    """Return a table as it is where it fits, else a paragraph a row: nothing is cut or squeezed."""
    if Measurement.get(_UNBOUNDED, _UNBOUNDED.options, table).maximum <= width:
        return table
    lines = [str(table.title)] if table.title else []
    names = [str(column.header) for column in table.columns]
    for first, *rest in zip(*(column.cells for column in table.columns), strict=True):
        cells = [" ".join(str(cell).split()) for cell in rest]
        of = f"{names[0]} {first}" if str(first).isdigit() else str(first)
        facts = ", ".join(f"{name} {cell}" for name, cell in zip(names[1:], cells, strict=True) if cell)
        lines.append(textwrap.fill(f"{of}: {facts}", max(width - 1, 20), subsequent_indent="  "))
    return Text("\n".join(lines) + "\n" * bool(table.title))
