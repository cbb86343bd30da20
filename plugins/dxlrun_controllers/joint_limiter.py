"""joint_limiter: passes positions on within limits of position, velocity and acceleration."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    Angle,
    AngularAcceleration,
    AngularVelocity,
    Context,
    Controller,
    Interfaces,
    ParametersModel,
)
from dxlrun_controllers.group import PositionsCommand
from dxlrun_controllers.joints import (
    JointsParameters,
    PerJoint,
    commanded_by,
    finite_or,
    row_of,
    take_shorter_way,
    take_where_heard,
)
from dxlrun_controllers.laws.limiting import Limiter


class LimiterLimits(ParametersModel):
    """Limits of the joints, each one value for all or a mapping by joint."""

    acceleration: PerJoint[Annotated[AngularAcceleration, Field(gt=0)]] | None = None
    """The joint's own limit if that is lower, or none is given; one of the two there must be."""
    velocity: PerJoint[Annotated[AngularVelocity, Field(gt=0)]] | None = None
    """The joint's own limit if that is lower, or none is given."""
    lower: PerJoint[Angle] | None = None
    """Lowest position; the joint's own limit if that is narrower."""
    upper: PerJoint[Angle] | None = None
    """Positions; the joint's own limits where they are narrower, or none are given."""


class LimiterParameters(JointsParameters):
    """Keys of a joint_limiter in the robot file."""

    command_interface: Literal["position", "posvel"] = "position"
    """`posvel` commands the velocity too: its magnitude to servos, with its sign to another controller."""
    limits: LimiterLimits = LimiterLimits()


class JointLimiter(Controller[LimiterParameters]):
    """Leads joints to positions in the least time that limits allow (`limiting.Limiter`).

    References: what controllers that are `into` this one command, else the newest `positions` command, else
    where the joints come to rest. A reference without a velocity is one at rest: joints follow a moving one
    by v**2 / (2 a) later, so those that move smoothly should command the velocity too.
    """

    Parameters = LimiterParameters
    Commands: ClassVar = {"positions": PositionsCommand}

    @classmethod
    def interfaces(cls, parameters: LimiterParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command positions, perhaps with velocities; export both."""
        command = commanded_by(parameters.command_interface)
        return Interfaces(parameters.joints, command, reference=("position", "velocity"))

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        joints, own, limits = context.joints, context.limits, self.parameters.limits
        acceleration = np.fmin(row_of(limits.acceleration, joints), own.acceleration)
        missing = [joint for joint, most in zip(joints, acceleration, strict=True) if not np.isfinite(most)]
        if missing:
            raise ValueError(
                f"{', '.join(missing)} has no limit of the acceleration: add limits.acceleration"
            )
        self._limiter = limiter = Limiter(len(joints))
        limiter.acceleration = acceleration
        limiter.speed = np.minimum(row_of(limits.velocity, joints), finite_or(own.velocity, np.inf))
        limiter.lower = np.maximum(row_of(limits.lower, joints, -np.inf), own.lower)
        limiter.upper = np.minimum(row_of(limits.upper, joints), own.upper)
        self._setpoint = np.zeros(len(joints))
        self._chained = np.zeros(len(joints), dtype=np.bool_)
        self._some_unknown = True
        self._posvel = self.parameters.command_interface == "posvel"

    def on_activate(self, time_ns: int) -> None:
        """Hold what was last sent, or the positions that were read where nothing was sent."""
        position = finite_or(self.context.goals.position, self.context.states.position)
        self._limiter.begin(position)
        np.copyto(self._setpoint, position)
        self._chained.fill(False)
        self._some_unknown = True

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new positions."""
        near = self._limiter.position
        np.copyto(self._setpoint, take_shorter_way(data, near, np.array(self.context.wrap)))

    def on_hold(self, time_ns: int) -> None:
        """Stop as soon as the limits allow."""
        limiter = self._limiter
        np.copyto(self._setpoint, limiter.stopping_point(limiter.position, limiter.velocity))

    def update(self, time_ns: int, period_ns: int) -> None:
        """Go on towards the reference."""
        limiter, references, commands = self._limiter, self.context.references, self.context.commands
        if self._some_unknown:
            self._hold_where_heard()
        free = np.isnan(references.position)
        stop = limiter.stopping_point(limiter.position, limiter.velocity)
        np.copyto(self._setpoint, stop, where=free & self._chained)
        self._chained = ~free
        rate = np.where(free, 0.0, finite_or(references.velocity, 0.0))
        limiter.update(np.where(free, self._setpoint, references.position), rate, period_ns * 1e-9)
        np.copyto(commands.position, limiter.position)
        if not self._posvel:
            return
        if self.context.into:
            np.copyto(commands.velocity, limiter.velocity)
        else:
            np.abs(limiter.velocity, out=commands.velocity)
            # a servo that lags when the joint is to rest goes the rest of its way at the highest speed
            np.copyto(commands.velocity, limiter.speed, where=limiter.velocity == 0.0)

    def _hold_where_heard(self) -> None:
        """Begin with joints that were not known at the activation where they are heard first."""
        limiter = self._limiter
        limiter.velocity[np.isnan(limiter.position)] = 0.0
        self._some_unknown = take_where_heard(limiter.position, self.context.states)
        self._setpoint = finite_or(self._setpoint, limiter.position)
