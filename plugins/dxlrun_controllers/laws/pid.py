"""PID: proportional, integral and derivative feedback, vectorised over joints.

Parallel form with a filtered derivative and a feed-forward w:

    u = sat(p e + I + d D + w),   dI/dt = i e,   filter * dD/dt = de/dt - D

Units: u in that of the command (Nm, A, fraction, rad/s), e in rad or rad/s, so p in u/e, i in u/(e s), d in
u s/e. Sources: K. J. Astrom, R. M. Murray, Feedback Systems (2008), sections 10.4 and 10.5; K. J. Astrom,
B. Wittenmark, Computer-Controlled Systems (1997), section 8.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from dxlrun import LIVE, Floats, ParametersModel
from dxlrun_controllers.joint_parameters import NotNegative, PerJoint, clamped, row_of


class Gains(ParametersModel):
    """Gains of a PID law. Each is one number for all joints or a mapping by joint, and can change in a run.

    u is the unit of the command (Nm, A or fraction of maximum; rad/s; fraction of the full voltage; rad), and
    e the unit of the reference (rad or rad/s).
    """

    p: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Proportional gain, u/e."""
    i: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Integral gain, u/(e s)."""
    d: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Derivative gain, u s/e."""
    feed_forward: Annotated[PerJoint[NotNegative], LIVE] = 0.0
    """Factor on the velocity of the reference, u s/rad; by default 1 if velocities are commanded."""


def feed_velocities_forward(data: object) -> object:
    """Return parameters, as written, with gain `feed_forward` 1 if they command velocities and do not set
    it.
    """
    if not isinstance(data, dict) or data.get("command_interface") != "velocity":
        return data
    gains = data.get("gains")
    return {**data, "gains": {"feed_forward": 1.0, **gains}} if isinstance(gains, dict) else data


class Pid:
    """PID law of joints. All arrays have the shape (joints,).

    - Integral and filter use backward Euler. With the filter's time constant tau and the period h, the filter
      is D += h / (tau + h) * (de/dt - D). Its pole tau / (tau + h) is in [0, 1) for every h, and tau = 0
      disables the filter. The bilinear rule would have its pole below 0 for tau < h / 2, and ring at tau = 0.
    - `integral` is the integral term, in units of the command. A change of the gain in a run therefore only
      affects later steps, and the output does not jump.
    - Anti-windup is by clamping. While the output is at its limit, the integral only takes steps that lead
      away from the limit, so the output leaves the limit as soon as the other terms do. Unlike
      back-calculation, clamping needs no time constant and cannot make the integral overshoot.
    - h is the time since the last measurement, for each joint. A joint without a new measurement keeps its
      last output, because one lost packet must not let an arm fall. The runtime sends no command to a lost
      joint (3 missing replies and 50 ms).
    """

    def __init__(self, joints: int) -> None:
        self.p, self.i, self.d = np.zeros((3, joints))
        self.filter_s = 0.0
        """Time constant of the filter on the rate of the error, s; 0 disables it."""
        self.lower, self.upper = np.full(joints, -np.inf), np.full(joints, np.inf)
        """Limits of the output, in units of the command."""
        self.integral_limit = np.full(joints, np.inf)
        """Largest magnitude of the integral term, in units of the command."""
        self._terms = np.zeros((5, joints))
        self.output, self.proportional, self.integral, self.derivative, self.rate = self._terms
        """Results of the last update, in units of the command; `rate` is the filtered rate of the error."""
        self._elapsed_s = np.zeros(joints)

    def set_gains(self, gains: Gains, joints: tuple[str, ...]) -> None:
        """Set the gains of the joints.

        A joint whose integral gain is 0 loses its integral, which would stay forever.
        """
        self.p, self.i, self.d = (row_of(gain, joints, 0.0) for gain in (gains.p, gains.i, gains.d))
        self.integral[self.i == 0.0] = 0.0

    def reset(self, output: Floats, error: Floats, bias: Floats) -> None:
        """Preset the integral so that the first update continues from `output` (bumpless transfer).

        The derivative term is not compensated, so it brakes a moving joint from the first update on. A joint
        without an integral gain starts with an integral of 0, because nothing could remove a preset again.
        The same holds where an argument is not finite.

        Args:
            output: Present command of the joints, in units of the command.
            error: Error that the first update gets.
            bias: Feed-forward that the first update gets.
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
        """Compute the output.

        Args:
            error: Reference minus measurement.
            rate: Rate of the error: rate of the reference minus measured rate.
            bias: Feed-forward, in units of the command.
            measured: False for a joint whose error is not new or not finite. Such joints keep their output.
            period_s: Time since the last update, s.

        Returns:
            The output, in units of the command. The next update overwrites this array.
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
        # Anti-windup: shorten the step by the excess over the limit, but never reverse the step.
        step -= clamped(output - inside, np.minimum(step, 0.0), np.maximum(step, 0.0))
        new = inside, proportional, step + self.integral, derivative, filtered
        np.copyto(self._terms, new, where=measured)
        elapsed[measured] = 0.0
        return self.output


class Slope:
    """Rate of a measured value of each joint: difference of two measurements over the time between them."""

    def __init__(self, joints: int) -> None:
        self.rate, self._last = np.zeros((2, joints))
        self._elapsed_s = np.zeros(joints)
        self._seen = np.zeros(joints, dtype=np.bool_)

    def reset(self) -> None:
        """Discard the last measurements; the next ones have the rate 0."""
        self._seen.fill(False)
        self.rate.fill(0.0)
        self._elapsed_s.fill(0.0)

    def update(self, value: Floats, measured: NDArray[np.bool_], period_s: float) -> Floats:
        """Add measurements and return the rates, 1/s. A joint with `measured` False keeps its last rate."""
        elapsed = self._elapsed_s
        elapsed += period_s
        # `_seen` makes the rate of the first measurement 0.
        np.copyto(self.rate, (value - self._last) / elapsed * self._seen, where=measured)
        np.copyto(self._last, value, where=measured)
        elapsed[measured] = 0.0
        self._seen |= measured
        return self.rate
