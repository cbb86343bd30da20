"""Controller whose class has all that a plug-in can get wrong; it is checked, and never runs."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from dxlrun import AngularVelocity, CommandModel, Controller, Duration, Interfaces, ParametersModel


class EasingParameters(ParametersModel):
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    time_constant: Annotated[Duration, Field(gt=0)] = 200_000_000
    speed: Annotated[AngularVelocity, Field(gt=0)] = math.pi / 2


class PositionsCommand(CommandModel):
    positions: tuple[float, ...]


class Easing(Controller[EasingParameters]):
    Parameters = EasingParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"positions": PositionsCommand}

    @classmethod
    def interfaces(cls, parameters: EasingParameters, joints: tuple[str, ...]) -> Interfaces:
        return Interfaces(parameters.joints, ("position",))

    def update(self, time_ns: int, period_ns: int) -> None:
        pass
