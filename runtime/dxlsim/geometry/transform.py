"""Transforms: pose of one frame (coordinate system) in another one, as a translation and a unit quaternion.

Plain Python, so that the client of a running robot needs no library; a robot has some twenty frames.
Quaternions are (x, y, z, w), as in ROS 2 messages; rotations are active and right-handed."""

from __future__ import annotations

import math
from typing import TypeAlias

import msgspec

Vector: TypeAlias = "tuple[float, float, float]"
Quaternion: TypeAlias = "tuple[float, float, float, float]"
Matrix: TypeAlias = "tuple[tuple[float, float, float, float], ...]"
NO_TURN: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Transform(msgspec.Struct, frozen=True):
    """Pose of an inner frame in an outer one: p_outer = rotation * p_inner + translation."""

    translation: Vector = (0.0, 0.0, 0.0)  # m
    rotation: Quaternion = NO_TURN  # Unit quaternion

    def __matmul__(self, inner: Transform) -> Transform:
        """Return the pose of a frame, given in this frame as `inner`, in the outer frame."""
        moved = self.transform_point(inner.translation)
        return Transform(moved, product(self.rotation, inner.rotation))

    def transform_point(self, point: Vector) -> Vector:
        """Convert a point from this frame to the outer frame, m."""
        x, y, z = rotated(self.rotation, point)
        a, b, c = self.translation
        return x + a, y + b, z + c

    @property
    def inverse(self) -> Transform:
        """Pose of the outer frame in this frame."""
        back = conjugate(self.rotation)
        x, y, z = rotated(back, self.translation)
        return Transform((-x, -y, -z), back)

    @property
    def matrix(self) -> Matrix:
        """Pose as a homogeneous matrix, 4 x 4, in row order."""
        columns = [
            rotated(self.rotation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        ]
        rows = zip(*columns, self.translation, strict=True)
        return (*((a, b, c, d) for a, b, c, d in rows), (0.0, 0.0, 0.0, 1.0))

    @property
    def rpy(self) -> Vector:
        """Rotation as roll, pitch and yaw, rad, as in a URDF: about the fixed x, y and z axes, in this
        order."""
        (a, _, _, _), (b, _, _, _), (c, d, e, _), _ = self.matrix
        level = math.hypot(a, b)
        if level < 1e-12:  # Gimbal lock: roll and yaw rotate about the same axis
            (_, f, *_), (_, h, *_), *_ = self.matrix
            return 0.0, math.atan2(-c, level), math.atan2(-f, h)
        return math.atan2(d, e), math.atan2(-c, level), math.atan2(b, a)


def product(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the rotation that rotates by `right` first, and then by `left`."""
    x1, y1, z1, w1 = left
    x2, y2, z2, w2 = right
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )


def conjugate(rotation: Quaternion) -> Quaternion:
    """Return the inverse of a rotation, a unit quaternion."""
    x, y, z, w = rotation
    return -x, -y, -z, w


def rotated(rotation: Quaternion, vector: Vector) -> Vector:
    """Return a vector rotated by a unit quaternion (u, w): v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z, w = rotation
    a, b, c = vector
    d, e, f = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d


def rotation_about(axis: Vector, angle: float) -> Quaternion:
    """Return the rotation by an angle, rad, about a unit axis. It is continuous in the angle."""
    x, y, z = axis
    sine = math.sin(angle / 2)
    return x * sine, y * sine, z * sine, math.cos(angle / 2)


def from_rpy(rpy: Vector) -> Quaternion:
    """Return the rotation by roll, pitch and yaw, rad, about the fixed x, y and z axes, in this order."""
    roll, pitch, yaw = rpy
    about_x, about_y = rotation_about((1.0, 0.0, 0.0), roll), rotation_about((0.0, 1.0, 0.0), pitch)
    return product(rotation_about((0.0, 0.0, 1.0), yaw), product(about_y, about_x))


def unit(rotation: Quaternion) -> Quaternion | None:
    """Return a quaternion scaled to length 1, or None for an invalid one: NaN, infinite or of length 0."""
    length = math.sqrt(sum(value * value for value in rotation))
    if not math.isfinite(length) or length < 1e-9:
        return None
    x, y, z, w = rotation
    return x / length, y / length, z / length, w / length


def near(rotation: Quaternion, last: Quaternion) -> Quaternion:
    """Return `rotation` or its negative, which is the same rotation: the one that is nearer to the quaternion
    `last`.

    Values between two messages are interpolated; with the other quaternion the interpolation would take
    the long way."""
    x, y, z, w = rotation
    together = x * last[0] + y * last[1] + z * last[2] + w * last[3]
    return (-x, -y, -z, -w) if together < 0 else rotation
