"""The shaft of a simulated servo: what the registers command, how it moves, what the registers show of it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar

from dxlrun.simulation import motion
from dxlrun.simulation.memory import Memory

ACCELERATION = 100.0
"""rad/s^2. The manual names none: 1.5 Nm of stall torque on 0.015 kg m^2 of gear and a light link [i]."""

Drive = tuple[float, ...]
"""What is commanded: nothing (limp), or a speed, or a goal with a speed and an acceleration; SI units."""


class Shaft(ABC):
    """Follows what is written, and is looked at; a subclass for each family of registers."""

    items: ClassVar[frozenset[str]]
    """Items whose writing may change the motion."""

    def __init__(self, memory: Memory, start_ns: int, angle: float) -> None:
        self.memory = memory
        self.now_ns = start_ns
        self._motion = motion.rest(start_ns, angle)
        self._drive: Drive = ()

    @property
    def angle(self) -> float:
        """Angle, rad from raw 0, of the shaft itself: turns count, Homing Offset and reversal do not."""
        return self._motion.at(self.now_ns)[0]

    @property
    def velocity(self) -> float:
        """Speed, rad/s, counter-clockwise positive."""
        return self._motion.at(self.now_ns)[1]

    @property
    def moving(self) -> bool:
        """True until it rests."""
        _, velocity, acceleration = self._motion.at(self.now_ns)
        return velocity != 0.0 or acceleration != 0.0

    @property
    def torque_on(self) -> bool:
        """True when the motor holds or moves the shaft: torque enabled and its limit not 0."""
        return self.memory.get("torque_enable") == 1 and self.memory.get("torque_limit", 1) > 0

    def rest_at(self, angle: float) -> None:
        """Put the shaft somewhere, at rest; what is commanded counts from the next `plan`."""
        self._motion = motion.rest(self.now_ns, angle)
        self._drive = ()

    def advance(self, now_ns: int) -> None:
        """Let time pass; going back is ignored."""
        self.now_ns = max(self.now_ns, now_ns)

    def plan(self, written: Iterable[str]) -> None:
        """Start another motion when what was written asks for one."""
        if self.items.isdisjoint(written):
            return
        drive = self._wanted()
        if drive == self._drive:
            return
        self._drive = drive
        angle, velocity, _ = self._motion.at(self.now_ns)
        if not drive:
            self._motion = motion.rest(self.now_ns, angle)
        elif len(drive) == 2:
            self._motion = motion.turn(self.now_ns, angle, velocity, *drive)
        else:
            goal, speed, acceleration = drive
            start = self._start_of_move(angle)
            self._motion = motion.move_to(
                self.now_ns, start, velocity, goal, speed=speed, acceleration=acceleration
            )

    def power_up(self) -> None:
        """Come to rest within one turn, and take the angle as the goal [i]."""
        self.rest_at(self.within_a_turn(self.angle))
        self.memory["goal_position"] = self.position_tick(self.angle)

    @abstractmethod
    def within_a_turn(self, angle: float) -> float:
        """Return an angle as the servo finds it when it is switched on."""

    @abstractmethod
    def position_tick(self, angle: float) -> int:
        """Return what Present Position shows."""

    @abstractmethod
    def refresh(self) -> None:
        """Bring the registers of the shaft to the time."""

    @abstractmethod
    def _wanted(self) -> Drive: ...

    def _start_of_move(self, angle: float) -> float:
        return angle

    def _load(self) -> float:
        """Return the load as a part of the maximum, with the speed's sign.

        No mechanics stand behind it: some for the speed, some for the change of it [i].
        """
        _, velocity, acceleration = self._motion.at(self.now_ns)
        return 0.1 * velocity / self.memory.table.max_speed + 0.4 * acceleration / ACCELERATION


def in_turn(angle: float) -> float:
    """Return the same direction between 0 and a whole turn."""
    return angle if 0 <= angle < math.tau else angle % math.tau
