"""Easing: joints go to their goals fast while they are far away, and arrive slowly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from dxlrun import AngularVelocity, CommandModel, Floats, JointController, Time


class PositionsCommand(CommandModel):
    """One goal a joint."""

    positions: tuple[float, ...]
    """rad, shape (joints,)"""


class Easing(JointController):
    """Leads joints to commanded positions along an exponential with a top speed."""

    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"positions": PositionsCommand}

    time_constant: Annotated[Time, Field(gt=0)] = 0.2
    """s; in each of it, two thirds of what is left of the way are done"""
    speed: Annotated[AngularVelocity, Field(gt=0)] = math.pi / 2
    """rad/s; never faster than this; `dxlrun parameters` changes it in a run"""

    def begin(self) -> None:
        """Stay where the joints are."""
        self.now = self.goal = self.start

    def on_command(self, kind: str, data: Floats, time_ns: int) -> None:
        """Take new goals."""
        self.goal = data

    def positions(self, time: float, dt: float) -> Floats:
        """Come nearer: by the true period, so that a late cycle makes a longer step."""
        share = -math.expm1(-dt / self.time_constant)
        longest = self.speed * dt
        self.now = self.now + np.clip((self.goal - self.now) * share, -longest, longest)
        return self.now
