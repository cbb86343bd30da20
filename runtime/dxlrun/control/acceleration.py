"""Acceleration limits of the gate: how fast goals may become faster, and slower, and where they must brake.

A goal's velocity v[k] = (goal[k] - goal[k-1]) / dt[k] changes by at most a * dt[k]. From v a goal that
brakes in every cycle comes to rest within v^2 / (2 a), whatever the later dt are: its way is the lower
Riemann sum of v - a t. So v[k] may be taken where what is left of the distance d behind the step is at least
that,

    d - v dt >= v^2 / (2 a)   <=>   v <= 2 d / (dt + sqrt(dt^2 + 2 d / a)),

and braking at full acceleration in the next cycle keeps this true, for any dt: with v' = v - a dt',
d' - v' dt' - v'^2 / (2 a) = (d' - v^2 / (2 a)) + a dt'^2 / 2 >= 0. Without `dt` it is the stopping distance
v^2 / (2 a) of ros2_control (joint_limits/src/joint_saturation_limiter.cpp, `stopping_distance`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun.plan.loop_plan import JointPlan

SLOWEST = 0.01
"""rad/s; a commanded speed toward a position counts as at least this, so that the goal arrives. The slowest
speed of an AX-12 is 0.0116 rad/s, see protocol.md: it never stands still on its way either."""
_ROUNDING = 1 + 1e-9
"""Differences of goals are off by the rounding of the goals, far below this part of an acceleration."""
_FARTHEST = 1e9
"""rad; a limit beyond is none, and its square is a number still."""


def braking_speed(distance: Floats, dt: float, acceleration: Floats) -> Floats:
    """Return the highest speed, rad/s, with which a step of `dt` s may begin `distance` rad before a limit.

    An infinite acceleration gives distance / dt. Where the speed that is sent acts until the next one comes,
    as in velocity mode, `dt` is the longest time that it may act: v dt + v^2 / (2 a) is the upper Riemann
    sum.
    """
    root: Floats = np.sqrt(dt * dt + 2.0 * distance / acceleration)
    speed: Floats = 2.0 * distance / (dt + root)
    return speed


class Ramps:
    """Goals of joints that are led to positions, with limited acceleration; rows are joints.

    A goal follows its commands exactly as long as they ask for no more than the acceleration; the commands'
    own velocity, their difference to those before, is not braked for. What the goal is behind is made up for
    with the speed from which it can stop there, so that it does not overshoot a command that stands. Without
    a command it comes to rest. Toward a position limit it is never faster than it can brake.
    """

    def __init__(self, joints: Sequence[JointPlan]) -> None:
        limits = [np.inf if joint.acceleration is None else joint.acceleration for joint in joints]
        count = len(joints)
        self._acceleration: Floats = np.array(limits, dtype=np.float64)
        self._limited: NDArray[np.bool_] = np.isfinite(self._acceleration)
        self.any = bool(self._limited.any())
        """True when a joint has an acceleration limit."""
        self.moving: Floats = np.zeros(count)
        """rad/s of each goal in the last step; NaN for joints that are not led to positions."""
        self._lower: Floats = np.clip([joint.lower for joint in joints], -_FARTHEST, _FARTHEST)
        self._upper: Floats = np.clip([joint.upper for joint in joints], -_FARTHEST, _FARTHEST)
        self._target: Floats = np.full(count, np.nan)
        """The command that the goal followed in the last step, within the limits."""
        self._left: Floats = np.full(count, np.nan)
        """The goals as the last step left them: goals that differ were set anew, and are at rest."""
        self._middle = (self._lower + self._upper) / 2
        self._half = np.where(self._limited, (self._upper - self._lower) / 2, np.inf)
        self._per_step = 0.5 / self._acceleration
        self._scale = np.vstack([self._acceleration * _ROUNDING] * 2)
        self._bounds = np.vstack([self._half] * 3)
        self._seen, self._beyond = np.empty((3, count)), np.empty((3, count), dtype=np.bool_)
        self._one, self._step = np.empty(count), np.empty(count)

    def rest(self, rows: NDArray[np.bool_], goal: Floats) -> None:
        """Take the goals of these joints as at rest."""
        self.moving[rows] = 0.0
        self._target[rows] = self._left[rows] = goal[rows]

    def passes(self, goal: Floats, desired: Floats, dt: float) -> bool:
        """Return whether every goal may go to its desired position at once, and take these steps if so.

        `desired`, rad, is the last goal where nothing is commanded. Three comparisons, over all joints at
        once: the change of velocity; the velocity beside that of the commands, which must vanish when they
        stop; where the goal comes to rest if it brakes from now on.
        """
        seen, bounds, step, one = self._seen, self._bounds, self._step, self._one
        square = dt * dt
        np.multiply(self._scale, square, bounds[:2])
        np.subtract(desired, goal, step)
        np.multiply(self.moving, dt, one)
        np.subtract(step, one, seen[0])
        np.subtract(self._target, goal, seen[1])
        np.abs(step, one)
        one *= step
        one *= self._per_step
        one /= square
        one += desired
        np.subtract(one, self._middle, seen[2])
        np.abs(seen, seen)
        if np.count_nonzero(np.greater(seen, bounds, self._beyond)):
            return False
        np.divide(step, dt, self.moving)
        np.copyto(self._target, desired)
        np.copyto(self._left, desired)
        return True

    def steer(self, goal: Floats, desired: Floats, most: Floats, toward: Floats, dt: float) -> Floats:
        """Return the next goals, rad: toward the desired ones as fast as the limits allow.

        `desired` is within the position limits, and the last goal where nothing is commanded; `most` is the
        highest speed of each joint, `toward` the commanded one, NaN: none. Rows of joints without an
        acceleration limit have no meaning.
        """
        limit = self._acceleration
        anew = goal != self._left
        self.rest(anew, goal)
        own = (desired - self._target) / dt  # the velocity of the commands, unless they jump
        own = np.where(np.abs(own) <= most, own, 0.0)
        behind = desired - goal - own * dt
        ways = self._seen  # behind the commands, to the upper and to the lower limit
        np.abs(behind, ways[0])
        np.fmax(np.subtract(self._upper, goal, ways[1]), 0.0, out=ways[1])
        np.fmax(np.subtract(goal, self._lower, ways[2]), 0.0, out=ways[2])
        nearing, up, down = braking_speed(ways, dt, limit)
        velocity = own + np.copysign(nearing, behind)
        highest = np.fmin(most, np.fmax(np.fmax(toward, SLOWEST), np.abs(own)))
        highest = np.where(np.isnan(toward), most, highest)
        velocity = np.minimum(np.maximum(velocity, -highest), highest)
        change = limit * dt
        velocity = np.minimum(np.maximum(velocity, self.moving - change), self.moving + change)
        velocity = np.minimum(np.maximum(velocity, -down), up)
        np.copyto(self.moving, velocity)
        np.copyto(self._target, desired)
        stepped: Floats = goal + velocity * dt
        # a sum that rounds past a limit is the limit; a goal that began outside of them stays where it is
        np.minimum(np.maximum(stepped, np.fmin(self._lower, goal)), np.fmax(self._upper, goal), out=stepped)
        np.copyto(self._left, stepped)
        return stepped

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Joints that have an acceleration limit."""
        return self._limited
