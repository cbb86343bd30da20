"""Tables and lines as data: the same numbers for a terminal and for a page."""

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
    """One cell; its tone draws the eye to what is not as it should be."""

    text: str
    tone: Tone = "plain"


Value = Cell | str | float | None
"""A cell's content (int included); None: there is none."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column, and how its values are written."""

    name: str
    kind: Kind = "number"
    """Numbers stand right; only a text may be folded into several lines."""
    form: str = "{}"
    """A format string, with the unit."""
    missing: str = ""
    """In place of None."""
    detail: bool = False
    """Left out where there is no room for it; of several the last one first."""

    def cell(self, value: Value) -> Cell:
        """Return a value as it is shown."""
        if isinstance(value, Cell):
            return value
        return Cell(self.missing if value is None else self.form.format(value))


Columns: TypeAlias = Sequence[tuple[Column, str | Callable[[T], Value]]]
"""Columns of things, each with the name of an attribute or a key, or a function of a thing."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells under columns; without any column name the first one names the rows."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, title: str, columns: Iterable[Column], rows: Iterable[Iterable[Value]]) -> Table:
        """Return the table of rows that have one value a column."""
        columns = tuple(columns)
        cells = (zip(columns, row, strict=True) for row in rows)
        return cls(title, columns, tuple(tuple(column.cell(value) for column, value in row) for row in cells))

    @classmethod
    def listing(cls, title: str, columns: Columns[T], things: Iterable[T]) -> Table:
        """Return a table with a row a thing."""
        rows = ([_value(thing, value) for _, value in columns] for thing in things)
        return cls.of(title, (column for column, _ in columns), rows)

    @classmethod
    def facts(cls, title: str, facts: Iterable[tuple[str, Value]]) -> Table:
        """Return names with their values, those without a value left out."""
        columns = (Column("", "name"), Column("", "text"))
        return cls.of(title, columns, ((name, value) for name, value in facts if value not in (None, "")))

    def escaped(self) -> Table:
        """Return it with texts that may be shown."""
        cells = (tuple(replace(cell, text=escaped(cell.text)) for cell in row) for row in self.rows)
        columns = tuple(replace(column, name=escaped(column.name)) for column in self.columns)
        return Table(escaped(self.title), columns, tuple(cells))

    def without_constants(self) -> tuple[str, Table]:
        """Return what is equal in all rows as a sentence, and the other columns, with the first one."""
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
        """Return it without the last column that may be left out; None: there is none."""
        last = max((index for index, column in enumerate(self.columns) if column.detail), default=None)
        return None if last is None else self._keeping([index != last for index in range(len(self.columns))])

    def _keeping(self, kept: Sequence[bool]) -> Table:
        columns = tuple(compress(self.columns, kept))
        return replace(self, columns=columns, rows=tuple(tuple(compress(row, kept)) for row in self.rows))

    def turned(self) -> Table:
        """Return a table whose rows are alike but for the first column with a row for each of its columns."""
        names = Cell(", ".join(row[0].text for row in self.rows))
        cells = zip(self.columns, (names, *self.rows[0][1:]), strict=True)
        return Table.facts(self.title, ((column.name, cell) for column, cell in cells if cell.text))

    def marked(self, rows: Iterable[bool]) -> Table:
        """Return it with all cells of these rows as errors."""
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
    """A sentence on a line of its own; never broken, so that what is in it can be copied."""

    text: str
    tone: Tone = "plain"


Part: TypeAlias = "Table | Graph | Sentence | str"
"""What is shown; a string is a plain line."""


def flagged(count: int, text: str = "", tone: Tone = "warning") -> Cell:
    """Return the cell of a count, of a text about it, with a tone unless it is 0."""
    return Cell(text or str(count), tone if count else "plain")


def numbers(*names: str) -> Sequence[Column]:
    """Return columns of numbers."""
    return [Column(name) for name in names]


def microseconds(value: float) -> str:
    """Return a time in us as a person writes it: us, ms or s."""
    if value >= 1e6:
        return f"{value / 1e6:.2f} s"
    return f"{value / 1e3:.2f} ms" if value >= 1e4 else f"{value:.0f} us"
