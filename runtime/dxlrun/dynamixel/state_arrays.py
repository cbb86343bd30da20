"""Replies of a cycle -> states, for all servos of one bus; prepared once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, ServoPlan, StateLayout
from dxlrun.interfaces import States

_MAGNITUDE = 0x3FF
_CLOCKWISE = 0x400

Integers = NDArray[np.integer]
Rows = slice | NDArray[np.intp]
"""Some rows of an array: a slice where they stand one behind the other, which is quicker."""


def rows_of(indices: Sequence[int]) -> Rows:
    """Return rows by their numbers."""
    first = indices[0]
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return np.array(indices, dtype=np.intp)


class StateArrays:
    """Decodes the replies of a cycle: one view for all servos of one layout.

    Position: q = direction * (raw * rad_per_tick - reference), rad. The sign of velocity and effort follows
    the joint's direction, so positive effort is torque toward growing q. They are sign-magnitude in Protocol
    1.0, bit 10 set = clockwise (e-Manual AX-12A, Present Speed (38), Present Load (40)), and two's complement
    in Protocol 2.0 (e-Manual XM430-W350, Present Velocity (128)).
    """

    __slots__ = ("_arrived", "_blocks", "_rows", "replies")

    def __init__(self, plan: BusPlan) -> None:
        layouts = dict.fromkeys(servo.state for servo in plan.servos)
        self._blocks = tuple(_StateBlock(layout, plan.servos) for layout in layouts)
        self.replies = tuple(
            next(block.replies[index] for block in self._blocks if index in block.replies)
            for index in range(len(plan.servos))
        )
        """Where each servo's bytes belong, in the order of the plan's servos."""
        self._rows = np.array([servo.row for servo in plan.servos], dtype=np.intp)
        self._arrived = np.full(len(plan.servos), -1, dtype=np.int64)

    def place(self, indices: Sequence[int]) -> tuple[NDArray[np.uint8], Rows]:
        """Return the bytes of all servos of one layout, one row a servo, and the rows of some of them."""
        block = next(block for block in self._blocks if indices[0] in block.replies)
        rows = list(block.replies)
        return block.data, rows_of([rows.index(index) for index in indices])

    def decode(
        self, states: States, fresh: NDArray[np.bool_], arrived_ns: NDArray[np.int64], now_ns: int
    ) -> None:
        """Fill the rows of this bus.

        `fresh`, `arrived_ns`: shape (servos,), whose reply arrived in this cycle, and when. A row that is not
        fresh keeps its values, is invalid, and its age grows.
        """
        rows = self._rows
        states.valid[rows] = fresh
        np.copyto(self._arrived, arrived_ns, where=fresh)
        states.age_ns[rows] = np.where(self._arrived < 0, -1, now_ns - self._arrived)
        for block in self._blocks:
            block.decode(states, fresh)


class _StateBlock:
    """The servos of one bus that have one layout."""

    __slots__ = (
        "_decoders",
        "_direction",
        "_effort",
        "_members",
        "_position",
        "_raw",
        "_reference",
        "_rows",
        "_speed",
        "data",
        "replies",
    )

    def __init__(self, layout: StateLayout, servos: Sequence[ServoPlan]) -> None:
        members = [index for index, servo in enumerate(servos) if servo.state == layout]
        mine = [servos[index] for index in members]
        buffer = bytearray(layout.length * len(mine))
        view, length = memoryview(buffer), layout.length
        self.replies = {
            index: view[number * length : (number + 1) * length] for number, index in enumerate(members)
        }
        self.data: NDArray[np.uint8] = np.frombuffer(buffer, np.uint8).reshape(len(mine), length)
        fields = (layout.position, layout.velocity, layout.effort)
        record = np.dtype(
            {
                "names": ["position", "velocity", "effort"],
                "formats": [_format(field) for field in fields],
                "offsets": [field.offset for field in fields],
                "itemsize": length,
            }
        )
        self._raw = np.frombuffer(buffer, dtype=record)
        self._decoders = tuple(_signed if field.encoding == "sign_magnitude" else _plain for field in fields)
        self._members = np.array(members, dtype=np.intp)
        self._rows = np.array([servo.row for servo in mine], dtype=np.intp)
        self._direction = np.array([float(servo.direction) for servo in mine])
        self._reference = np.array([servo.reference for servo in mine])
        self._position = np.array([servo.rad_per_tick for servo in mine])
        self._speed = self._direction * np.array([servo.rad_s_per_tick for servo in mine])
        self._effort = self._direction * np.array([servo.effort_per_tick for servo in mine])

    def decode(self, states: States, all_fresh: NDArray[np.bool_]) -> None:
        rows, raw = self._rows, self._raw
        fresh = all_fresh[self._members]
        ticks = [
            decoder(raw[name])
            for name, decoder in zip(("position", "velocity", "effort"), self._decoders, strict=True)
        ]
        position = self._direction * (ticks[0] * self._position - self._reference)
        velocity = ticks[1] * self._speed
        effort = ticks[2] * self._effort
        if not fresh.all():
            rows, position, velocity, effort = rows[fresh], position[fresh], velocity[fresh], effort[fresh]
        states.position[rows] = position
        states.velocity[rows] = velocity
        states.effort[rows] = effort


def _format(field: Field) -> str:
    return f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}"


def _plain(raw: Integers) -> Integers:
    return raw


def _signed(raw: Integers) -> Integers:
    magnitude = (raw & _MAGNITUDE).astype(np.int32)
    return np.where(raw & _CLOCKWISE, -magnitude, magnitude)
