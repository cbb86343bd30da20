"""A report for the terminal: the verdict first, then tables that fit its width."""

from __future__ import annotations

from dataclasses import dataclass

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from dxlrun.analysis.output.tables import Table, tables
from dxlrun.analysis.report import Report

_STYLES = {"plain": "", "warning": "yellow", "error": "red"}
_ROOM_FOR_DETAIL = 110
_WIDEST = 120
"""A line longer than this is hard to read, however wide the terminal."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A table that leaves out its details where the terminal is narrow."""

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = min(options.max_width, _WIDEST)
        kept = [
            index
            for index, column in enumerate(self.table.columns)
            if width >= _ROOM_FOR_DETAIL or not column.detail
        ]
        shown = RichTable(
            box=box.SIMPLE_HEAD, header_style="dim", padding=(0, 1, 0, 0), pad_edge=False, show_edge=False
        )
        for index in kept:
            column = self.table.columns[index]
            shown.add_column(
                column.name,
                justify="right" if column.kind == "number" else "left",
                overflow="fold",
            )
        for row in self.table.rows:
            shown.add_row(*(Text(row[index].text, style=_STYLES[row[index].tone]) for index in kept))
        yield Text("")
        yield Text(self.table.title, style="bold")
        yield from console.render(shown, options.update_width(width))


def render(report: Report) -> Group:
    """Return what a terminal shows of a report: sentences, then one table a subject that has something."""
    style = "green" if report.verdict.good else "yellow"
    sentences = (Text(sentence, style=style) for sentence in report.verdict.sentences)
    return Group(*sentences, *(Shown(table) for table in tables(report)))
