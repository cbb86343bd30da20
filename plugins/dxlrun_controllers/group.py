"""Group controllers: forward one command a joint until the next one comes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Context, Controller, Interfaces, ParametersModel

JointNames = Annotated[tuple[str, ...], Field(min_length=1)]


class GroupParameters(ParametersModel):
    """Keys of a group controller in the robot file."""

    joints: JointNames
    """The joints, in the order in which commands name them."""


class PositionsCommand(CommandModel):
    """One goal a joint."""

    positions: tuple[float, ...]
    """rad, shape (joints,)"""


class PosVelCommand(CommandModel):
    """One goal and one speed a joint."""

    positions: tuple[float, ...]
    """rad, shape (joints,)"""
    velocities: tuple[float, ...]
    """rad/s, shape (joints,); the magnitude counts"""


class PosEffortCommand(CommandModel):
    """One goal and the highest effort on the way there and at it, a joint."""

    positions: tuple[float, ...]
    """rad, shape (joints,)"""
    efforts: tuple[float, ...]
    """Nm, A or the fraction of maximum, as the model measures it; shape (joints,); the magnitude counts"""


def check_size(what: str, found: int, joints: tuple[str, ...]) -> None:
    """Raise ValueError when a command does not have one value a joint."""
    if found != len(joints):
        raise ValueError(f"{found} {what} for {len(joints)} joints ({', '.join(joints)})")


def hold(context: Context) -> None:
    """Command what was last sent, so that nothing moves; what the servo says where nothing was sent."""
    commands, goals = context.commands, context.goals
    np.copyto(commands.position, goals.position)
    np.copyto(commands.position, context.states.position, where=np.isnan(goals.position))
    np.copyto(commands.velocity, goals.velocity)


class JointGroupPositionController(Controller[GroupParameters]):
    """Forwards positions; the servos go there as fast as they can."""

    Parameters = GroupParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"positions": PositionsCommand}

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the position of the parameters' joints."""
        return Interfaces(parameters.joints, ("position",))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GroupParameters) -> NDArray[np.float64]:
        """Return the positions, rad, shape (joints,). Raises ValueError for a wrong size."""
        if not isinstance(command, PositionsCommand):
            return super().prepare(kind, command, parameters)
        check_size("positions", len(command.positions), parameters.joints)
        return np.array(command.positions, dtype=np.float64)

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are."""
        hold(self.context)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new positions."""
        np.copyto(self.context.commands.position, data)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last command: the manager takes it as it stands."""


class JointGroupPosVelController(Controller[GroupParameters]):
    """Forwards positions, and the speeds at which the servos go there."""

    Parameters = GroupParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"posvel": PosVelCommand}

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position and velocity of the parameters' joints."""
        return Interfaces(parameters.joints, ("position", "velocity"))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GroupParameters) -> NDArray[np.float64]:
        """Return positions, then velocities, shape (2 * joints,). Raises ValueError for a wrong size."""
        if not isinstance(command, PosVelCommand):
            return super().prepare(kind, command, parameters)
        check_size("positions", len(command.positions), parameters.joints)
        check_size("velocities", len(command.velocities), parameters.joints)
        return np.array((*command.positions, *command.velocities), dtype=np.float64)

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are."""
        hold(self.context)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new positions and speeds."""
        commands = self.context.commands
        joints = len(commands.position)
        np.copyto(commands.position, data[:joints])
        np.copyto(commands.velocity, data[joints:])

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last command: the manager takes it as it stands."""


class JointGroupPosEffortController(Controller[GroupParameters]):
    """Forwards positions, and how much effort the servos may take to be there: a gripper holds gently.

    Until the first command a servo may take as much as its own limit lets it.
    """

    Parameters = GroupParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"poseffort": PosEffortCommand}

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position and effort of the parameters' joints."""
        return Interfaces(parameters.joints, ("position", "effort"))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GroupParameters) -> NDArray[np.float64]:
        """Return positions, then efforts, shape (2 * joints,). Raises ValueError for a wrong size."""
        if not isinstance(command, PosEffortCommand):
            return super().prepare(kind, command, parameters)
        check_size("positions", len(command.positions), parameters.joints)
        check_size("efforts", len(command.efforts), parameters.joints)
        return np.array((*command.positions, *command.efforts), dtype=np.float64)

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are."""
        hold(self.context)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new positions and efforts."""
        commands = self.context.commands
        joints = len(commands.position)
        np.copyto(commands.position, data[:joints])
        np.copyto(commands.effort, data[joints:])

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last command: the manager takes it as it stands."""
