"""CDR columns: reads a field of many messages at once, by the message's definition; layout as in cdr.py.

Each message has a cursor, and a field is read for all messages with a few calls of NumPy. The cost therefore
depends on the number of fields, not of messages. Exceptions are texts, and sequences of messages, which are
read element by element.
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
"""Number of zero bytes after the messages, which a cursor reads that has left its message."""
_DEEPEST = 32
"""Most levels of nested messages: a definition that contains itself would not end."""


@dataclass(slots=True)
class FieldColumn:
    """One field of many messages: values, sequences of elements, or the fields of nested messages."""

    values: NDArray[np.generic] | None = None
    """Values of the field, shape (messages,): numbers, or texts as objects; None for other kinds of fields.
    """
    counts: Indices | None = None
    """Number of elements of each message's sequence, shape (messages,); None unless the field is a sequence.
    """
    elements: FieldColumn | None = None
    """Elements of all messages' sequences, concatenated; None unless the field is a sequence."""
    fields: dict[str, FieldColumn] = field(default_factory=dict)

    @property
    def leaves(self) -> tuple[str, ...]:
        """Dotted names of all values in this column, also in sequences of messages: `header.stamp.sec`."""
        inside = self.elements if self.elements is not None else self
        return tuple(
            f"{name}.{leaf}" if leaf else name
            for name, column in inside.fields.items()
            for leaf in column.leaves or ("",)
        )

    def leaf(self, place: str) -> FieldColumn:
        """Return the column of a value inside this one by its dotted name.

        Raises KeyError for an unknown name.
        """
        if not place:
            return self
        if self.elements is not None:
            return FieldColumn(counts=self.counts, elements=self.elements.leaf(place))
        name, _, rest = place.partition(".")
        return self.fields[name].leaf(rest)

    def array(self) -> NDArray[np.generic]:
        """Return the values as one array with one row per message; rows of different lengths become objects.

        Raises ValueError for a nested message, which has fields.
        """
        if self.values is not None:
            return self.values
        if self.counts is None or self.elements is None:
            raise ValueError("a message with fields is not a value; name one of its fields")
        inside = self.elements.array()
        if len(self.counts) and (self.counts == self.counts[0]).all():
            return inside.reshape((len(self.counts), int(self.counts[0]), *inside.shape[1:]))
        rows = np.empty(len(self.counts), object)
        rows[:] = np.split(inside, np.cumsum(self.counts)[:-1]) if len(self.counts) else []
        return rows

    @property
    def flat(self) -> tuple[Indices, NDArray[np.generic]]:
        """Number of elements in each message's sequence, and all elements.

        Empty if the field is not a sequence.
        """
        inside = None if self.elements is None else self.elements.values
        if self.counts is None or inside is None:
            return np.zeros(0, np.int64), np.zeros(0)
        return self.counts, inside

    def select_rows(self, rows: Indices) -> FieldColumn:
        """Return a column with these rows (messages) only."""
        if self.values is not None:
            return FieldColumn(values=self.values[rows])
        if self.counts is not None and self.elements is not None:
            begin = np.cumsum(self.counts) - self.counts
            counts = self.counts[rows]
            shift = begin[rows] - (np.cumsum(counts) - counts)
            return FieldColumn(
                counts=counts,
                elements=self.elements.select_rows(np.repeat(shift, counts) + np.arange(int(counts.sum()))),
            )
        return FieldColumn(fields={name: column.select_rows(rows) for name, column in self.fields.items()})

    @classmethod
    def joined(cls, parts: Sequence[FieldColumn]) -> FieldColumn:
        """Concatenate the rows of columns of the same field."""
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
    """Position in each of many messages up to which fields were read."""

    data: NDArray[np.uint8]
    at: Indices
    end: Indices
    origin: Indices
    """Index from which the alignment of each message's fields counts."""
    good: Flags
    """False for messages that ended before all their fields were read."""

    def align(self, size: int) -> None:
        self.at += (self.origin - self.at) % size

    def ahead(self, sizes: Indices | int) -> Indices:
        """Advance each cursor and return the previous positions. A message that is too short becomes bad."""
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
        """Read the length of a sequence from each message.

        One beyond its message becomes 0, the message bad.
        """
        self.align(4)
        begin = self.ahead(4)
        counts = self.numbers(begin, "uint32").astype(np.int64)
        fits = counts * least <= self.end - self.at
        self.good &= fits
        return np.where(fits & self.good, counts, 0)

    def some(self, rows: Indices) -> _Cursors:
        return _Cursors(self.data, self.at[rows], self.end[rows], self.origin[rows], self.good[rows])


Read = Callable[[_Cursors, bool], FieldColumn]
"""Function that reads one field of all messages. If it is to skip the field, the column is empty."""


