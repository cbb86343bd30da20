"""Group controllers: forward the newest command of one or two interfaces to a group of joints."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import CommandModel, Controller, Interfaces
from dxlrun_controllers.joint_parameters import JointsParameters, hold_joints, take_shorter_way_from_goals


class GroupParameters(JointsParameters):
    """Keys of a group controller in the robot file."""


class PositionsCommand(CommandModel):
    """One goal position per joint"""

    positions: tuple[float, ...]
    """Goal positions, rad, shape (joints,)"""


class PosVelCommand(CommandModel):
    """One goal position and one speed per joint"""

    positions: tuple[float, ...]
    """Goal positions, rad, shape (joints,)"""
    velocities: tuple[float, ...]
    """Speeds on the way, rad/s, shape (joints,). Signs are ignored"""


class PosEffortCommand(CommandModel):
    """One goal position and one effort limit per joint"""

    positions: tuple[float, ...]
    """Goal positions, rad, shape (joints,)"""
    efforts: tuple[float, ...]
    """Effort limits, Nm, A or the fraction of maximum, as the model measures it, shape (joints,). Signs are
    ignored"""


class VelocitiesCommand(CommandModel):
    """One velocity per joint"""

    velocities: tuple[float, ...]
    """Goal velocities, rad/s, signed, shape (joints,)"""


class EffortsCommand(CommandModel):
    """One effort per joint"""

    efforts: tuple[float, ...]
    """Goal efforts, Nm, A or the fraction of maximum, as the model measures it, signed, shape (joints,)"""


class PwmCommand(CommandModel):
    """One PWM duty per joint"""

    pwm: tuple[Annotated[float, Field(ge=-1, le=1)], ...]
    """PWM duties, fraction of the full voltage, -1..1, shape (joints,). 20 for 20 % is rejected"""


class _GroupController(Controller[GroupParameters]):
    """Base of the controllers that forward the newest command to the interfaces `claimed`, in that order."""

    Parameters = GroupParameters
    claimed: ClassVar[tuple[Literal["position", "velocity", "effort", "pwm"], ...]]

    @classmethod
    def interfaces(cls, parameters: GroupParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the interfaces `claimed` on the joints of the parameters."""
        return Interfaces(parameters.joints, cls.claimed)

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals; velocities, efforts and PWM start at 0."""
        if "position" in self.claimed:
            hold_joints(self.context)
        else:
            getattr(self.context.commands, self.claimed[0]).fill(0.0)

    def on_restart(self, time_ns: int) -> None:
        """Activate again, but keep the efforts or PWM that were sent, because joints may carry a load."""
        self.on_activate(time_ns)
        if self.claimed[0] in ("effort", "pwm"):
            sent = getattr(self.context.goals, self.claimed[0])
            np.copyto(getattr(self.context.commands, self.claimed[0]), sent, where=np.isfinite(sent))

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Set new values for the joints."""
        for name, values in zip(self.claimed, data.reshape(len(self.claimed), -1), strict=True):
            wanted = take_shorter_way_from_goals(values, self.context) if name == "position" else values
            np.copyto(getattr(self.context.commands, name), wanted)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Do nothing: the manager sends the command arrays as they are."""


class JointGroupPositionController(_GroupController):
    """Controller that forwards positions. The servos move there as fast as they can."""

    claimed = ("position",)
    Commands: ClassVar = {"positions": PositionsCommand}


class JointGroupPosVelController(_GroupController):
    """Controller that forwards positions and the speeds at which the servos move there"""

    claimed = ("position", "velocity")
    Commands: ClassVar = {"posvel": PosVelCommand}


class JointGroupPosEffortController(_GroupController):
    """Controller that forwards positions and effort limits, for example for a gripper that holds gently.

    Until the first command, the effort is only limited by the servo's own limit.
    """

    claimed = ("position", "effort")
    Commands: ClassVar = {"poseffort": PosEffortCommand}


class JointGroupVelocityController(_GroupController):
    """Controller that forwards velocities, for wheels and other joints that turn at a speed"""

    claimed = ("velocity",)
    Commands: ClassVar = {"velocities": VelocitiesCommand}


class JointGroupEffortController(_GroupController):
    """Controller that forwards efforts: torques or currents. Without a command the effort is 0, so joints are
    compliant."""

    claimed = ("effort",)
    Commands: ClassVar = {"efforts": EffortsCommand}


class JointGroupPwmController(_GroupController):
    """Controller that forwards PWM duties: a voltage without closed-loop control"""

    claimed = ("pwm",)
    Commands: ClassVar = {"pwm": PwmCommand}
