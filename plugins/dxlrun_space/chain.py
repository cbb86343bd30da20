"""Chain: the joints between two links of a URDF, the pose of the last link, and its Jacobian.

Plain Python floats, no linear algebra library: for three to seven joints one is hardly faster, and its
results depend on the processor, so that a replay on another computer would differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, TypeAlias

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun.tooling.files import Mistakes
from dxlrun.tooling.robots import (
    Transform,
    Urdf,
    UrdfJoint,
    from_rpy,
    product,
    read_urdf,
    rotated,
    rotation_about,
)

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Column: TypeAlias = tuple[float, float, float, float, float, float]
"""Velocity of the link by one joint at unit speed: linear, then angular times a lever, in the base's axes."""

BASE: Final = Transform()
"""Pose of the base in itself."""
_LEAST_SINE: Final = 1e-9
_PRIMES: Final = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


class WrongChain(Mistakes):
    """The links and joints do not make a chain; `key` is the parameter that is wrong, `fix` the remedy."""

    def __init__(self, key: str, what: str, fix: str) -> None:
        super().__init__([((key,) if key else (), f"{what}; {fix}")])
        self.key, self.what, self.fix = key, what, fix


class _JointStep(msgspec.Struct, frozen=True):
    """One joint: its index in the positions, and its frame in the one before it."""

    index: int
    fixed: Transform
    axis: Vector
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
        steps: list[_JointStep] = []
        before = BASE
        for joint in ways:
            before = before @ Transform(joint.xyz, from_rpy(joint.rpy))
            if joint.moves:
                index, slides = joints.index(joint.name), joint.type == "prismatic"
                steps.append(_JointStep(index, before, joint.axis, slides))
                before = BASE
        self._steps, self._end = tuple(steps), before
        parts = *(step.fixed for step in steps[1:]), self._end
        lengths = [math.hypot(*part.translation) for part in parts]
        self.links = tuple((step.index, step.slides, part) for step, part in zip(steps, lengths, strict=True))
        """Joints from the base on: index, True if it slides, and distance to the next one, m."""
        self.length = max(0.01, math.fsum(lengths))
        """Sum of the distances from the first joint to the tip, m: the scale of the arm."""
        self._tip_at = BASE.translation
        self._axes = [(BASE.translation, BASE.translation, False)] * len(joints)
        """Axis and origin of each joint in the base, and True if it slides."""

    def pose(self, positions: Sequence[float]) -> Transform:
        """Return the pose of the tip in the base at joint positions, rad or m; `jacobian` refers to it."""
        turn, (x, y, z) = BASE.rotation, BASE.translation
        for step in self._steps:
            u, v, w = rotated(turn, step.fixed.translation)
            x, y, z = x + u, y + v, z + w
            turn = product(turn, step.fixed.rotation)
            u, v, w = axis = rotated(turn, step.axis)
            position = positions[step.index]
            if step.slides:
                x, y, z = x + u * position, y + v * position, z + w * position
            else:
                turn = product(turn, rotation_about(step.axis, position))
            self._axes[step.index] = axis, (x, y, z), step.slides
        tip = Transform((x, y, z), turn) @ self._end
        self._tip_at = tip.translation
        return tip

    def jacobian(self, lever: float = 1.0) -> list[Column]:
        """Return a column per joint, in the order of `joints`, at the positions that `pose` got last.

        Args:
            lever: Factor on angular velocities, m/rad, so that they compare with linear ones.
        """
        x, y, z = self._tip_at
        columns: list[Column] = []
        for (a, b, c), (u, v, w), slides in self._axes:
            if slides:
                columns.append((a, b, c, 0.0, 0.0, 0.0))
            else:
                p, q, r = x - u, y - v, z - w
                columns.append((b * r - c * q, c * p - a * r, a * q - b * p, a * lever, b * lever, c * lever))
        return columns


def chain_of(urdf: str | None, base: str, tip: str) -> Chain:
    """Return the chain in the text of a robot's URDF; raise WrongChain if it has none."""
    if urdf is None:
        raise WrongChain("tip", "the robot file names no URDF", "write `model: {urdf: NAME.urdf}`")
    return Chain(read_urdf(urdf), base, tip)


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


# Positions and rotations


def spread(lower: Sequence[float], upper: Sequence[float], count: int) -> Floats:
    """Return joint positions that are spread evenly over the limits, at most half a turn, one row each.

    This is the sequence of R. D. Richtmyer (1951): multiples of square roots of primes, modulo 1.
    """
    low, high = np.clip((lower, upper), -math.pi, math.pi)
    shares = np.arange(1, count + 1)[:, None] * np.sqrt(np.resize(_PRIMES, len(low))) % 1.0
    positions: Floats = low + shares * (high - low)
    return positions


def scaled(vector: Vector, scale: float) -> Vector:
    """Return a multiple of a vector."""
    x, y, z = vector
    return x * scale, y * scale, z * scale


def shifted(pose: Transform, way: Vector, turn: Vector) -> Transform:
    """Return a pose that is moved, and turned by a rotation vector, in the axes of its parent."""
    angle, (x, y, z), (u, v, w) = math.hypot(*turn), pose.translation, way
    rotation = rotation_about(scaled(turn, 1 / max(angle, _LEAST_SINE)), angle)
    return Transform((x + u, y + v, z + w), product(rotation, pose.rotation))


def rotation_vector(rotation: Quaternion) -> Vector:
    """Return axis times angle of a rotation, rad, with an angle of at most half a turn."""
    x, y, z, w = rotation
    sine = math.hypot(x, y, z)
    scale = 2 * math.atan2(sine, abs(w)) / sine if sine > _LEAST_SINE else 2.0
    scale = math.copysign(scale, w)  # the quaternion with the other sign is the same rotation
    return x * scale, y * scale, z * scale