class ColumnReader:
    """Reader of messages of one type as columns, made once from the definition.

    Raises ValueError for an invalid definition.
    """

    def __init__(self, message: MessageType) -> None:
        self.message = message
        self.definitions: Definitions = parse(message)
        self._top = short_name(message.name)
        if self._top not in self.definitions:
            raise ValueError(f"the definition of {message.name} is empty")
        self.leaves = tuple(self._leaves(self._top, 0))
        """Paths of all values."""

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

    def find_unknown(self, fields: Sequence[str]) -> str | None:
        """Return the first unknown path; None when all exist."""
        return next((place for place in fields if place not in self.leaves), None)

    def read_columns(
        self,
        data: NDArray[np.uint8],
        start: Indices,
        size: Indices,
        fields: Sequence[str] | None = None,
    ) -> tuple[Indices, FieldColumn]:
        """Return the indices of intact messages in `data`, and their columns.

        Args:
            data: Bytes that contain the messages.
            start: Index of each message's encapsulation header.
            size: Length of each message, bytes.
            fields: Paths to read; other fields are skipped. None reads all.

        Raises:
            ValueError: No message is little-endian CDR.
        """
        rows = np.flatnonzero(size >= _HEAD)
        padded = np.concatenate((data, np.zeros(_SPARE, np.uint8)))
        known = (padded[start[rows]] == ENCAPSULATION[0]) & (padded[start[rows] + 1] == ENCAPSULATION[1])
        if len(rows) and not known.any():
            raise ValueError(f"{self.message.name}: the bytes are not little-endian CDR")
        rows = rows[known]
        wanted = None if fields is None else frozenset(fields)
        while True:
            origin, end = start[rows] + _HEAD, start[rows] + size[rows]
            cursors = _Cursors(padded, origin.copy(), end, origin, np.ones(len(rows), np.bool_))
            column = self._message(self._top, cursors, "", wanted)
            if cursors.good.all():
                return rows, column
            # Rare: read again without the damaged messages.
            rows = rows[cursors.good]

    def _message(
        self, name: str, cursors: _Cursors, place: str, wanted: frozenset[str] | None
    ) -> FieldColumn:
        fields = self.definitions[name]
        if not fields:
            # ROS 2 gives a message without fields one byte.
            cursors.ahead(1)
        found: dict[str, FieldColumn] = {}
        for one in fields:
            inner = f"{place}{one.name}"
            asked = wanted is None or any(other == inner or other.startswith(f"{inner}.") for other in wanted)
            column = self._field(one, cursors, inner, wanted, asked=asked)
            if asked:
                found[one.name] = column
        return FieldColumn(fields=found)

    def _field(
        self,
        one: MessageField,
        cursors: _Cursors,
        place: str,
        wanted: frozenset[str] | None,
        *,
        asked: bool,
    ) -> FieldColumn:
        many = one.sequence or one.length
        if one.kind in PRIMITIVES:
            return _many_numbers(one, cursors, asked=asked) if many else _numbers(one.kind, cursors)

        def element(sub: _Cursors) -> FieldColumn:
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


def _numbers(kind: str, cursors: _Cursors) -> FieldColumn:
    size = np.dtype(PRIMITIVES[kind]).itemsize
    cursors.align(size)
    return FieldColumn(values=cursors.numbers(cursors.ahead(size), kind))


def _many_numbers(one: MessageField, cursors: _Cursors, *, asked: bool) -> FieldColumn:
    size = np.dtype(PRIMITIVES[one.kind]).itemsize
    counts = np.full(len(cursors.at), one.length, np.int64) if one.length else cursors.counted(size)
    cursors.at += np.where(counts > 0, (cursors.origin - cursors.at) % size, 0)
    begin = cursors.ahead(counts * size)
    if not asked:
        return FieldColumn()
    counts = np.where(cursors.good, counts, 0)
    kind = np.dtype(PRIMITIVES[one.kind]).newbyteorder("<")
    values = pieces(cursors.data, begin, counts * size).view(kind)
    return FieldColumn(counts=counts, elements=FieldColumn(values=values))


def pieces(data: NDArray[np.uint8], begin: Indices, size: Indices) -> NDArray[np.uint8]:
    """Return concatenated pieces of `data`; all pieces of one size are copied at once."""
    into, found = np.cumsum(size) - size, np.empty(int(size.sum()), np.uint8)
    for one in np.unique(size[size > 0]).tolist():
        rows = np.flatnonzero(size == one)
        _windows(found, one)[into[rows]] = _windows(data, one)[begin[rows]]
    return found


def _windows(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """Return overlapping windows of `size` bytes, one from each byte, without a copy."""
    return np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))


def _texts(cursors: _Cursors, *, asked: bool) -> FieldColumn:
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
    return FieldColumn(values=texts)


def _elements(cursors: _Cursors, counts: Indices, element: Callable[[_Cursors], FieldColumn]) -> FieldColumn:
    """Read the first element of all rows, then the second of those that have one, and so on."""
    order: list[Indices] = []
    parts: list[FieldColumn] = []
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
        # No row has an element; only the column's kind is needed.
        parts.append(element(cursors.some(live)))
        order.append(live)
    inside = FieldColumn.joined(parts).select_rows(np.argsort(np.concatenate(order), kind="stable"))
    return FieldColumn(counts=counts, elements=inside)
