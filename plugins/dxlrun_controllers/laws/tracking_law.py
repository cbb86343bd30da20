"""Tracking: PID law with feed-forward that makes joints follow a desired motion by velocities or efforts."""

from typing import Annotated, Final, Literal

import numpy as np

from dxlrun import LIVE, Context, Floats
from dxlrun_controllers.joint_parameters import NotNegative, PerJoint, finite_or, row_of
from dxlrun_controllers.laws.pid import Gains, Pid
from dxlrun_controllers.laws.spline import SplineSample

CLOSING_SPEED: Final = 0.5
"""Lowest profile velocity that `posvel` commands, rad/s. A lagging servo needs it for the rest of the
distance: with the speed 0 at the end of a motion it would creep at one tick (0.012 rad/s)."""


class TrackingGains(Gains):
    """Gains of PID law and feed-forward. u is the unit of the effort: Nm, A or fraction of maximum.

    `feed_forward` is the viscous term, u s/rad. The feed-forward is that of L. Sciavicco, B. Siciliano,
    Modelling and Control of Robot Manipulators (2000), section 7.2, for one joint without gravity.
    """

    acceleration: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Inertia, u s^2/rad. It is multiplied by the desired acceleration."""
    friction: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Dry friction, u. It acts in the direction of the desired velocity."""


class Tracking:
    """Law that commands the velocity or the effort of joints so that they follow a desired motion."""

    def __init__(self, context: Context, interface: Literal["velocity", "effort"], filter_s: float) -> None:
        limits, commands = context.limits, context.commands
        self._pid = Pid(len(context.joints))
        self._pid.filter_s = filter_s
        most = finite_or(limits.velocity if interface == "velocity" else limits.effort, np.inf)
        self._pid.lower, self._pid.upper = -most, most
        self._states = context.states
        self._output: Floats = commands.velocity if interface == "velocity" else commands.effort
        self._sent: Floats = context.goals.velocity if interface == "velocity" else context.goals.effort

    def set_gains(self, gains: TrackingGains, joints: tuple[str, ...]) -> None:
        """Set the gains of the joints."""
        self._pid.set_gains(gains, joints)
        self._velocity = row_of(gains.feed_forward, joints, 0.0)
        self._acceleration = row_of(gains.acceleration, joints, 0.0)
        self._friction = row_of(gains.friction, joints, 0.0)

    def start_tracking(self, desired: SplineSample) -> None:
        """Start from the command that was last sent, or from 0, so that the output does not jump."""
        np.copyto(self._output, finite_or(self._sent, 0.0))
        self._pid.reset(self._output, desired.position - self._states.position, self._bias(desired))

    def update(self, desired: SplineSample, period_s: float) -> None:
        """Command the output of the law for a desired state, `period_s` after the last update."""
        states = self._states
        error, rate = desired.position - states.position, desired.velocity - states.velocity
        measured = np.isfinite(error) & states.valid
        np.copyto(self._output, self._pid.update(error, rate, self._bias(desired), measured, period_s))

    def _bias(self, desired: SplineSample) -> Floats:
        bias: Floats = self._velocity * desired.velocity + self._acceleration * desired.acceleration
        bias += np.sign(desired.velocity) * self._friction
        return bias
