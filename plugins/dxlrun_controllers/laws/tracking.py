"""Tracking: velocities or efforts that make joints follow a desired motion: PID and feed-forward."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from dxlrun import LIVE, Context, Floats
from dxlrun_controllers.joints import NotNegative, PerJoint, fill, finite_or
from dxlrun_controllers.laws.pid import Gains, Pid
from dxlrun_controllers.laws.spline import SplineSample


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
        count = len(context.joints)
        limits, commands = context.limits, context.commands
        self._pid = Pid(count)
        self._pid.filter_s = filter_s
        most = finite_or(limits.velocity if interface == "velocity" else limits.effort, np.inf)
        np.copyto(self._pid.upper, most)
        np.negative(most, out=self._pid.lower)
        self._states = context.states
        self._output: Floats = commands.velocity if interface == "velocity" else commands.effort
        self._sent: Floats = context.goals.velocity if interface == "velocity" else context.goals.effort
        self._velocity, self._acceleration, self._friction = np.zeros((3, count))
        self._error, self._rate, self._bias, self._part = np.zeros((4, count))
        self._measured = np.zeros(count, dtype=np.bool_)

    def take(self, gains: TrackingGains, joints: tuple[str, ...]) -> None:
        """Take the gains."""
        self._pid.take(gains, joints)
        fill(self._velocity, gains.feed_forward, joints, 0.0)
        fill(self._acceleration, gains.acceleration, joints, 0.0)
        fill(self._friction, gains.friction, joints, 0.0)

    def begin(self, desired: SplineSample) -> None:
        """Begin with the output that was last sent, or with 0."""
        self._aim(desired)
        np.copyto(self._output, finite_or(self._sent, 0.0))
        self._pid.reset(self._output, self._error, self._bias)

    def update(self, desired: SplineSample, period_s: float) -> None:
        """Command by the law, after `period_s`."""
        self._aim(desired)
        np.copyto(
            self._output, self._pid.update(self._error, self._rate, self._bias, self._measured, period_s)
        )

    def _aim(self, desired: SplineSample) -> None:
        states, bias, part = self._states, self._bias, self._part
        np.subtract(desired.position, states.position, out=self._error)
        np.isfinite(self._error, out=self._measured)
        self._measured &= states.valid
        np.subtract(desired.velocity, states.velocity, out=self._rate)
        np.multiply(self._velocity, desired.velocity, out=bias)
        np.multiply(self._acceleration, desired.acceleration, out=part)
        bias += part
        np.sign(desired.velocity, out=part)
        part *= self._friction
        bias += part
