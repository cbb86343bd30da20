"""Table: tables and lines as data: the same numbers for a terminal and for a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from operator import attrgetter
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

from dxlrun.output.escaping import escaped

if TYPE_CHECKING:
    from dxlrun.output.graph import Graph

T = TypeVar("T")
Kind = Literal["name", "number", "text"]
Tone = Literal["plain", "good", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell; its tone marks values that need attention."""

    text: str
    tone: Tone = "plain"


Value = Cell | str | float | None
"""A cell's content (int included); None: empty."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column and the format of its values."""

    name: str
    kind: Kind = "number"
    """Numbers are right-aligned; only texts may be wrapped."""
    form: str = "{}"
    """Format string, with the unit."""
    missing: str = ""
    """Text in place of None."""
    detail: bool = False
    """True for a column that is omitted when space is short, beginning with the last one."""

    def cell(self, value: Value) -> Cell:
        """Return the formatted cell of a value."""
        if isinstance(value, Cell):
            return value
        return Cell(self.missing if value is None else self.form.format(value))


Columns: TypeAlias = Sequence[tuple[Column, str | Callable[[T], Value]]]
"""Columns with the source of their values: the name of an attribute or a key, or a function."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells under columns. Without column names, the first column names the rows."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, title: str, columns: Iterable[Column], rows: Iterable[Iterable[Value]]) -> Table:
        """Return a table of rows with one value per column."""
        columns = tuple(columns)
        cells = (zip(columns, row, strict=True) for row in rows)
        return cls(title, columns, tuple(tuple(column.cell(value) for column, value in row) for row in cells))

    @classmethod
    def listing(cls, title: str, columns: Columns[T], things: Iterable[T]) -> Table:
        """Return a table with one row per object."""
        rows = ([_value(thing, value) for _, value in columns] for thing in things)
        return cls.of(title, (column for column, _ in columns), rows)

    @classmethod
    def facts(cls, title: str, facts: Iterable[tuple[str, Value]]) -> Table:
        """Return a table of names and values, without empty values."""
        columns = (Column("", "name"), Column("", "text"))
        return cls.of(title, columns, ((name, value) for name, value in facts if value not in (None, "")))

    def escaped(self) -> Table:
        """Return the table with escaped texts."""
        cells = (tuple(replace(cell, text=escaped(cell.text)) for cell in row) for row in self.rows)
        columns = tuple(replace(column, name=escaped(column.name)) for column in self.columns)
        return Table(escaped(self.title), columns, tuple(cells))

    def without_constants(self) -> tuple[str, Table]:
        """Return a sentence about columns that are equal in all rows, and the table without them."""
        first = self.rows[0]
        same = [
            index > 0 and all(row[index].text == first[index].text for row in self.rows)
            for index in range(len(self.columns))
        ]
        said = (
            f"{column.name} {cell.text}"
            for column, cell, constant in zip(self.columns, first, same, strict=True)
            if constant and cell.text
        )
        return ", ".join(said), self._keeping([not constant for constant in same])

    def less(self) -> Table | None:
        """Return the table without its last omissible column; None without one."""
        last = max((index for index, column in enumerate(self.columns) if column.detail), default=None)
        return None if last is None else self._keeping([index != last for index in range(len(self.columns))])

    def _keeping(self, kept: Sequence[bool]) -> Table:
        columns = tuple(compress(self.columns, kept))
        return replace(self, columns=columns, rows=tuple(tuple(compress(row, kept)) for row in self.rows))

    def turned(self) -> Table:
        """Return a transposed table, for rows that differ only in the first column."""
        names = Cell(", ".join(row[0].text for row in self.rows))
        cells = zip(self.columns, (names, *self.rows[0][1:]), strict=True)
        return Table.facts(self.title, ((column.name, cell) for column, cell in cells if cell.text))

    def marked(self, rows: Iterable[bool]) -> Table:
        """Return the table with all cells of these rows marked as errors."""
        pairs = zip(self.rows, rows, strict=True)
        cells = (tuple(Cell(cell.text, "error") for cell in row) if bad else row for row, bad in pairs)
        return replace(self, rows=tuple(cells))


def _value(thing: T, value: str | Callable[[T], Value]) -> Value:
    if not isinstance(value, str):
        return value(thing)
    found: Value = thing[value] if isinstance(thing, Mapping) else attrgetter(value)(thing)
    return found


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence on its own line; never wrapped, so that commands in it can be copied."""

    text: str
    tone: Tone = "plain"


Part: TypeAlias = "Table | Graph | Sentence | str"
"""A part of the output; a string is a plain line."""


def flagged(count: int, text: str = "", tone: Tone = "warning") -> Cell:
    """Return a cell with a count or a text about it, with a tone unless the count is 0."""
    return Cell(text or str(count), tone if count else "plain")


def numbers(*names: str) -> Sequence[Column]:
    """Return columns of numbers."""
    return [Column(name) for name in names]


def microseconds(value: float) -> str:
    """Format a time, given in us, in us, ms or s."""
    if value >= 1e6:
        return f"{value / 1e6:.2f} s"
    return f"{value / 1e3:.2f} ms" if value >= 1e4 else f"{value:.0f} us"
