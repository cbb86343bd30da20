"""Replies of a cycle -> ticks, for all servos of one bus; prepared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, ServoPlan, StateLayout
from dxlrun.interfaces import Floats

_SIGNED = np.concatenate((np.arange(0x400), -np.arange(0x400))).astype(np.float64)
"""Sign-magnitude of eleven bits -> ticks: the highest one is the sign; further bits are not looked at."""

Rows = slice | NDArray[np.intp]
"""Some rows of an array: a slice where they stand one behind the other, which is quicker."""
_Raw = NDArray[np.integer]
_Cast = tuple[Floats, _Raw]


def rows_of(indices: Sequence[int]) -> Rows:
    """Return rows by their numbers."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return np.array(indices, dtype=np.intp)


@dataclass(frozen=True, slots=True)
class Arrivals:
    """What came of the servos in a cycle: one column a servo, in the order of the plans' servos."""

    ticks: Floats
    """Shape (3, servos): position, velocity and effort as the servos count."""
    fresh: NDArray[np.bool_]
    """Whose reply arrived intact in this cycle."""
    at_ns: NDArray[np.int64]
    """When the newest intact reply arrived; -1 while none ever did."""

    @classmethod
    def none(cls, servos: int) -> Arrivals:
        """Return those of servos of which nothing came."""
        return cls(
            np.zeros((3, servos)),
            np.zeros(servos, dtype=np.bool_),
            np.full(servos, -1, dtype=np.int64),
        )

    def part(self, first: int, count: int) -> Arrivals:
        """Return a view of some servos that follow each other."""
        here = slice(first, first + count)
        return Arrivals(self.ticks[:, here], self.fresh[here], self.at_ns[here])


class StateArrays:
    """The bytes of one bus's servos, and how they become ticks: one view for all servos of one layout.

    Velocity and effort are sign-magnitude in Protocol 1.0, bit 10 set = clockwise (e-Manual AX-12A, Present
    Speed (38), Present Load (40)), and two's complement in Protocol 2.0 (e-Manual XM430-W350, Present
    Velocity (128)).
    """

    __slots__ = ("_blocks", "_plain", "_scattered", "_signed", "arrivals", "replies")

    def __init__(self, plan: BusPlan, arrivals: Arrivals) -> None:
        self.arrivals = arrivals
        """What came of this bus's servos, in the order of the plan's servos."""
        layouts = dict.fromkeys(servo.state for servo in plan.servos)
        self._blocks = tuple(_Block(layout, plan.servos, arrivals.ticks) for layout in layouts)
        self._plain = [*chain.from_iterable(block.plain for block in self._blocks)]
        self._signed = [*chain.from_iterable(block.signed for block in self._blocks)]
        self._scattered = [block.scattered for block in self._blocks if block.scattered is not None]
        self.replies = tuple(
            next(block.replies[index] for block in self._blocks if index in block.replies)
            for index in range(len(plan.servos))
        )
        """Where each servo's bytes belong, in the order of the plan's servos."""

    def place(self, indices: Sequence[int]) -> tuple[NDArray[np.uint8], Rows]:
        """Return the bytes of all servos of one layout, one row a servo, and the rows of some of them."""
        block = next(block for block in self._blocks if indices[0] in block.replies)
        rows = list(block.replies)
        return block.data, rows_of([rows.index(index) for index in indices])

    def count(self) -> None:
        """Bring the bytes to ticks, of who did not answer those of its last reply."""
        for ticks, raw in self._plain:
            ticks[...] = raw
        for ticks, raw in self._signed:
            _SIGNED.take(raw, None, ticks, "wrap")
        for all_ticks, members, own in self._scattered:
            all_ticks[:, members] = own


class _Block:
    """The servos of one bus that have one layout."""

    __slots__ = ("data", "plain", "replies", "scattered", "signed")

    def __init__(self, layout: StateLayout, servos: Sequence[ServoPlan], ticks: Floats) -> None:
        members = [index for index, servo in enumerate(servos) if servo.state == layout]
        count, length = len(members), layout.length
        buffer = bytearray(length * count)
        view = memoryview(buffer)
        self.replies = {
            index: view[number * length : (number + 1) * length] for number, index in enumerate(members)
        }
        self.data: NDArray[np.uint8] = np.frombuffer(buffer, np.uint8).reshape(count, length)
        place = rows_of(members)
        own = ticks[:, place]  # a copy where they do not stand side by side
        self.scattered = None if isinstance(place, slice) else (ticks, place, own)
        self.plain: list[_Cast] = []
        self.signed: list[_Cast] = []
        first = 0
        for alike in _alike((layout.position, layout.velocity, layout.effort)):
            field, step = alike[0], alike[-1].offset - alike[0].offset
            raw: _Raw = np.ndarray(
                (len(alike), count),
                f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}",
                self.data,
                field.offset,
                (step // max(len(alike) - 1, 1), length),
            )
            casts = self.signed if field.encoding == "sign_magnitude" else self.plain
            casts.append((own[first : first + len(alike)], raw))
            first += len(alike)


def _alike(fields: Sequence[Field]) -> list[list[Field]]:
    """Return the fields in parts that numpy takes at once: of one kind, and as far apart."""
    parts: list[list[Field]] = []
    for field in fields:
        part = parts[-1] if parts else []
        alike = part and (part[0].size, part[0].encoding) == (field.size, field.encoding)
        if alike and (len(part) < 2 or field.offset - part[-1].offset == part[1].offset - part[0].offset):
            part.append(field)
        else:
            parts.append([field])
    return parts
