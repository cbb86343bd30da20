"""PID: the law of proportional, integral and derivative feedback, for some joints at once.

Parallel form with a filtered derivative and a feed-forward w:

    u = sat(p e + I + d D + w),   dI/dt = i e,   filter * dD/dt = de/dt - D

Units: u in that of the command (Nm, A, fraction, rad/s), e in rad or rad/s, so p in u/e, i in u/(e s), d in
u s/e. Sources: K. J. Astrom, R. M. Murray, Feedback Systems (2008), sections 10.4 and 10.5; K. J. Astrom,
B. Wittenmark, Computer-Controlled Systems (1997), section 8.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from dxlrun import LIVE, Floats, ParametersModel
from dxlrun_controllers.joints import NotNegative, PerJoint, fill


class Gains(ParametersModel):
    """Gains of a PID law, each one number for all joints or a mapping by joint; they can be changed in a run.

    u is the unit of the command (Nm, A or fraction of maximum; rad/s; fraction of the full voltage; rad), e
    that of the reference (rad or rad/s).
    """

    p: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u/e"""
    i: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u/(e s)"""
    d: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u s/e"""
    feed_forward: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """u s/rad, times the reference's velocity; left out, it is 1 where velocities are commanded."""


def feed_velocities_forward(data: object) -> object:
    """Return parameters as written, with a feed_forward of 1 where velocities are commanded and it is not."""
    if not isinstance(data, dict) or data.get("command_interface") != "velocity":
        return data
    gains = data.get("gains")
    return {**data, "gains": {"feed_forward": 1.0, **gains}} if isinstance(gains, dict) else data


