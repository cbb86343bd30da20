"""device_command_controller: forwards values to commands of devices: lamps, buzzers, power switches."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Controller, Interfaces, ParametersModel


class DeviceCommandParameters(ParametersModel):
    """Keys of a device_command_controller in the robot file."""

    commands: Annotated[tuple[str, ...], Field(min_length=1)]
    """Commands of devices: `board/led`."""


class DeviceCommands(CommandModel):
    """Values of some of the commands; the others keep theirs."""

    values: Annotated[dict[str, float], Field(min_length=1)]
    """By name, `board/led`, SI units"""


class DeviceCommandController(Controller[DeviceCommandParameters]):
    """Forwards the newest value of each command; one that has had none is left as it is.

    When it leaves, fails, or its stream ends, the commands become their safe values.
    """

    Parameters = DeviceCommandParameters
    Commands: ClassVar = {"device_commands": DeviceCommands}

    @classmethod
    def interfaces(cls, parameters: DeviceCommandParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the commands."""
        return Interfaces((), device_commands=parameters.commands)

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: DeviceCommandParameters
    ) -> NDArray[np.float64]:
        """Return a value each, shape (commands,), NaN: as it is. Raises ValueError for an unknown command."""
        if not isinstance(command, DeviceCommands):
            return super().prepare(kind, command, parameters)
        known = parameters.commands
        if unknown := [name for name in command.values if name not in known]:
            raise ValueError(f"{unknown[0]} is none of its commands ({', '.join(known)})")
        if not np.isfinite(list(command.values.values())).all():
            raise ValueError("a value is not finite")
        return np.array([command.values.get(name, np.nan) for name in known])

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new values."""
        np.copyto(self.context.device_commands, data, where=np.isfinite(data))

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last values: the manager takes the array as it is."""
