"""Goals -> the sync writes of one bus; prepared once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, GoalLayout
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.plan import goal_layouts
from dxlrun.interfaces import Commands, Floats


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


def _format(field: Field) -> str:
    return f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}"
