"""How a simulated servo moves: at goal speed with bounded acceleration, braking to rest at the goal.

In closed form: a motion is a few pieces of constant acceleration, made when something is commanded and
evaluated when somebody looks. There is no time step, so a minute of eight servos costs as much as its
commands, and two runs agree to the last bit.

Not modelled: gravity, the inertia of what hangs on the servo, friction, compliance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Piece = tuple[float, float]
"""Duration, s, and acceleration, rad/s^2."""

_FOREVER = math.inf


@dataclass(frozen=True, slots=True)
class Motion:
    """Angle over time from a start: pieces of constant acceleration, then rest or constant speed."""

    start_ns: int
    angle: float
    """rad at the start"""
    velocity: float
    """rad/s at the start"""
    pieces: tuple[Piece, ...]
    goal: float | None
    """rad at the end, exactly; None: the motion goes on with its last speed."""
    end_ns: int | None
    """Time of rest; None: the motion does not end."""

    def at(self, now_ns: int) -> tuple[float, float, float]:
        """Return angle, rad, velocity, rad/s, and acceleration, rad/s^2; before the start as at the start."""
        if self.end_ns is not None and now_ns >= self.end_ns:
            return (self.angle if self.goal is None else self.goal), 0.0, 0.0
        left = max(0, now_ns - self.start_ns) * 1e-9
        angle, velocity = self.angle, self.velocity
        for duration, acceleration in self.pieces:
            step = min(left, duration)
            if left < duration:
                return (
                    angle + (velocity + acceleration / 2 * step) * step,
                    velocity + acceleration * step,
                    acceleration,
                )
            angle += (velocity + acceleration / 2 * step) * step
            velocity += acceleration * step
            left -= step
        return angle, velocity, 0.0


def rest(now_ns: int, angle: float) -> Motion:
    """Return the motion of a servo that stays where it is; angle in rad."""
    return Motion(now_ns, angle, 0.0, (), angle, now_ns)


def move_to(
    now_ns: int, angle: float, velocity: float, goal: float, *, speed: float, acceleration: float
) -> Motion:
    """Return the fastest motion to `goal` (rad) with at most `speed` (rad/s) and `acceleration` (rad/s^2).

    A servo that is too fast to stop in time brakes past the goal and comes back; one that is faster than
    `speed` brakes down to it first. Textbook trapezoid of velocity: a peak speed v_p is reached and left with
    the same acceleration a, so that x = (v_p^2 - v^2) / 2a + v_p^2 / 2a.
    """
    brake = velocity * abs(velocity) / (2 * acceleration)
    rest_of_way = goal - angle - brake
    side = math.copysign(1.0, rest_of_way)
    distance, along = side * (goal - angle), side * velocity
    pieces: list[Piece] = []
    if along > speed:
        pieces.append(((along - speed) / acceleration, -acceleration))
        distance -= (along**2 - speed**2) / (2 * acceleration)
        peak = speed
    else:
        peak = min(speed, math.sqrt(max(0.0, acceleration * distance + along**2 / 2)))
        peak = max(peak, along, 0.0)
        pieces.append(((peak - along) / acceleration, acceleration))
        distance -= (peak**2 - along**2) / (2 * acceleration)
    cruise = max(0.0, distance - peak**2 / (2 * acceleration))
    if cruise > 0.0 and peak > 0.0:
        pieces.append((cruise / peak, 0.0))
    pieces.append((peak / acceleration, -acceleration))
    directed = tuple((duration, side * rate) for duration, rate in pieces if duration > 0.0)
    end_ns = now_ns + math.ceil(sum(duration for duration, _ in directed) * 1e9)
    return Motion(now_ns, angle, velocity, directed, goal, end_ns)


def turn(now_ns: int, angle: float, velocity: float, speed: float, acceleration: float) -> Motion:
    """Return the motion that comes to the signed `speed` (rad/s) and keeps it: wheel mode."""
    change = speed - velocity
    ramp = (abs(change) / acceleration, math.copysign(acceleration, change))
    return Motion(now_ns, angle, velocity, (ramp, (_FOREVER, 0.0)), None, None)
