"""Arrays of one bus: replies of a cycle -> states, goals -> the sync writes; prepared once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, GoalLayout, ServoPlan, StateLayout
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.plan import goal_layouts
from dxlrun.interfaces import Commands, Floats, States

_MAGNITUDE = 0x3FF
_CLOCKWISE = 0x400

Integers = NDArray[np.integer]


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


class GoalArrays:
    """Builds the goal packets of one bus, one sync write for all servos of one layout.

    Position: to the nearest tick, inside the joint's limits and so inside the servo's range, never wraps.
    Speed: magnitude; 0 rad/s is 1 tick, because 0 ticks mean the maximum in joint mode and no limit in a
    profile; NaN is 0 ticks; too fast is the highest tick.
    """

    __slots__ = ("_blocks",)

    def __init__(self, plan: BusPlan) -> None:
        self._blocks = tuple(_GoalBlock(plan, layout) for layout in goal_layouts(plan.servos))

    def packets(
        self, goals: Commands, included: NDArray[np.bool_], ceiling: Floats | None = None
    ) -> list[bytes]:
        """Return the packets for the servos that are `included`, shape (servos,), and have a goal.

        `ceiling`, shape (servos,): the highest speed toward the goal, rad/s; NaN: no other than the goal's.
        """
        found = (block.packet(goals, included, ceiling) for block in self._blocks)
        return [packet for packet in found if packet is not None]


class _GoalBlock:
    """The servos of one bus that have one goal layout."""

    __slots__ = (
        "_direction",
        "_highest",
        "_layout",
        "_lowest",
        "_members",
        "_most",
        "_position",
        "_records",
        "_reference",
        "_rows",
        "_speed",
        "_sync_write",
    )

    def __init__(self, plan: BusPlan, layout: GoalLayout) -> None:
        members = [index for index, servo in enumerate(plan.servos) if servo.goal == layout]
        mine = [plan.servos[index] for index in members]
        fields = [("position", layout.position), ("speed", layout.speed)]
        known = [(name, field) for name, field in fields if field is not None]
        record = np.dtype(
            {
                "names": ["id", *(name for name, _ in known)],
                "formats": ["u1", *(_format(field) for _, field in known)],
                "offsets": [0, *(1 + field.offset for _, field in known)],
                "itemsize": 1 + layout.length,
            }
        )
        self._layout = layout
        self._sync_write = dialect_of(plan.protocol).sync_write_records
        self._records = np.zeros(len(mine), dtype=record)
        self._records["id"] = [servo.servo_id for servo in mine]
        self._members = np.array(members, dtype=np.intp)
        self._rows = np.array([servo.row for servo in mine], dtype=np.intp)
        self._direction = np.array([float(servo.direction) for servo in mine])
        self._reference = np.array([servo.reference for servo in mine])
        self._position = np.array([servo.rad_per_tick for servo in mine])
        self._speed = np.array([servo.rad_s_per_tick for servo in mine])
        self._lowest = np.array([servo.lower_tick for servo in mine], dtype=np.float64)
        self._highest = np.array([servo.upper_tick for servo in mine], dtype=np.float64)
        self._most = np.array([servo.max_speed_tick for servo in mine], dtype=np.float64)

    def packet(self, goals: Commands, included: NDArray[np.bool_], ceiling: Floats | None) -> bytes | None:
        """Return the packet; None: there is nobody."""
        position = goals.position[self._rows]
        chosen = included[self._members] & ~np.isnan(position)
        if not chosen.any():
            return None
        records = self._records
        ticks = np.rint((self._direction * position + self._reference) / self._position)
        records["position"] = np.where(chosen, np.clip(ticks, self._lowest, self._highest), 0)
        if self._layout.speed is not None:
            velocity = np.abs(goals.velocity[self._rows])
            if ceiling is not None:
                velocity = np.fmin(velocity, ceiling[self._members])
            records["speed"] = self._speeds(velocity)
        sent = records if chosen.all() else records[chosen]
        return self._sync_write(self._layout.address, self._layout.length, sent.tobytes())

    def _speeds(self, velocity: Floats) -> Floats:
        speed = np.rint(velocity / self._speed)
        return np.where(np.isnan(speed), 0, np.clip(speed, 1, self._most))
