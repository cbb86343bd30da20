"""Easing: joints go to their goals fast while they are far away, and arrive slowly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    LIVE,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    ParametersModel,
)


class EasingParameters(ParametersModel):
    """Keys of the controller in the robot file."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """The joints, in the order in which commands name them."""
    time_constant: Annotated[Duration, Field(gt=0)] = 200_000_000
    """ns; in each of it, two thirds of what is left of the way are done"""
    speed: Annotated[AngularVelocity, Field(gt=0), LIVE] = math.pi / 2
    """rad/s; never faster than this; `dxlrun parameters` changes it in a run"""


class PositionsCommand(CommandModel):
    """One goal a joint."""

    positions: tuple[float, ...]
    """rad, shape (joints,)"""


@dataclass(frozen=True, slots=True)
class EasingState:
    """Message of the topic `state`."""

    left: Floats
    """rad, shape (joints,): what is left of the way"""


class Easing(Controller[EasingParameters]):
    """Leads joints to commanded positions along an exponential with a top speed."""

    Parameters = EasingParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"positions": PositionsCommand}
    Topics: ClassVar[Mapping[str, type]] = {"state": EasingState}

    @classmethod
    def interfaces(cls, parameters: EasingParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the position of the parameters' joints."""
        return Interfaces(parameters.joints, ("position",))

    def on_configure(self, context: Context) -> None:
        """Make what is kept from cycle to cycle."""
        super().on_configure(context)
        self._goal = np.zeros(len(context.joints))

    def on_activate(self, time_ns: int) -> None:
        """Stay where the joints are: at what was last sent, or where nothing was sent, at what is read."""
        context = self.context
        sent = context.goals.position
        np.copyto(self._goal, sent)
        np.copyto(self._goal, context.states.position, where=np.isnan(sent))
        np.copyto(context.commands.position, self._goal)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new goals."""
        np.copyto(self._goal, data)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Come nearer: by the true period, so that a late cycle makes a longer step."""
        position = self.context.commands.position
        share = -math.expm1(-period_ns / self.parameters.time_constant)
        longest = self.parameters.speed * period_ns * 1e-9
        step = (self._goal - position) * share
        position += np.clip(step, -longest, longest)
        self.context.publish("state", EasingState(self._goal - position))
