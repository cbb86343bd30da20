"""Chain: the joints between two links of a URDF, the pose of the last link, and its Jacobian.

Plain Python floats, no linear algebra library: for three to seven joints one is hardly faster, and its
results depend on the processor, so that a replay on another computer would differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, TypeAlias

import msgspec

from dxlrun.tooling.robots import Urdf, UrdfJoint, from_rpy

Vector: TypeAlias = tuple[float, float, float]
Rotation: TypeAlias = "tuple[float, float, float, float, float, float, float, float, float]"
"""Rotation matrix by columns: the x axis, the y axis, the z axis."""
Quaternion: TypeAlias = tuple[float, float, float, float]
Pose: TypeAlias = "tuple[Rotation, Vector]"
Column: TypeAlias = "tuple[float, float, float, float, float, float]"
"""Velocity of the link by one joint at unit speed: linear, then angular, in the axes of the base."""

IDENTITY: Final[Rotation] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
BASE: Final[Pose] = (IDENTITY, (0.0, 0.0, 0.0))
"""Pose of the base in itself."""
_LEAST_SINE: Final = 1e-9


class WrongChain(ValueError):
    """The links and joints do not make a chain; `key` is the parameter that is wrong, `fix` the remedy."""

    def __init__(self, key: str, what: str, fix: str) -> None:
        super().__init__(f"{what}; {fix}")
        self.key, self.what, self.fix = key, what, fix


class _JointStep(msgspec.Struct, frozen=True):
    """One joint: the fixed pose of its frame, whose z axis is the joint's axis, in the frame before it."""

    rotation: Rotation
    origin: Vector
    slides: bool


