"""Drive controllers: forward one velocity, effort or PWM a joint until the next one comes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Controller, Floats, Interfaces
from dxlrun_controllers.group import GroupParameters, check_size


class VelocitiesCommand(CommandModel):
    """One velocity a joint."""

    velocities: tuple[float, ...]
    """rad/s, shape (joints,), with their signs"""


class EffortsCommand(CommandModel):
    """One effort a joint."""

    efforts: tuple[float, ...]
    """Nm, A or the fraction of maximum, as the model measures it; shape (joints,), with their signs"""


class PwmCommand(CommandModel):
    """One PWM a joint."""

    pwm: tuple[Annotated[float, Field(ge=-1, le=1)], ...]
    """Fraction of the full voltage, -1..1, shape (joints,); who writes 20 for 20 % shall not get it all"""


class _DriveController(Controller[GroupParameters]):
    """Forwards what was sent last; nothing moves by itself before, and after the controller was left."""

    Parameters = GroupParameters
    claimed: ClassVar[Literal["velocity", "effort", "pwm"]]

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the one interface of the parameters' joints."""
        return Interfaces(parameters.joints, (cls.claimed,))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GroupParameters) -> NDArray[np.float64]:
        """Return the values, shape (joints,). Raises ValueError for a wrong size."""
        ((what, values),) = command.model_dump().items()
        check_size(what, len(values), parameters.joints)
        return np.array(values, dtype=np.float64)

    def on_activate(self, time_ns: int) -> None:
        """Command 0."""
        self._commands().fill(0.0)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new values."""
        np.copyto(self._commands(), data)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last command: the manager takes it as it stands."""

    def _commands(self) -> Floats:
        array: Floats = getattr(self.context.commands, self.claimed)
        return array


class JointGroupVelocityController(_DriveController):
    """Forwards velocities: wheels, and joints that turn at a speed."""

    claimed = "velocity"
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"velocities": VelocitiesCommand}


class JointGroupEffortController(_DriveController):
    """Forwards efforts: torques or currents. Without a command joints have none, so they give way."""

    claimed = "effort"
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"efforts": EffortsCommand}


class JointGroupPwmController(_DriveController):
    """Forwards PWM: a voltage, without any control behind it."""

    claimed = "pwm"
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"pwm": PwmCommand}
