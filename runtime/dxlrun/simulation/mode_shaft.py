"""The shaft of servos with an operating mode: Protocol 2.0 but the XL-320.

Modelled: velocity (1), position (3), extended position (4) and, without its limit of the current,
current-based position (5). In the other modes, current or torque (0) and PWM (16), the registers take what is
written and the shaft stays where it is.
"""

from __future__ import annotations

import math
from typing import ClassVar

from dxlrun.simulation.access import OperatingMode, watchdog_expired
from dxlrun.simulation.shaft import ACCELERATION, Drive, Shaft, in_turn

REVERSE, TIME_BASED = 0x01, 0x04
"""Bits of Drive Mode (10): clockwise is positive; Profile Velocity and Acceleration are durations in ms."""

_PER_MINUTE_SQUARED = 214.577 * math.tau / 3600
"""Unit of Profile Acceleration (108), rad/s^2 (e-Manual, X series: 214.577 rev/min^2)."""


class ModeShaft(Shaft):
    """Moves by Goal Position or Goal Velocity, with the profile that stands beside it."""

    items: ClassVar[frozenset[str]] = frozenset(
        (
            "torque_enable",
            "operating_mode",
            "drive_mode",
            "homing_offset",
            "goal_position",
            "goal_velocity",
            "profile_velocity",
            "profile_acceleration",
            "velocity_limit",
            "bus_watchdog",
        )
    )

    def within_a_turn(self, angle: float) -> float:
        """Return the angle within the turn that the encoder knows: 0 to 4095 ticks, or around 0."""
        shown = self._sign * angle
        if self.memory.table.items["min_position_limit"].minimum < 0:
            return self._sign * (shown - math.tau * round(shown / math.tau))
        return self._sign * in_turn(shown)

    def position_tick(self, angle: float) -> int:
        """Return what Present Position shows."""
        tick = round(self._sign * angle / self.memory.table.rad_per_tick)
        return tick + self._offset

    def refresh(self) -> None:
        """Bring everything that can be read of the motion to the time."""
        memory = self.memory
        angle, velocity, acceleration = self._motion.at(self.now_ns)
        position, sign = self.position_tick(angle), self._sign
        speed = round(sign * velocity / memory.table.rad_s_per_tick)
        load = max(-1.0, min(1.0, sign * self._load()))
        moving = velocity != 0.0 or acceleration != 0.0
        memory.show("present_position", position)
        memory.show("present_velocity", speed)
        memory.show("position_trajectory", position)
        memory.show("velocity_trajectory", speed)
        memory.show("present_load", round(load * 1000))  # unit 0.1 %
        memory.show("present_current", round(load * memory.get("current_limit", 1000)))
        memory.show("present_pwm", round(load * memory.get("pwm_limit", 885)))
        memory.show("moving", int(moving))
        memory.show("moving_status", int(not moving))  # bit 0: in position

    @property
    def _sign(self) -> int:
        return -1 if self.memory.get("drive_mode") & REVERSE else 1

    @property
    def _offset(self) -> int:
        return self.memory.ticks("homing_offset") if "homing_offset" in self.memory else 0

    def _wanted(self) -> Drive:
        memory = self.memory
        if not self.torque_on or watchdog_expired(memory):
            return ()
        match memory["operating_mode"]:
            case OperatingMode.VELOCITY:
                return self._turn()
            case (
                OperatingMode.POSITION
                | OperatingMode.EXTENDED_POSITION
                | OperatingMode.CURRENT_BASED_POSITION
            ):
                return self._move()
        return ()

    def _turn(self) -> Drive:
        table = self.memory.table
        speed = self._sign * self.memory.ticks("goal_velocity") * table.rad_s_per_tick
        highest = table.max_speed
        ramp = self._profile("profile_acceleration")
        return max(-highest, min(highest, speed)), ramp * _PER_MINUTE_SQUARED if ramp else ACCELERATION

    def _move(self) -> Drive:
        memory, table = self.memory, self.memory.table
        goal = self._sign * (memory.ticks("goal_position") - self._offset) * table.rad_per_tick
        profile, ramp = self._profile("profile_velocity"), self._profile("profile_acceleration")
        if memory.get("drive_mode") & TIME_BASED:
            return self._timed(goal, profile * 1e-3, ramp * 1e-3)
        speed = profile * table.rad_s_per_tick or table.max_speed
        acceleration = ramp * _PER_MINUTE_SQUARED or ACCELERATION
        return goal, min(speed, table.max_speed), acceleration

    def _timed(self, goal: float, duration: float, ramp: float) -> Drive:
        """Return the move that takes a duration, s, and a time to come to speed, s; 0: the least."""
        distance, highest = abs(goal - self.angle), self.memory.table.max_speed
        if duration <= 0.0 or distance == 0.0:
            return goal, highest, ACCELERATION
        ramp = min(ramp, duration / 2)
        speed = distance / (duration - ramp)
        return goal, min(speed, highest), min(speed / ramp, ACCELERATION) if ramp else ACCELERATION

    def _profile(self, name: str) -> int:
        return abs(self.memory.ticks(name)) if name in self.memory else 0
