"""Easing: controller that moves joints fast while they are far from their goals, and slowly on arrival."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from dxlrun import AngularVelocity, CommandModel, Floats, JointController, Time


class PositionsCommand(CommandModel):
    """One goal position per joint"""

    positions: tuple[float, ...]
    """Goal positions, rad, shape (joints,)"""


class Easing(JointController):
    """Controller that moves joints to commanded positions along an exponential with a speed limit"""

    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"positions": PositionsCommand}

    time_constant: Annotated[Time, Field(gt=0)] = 0.2
    """Time in which the distance to the goal falls by two thirds, s"""
    speed: Annotated[AngularVelocity, Field(gt=0)] = math.pi / 2
    """Speed limit, rad/s; `dxlrun parameters` changes it in a run"""

    def begin(self) -> None:
        """Hold the joints where they are."""
        self.now = self.goal = self.start

    def on_command(self, kind: str, data: Floats, time_ns: int) -> None:
        """Set new goal positions, rad."""
        self.goal = data

    def positions(self, time: float, dt: float) -> Floats:
        """Return the positions to command in this cycle, rad.

        `dt` is the measured period, so a late cycle makes a longer step.
        """
        share = -math.expm1(-dt / self.time_constant)
        longest = self.speed * dt
        self.now = self.now + np.clip((self.goal - self.now) * share, -longest, longest)
        return self.now
