"""Odometry of a base with differential drive: pose in the plane from the travel of the wheels.

Both rims are assumed to move at constant speeds between two samples, so the base moves on an arc of a circle
or on a straight line. With l and r, the distances that the left and the right rim travel:

    s = (r + l) / 2,  a = (r - l) / separation
    chord = s * sin(a / 2) / (a / 2), in the direction heading + a / 2

The formula is exact for every radius. Siegwart and Nourbakhsh, Introduction to Autonomous Mobile
Robots, section 5.2.4, approximate sin(a / 2) / (a / 2) by 1. `integrate_exact` of ROS 2's
diff_drive_controller computes the same arc, but divides by the angle.
"""

from __future__ import annotations

import math

import numpy as np

from dxlrun import States

_SMALL = 1e-4
"""Half angle, rad, below which two terms of the series of sin(x) / x are exact (the next is x^4 / 120)."""
HALF_TURN = math.pi
FASTEST_WHEEL = 50.0
"""Highest speed of a wheel when its limit is unknown, rad/s: the MX-12W has 470 rpm at 12 V (e-Manual)."""


class BasePose:
    """Pose of a base in the frame in which it started: x and y (m), and heading (rad, counts whole turns)."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = 0.0

    def move_along_arc(self, way: float, angle: float) -> None:
        """Move the pose along an arc of the length `way`, m, that turns by `angle`, rad (positive: to the
        left).
        """
        half = angle / 2
        chord = way * (math.sin(half) / half if abs(half) > _SMALL else 1.0 - half * half / 6.0)
        direction = self.heading + half
        self.x += chord * math.cos(direction)
        self.y += chord * math.sin(direction)
        self.heading += angle


class WheelAngles:
    """Rotation of wheels between two samples in which all wheels answered, shape (wheels,).

    In velocity mode the positions of most servos count whole turns, but those of Protocol 1.0 wrap around.
    A step of more than half a turn in a time too short for it is a wrap-around, and is corrected. After a
    longer gap the number of turns is ambiguous, so the step is discarded.
    """

    def __init__(self, wheels: int, fastest: float, period_ns: int) -> None:
        """Set the longest gap that is still unambiguous.

        Args:
            wheels: Number of wheels.
            fastest: Highest speed of a wheel, rad/s, or NaN if it is unknown.
            period_ns: Time between two updates, ns.
        """
        speed = fastest if math.isfinite(fastest) and fastest > 0 else FASTEST_WHEEL
        self.longest_ns = max(round(HALF_TURN / (2 * speed) * 1e9), 2 * period_ns)
        """Longest gap between two usable samples, ns. It is half the time of half a turn, because a base that
        is pushed can turn its wheels faster than their limit."""
        self.turned = np.zeros(wheels)
        """Rotation of each wheel between the last two samples, rad; valid after an `add_sample` that did not
        return None.
        """
        self._before = np.zeros(wheels)
        self._known_ns = -1

    def restart_odometry(self) -> None:
        """Discard the last sample: the rotation until the next one is not used."""
        self._known_ns = -1

    def add_sample(self, states: States, time_ns: int) -> int | None:
        """Add the wheel positions of a cycle in which all wheels answered, and update `turned`.

        Returns:
            The time since the last sample, ns; None if the rotation since then is unknown.
        """
        known_ns, self._known_ns = self._known_ns, time_ns
        turned = self.turned
        np.subtract(states.position, self._before, out=turned)
        np.copyto(self._before, states.position)
        if known_ns < 0 or time_ns - known_ns > self.longest_ns:
            return None
        # A wrap-around is always a whole turn, whatever the resolution of the servo.
        turned -= 2 * HALF_TURN * np.rint(turned / (2 * HALF_TURN))
        return time_ns - known_ns

    def age_ns(self, time_ns: int) -> int:
        """Return the time since the last sample, ns; -1 before the first."""
        return -1 if self._known_ns < 0 else time_ns - self._known_ns
