"""Replies of a cycle -> ticks, for all servos of one bus; prepared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
    """When the newest reply arrived that was intact, and can be true; -1 while none ever did."""

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


class Source(NamedTuple):
    """Where bytes of several servos stand, equally far apart."""

    buffer: bytearray
    first: int
    """Where those of the first one begin."""
    step: int


class Counting:
    """How the bytes of some servos of one layout become ticks: one view for all of them; prepared once."""

    __slots__ = ("_plain", "_scattered", "_signed")

    def __init__(self, layout: StateLayout, servos: Sequence[int], source: Source, ticks: Floats) -> None:
        """`servos`: their columns of `ticks`."""
        place = rows_of(servos)
        own = ticks[:, place]  # a copy where they do not stand side by side
        self._scattered = None if isinstance(place, slice) else (ticks, place, own)
        self._plain: list[_Cast] = []
        self._signed: list[_Cast] = []
        first = 0
        for alike in _alike((layout.position, layout.velocity, layout.effort)):
            field, end = alike[0], first + len(alike)
            raw: _Raw = np.ndarray(
                (len(alike), len(servos)),
                f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}",
                source.buffer,
                source.first + field.offset,
                (alike[-1].offset - alike[-2].offset if len(alike) > 1 else 0, source.step),
            )
            casts = self._signed if field.encoding == "sign_magnitude" else self._plain
            casts.append((own[first:end], raw))
            first = end

    def count(self) -> None:
        """Bring the bytes to ticks."""
        for ticks, raw in self._plain:
            ticks[...] = raw
        for ticks, raw in self._signed:
            _SIGNED.take(raw, None, ticks, "wrap")
        if self._scattered is not None:
            all_ticks, place, own = self._scattered
            all_ticks[:, place] = own


class StateArrays:
    """The bytes of one bus's servos, as their replies brought them.

    Velocity and effort are sign-magnitude in Protocol 1.0 and of XL-320, bit 10 set = clockwise (e-Manual
    AX-12A, Present Speed (38), Present Load (40); XL-320, Present Speed (39)), else two's complement
    (e-Manual XM430-W350, Present Velocity (128)).
    """

    __slots__ = ("_blocks", "_plan", "arrivals", "replies")

    def __init__(self, plan: BusPlan, arrivals: Arrivals) -> None:
        self._plan = plan
        self.arrivals = arrivals
        """What came of this bus's servos, in the order of the plan's servos."""
        layouts = dict.fromkeys(servo.state for servo in plan.servos)
        self._blocks = tuple(_Block(layout, plan.servos, arrivals.ticks) for layout in layouts)
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

    def counting(self, servos: Sequence[int], source: Source) -> Counting:
        """Return how bytes of servos of one layout that stand elsewhere become ticks."""
        return Counting(self._plan.servos[servos[0]].state, servos, source, self.arrivals.ticks)

    def count(self) -> None:
        """Bring the ticks up to date, of who did not answer by its last reply that was kept here."""
        for block in self._blocks:
            block.counting.count()


class _Block:
    """The servos of one bus that have one layout."""

    __slots__ = ("counting", "data", "replies")

    def __init__(self, layout: StateLayout, servos: Sequence[ServoPlan], ticks: Floats) -> None:
        members = [index for index, servo in enumerate(servos) if servo.state == layout]
        count, length = len(members), layout.length
        buffer = bytearray(length * count)
        view = memoryview(buffer)
        self.replies = {
            index: view[number * length : (number + 1) * length] for number, index in enumerate(members)
        }
        self.data: NDArray[np.uint8] = np.frombuffer(buffer, np.uint8).reshape(count, length)
        self.counting = Counting(layout, members, Source(buffer, 0, length), ticks)


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
