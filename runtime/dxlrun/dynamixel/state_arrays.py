"""Replies of a cycle -> states, for all servos of one bus; prepared once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, ServoPlan, StateLayout
from dxlrun.interfaces import Floats, States
from dxlrun.mode import Mode

_SIGNED = np.concatenate((np.arange(0x400), -np.arange(0x400))).astype(np.float64)
"""Sign-magnitude of eleven bits -> ticks: the highest one is the sign; further bits are not looked at."""

# numpy takes ten times as long to compare with a member of an Enum
_VELOCITY, _PWM = int(Mode.VELOCITY), int(Mode.PWM)

Integers = NDArray[np.integer]
Rows = slice | NDArray[np.intp]
"""Some rows of an array: a slice where they stand one behind the other, which is quicker."""


def rows_of(indices: Sequence[int]) -> Rows:
    """Return rows by their numbers."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return np.array(indices, dtype=np.intp)


class StateArrays:
    """Decodes the replies of a cycle: one view for all servos of one layout.

    Position: q = direction * (raw * rad_per_tick - reference), rad. The sign of velocity and effort follows
    the joint's direction, so positive effort is torque toward growing q. They are sign-magnitude in Protocol
    1.0, bit 10 set = clockwise (e-Manual AX-12A, Present Speed (38), Present Load (40)), and two's complement
    in Protocol 2.0 (e-Manual XM430-W350, Present Velocity (128)). In wheel mode the speed of a model that
    controls none is a fraction of full output (AX-12A, Present Speed (38)), see `mode_plan`.
    """

    __slots__ = ("_age", "_arrived", "_blocks", "_everybody", "_now", "_rows", "replies")

    def __init__(self, plan: BusPlan) -> None:
        layouts = dict.fromkeys(servo.state for servo in plan.servos)
        self._blocks = tuple(_StateBlock(layout, plan.servos) for layout in layouts)
        self.replies = tuple(
            next(block.replies[index] for block in self._blocks if index in block.replies)
            for index in range(len(plan.servos))
        )
        """Where each servo's bytes belong, in the order of the plan's servos."""
        self._rows = rows_of([servo.row for servo in plan.servos])
        self._everybody = b"\1" * len(plan.servos)
        self._arrived = np.full(len(plan.servos), -1, dtype=np.int64)
        self._age = np.zeros(len(plan.servos), dtype=np.int64)
        self._now = np.zeros(1, dtype=np.int64)

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
        if fresh.tobytes() == self._everybody:
            self._arrived[:] = arrived_ns
            self._now[0] = now_ns  # quicker than to let numpy make an array of an int
            states.age_ns[rows] = np.subtract(self._now, arrived_ns, self._age)
            for block in self._blocks:
                block.decode(states)
            return
        np.copyto(self._arrived, arrived_ns, where=fresh)
        states.age_ns[rows] = np.where(self._arrived < 0, -1, now_ns - self._arrived)
        for block in self._blocks:
            block.decode_some(states, fresh)


class _StateBlock:
    """The servos of one bus that have one layout."""

    __slots__ = (
        "_effort",
        "_efforts",
        "_in_place",
        "_members",
        "_position",
        "_positions",
        "_reference",
        "_rows",
        "_speeds",
        "_states",
        "_velocity",
        "_wheel",
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
        direction = np.array([float(servo.direction) for servo in mine])
        self._members = np.array(members, dtype=np.intp)
        self._states: States | None = None
        self._rows = rows_of([servo.row for servo in mine])
        self._reference = direction * np.array([servo.reference for servo in mine])
        self._position = _Column(
            self.data, layout.position, direction * np.array([servo.rad_per_tick for servo in mine])
        )
        self._velocity = _Column(
            self.data, layout.velocity, direction * np.array([servo.rad_s_per_tick for servo in mine])
        )
        ratio = np.array([_in_wheel_mode(servo) for servo in mine])
        self._wheel = ratio if (ratio != 1.0).any() else None
        """By what a speed has to be multiplied in wheel mode; None: every mode has the same unit."""
        self._effort = _Column(
            self.data, layout.effort, direction * np.array([servo.effort_per_tick for servo in mine])
        )

    def decode(self, states: States) -> None:
        """Fill the rows of all servos."""
        if states is not self._states:
            self._show(states)
        np.subtract(self._position.values(self._positions), self._reference, self._positions)
        self._velocities(states, self._speeds)
        self._effort.values(self._efforts)
        if not self._in_place:
            rows = self._rows
            states.position[rows] = self._positions
            states.velocity[rows] = self._speeds
            states.effort[rows] = self._efforts

    def _show(self, states: States) -> None:
        """Decode right into the rows of these states from now on, where they stand one behind the other."""
        self._states = states
        self._in_place = isinstance(self._rows, slice)
        # a copy where they do not
        self._positions = states.position[self._rows]
        self._speeds = states.velocity[self._rows]
        self._efforts = states.effort[self._rows]

    def decode_some(self, states: States, all_fresh: NDArray[np.bool_]) -> None:
        """Fill the rows of those whose reply arrived."""
        fresh = all_fresh[self._members]
        position = self._position.values() - self._reference
        for values, column in (
            (states.position, position),
            (states.velocity, self._velocities(states)),
            (states.effort, self._effort.values()),
        ):
            values[self._rows] = np.where(fresh, column, values[self._rows])

    def _velocities(self, states: States, out: Floats | None = None) -> Floats:
        values = self._velocity.values(out)
        if self._wheel is not None:
            mode = states.mode[self._rows]
            turning = (mode == _VELOCITY) | (mode == _PWM)
            if turning.any():
                np.multiply(values, self._wheel, values, where=turning)
        return values


def _in_wheel_mode(servo: ServoPlan) -> float:
    """Return the unit of the present speed in wheel mode as a part of the one in joint mode."""
    units = [mode.present_rad_s_per_tick for mode in servo.modes if mode.mode == Mode.VELOCITY]
    return units[0] / servo.rad_s_per_tick if units else 1.0


class _Column:
    """One item of all servos of a block, in its unit."""

    __slots__ = ("_per_tick", "_raw", "_signed", "_work")

    def __init__(self, data: NDArray[np.uint8], field: Field, per_tick: Floats) -> None:
        rows, length = data.shape
        self._raw: Integers = np.ndarray(
            (rows,), _format(field), data, offset=field.offset, strides=(length,)
        )
        self._per_tick = per_tick
        self._signed = field.encoding == "sign_magnitude"
        self._work = np.zeros(rows)

    def values(self, out: Floats | None = None) -> Floats:
        """Return the values, in `out` if it is there; else good until the next call."""
        if out is None:
            out = self._work
        if not self._signed:
            return np.multiply(self._raw, self._per_tick, out)
        _SIGNED.take(self._raw, out=out, mode="wrap")
        return np.multiply(out, self._per_tick, out)


def _format(field: Field) -> str:
    return f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}"
