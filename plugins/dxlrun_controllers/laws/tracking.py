"""Tracking: velocities or efforts that make joints follow a desired motion: PID and feed-forward."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import numpy as np

from dxlrun import LIVE, Context, Floats
from dxlrun_controllers.joints import NotNegative, PerJoint, finite_or, row_of
from dxlrun_controllers.laws.pid import Gains, Pid
from dxlrun_controllers.laws.spline import SplineSample

CLOSING_SPEED: Final = 0.5
"""rad/s, posvel: the least speed for the rest of the way of a servo that lags; with the speed 0 of an end it
would creep there at one tick (0.012 rad/s)."""


class TrackingGains(Gains):
    """Gains of the law, and the effort that a motion needs by itself (Nm, A or fraction of maximum: u).

    feed_forward is the viscous part, u s/rad. Sum as in L. Sciavicco, B. Siciliano, Modelling and Control of
    Robot Manipulators (2000), section 7.2, for one joint without gravity.
    """

    acceleration: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u s^2/rad, times the desired acceleration: the inertia."""
    friction: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u, in the direction of the desired velocity: the dry friction."""


class Tracking:
    """Commands one interface of some joints so that they follow a desired state."""

    def __init__(self, context: Context, interface: Literal["velocity", "effort"], filter_s: float) -> None:
        limits, commands = context.limits, context.commands
        self._pid = Pid(len(context.joints))
        self._pid.filter_s = filter_s
        most = finite_or(limits.velocity if interface == "velocity" else limits.effort, np.inf)
        self._pid.lower, self._pid.upper = -most, most
        self._states = context.states
        self._output: Floats = commands.velocity if interface == "velocity" else commands.effort
        self._sent: Floats = context.goals.velocity if interface == "velocity" else context.goals.effort

    def take(self, gains: TrackingGains, joints: tuple[str, ...]) -> None:
        """Take the gains."""
        self._pid.take(gains, joints)
        self._velocity = row_of(gains.feed_forward, joints, 0.0)
        self._acceleration = row_of(gains.acceleration, joints, 0.0)
        self._friction = row_of(gains.friction, joints, 0.0)

    def begin(self, desired: SplineSample) -> None:
        """Begin with the output that was last sent, or with 0."""
        np.copyto(self._output, finite_or(self._sent, 0.0))
        self._pid.reset(self._output, desired.position - self._states.position, self._bias(desired))

    def update(self, desired: SplineSample, period_s: float) -> None:
        """Command by the law, after `period_s`."""
        states = self._states
        error, rate = desired.position - states.position, desired.velocity - states.velocity
        measured = np.isfinite(error) & states.valid
        np.copyto(self._output, self._pid.update(error, rate, self._bias(desired), measured, period_s))

    def _bias(self, desired: SplineSample) -> Floats:
        bias: Floats = self._velocity * desired.velocity + self._acceleration * desired.acceleration
        bias += np.sign(desired.velocity) * self._friction
        return bias
