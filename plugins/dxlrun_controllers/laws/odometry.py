"""Odometry of a base on two sides of wheels: from the ways of the wheels to a pose in the plane.

Between two samples both rims are taken to move at constant speeds, so that the base moves on an arc of a
circle, or a straight line. Of the ways l and r of the left and right rims:

    s = (r + l) / 2,  a = (r - l) / separation
    chord = s * sin(a / 2) / (a / 2), in the direction heading + a / 2

which is exact for every radius. Siegwart and Nourbakhsh, Introduction to Autonomous Mobile
Robots, section 5.2.4, has the chord with sin(a / 2) / (a / 2) = 1; the exact arc is that of ROS 2's
diff_drive_controller (`integrate_exact`), which divides by the angle.
"""

from __future__ import annotations

import math

import numpy as np

from dxlrun import States

_SMALL = 1e-4
"""rad; below it the series of sin(x) / x is exact to the last bit: the next term is x^4 / 120."""
HALF_TURN = math.pi
FASTEST_WHEEL = 50.0
"""rad/s; no servo turns faster: the MX-12W has 470 rpm at 12 V (e-Manual, MX-12W, Specifications)."""


class Pose:
    """Where a base is, in the frame of its start: x and y, m, and heading, rad, which counts turns."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = 0.0

    def move(self, way: float, angle: float) -> None:
        """Go on along an arc of `way` m, which turns by `angle` rad, to the left where it is positive."""
        half = angle / 2
        chord = way * (math.sin(half) / half if abs(half) > _SMALL else 1.0 - half * half / 6.0)
        direction = self.heading + half
        self.x += chord * math.cos(direction)
        self.y += chord * math.sin(direction)
        self.heading += angle


class WheelAngles:
    """How far wheels have turned since they last all answered; shape (wheels,).

    The positions of most servos count turns in velocity mode. Those of Protocol 1.0 begin anew after each
    turn: a step of more than half a turn, in so short a time that no wheel can have made it, is the step
    over that end. After a longer time without a reply the turns are not known, so such a step is left out.
    """

    def __init__(self, wheels: int, fastest: float, period_ns: int) -> None:
        """`fastest` in rad/s, NaN where it is not known; `period_ns` is the time between two updates."""
        speed = fastest if math.isfinite(fastest) and fastest > 0 else FASTEST_WHEEL
        self.longest_ns = max(round(HALF_TURN / (2 * speed) * 1e9), 2 * period_ns)
        """After a longer time the way since the sample before is not known, ns. Half of what half a turn
        takes: a base that is pushed turns its wheels faster than it may."""
        self.turned = np.zeros(wheels)
        """rad, of the last `take` that returned true"""
        self._before = np.zeros(wheels)
        self._known_ns = -1

    def begin(self) -> None:
        """Forget the sample before: the next one is a beginning."""
        self._known_ns = -1

    def take(self, states: States, time_ns: int) -> int | None:
        """Take a sample in which all wheels answered.

        Returns the time since the one before, ns, and `turned` has the way; None when that is not known.
        """
        known_ns, self._known_ns = self._known_ns, time_ns
        turned = self.turned
        np.subtract(states.position, self._before, out=turned)
        np.copyto(self._before, states.position)
        if known_ns < 0 or time_ns - known_ns > self.longest_ns:
            return None
        # an end that begins anew is a whole turn away, whatever the unit of the servo's positions
        turned -= 2 * HALF_TURN * np.rint(turned / (2 * HALF_TURN))
        return time_ns - known_ns

    def age_ns(self, time_ns: int) -> int:
        """Return the time since the last sample, ns; -1 before the first."""
        return -1 if self._known_ns < 0 else time_ns - self._known_ns