class Pid:
    """PID of some joints; all arrays have the shape (joints,), nothing is allocated in `update`.

    - Integral and filter are backward Euler: with tau the filter's time constant and h the period, the filter
      is D += h / (tau + h) * (de/dt - D). Its pole tau / (tau + h) lies in [0, 1) for every h, so tau = 0 is
      no filter; the bilinear rule has its pole below 0 for tau < h / 2, and rings at tau = 0.
    - `integral` is the term itself, in units of the command: a gain that is changed in a run changes only
      what is added from then on, and the output does not jump by it.
    - Anti-windup by clamping: where the output is at its limit, the integral takes only the part of its step
      that leads away from the limit, so the output leaves the limit as soon as the rest of the law does. It
      needs no time constant, as back-calculation does, and cannot make the integral overshoot.
    - h is, for each joint, the time since its last measurement. A joint without one keeps its last output:
      one lost packet must not let an arm fall. The runtime withdraws the commands of a joint that stays
      silent (lost: 3 replies and 50 ms).
    """

    def __init__(self, joints: int) -> None:
        self.p, self.i, self.d = np.zeros((3, joints))
        self.filter_s = 0.0
        """Time constant of the derivative's filter, s; 0: none."""
        self.lower, self.upper = np.full(joints, -np.inf), np.full(joints, np.inf)
        """Limits of the output."""
        self.integral_limit, self._least_integral = np.full(joints, np.inf), np.full(joints, -np.inf)
        """Largest magnitude of the integral term; set by `limit_integral`."""
        self._terms = np.zeros((5, joints))
        self.output, self.proportional, self.integral, self.derivative, self.rate = self._terms
        """What the last update made; `rate` is the filtered rate of the error."""
        self._new = np.zeros((5, joints))
        self._elapsed_s = np.zeros(joints)
        self._room, self._share = np.zeros((2, joints))

    def take(self, gains: Gains, joints: tuple[str, ...]) -> None:
        """Take other gains; an integral that nothing would ever remove begins anew."""
        fill(self.p, gains.p, joints, 0.0)
        fill(self.i, gains.i, joints, 0.0)
        fill(self.d, gains.d, joints, 0.0)
        self.integral[self.i == 0.0] = 0.0

    def limit_integral(self, limit: Floats) -> None:
        """Limit the magnitude of the integral term, in units of the command."""
        np.copyto(self.integral_limit, limit)
        np.negative(limit, out=self._least_integral)

    def reset(self, output: Floats, error: Floats, bias: Floats) -> None:
        """Begin so that the first output is `output` where there is an integral gain, without its rate.

        `output` is what the joint has now, `error` and `bias` (the feed-forward) what the first update gets;
        where one is not finite, the integral begins with 0. Without an integral gain nothing could remove
        the bias again, so there the law begins as it is. The derivative brakes a moving joint from the first
        update on.
        """
        np.copyto(self.output, output)
        self.proportional.fill(0.0)
        self.derivative.fill(0.0)
        self.rate.fill(0.0)
        self._elapsed_s.fill(0.0)
        start = output - self.p * error - bias
        start[~np.isfinite(start) | (self.i == 0.0)] = 0.0
        np.clip(start, self._least_integral, self.integral_limit, out=self.integral)

    def update(
        self, error: Floats, rate: Floats, bias: Floats, measured: NDArray[np.bool_], period_s: float
    ) -> Floats:
        """Return the output after `period_s`, one array that the next update overwrites.

        `rate` is the rate of the error (reference rate minus measured rate), `bias` the feed-forward;
        `measured` is False where the error is not new or not finite: there nothing changes.
        """
        output, proportional, integral, derivative, filtered = new = self._new
        room, share, elapsed = self._room, self._share, self._elapsed_s
        elapsed += period_s
        if self.filter_s > 0.0:
            np.add(elapsed, self.filter_s, out=share)
            np.divide(elapsed, share, out=share)
            np.subtract(rate, self.rate, out=filtered)
            filtered *= share
            filtered += self.rate
        else:
            np.copyto(filtered, rate)
        np.multiply(self.p, error, out=proportional)
        np.multiply(self.d, filtered, out=derivative)
        step = share
        np.multiply(self.i, error, out=step)
        step *= elapsed
        step += self.integral
        np.minimum(step, self.integral_limit, out=step)
        np.maximum(step, self._least_integral, out=step)
        step -= self.integral
        np.add(proportional, derivative, out=output)
        output += bias
        output += self.integral
        output += step
        # what is beyond a limit is taken off the step, as far as the step led there
        np.minimum(output, self.upper, out=room)
        np.maximum(room, self.lower, out=room)
        np.subtract(output, room, out=integral)
        np.copyto(output, room)
        np.minimum(step, 0.0, out=room)
        np.maximum(integral, room, out=integral)
        np.maximum(step, 0.0, out=room)
        np.minimum(integral, room, out=integral)
        np.subtract(step, integral, out=integral)
        integral += self.integral
        np.copyto(self._terms, new, where=measured)
        np.copyto(elapsed, 0.0, where=measured)
        return self.output


class Slope:
    """Rate of a measured value: its difference over the time between two measurements."""

    def __init__(self, joints: int) -> None:
        self.rate, self._last, self._new = np.zeros((3, joints))
        self._elapsed_s = np.zeros(joints)
        self._seen = np.zeros(joints, dtype=np.bool_)

    def reset(self) -> None:
        """Begin anew: the first measurement has the rate 0."""
        self._seen.fill(False)
        self.rate.fill(0.0)
        self._elapsed_s.fill(0.0)

    def update(self, value: Floats, measured: NDArray[np.bool_], period_s: float) -> Floats:
        """Return the rates, 1/s; where `measured` is False the last one stays."""
        new, elapsed = self._new, self._elapsed_s
        elapsed += period_s
        np.subtract(value, self._last, out=new)
        np.divide(new, elapsed, out=new)
        new *= self._seen  # the first measurement has no one before it
        np.copyto(self.rate, new, where=measured)
        np.copyto(self._last, value, where=measured)
        np.copyto(elapsed, 0.0, where=measured)
        self._seen |= measured
        return self.rate
