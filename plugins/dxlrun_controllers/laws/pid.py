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
from dxlrun_controllers.joints import NotNegative, PerJoint, clamped, row_of


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
      one lost packet must not let an arm fall. The runtime passes on none of a joint that stays silent
      (lost: 3 replies and 50 ms).
    """

    def __init__(self, joints: int) -> None:
        self.p, self.i, self.d = np.zeros((3, joints))
        self.filter_s = 0.0
        """Time constant of the derivative's filter, s; 0: none."""
        self.lower, self.upper = np.full(joints, -np.inf), np.full(joints, np.inf)
        """Limits of the output."""
        self.integral_limit = np.full(joints, np.inf)
        """Largest magnitude of the integral term, in units of the command."""
        self._terms = np.zeros((5, joints))
        self.output, self.proportional, self.integral, self.derivative, self.rate = self._terms
        """What the last update made; `rate` is the filtered rate of the error."""
        self._elapsed_s = np.zeros(joints)

    def take(self, gains: Gains, joints: tuple[str, ...]) -> None:
        """Take other gains; an integral that nothing would ever remove begins anew."""
        self.p, self.i, self.d = (row_of(gain, joints, 0.0) for gain in (gains.p, gains.i, gains.d))
        self.integral[self.i == 0.0] = 0.0

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
        np.clip(start, -self.integral_limit, self.integral_limit, out=self.integral)

    def update(
        self, error: Floats, rate: Floats, bias: Floats, measured: NDArray[np.bool_], period_s: float
    ) -> Floats:
        """Return the output after `period_s`, one array that the next update overwrites.

        `rate` is the rate of the error (reference rate minus measured rate), `bias` the feed-forward;
        `measured` is False where the error is not new or not finite: there nothing changes.
        """
        elapsed = self._elapsed_s
        elapsed += period_s
        filtered = rate
        if self.filter_s > 0.0:
            filtered = (rate - self.rate) * (elapsed / (elapsed + self.filter_s)) + self.rate
        proportional, derivative = self.p * error, self.d * filtered
        step = self.i * error * elapsed + self.integral
        step = clamped(step, -self.integral_limit, self.integral_limit) - self.integral
        output = proportional + derivative + bias + self.integral + step
        inside = clamped(output, self.lower, self.upper)
        # what is beyond a limit is taken off the step, as far as the step led there
        step -= clamped(output - inside, np.minimum(step, 0.0), np.maximum(step, 0.0))
        new = inside, proportional, step + self.integral, derivative, filtered
        np.copyto(self._terms, new, where=measured)
        elapsed[measured] = 0.0
        return self.output


class Slope:
    """Rate of a measured value: its difference over the time between two measurements."""

    def __init__(self, joints: int) -> None:
        self.rate, self._last = np.zeros((2, joints))
        self._elapsed_s = np.zeros(joints)
        self._seen = np.zeros(joints, dtype=np.bool_)

    def reset(self) -> None:
        """Begin anew: the first measurement has the rate 0."""
        self._seen.fill(False)
        self.rate.fill(0.0)
        self._elapsed_s.fill(0.0)

    def update(self, value: Floats, measured: NDArray[np.bool_], period_s: float) -> Floats:
        """Return the rates, 1/s; where `measured` is False the last one stays."""
        elapsed = self._elapsed_s
        elapsed += period_s
        # the first measurement has no one before it
        np.copyto(self.rate, (value - self._last) / elapsed * self._seen, where=measured)
        np.copyto(self._last, value, where=measured)
        elapsed[measured] = 0.0
        self._seen |= measured
        return self.rate
