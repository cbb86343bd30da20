"""CDR in columns: a field of many messages in one go, by the messages' definition; layout as in cdr.py.

Each message has a cursor; a field is read for all of them with a few calls of numpy. So it costs by fields
and not by messages, except for texts, and for sequences of messages, which are gone through by elements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun.messages.cdr import ENCAPSULATION
from dxlrun.messages.definition import (
    PRIMITIVES,
    Definitions,
    MessageField,
    MessageType,
    parse,
    short_name,
)

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
_HEAD = len(ENCAPSULATION)
_SPARE = 16
"""Zero bytes behind the messages: a cursor that left its message finds something to read."""
_DEEPEST = 32
"""Messages inside messages: a definition that contains itself has no end."""


@dataclass(slots=True)
class Column:
    """One field of many messages: values; elements, of which a row has some; or fields of a message."""

    values: NDArray[np.generic] | None = None
    """Shape (rows,): numbers, or texts as objects."""
    counts: Indices | None = None
    """Shape (rows,): how many elements each row has."""
    elements: Column | None = None
    """The elements of all rows, one behind the other."""
    fields: dict[str, Column] = field(default_factory=dict)

    @property
    def leaves(self) -> tuple[str, ...]:
        """Places of all values: `header.stamp.sec`; those in sequences of messages too."""
        inside = self.elements if self.elements is not None else self
        return tuple(
            f"{name}.{leaf}" if leaf else name
            for name, column in inside.fields.items()
            for leaf in column.leaves or ("",)
        )

    def leaf(self, place: str) -> Column:
        """Return the column at a place. Raises KeyError when there is none."""
        if not place:
            return self
        if self.elements is not None:
            return Column(counts=self.counts, elements=self.elements.leaf(place))
        name, _, rest = place.partition(".")
        return self.fields[name].leaf(rest)

    def array(self) -> NDArray[np.generic]:
        """Return values as one array, a row a message; rows that differ in length as objects.

        Raises ValueError for a message, which has fields.
        """
        if self.values is not None:
            return self.values
        if self.counts is None or self.elements is None:
            raise ValueError("a message has fields, of which one is to be named")
        inside = self.elements.array()
        if len(self.counts) and (self.counts == self.counts[0]).all():
            return inside.reshape((len(self.counts), int(self.counts[0]), *inside.shape[1:]))
        rows = np.empty(len(self.counts), object)
        rows[:] = np.split(inside, np.cumsum(self.counts)[:-1]) if len(self.counts) else []
        return rows

    @property
    def flat(self) -> tuple[Indices, NDArray[np.generic]]:
        """How many elements each row has, and those of all rows; of what is no sequence of values nothing."""
        inside = None if self.elements is None else self.elements.values
        if self.counts is None or inside is None:
            return np.zeros(0, np.int64), np.zeros(0)
        return self.counts, inside

    def take(self, rows: Indices) -> Column:
        """Return some rows."""
        if self.values is not None:
            return Column(values=self.values[rows])
        if self.counts is not None and self.elements is not None:
            begin = np.cumsum(self.counts) - self.counts
            counts = self.counts[rows]
            shift = begin[rows] - (np.cumsum(counts) - counts)
            return Column(
                counts=counts,
                elements=self.elements.take(np.repeat(shift, counts) + np.arange(int(counts.sum()))),
            )
        return Column(fields={name: column.take(rows) for name, column in self.fields.items()})

    @classmethod
    def joined(cls, parts: Sequence[Column]) -> Column:
        """Return the rows of several columns of one kind, one behind the other."""
        first = parts[0]
        if first.values is not None:
            return cls(values=np.concatenate([part.values for part in parts if part.values is not None]))
        if first.counts is not None:
            return cls(
                counts=np.concatenate([part.counts for part in parts if part.counts is not None]),
                elements=cls.joined([part.elements for part in parts if part.elements is not None]),
            )
        return cls(fields={name: cls.joined([part.fields[name] for part in parts]) for name in first.fields})


@dataclass(slots=True)
class _Cursors:
    """How far each message was read."""

    data: NDArray[np.uint8]
    at: Indices
    end: Indices
    origin: Indices
    """From which alignment counts."""
    good: Flags
    """False where a message ended before its fields."""

    def align(self, size: int) -> None:
        self.at += (self.origin - self.at) % size

    def ahead(self, sizes: Indices | int) -> Indices:
        """Go on by so many bytes; return where they begin. A message that has fewer ends, and is bad."""
        fits = self.at + sizes <= self.end
        self.good &= fits
        begin = np.where(fits, self.at, len(self.data) - _SPARE)
        self.at = np.where(fits, self.at + sizes, self.end)
        return begin

    def numbers(self, at: Indices, kind: str) -> NDArray[np.generic]:
        dtype = np.dtype(PRIMITIVES[kind]).newbyteorder("<")
        count = len(self.data) - dtype.itemsize + 1
        found: NDArray[np.generic] = np.ndarray((count,), dtype, self.data, 0, (1,))[at]
        return found

    def counted(self, least: int) -> Indices:
        """Read lengths; one that the message has no room for, at `least` bytes an element, is 0, and bad."""
        self.align(4)
        begin = self.ahead(4)
        counts = self.numbers(begin, "uint32").astype(np.int64)
        fits = counts * least <= self.end - self.at
        self.good &= fits
        return np.where(fits & self.good, counts, 0)

    def some(self, rows: Indices) -> _Cursors:
        return _Cursors(self.data, self.at[rows], self.end[rows], self.origin[rows], self.good[rows])


Read = Callable[[_Cursors, bool], Column]
"""Reads one field, or only goes past it and returns nothing that counts."""


class ColumnReader:
    """Reads messages of one type as columns; made once from the definition.

    Raises ValueError for a definition that cannot be laid out.
    """

    def __init__(self, message: MessageType) -> None:
        self.message = message
        self.definitions: Definitions = parse(message)
        self._top = short_name(message.name)
        if self._top not in self.definitions:
            raise ValueError(f"the definition of {message.name} is empty")
        self.leaves = tuple(self._leaves(self._top, 0))
        """Places of all values."""

    def _leaves(self, name: str, depth: int) -> list[str]:
        if depth > _DEEPEST:
            raise ValueError(f"{self.message.name} contains itself")
        found: list[str] = []
        for one in self.definitions[name]:
            if one.kind in self.definitions:
                found += [f"{one.name}.{leaf}" for leaf in self._leaves(one.kind, depth + 1)]
            else:
                found.append(one.name)
        return found

    def check(self, fields: Sequence[str]) -> str | None:
        """Return the first of these places that no message has; None when all of them exist."""
        return next((place for place in fields if place not in self.leaves), None)

    def read(
        self,
        data: NDArray[np.uint8],
        start: Indices,
        size: Indices,
        fields: Sequence[str] | None = None,
    ) -> tuple[Indices, Column]:
        """Return which of the messages in `data` are whole, and their fields; of other fields nothing.

        Raises ValueError when none is CDR, little-endian.
        """
        rows = np.flatnonzero(size >= _HEAD)
        padded = np.concatenate((data, np.zeros(_SPARE, np.uint8)))
        known = (padded[start[rows]] == ENCAPSULATION[0]) & (padded[start[rows] + 1] == ENCAPSULATION[1])
        if len(rows) and not known.any():
            raise ValueError(f"{self.message.name}: not CDR, little-endian")
        rows = rows[known]
        wanted = None if fields is None else frozenset(fields)
        while True:
            origin, end = start[rows] + _HEAD, start[rows] + size[rows]
            cursors = _Cursors(padded, origin.copy(), end, origin, np.ones(len(rows), np.bool_))
            column = self._message(self._top, cursors, "", wanted)
            if cursors.good.all():
                return rows, column
            rows = rows[cursors.good]  # rare: read again without those that are damaged

    def _message(self, name: str, cursors: _Cursors, place: str, wanted: frozenset[str] | None) -> Column:
        fields = self.definitions[name]
        if not fields:
            cursors.ahead(1)  # ROS 2 gives a message without fields one byte
        found: dict[str, Column] = {}
        for one in fields:
            inner = f"{place}{one.name}"
            asked = wanted is None or any(other == inner or other.startswith(f"{inner}.") for other in wanted)
            column = self._field(one, cursors, inner, wanted, asked=asked)
            if asked:
                found[one.name] = column
        return Column(fields=found)

    def _field(
        self,
        one: MessageField,
        cursors: _Cursors,
        place: str,
        wanted: frozenset[str] | None,
        *,
        asked: bool,
    ) -> Column:
        many = one.sequence or one.length
        if one.kind in PRIMITIVES:
            return _many_numbers(one, cursors, asked=asked) if many else _numbers(one.kind, cursors)

        def element(sub: _Cursors) -> Column:
            if one.kind == "string":
                return _texts(sub, asked=asked)
            return self._message(one.kind, sub, f"{place}.", wanted if asked else frozenset())

        if not many:
            return element(cursors)
        least = 4 if one.kind == "string" else 1
        counts = (
            np.where(cursors.good, one.length, 0).astype(np.int64) if one.length else cursors.counted(least)
        )
        return _elements(cursors, counts, element)


def _numbers(kind: str, cursors: _Cursors) -> Column:
    size = np.dtype(PRIMITIVES[kind]).itemsize
    cursors.align(size)
    return Column(values=cursors.numbers(cursors.ahead(size), kind))


def _many_numbers(one: MessageField, cursors: _Cursors, *, asked: bool) -> Column:
    size = np.dtype(PRIMITIVES[one.kind]).itemsize
    counts = np.full(len(cursors.at), one.length, np.int64) if one.length else cursors.counted(size)
    cursors.at += np.where(counts > 0, (cursors.origin - cursors.at) % size, 0)
    begin = cursors.ahead(counts * size)
    if not asked:
        return Column()
    counts = np.where(cursors.good, counts, 0)
    kind = np.dtype(PRIMITIVES[one.kind]).newbyteorder("<")
    values = pieces(cursors.data, begin, counts * size).view(kind)
    return Column(counts=counts, elements=Column(values=values))


def pieces(data: NDArray[np.uint8], begin: Indices, size: Indices) -> NDArray[np.uint8]:
    """Return pieces of `data` one behind the other; it is copied by pieces of one size, not by bytes."""
    into, found = np.cumsum(size) - size, np.empty(int(size.sum()), np.uint8)
    for one in np.unique(size[size > 0]).tolist():
        rows = np.flatnonzero(size == one)
        _windows(found, one)[into[rows]] = _windows(data, one)[begin[rows]]
    return found


def _windows(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """Return what lies from each byte on, that many bytes each, without a copy."""
    return np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))


def _texts(cursors: _Cursors, *, asked: bool) -> Column:
    lengths = cursors.counted(1)
    begin = cursors.ahead(lengths)
    texts = np.empty(len(lengths), object)
    if asked:
        known: dict[bytes, str] = {}
        data = cursors.data.data
        for row, (at, length) in enumerate(zip(begin.tolist(), lengths.tolist(), strict=True)):
            raw = bytes(data[at : at + max(length - 1, 0)])
            text = known.get(raw)
            if text is None:
                text = known[raw] = raw.decode(errors="replace")
            texts[row] = text
    return Column(values=texts)


def _elements(cursors: _Cursors, counts: Indices, element: Callable[[_Cursors], Column]) -> Column:
    """Read the first element of all rows, then the second of those that have one, and so on."""
    order: list[Indices] = []
    parts: list[Column] = []
    live, number = np.flatnonzero(counts > 0), 0
    while len(live):
        sub = cursors.some(live)
        parts.append(element(sub))
        order.append(live)
        cursors.at[live] = sub.at
        cursors.good[live] &= sub.good
        number += 1
        live = live[(counts[live] > number) & cursors.good[live]]
    if not parts:
        parts.append(element(cursors.some(live)))  # no row has any: the kind of the column alone
        order.append(live)
    inside = Column.joined(parts).take(np.argsort(np.concatenate(order), kind="stable"))
    return Column(counts=counts, elements=inside)