class Chain:
    """The moving joints from one link of a URDF down to another one.

    Args:
        urdf: The robot's URDF.
        base: Link in whose axes poses are given; empty: the root.
        tip: Link that is moved.
        joints: Joints that the chain may move, in the order of its positions; empty: all that move the tip.

    Raises:
        WrongChain: A link is unknown, the base is not above the tip, a joint of the chain is missing, follows
            another one, or is not in the chain.
    """

    def __init__(self, urdf: Urdf, base: str, tip: str, joints: Sequence[str] = ()) -> None:
        self.base = base or urdf.root
        self.tip = tip
        ways = _ways(urdf, self.base, tip)
        self.joints = joints = tuple(joints) or tuple(joint.name for joint in ways if joint.moves)
        _check_joints(ways, joints)
        order = {name: index for index, name in enumerate(joints)}
        steps: list[_JointStep] = []
        rotation, origin = IDENTITY, (0.0, 0.0, 0.0)
        self.order: list[int] = []
        """Index in `joints` of each joint from the base on."""
        back = IDENTITY
        for joint in ways:
            fixed = compose((rotation, origin), (rotation_of(from_rpy(joint.rpy)), joint.xyz))
            rotation, origin = fixed
            if not joint.moves:
                continue
            onto = _onto(joint.axis)
            steps.append(_JointStep(times(rotation, onto), origin, joint.type == "prismatic"))
            self.order.append(order[joint.name])
            back = inverted(onto)
            rotation, origin = back, (0.0, 0.0, 0.0)
        self._steps = tuple(steps)
        self._end: Pose = rotation, origin
        self.length = max(
            0.01, sum(math.hypot(*each.origin) for each in steps[1:]) + math.hypot(*self._end[1])
        )
        """Sum of the distances from the first joint to the tip, m: the scale of the arm."""
        count = len(joints)
        self._axes: list[Vector] = [(0.0, 0.0, 0.0)] * count
        self._origins: list[Vector] = [(0.0, 0.0, 0.0)] * count
        self._slides = [False] * count
        for place, each in zip(self.order, steps, strict=True):
            self._slides[place] = each.slides

    def pose(self, positions: Sequence[float]) -> Pose:
        """Return the pose of the tip in the base at joint positions, rad or m; `jacobian` refers to it."""
        axes, origins = self._axes, self._origins
        a, b, c, d, e, f, g, h, i = IDENTITY
        x = y = z = 0.0
        for place, step in zip(self.order, self._steps, strict=True):
            u, v, w = step.origin
            x += a * u + d * v + g * w
            y += b * u + e * v + h * w
            z += c * u + f * v + i * w
            k, q, m, n, o, p, r, s, t = step.rotation
            # The joint's frame in the base; its third column is the joint's axis.
            a, b, c, d, e, f, g, h, i = (
                a * k + d * q + g * m,
                b * k + e * q + h * m,
                c * k + f * q + i * m,
                a * n + d * o + g * p,
                b * n + e * o + h * p,
                c * n + f * o + i * p,
                a * r + d * s + g * t,
                b * r + e * s + h * t,
                c * r + f * s + i * t,
            )
            position = positions[place]
            axes[place] = g, h, i
            if step.slides:
                x, y, z = x + g * position, y + h * position, z + i * position
            else:
                sine, cosine = math.sin(position), math.cos(position)
                a, b, c, d, e, f = (
                    cosine * a + sine * d,
                    cosine * b + sine * e,
                    cosine * c + sine * f,
                    cosine * d - sine * a,
                    cosine * e - sine * b,
                    cosine * f - sine * c,
                )
            origins[place] = x, y, z
        rotation, origin = compose(((a, b, c, d, e, f, g, h, i), (x, y, z)), self._end)
        self._tip_at = origin
        return rotation, origin

    def without_turns(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return the positions with angles of at most half a turn, which have the same pose."""
        return tuple(
            each if slides else math.remainder(each, math.tau)
            for each, slides in zip(positions, self._slides, strict=True)
        )

    def jacobian(self) -> list[Column]:
        """Return a column per joint, in the order of `joints`, at the positions that `pose` got last."""
        x, y, z = self._tip_at
        columns: list[Column] = []
        for (a, b, c), (u, v, w), slides in zip(self._axes, self._origins, self._slides, strict=True):
            if slides:
                columns.append((a, b, c, 0.0, 0.0, 0.0))
            else:
                p, q, r = x - u, y - v, z - w
                columns.append((b * r - c * q, c * p - a * r, a * q - b * p, a, b, c))
        return columns


def _ways(urdf: Urdf, base: str, tip: str) -> list[UrdfJoint]:
    """Return all joints from the base down to the tip."""
    for key, link in (("base", base), ("tip", tip)):
        if link not in urdf.links:
            known = ", ".join(urdf.links)
            raise WrongChain(key, f"{key} {link} is not a link of the URDF", f"use one of {known}")
    above = {joint.child: joint for joint in urdf.joints}
    ways: list[UrdfJoint] = []
    link = tip
    while link != base:
        if link not in above:
            raise WrongChain(
                "base", f"the URDF has no chain from {base} down to {tip}", "name a link above the tip"
            )
        ways.append(above[link])
        link = ways[-1].parent
    return ways[::-1]


def _check_joints(ways: Sequence[UrdfJoint], joints: Sequence[str]) -> None:
    moving = [joint for joint in ways if joint.moves]
    if not moving:
        raise WrongChain("tip", "no joint moves the tip in the base", "name a link below a joint")
    for joint in moving:
        if joint.mimic is not None:
            what = f"the chain passes {joint.name}, which mimics {joint.mimic.joint}"
            raise WrongChain("tip", what, "name a tip above that joint")
        if joint.name not in joints:
            what = f"the chain passes {joint.name}, which this controller does not move"
            raise WrongChain("joints", what, f"add {joint.name} to `joints`, or choose another base or tip")
    names = [joint.name for joint in moving]
    for name in joints:
        if name not in names:
            what = f"{name} does not move the tip in the base"
            raise WrongChain("joints", what, f"remove it; the chain has {', '.join(names) or 'no joint'}")


# Rotations


def times(left: Rotation, right: Rotation) -> Rotation:
    """Return the product of two rotations: `right` first, then `left`."""
    return (*turned(left, right[:3]), *turned(left, right[3:6]), *turned(left, right[6:]))


def turned(rotation: Rotation, vector: Vector) -> Vector:
    """Return a vector that is rotated."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = vector
    return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def inverted(rotation: Rotation) -> Rotation:
    """Return the inverse of a rotation: its transpose."""
    a, b, c, d, e, f, g, h, i = rotation
    return a, d, g, b, e, h, c, f, i


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return the pose of a frame, given in another one as `inner`, in the frame of `outer`."""
    x, y, z = turned(outer[0], inner[1])
    u, v, w = outer[1]
    return times(outer[0], inner[0]), (x + u, y + v, z + w)


def rotation_of(quaternion: Quaternion) -> Rotation:
    """Return the rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y + w * z),
        2 * (x * z - w * y),
        2 * (x * y - w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z + w * x),
        2 * (x * z + w * y),
        2 * (y * z - w * x),
        1 - 2 * (x * x + y * y),
    )


def rotation_vector(rotation: Rotation) -> Vector:
    """Return axis times angle of a rotation, rad, with an angle of at most half a turn."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = (f - h) / 2, (g - c) / 2, (b - d) / 2
    sine, cosine = math.sqrt(x * x + y * y + z * z), (a + e + i - 1) / 2
    angle = math.atan2(sine, cosine)
    if sine > _LEAST_SINE:
        scale = angle / sine
        return x * scale, y * scale, z * scale
    if cosine > 0:
        return x, y, z
    # Half a turn: R + 1 = 2 * axis * axis^T, of which the longest column is the most accurate.
    columns = ((a + 1, b, c), (d, e + 1, f), (g, h, i + 1))
    x, y, z = max(columns, key=lambda column: math.hypot(*column))
    scale = angle / math.hypot(x, y, z)
    return x * scale, y * scale, z * scale


def rotation_by(vector: Vector) -> Rotation:
    """Return the rotation about a vector by its length, rad; the inverse of `rotation_vector`."""
    angle = math.hypot(*vector)
    half = math.sin(angle / 2) / angle if angle > _LEAST_SINE else 0.5
    x, y, z = vector
    return rotation_of((x * half, y * half, z * half, math.cos(angle / 2)))


def _onto(axis: Vector) -> Rotation:
    """Return a rotation that turns the z axis onto a unit vector."""
    x, y, z = axis
    if z < -0.999999:
        return 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0
    scale = 1 / (1 + z)
    return 1 - x * x * scale, -x * y * scale, -x, -x * y * scale, 1 - y * y * scale, -y, x, y, z
