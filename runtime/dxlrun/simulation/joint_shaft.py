"""The shaft of servos with angle limits and a moving speed: Protocol 1.0, and the XL-320."""

from __future__ import annotations

import math
from typing import ClassVar

from dxlrun.simulation.access import wheel_mode
from dxlrun.simulation.shaft import ACCELERATION, Drive, Shaft, in_turn


class JointShaft(Shaft):
    """Joint mode and wheel mode; the multi-turn and torque modes of some models are not modelled."""

    items: ClassVar[frozenset[str]] = frozenset(
        (
            "torque_enable",
            "goal_position",
            "moving_speed",
            "torque_limit",
            "cw_angle_limit",
            "ccw_angle_limit",
            "control_mode",
        )
    )

    def within_a_turn(self, angle: float) -> float:
        """Return the angle: such a servo counts no turns."""
        return angle

    def position_tick(self, angle: float) -> int:
        """Return what Present Position shows; beyond the reach the nearest end [i]."""
        table = self.memory.table
        tick = round(in_turn(angle) / table.rad_per_tick)
        if tick <= table.max_tick:
            return tick
        dead_zone = math.tau / table.rad_per_tick - table.max_tick
        return table.max_tick if tick - table.max_tick < dead_zone / 2 else 0

    def refresh(self) -> None:
        """Bring position, speed, load and moving to the time."""
        memory, table = self.memory, self.memory.table
        angle, velocity, acceleration = self._motion.at(self.now_ns)
        unit = table.max_speed / table.max_speed_tick if wheel_mode(memory) else table.rad_s_per_tick
        memory["present_position"] = self.position_tick(angle)
        memory["present_speed"] = _sign_magnitude(velocity / unit, table.max_speed_tick)
        fraction = table.items["present_load"].scale
        memory["present_load"] = _sign_magnitude(self._load() / fraction, memory.get("torque_limit", 1023))
        memory.show("moving", int(velocity != 0.0 or acceleration != 0.0))

    def _wanted(self) -> Drive:
        memory, table = self.memory, self.memory.table
        if not self.torque_on:
            return ()
        ticks = memory.ticks("moving_speed")
        if wheel_mode(memory):
            return ticks / table.max_speed_tick * table.max_speed, ACCELERATION
        speed = abs(ticks) * table.rad_s_per_tick
        goal = memory["goal_position"] * table.rad_per_tick
        return goal, min(speed, table.max_speed) if speed else table.max_speed, ACCELERATION

    def _start_of_move(self, angle: float) -> float:
        return in_turn(angle)  # turns of wheel mode are not counted


def _sign_magnitude(ticks: float, limit: int) -> int:
    magnitude = min(limit, round(abs(ticks)))
    return magnitude | 1 << 10 if ticks < 0 and magnitude else magnitude
