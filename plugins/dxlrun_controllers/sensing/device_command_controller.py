"""device_command_controller: forward values to commands of devices: lamps, buzzers, power switches."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Controller, Interfaces, ParametersModel


class DeviceCommandParameters(ParametersModel):
    """Keys of a device_command_controller in the robot file."""

    commands: Annotated[tuple[str, ...], Field(min_length=1, examples=["[board/led]"])]
    """Commands of devices, such as `board/led`."""


class DeviceCommands(CommandModel):
    """Values of commands. Commands that are not named keep their values."""

    values: Annotated[dict[str, float], Field(min_length=1)]
    """Values by command, such as `board/led`, in SI units"""


class DeviceCommandController(Controller[DeviceCommandParameters]):
    """Controller that forwards the newest value of each command. A command without a value stays unchanged.

    The commands are set to their safe values when the controller is deactivated or fails, or when its stream
    ends.
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
        """Return the values of a command, shape (commands,); NaN leaves one unchanged.

        Raises:
            ValueError: A command is unknown, or a value is not finite.
        """
        if not isinstance(command, DeviceCommands):
            return super().prepare(kind, command, parameters)
        known = parameters.commands
        if unknown := [name for name in command.values if name not in known]:
            raise ValueError(f"{unknown[0]} is not one of its commands ({', '.join(known)})")
        if not np.isfinite(list(command.values.values())).all():
            raise ValueError("a value is not finite")
        return np.array([command.values.get(name, np.nan) for name in known])

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Set new values for the device commands that the command names."""
        np.copyto(self.context.device_commands, data, where=np.isfinite(data))

    def update(self, time_ns: int, period_ns: int) -> None:
        """Do nothing: the manager sends the array of values as it is."""
