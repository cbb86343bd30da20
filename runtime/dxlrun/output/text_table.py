"""Table: tables and lines as data, to be printed in a terminal or put on a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import compress
from operator import attrgetter
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, TypeVar

from dxlrun.output.escaping import escaped

if TYPE_CHECKING:
    from dxlrun.output.graph import Graph

T = TypeVar("T")
Kind = Literal["name", "number", "text"]
Tone = Literal["plain", "good", "warning", "error"]


class Cell(NamedTuple):
    """Text of a table's cell; its tone (good, warning, error) becomes a colour."""

    text: str
    tone: Tone = "plain"


Value = Cell | str | float | None
"""Value for a cell before formatting (int included); None: an empty cell."""


class Column(NamedTuple):
    """Name of a column, and how its values are formatted and aligned."""

    name: str
    kind: Kind = "number"
    """Kind of values: numbers are right-aligned; only `text` columns may be wrapped."""
    form: str = "{}"
    """Format string for the values, which may add a unit."""
    missing: str = ""
    """Text of a cell whose value is None."""
    detail: bool = False
    """True if the column may be omitted when space is short; the last one goes first."""

    def cell(self, value: Value) -> Cell:
        """Format a value as a cell; None becomes `missing`."""
        if isinstance(value, Cell):
            return value
        return Cell(self.missing if value is None else self.form.format(value))


Columns: TypeAlias = Sequence[tuple[Column, str | Callable[[T], Value]]]
"""Columns, each with the source of its values: an attribute or key of the row's object, or a function."""


class Table(NamedTuple):
    """A table: title, columns, and rows of cells. If columns have no names, the first names the rows."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def from_rows(cls, title: str, columns: Iterable[Column], rows: Iterable[Iterable[Value]]) -> Table:
        """Make a table from rows of values, one per column."""
        columns = tuple(columns)
        cells = (zip(columns, row, strict=True) for row in rows)
        return cls(title, columns, tuple(tuple(column.cell(value) for column, value in row) for row in cells))

    @classmethod
    def listing(cls, title: str, columns: Columns[T], things: Iterable[T]) -> Table:
        """Make a table with a row for each object, with values from its attributes, keys or functions."""
        rows = ([_value(thing, value) for _, value in columns] for thing in things)
        return cls.from_rows(title, (column for column, _ in columns), rows)

    @classmethod
    def facts(cls, title: str, facts: Iterable[tuple[str, Value]]) -> Table:
        """Make a table of two columns, names and values, without those that are empty."""
        columns = (Column("", "name"), Column("", "text"))
        return cls.from_rows(
            title, columns, ((name, value) for name, value in facts if value not in (None, ""))
        )

    def escaped(self) -> Table:
        """Return the table with control characters in all texts escaped."""
        cells = (tuple(cell._replace(text=escaped(cell.text)) for cell in row) for row in self.rows)
        columns = tuple(column._replace(name=escaped(column.name)) for column in self.columns)
        return Table(escaped(self.title), columns, tuple(cells))

    def without_constants(self) -> tuple[str, Table]:
        """Return the columns that are equal in all rows as a sentence, and the table without them."""
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
        """Return the table without its last column that may be omitted; None if there is no such column."""
        last = max((index for index, column in enumerate(self.columns) if column.detail), default=None)
        return None if last is None else self._keeping([index != last for index in range(len(self.columns))])

    def _keeping(self, kept: Sequence[bool]) -> Table:
        columns = tuple(compress(self.columns, kept))
        return self._replace(columns=columns, rows=tuple(tuple(compress(row, kept)) for row in self.rows))

    def turned(self) -> Table:
        """Return a table with a row for each column, for rows that differ only in the first column."""
        names = Cell(", ".join(row[0].text for row in self.rows))
        cells = zip(self.columns, (names, *self.rows[0][1:]), strict=True)
        return Table.facts(self.title, ((column.name, cell) for column, cell in cells if cell.text))

    def marked(self, rows: Iterable[bool]) -> Table:
        """Return the table with the error tone for the rows whose flag is True."""
        pairs = zip(self.rows, rows, strict=True)
        cells = (tuple(Cell(cell.text, "error") for cell in row) if bad else row for row, bad in pairs)
        return self._replace(rows=tuple(cells))


def _value(thing: T, value: str | Callable[[T], Value]) -> Value:
    if not isinstance(value, str):
        return value(thing)
    found: Value = thing[value] if isinstance(thing, Mapping) else attrgetter(value)(thing)
    return found


class Sentence(NamedTuple):
    """A line of output, never wrapped, so that commands in it can be copied."""

    text: str
    tone: Tone = "plain"


Part: TypeAlias = "Table | Graph | Sentence | str"
"""A piece of output: a table, a graph, a sentence, or a plain line."""


def flagged(count: int, text: str = "", tone: Tone = "warning") -> Cell:
    """Return a cell with a count, or a text about it; it has the tone unless the count is 0."""
    return Cell(text or str(count), tone if count else "plain")


def numbers(*names: str) -> Sequence[Column]:
    """Return one column of numbers for each name."""
    return [Column(name) for name in names]


def microseconds(value: float) -> str:
    """Format a time given in us as us, ms or s, by its size."""
    if value >= 1e6:
        return f"{value / 1e6:.2f} s"
    return f"{value / 1e3:.2f} ms" if value >= 1e4 else f"{value:.0f} us"
