"""Group controllers: forward one command a joint, of one or two interfaces, until the next one comes."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Controller, Interfaces
from dxlrun_controllers.joints import JointsParameters, hold, take_shorter_way_from_goals


class GroupParameters(JointsParameters):
    """Keys of a group controller in the robot file."""


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
    """Fraction of the full voltage, -1..1, shape (joints,): 20 for 20 % is refused"""


class _GroupController(Controller[GroupParameters]):
    """Forwards the newest command; each field of it is for one interface, in the order of `claimed`."""

    Parameters = GroupParameters
    claimed: ClassVar[tuple[Literal["position", "velocity", "effort", "pwm"], ...]]

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the controller's interfaces of the parameters' joints."""
        return Interfaces(parameters.joints, cls.claimed)

    def on_activate(self, time_ns: int) -> None:
        """Hold positions where the joints are; velocities, efforts and PWM begin with 0."""
        if "position" in self.claimed:
            hold(self.context)
        else:
            getattr(self.context.commands, self.claimed[0]).fill(0.0)

    def on_restart(self, time_ns: int) -> None:
        """Keep the efforts or PWM of the other joints, which may carry a load; else as an activation."""
        self.on_activate(time_ns)
        if self.claimed[0] in ("effort", "pwm"):
            sent = getattr(self.context.goals, self.claimed[0])
            np.copyto(getattr(self.context.commands, self.claimed[0]), sent, where=np.isfinite(sent))

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new values."""
        for name, values in zip(self.claimed, data.reshape(len(self.claimed), -1), strict=True):
            wanted = take_shorter_way_from_goals(values, self.context) if name == "position" else values
            np.copyto(getattr(self.context.commands, name), wanted)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Keep the last command: the manager takes the arrays as they are."""


class JointGroupPositionController(_GroupController):
    """Forwards positions; the servos go there as fast as they can."""

    claimed = ("position",)
    Commands: ClassVar = {"positions": PositionsCommand}


class JointGroupPosVelController(_GroupController):
    """Forwards positions, and the speeds at which the servos go there."""

    claimed = ("position", "velocity")
    Commands: ClassVar = {"posvel": PosVelCommand}


class JointGroupPosEffortController(_GroupController):
    """Forwards positions, and the highest effort of the servos there: a gripper holds gently.

    Until the first command a servo may take as much as its own limit lets it.
    """

    claimed = ("position", "effort")
    Commands: ClassVar = {"poseffort": PosEffortCommand}


class JointGroupVelocityController(_GroupController):
    """Forwards velocities: wheels, and joints that turn at a speed."""

    claimed = ("velocity",)
    Commands: ClassVar = {"velocities": VelocitiesCommand}


class JointGroupEffortController(_GroupController):
    """Forwards efforts: torques or currents. Without a command joints have none, so they give way."""

    claimed = ("effort",)
    Commands: ClassVar = {"efforts": EffortsCommand}


class JointGroupPwmController(_GroupController):
    """Forwards PWM: a voltage, without any control behind it."""

    claimed = ("pwm",)
    Commands: ClassVar = {"pwm": PwmCommand}
