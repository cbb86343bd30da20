"""Control law: commands of the controllers inside simulated servos. `mechanics.c` has the law."""

from __future__ import annotations

from typing import NamedTuple

FREE = 1e6  # Unreachable limit: rad/s, rad/s^2, Nm. It is finite to avoid 0 * infinity.


class ServoCommand(NamedTuple):
    """Parameters of one servo's controller, computed from its registers; every default switches its term off.

    `duty` is a fraction of the supply voltage at the motor, -1 to 1. Angles are those of the shaft."""

    goal: float = 0.0  # rad; end of the trajectory
    speed: float = FREE
    """Speed limit of the trajectory, rad/s; with `turning` the signed speed."""
    acceleration: float = FREE  # rad/s^2 of the trajectory
    turning: float = 0.0  # 1: the trajectory continues indefinitely at `speed`
    p_ccw: float = 0.0  # duty per rad of error, if the goal is counter-clockwise of the shaft
    p_cw: float = 0.0
    margin_ccw: float = 0.0  # rad of error without a reaction
    margin_cw: float = 0.0
    punch: float = 0.0  # duty at the edge of the margin
    i: float = 0.0  # duty per rad s
    d: float = 0.0  # duty per rad/s of the error's speed
    feed_velocity: float = 0.0  # duty per rad/s of the trajectory, in addition to `d`
    feed_acceleration: float = 0.0  # duty per rad/s^2 of the trajectory
    bias: float = 0.0  # duty, independent of the position
    limit: float = 0.0  # largest duty; 0: the servo is limp
    torque_limit: float = FREE  # Nm, torque limit if the motor's current is controlled


LIMP = ServoCommand()
"""Command without torque: the shaft moves freely, and the motor brakes it as with shorted terminals [i]."""
