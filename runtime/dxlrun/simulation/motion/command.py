"""What the registers of a simulated servo command: the numbers that its control law works with."""

from __future__ import annotations

from typing import NamedTuple

FREE = 1e6
"""A limit that nothing reaches: rad/s, rad/s^2, Nm. Finite, so that no step makes 0 * infinity."""


class Command(NamedTuple):
    """The inside of one servo for the time until the next command; what is left out is switched off.

    `duty` is a part of the supply's voltage at the motor, -1 to 1. Angles are those of the shaft.
    """

    goal: float = 0.0
    """rad; where the trajectory ends"""
    speed: float = FREE
    """rad/s, the most that the trajectory has; where it is `turning`: the speed with its sign"""
    acceleration: float = FREE
    """rad/s^2 of the trajectory"""
    turning: float = 0.0
    """1: the trajectory goes on for ever at `speed`"""
    p_ccw: float = 0.0
    """duty per rad of error, where the goal is counter-clockwise of the shaft"""
    p_cw: float = 0.0
    margin_ccw: float = 0.0
    """rad of error that are left alone"""
    margin_cw: float = 0.0
    punch: float = 0.0
    """duty at the edge of the margin"""
    i: float = 0.0
    """duty per rad s"""
    d: float = 0.0
    """duty per rad/s of the error's speed"""
    feed_velocity: float = 0.0
    """duty per rad/s of the trajectory, beside `d`"""
    feed_acceleration: float = 0.0
    """duty per rad/s^2 of the trajectory"""
    bias: float = 0.0
    """duty, whatever the position"""
    limit: float = 0.0
    """most duty; 0: the servo is limp"""
    torque_limit: float = FREE
    """Nm, most torque where the motor's current is controlled"""


LIMP = Command()
"""No torque: the shaft follows what turns it, and the motor brakes it as with closed terminals [i]."""

ROWS = {name: row for row, name in enumerate(Command._fields)}
"""Row of each number in an array of all servos."""
