"""Transforms: where one frame lies in another one, as a translation and a unit quaternion.

Plain Python: the client of a running robot needs no library, and a robot has some twenty frames. Quaternions
are (x, y, z, w), as in ROS 2's messages; rotations are active and right-handed.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import msgspec

Vector: TypeAlias = "tuple[float, float, float]"
Quaternion: TypeAlias = "tuple[float, float, float, float]"
Matrix: TypeAlias = "tuple[tuple[float, float, float, float], ...]"
NO_TURN: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Transform(msgspec.Struct, frozen=True):
    """A frame in another one: p_there = rotation * p_here + translation."""

    translation: Vector = (0.0, 0.0, 0.0)  # m
    rotation: Quaternion = NO_TURN  # Of length 1

    def __matmul__(self, inner: Transform) -> Transform:
        """Return a frame that lies in this one, seen from where this one lies."""
        moved = self.apply(inner.translation)
        return Transform(moved, product(self.rotation, inner.rotation))

    def apply(self, point: Vector) -> Vector:
        """Return a point of this frame, m, seen from where the frame lies."""
        x, y, z = rotated(self.rotation, point)
        a, b, c = self.translation
        return x + a, y + b, z + c

    @property
    def inverse(self) -> Transform:
        """Where the outer frame lies in this one."""
        back = conjugate(self.rotation)
        x, y, z = rotated(back, self.translation)
        return Transform((-x, -y, -z), back)

    @property
    def matrix(self) -> Matrix:
        """The homogeneous matrix, 4 x 4, row by row."""
        columns = [
            rotated(self.rotation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        ]
        rows = zip(*columns, self.translation, strict=True)
        return (*((a, b, c, d) for a, b, c, d in rows), (0.0, 0.0, 0.0, 1.0))

    @property
    def rpy(self) -> Vector:
        """Roll, pitch and yaw, rad, as in a URDF: about the fixed x, y and z, one after the other."""
        (a, _, _, _), (b, _, _, _), (c, d, e, _), _ = self.matrix
        level = math.hypot(a, b)
        if level < 1e-12:  # straight up or down: roll and yaw turn about the same axis
            (_, f, *_), (_, h, *_), *_ = self.matrix
            return 0.0, math.atan2(-c, level), math.atan2(-f, h)
        return math.atan2(d, e), math.atan2(-c, level), math.atan2(b, a)


def product(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the rotation that turns by `right` and then by `left`."""
    x1, y1, z1, w1 = left
    x2, y2, z2, w2 = right
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )


def conjugate(rotation: Quaternion) -> Quaternion:
    """Return the rotation back."""
    x, y, z, w = rotation
    return -x, -y, -z, w


def rotated(rotation: Quaternion, vector: Vector) -> Vector:
    """Return a vector turned: v + 2 w (u x v) + 2 u x (u x v), with the quaternion (u, w)."""
    x, y, z, w = rotation
    a, b, c = vector
    d, e, f = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d


def turn(axis: Vector, angle: float) -> Quaternion:
    """Return a rotation by an angle, rad, about an axis of length 1; it is continuous in the angle."""
    x, y, z = axis
    sine = math.sin(angle / 2)
    return x * sine, y * sine, z * sine, math.cos(angle / 2)


def from_rpy(rpy: Vector) -> Quaternion:
    """Return the rotation of roll, pitch and yaw, rad, about the fixed x, y and z, one after the other."""
    roll, pitch, yaw = rpy
    about_x, about_y = turn((1.0, 0.0, 0.0), roll), turn((0.0, 1.0, 0.0), pitch)
    return product(turn((0.0, 0.0, 1.0), yaw), product(about_y, about_x))


def unit(rotation: Quaternion) -> Quaternion | None:
    """Return a quaternion of length 1; None for one that is no rotation: NaN, infinite or of no length."""
    length = math.sqrt(sum(value * value for value in rotation))
    if not math.isfinite(length) or length < 1e-9:
        return None
    x, y, z, w = rotation
    return x / length, y / length, z / length, w / length


def near(rotation: Quaternion, last: Quaternion) -> Quaternion:
    """Return the one of the two quaternions of a rotation that is nearer to another quaternion.

    Values between two messages are interpolated, which would turn the long way round otherwise.
    """
    x, y, z, w = rotation
    together = x * last[0] + y * last[1] + z * last[2] + w * last[3]
    return (-x, -y, -z, -w) if together < 0 else rotation
