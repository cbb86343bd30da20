"""Arrays of one bus: replies of a cycle -> states, goals -> the sync write; prepared once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel import protocol1
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.plan import GOAL_LENGTH, STATE_LENGTH
from dxlrun.dynamixel.transaction import BROADCAST_ID
from dxlrun.interfaces import Commands, States

_STATE = np.dtype([("position", "<u2"), ("speed", "<u2"), ("load", "<u2")])
_GOAL = np.dtype([("id", "u1"), ("position", "<u2"), ("speed", "<u2")])
_MAGNITUDE = 0x3FF
_CLOCKWISE = 0x400
_GOAL_ADDRESS = 30


class StateArrays:
    """Decodes the replies of a cycle with one view.

    Position: q = direction * (raw * rad_per_tick - reference), rad. Velocity and effort are sign-magnitude,
    bit 10 set = clockwise (e-Manual AX-12A, Present Speed (38), Present Load (40)): their sign follows the
    joint's direction, so positive effort is torque toward growing q, as a fraction of the maximum.
    """

    __slots__ = (
        "_arrived",
        "_direction",
        "_effort",
        "_position",
        "_raw",
        "_reference",
        "_rows",
        "_speed",
        "replies",
    )

    def __init__(self, plan: BusPlan) -> None:
        servos = plan.servos
        buffer = bytearray(STATE_LENGTH * len(servos))
        view = memoryview(buffer)
        self.replies = tuple(view[i : i + STATE_LENGTH] for i in range(0, len(view), STATE_LENGTH))
        """Where each servo's six bytes belong, in the order of the plan's servos."""
        self._raw = np.frombuffer(buffer, dtype=_STATE)
        self._rows = np.array([servo.row for servo in servos], dtype=np.intp)
        self._direction = np.array([float(servo.direction) for servo in servos])
        self._reference = np.array([servo.reference for servo in servos])
        self._position = np.array([servo.rad_per_tick for servo in servos])
        self._speed = self._direction * np.array([servo.rad_s_per_tick for servo in servos])
        self._effort = self._direction * np.array([servo.effort_per_tick for servo in servos])
        self._arrived = np.full(len(servos), -1, dtype=np.int64)

    def decode(
        self, states: States, fresh: NDArray[np.bool_], arrived_ns: NDArray[np.int64], now_ns: int
    ) -> None:
        """Fill the rows of this bus.

        `fresh`, `arrived_ns`: shape (servos,), whose reply arrived in this cycle, and when. A row that is not
        fresh keeps its values, is invalid, and its age grows.
        """
        rows, raw = self._rows, self._raw
        states.valid[rows] = fresh
        np.copyto(self._arrived, arrived_ns, where=fresh)
        states.age_ns[rows] = np.where(self._arrived < 0, -1, now_ns - self._arrived)
        position = self._direction * (raw["position"] * self._position - self._reference)
        velocity = _signed(raw["speed"]) * self._speed
        effort = _signed(raw["load"]) * self._effort
        if not fresh.all():
            rows, position, velocity, effort = rows[fresh], position[fresh], velocity[fresh], effort[fresh]
        states.position[rows] = position
        states.velocity[rows] = velocity
        states.effort[rows] = effort


def _signed(raw: NDArray[np.uint16]) -> NDArray[np.int32]:
    magnitude = (raw & _MAGNITUDE).astype(np.int32)
    return np.where(raw & _CLOCKWISE, -magnitude, magnitude)


class GoalArrays:
    """Builds the sync write of one bus in a buffer that is made once.

    Position: to the nearest tick, inside the joint's limits and so inside 0..max, never wraps. Speed:
    magnitude; 0 rad/s is 1 tick, because 0 ticks mean the maximum in joint mode; NaN is 0 ticks; too
    fast is the highest tick.
    """

    __slots__ = (
        "_buffer",
        "_direction",
        "_goals",
        "_highest",
        "_lowest",
        "_most",
        "_position",
        "_records",
        "_reference",
        "_rows",
        "_speed",
        "_view",
    )

    def __init__(self, plan: BusPlan) -> None:
        servos = plan.servos
        self._buffer = bytearray(protocol1.sync_write(_GOAL_ADDRESS, GOAL_LENGTH, {}))
        head = len(self._buffer) - 1
        self._buffer.extend(bytes(_GOAL.itemsize * len(servos)))
        self._view = memoryview(self._buffer)
        self._goals = np.frombuffer(self._buffer, dtype=_GOAL, offset=head, count=len(servos))
        self._records = np.zeros(len(servos), dtype=_GOAL)
        self._records["id"] = [servo.servo_id for servo in servos]
        self._rows = np.array([servo.row for servo in servos], dtype=np.intp)
        self._direction = np.array([float(servo.direction) for servo in servos])
        self._reference = np.array([servo.reference for servo in servos])
        self._position = np.array([servo.rad_per_tick for servo in servos])
        self._speed = np.array([servo.rad_s_per_tick for servo in servos])
        self._lowest = np.array([servo.lower_tick for servo in servos], dtype=np.float64)
        self._highest = np.array([servo.upper_tick for servo in servos], dtype=np.float64)
        self._most = np.array([servo.max_speed_tick for servo in servos], dtype=np.float64)

    def packet(self, goals: Commands, included: NDArray[np.bool_]) -> memoryview | None:
        """Return the packet for the servos that are `included`, shape (servos,), and have a goal.

        None: there is nobody. The bytes are good until the next call.
        """
        position = goals.position[self._rows]
        chosen = included & ~np.isnan(position)
        count = int(np.count_nonzero(chosen))
        if count == 0:
            return None
        records = self._records
        ticks = np.rint((self._direction * position + self._reference) / self._position)
        records["position"] = np.where(chosen, np.clip(ticks, self._lowest, self._highest), 0)
        speed = np.rint(np.abs(goals.velocity[self._rows]) / self._speed)
        records["speed"] = np.where(np.isnan(speed), 0, np.clip(speed, 1, self._most))
        if count == len(records):
            self._goals[:] = records
        else:
            np.compress(chosen, records, out=self._goals[:count])
        return self._finish(count)

    def _finish(self, count: int) -> memoryview:
        buffer = self._buffer
        end = 7 + count * _GOAL.itemsize
        buffer[2] = BROADCAST_ID
        buffer[3] = end - 3
        buffer[end] = protocol1.checksum(self._view[2:end])
        return self._view[: end + 1]
