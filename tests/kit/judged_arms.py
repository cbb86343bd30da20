"""Arms of the example robots, with forward kinematics of our own: matrices from the XML of the URDF."""

import math
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dxlrun.testing import plan_of
from dxlrun.tooling.robots import Transform, read_urdf
from dxlrun_space.chain import Chain
from dxlrun_space.solver import Solver

ROBOTS = Path(__file__).parents[2] / "robots"


def turn(axis: Any, angle: float) -> Any:
    """Return a rotation by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def numbers(element: Any, name: str, otherwise: str) -> Any:
    return np.array(
        [float(word) for word in ((element is not None and element.get(name)) or otherwise).split()]
    )


@dataclass(frozen=True)
class Arm:
    """A chain of a robot."""

    name: str
    urdf: str
    base: str
    tip: str
    joints: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    def exact(self) -> bool:
        return len(self.joints) >= 6

    @cached_property
    def chain(self) -> Chain:
        return Chain(read_urdf(self.urdf), self.base, self.tip, self.joints)

    @cached_property
    def solver(self) -> Solver:
        return Solver(self.chain, self.lower, self.upper)

    @cached_property
    def _above(self) -> dict[str, Any]:
        root = ElementTree.fromstring(self.urdf)  # noqa: S314  of a file of ours
        return {joint.find("child").get("link"): joint for joint in root.findall("joint")}  # type: ignore[union-attr]  # each has one

    def matrix(self, positions: Any) -> Any:
        """Return the pose of the tip in the base, 4 x 4."""
        at, pose, link = dict(zip(self.joints, positions, strict=True)), np.eye(4), self.tip
        while link != self.base:
            joint = self._above[link]
            local, origin = np.eye(4), joint.find("origin")
            roll, pitch, yaw = numbers(origin, "rpy", "0 0 0")
            local[:3, :3] = turn((0, 0, 1), yaw) @ turn((0, 1, 0), pitch) @ turn((1, 0, 0), roll)
            local[:3, 3] = numbers(origin, "xyz", "0 0 0")
            axis, moved = numbers(joint.find("axis"), "xyz", "1 0 0"), np.eye(4)
            if joint.get("type") == "prismatic":
                moved[:3, 3] = axis * at[joint.get("name")]
            elif joint.get("type") != "fixed":
                moved[:3, :3] = turn(axis / np.linalg.norm(axis), at[joint.get("name")])
            pose, link = local @ moved @ pose, joint.find("parent").get("link")
        return pose

    @cached_property
    def _model(self) -> Any:
        pin = import_module("pinocchio")
        model = pin.buildModelFromXML(self.urdf)
        return (
            pin,
            model,
            model.createData(),
            [model.joints[model.getJointId(name)].idx_q for name in self.joints],
        )

    def matrix_of_pinocchio(self, positions: Any) -> Any:
        """Return the pose of the tip in the base as the second judge sees it."""
        pin, model, data, places = self._model
        whole = pin.neutral(model)
        whole[places] = positions
        pin.framesForwardKinematics(model, data, whole)
        base, tip = (data.oMf[model.getFrameId(link)] for link in (self.base, self.tip))
        return (base.inverse() * tip).homogeneous

    def target(self, positions: Any) -> Any:
        """Return the pose as the solver takes it."""
        return as_pose(self.matrix(positions))

    def within(self, positions: Any) -> bool:
        return all(
            low <= each <= high for low, each, high in zip(self.lower, positions, self.upper, strict=True)
        )

    def drawn(self, chance: Any, share: float = 1.0) -> tuple[float, ...]:
        """Return random positions within this share of the limits."""
        return tuple(
            chance.uniform(a * share, b * share) for a, b in zip(self.lower, self.upper, strict=True)
        )


def as_pose(matrix: Any) -> Any:
    """Return the transform of a 4 x 4 matrix: of 4 q q^T the longest row is the most accurate."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3]
    rows = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    longest = rows[np.diag(rows).argmax()]
    turn = (longest / np.linalg.norm(longest)).tolist()
    return Transform(tuple(matrix[:3, 3].tolist()), tuple(turn))


def apart(one: Any, other: Any) -> tuple[float, float]:
    """Return the distance of two poses, m and rad."""
    cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    skew = one[:3, :3].T @ other[:3, :3]
    sine = np.linalg.norm(skew - skew.T) / math.sqrt(8)
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), math.atan2(sine, cosine)


def example(file: str, base: str, tip: str, *joints: str) -> Arm:
    plan = plan_of(ROBOTS / f"{file}.yaml")
    planned = {joint.name: joint for joint in plan.loop.joints}
    bounds = [(planned[joint].lower, planned[joint].upper) for joint in joints]
    lower, upper = zip(*bounds, strict=True)
    return Arm(file, plan.urdf or "", base, tip, joints, lower, upper)


def six_axis(*, more: bool = False) -> Arm:
    """Return an industrial arm with a wrist whose axes meet, and with one joint more in its middle."""
    steps = [("0 0 0.1", "0 0 1"), ("0 0 0.05", "0 1 0"), ("0 0 0.2", "0 1 0"), ("0.05 0 0", "1 0 0"),
             ("0.2 0 0", "0 1 0"), ("0 0 0", "1 0 0")]  # fmt: skip
    steps[2:2] = [("0 0 0.1", "0 0 1")] * more
    return _built("seven" if more else "six", [("revolute", 2.9, *step) for step in steps])


def _built(name: str, steps: list[tuple[str, float, str, str]]) -> Arm:
    """Return an arm whose joints have a type, a limit on both sides, an origin and an axis."""
    text = f'<robot name="{name}"><link name="l0"/>'
    for number, (kind, limit, origin, axis) in enumerate(steps):
        text += (
            f'<link name="l{number + 1}"/><joint name="j{number}" type="{kind}"><parent link="l{number}"/>'
            f'<child link="l{number + 1}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="1" velocity="4"/></joint>'
        )
    count = len(steps)
    text += (
        f'<link name="tip"/><joint name="end" type="fixed"><parent link="l{count}"/><child link="tip"/>'
        '<origin xyz="0.1 0 0"/></joint></robot>'
    )
    limits = tuple(limit for _, limit, *_ in steps)
    names = tuple(f"j{number}" for number in range(count))
    return Arm(name, text, "l0", "tip", names, tuple(-limit for limit in limits), limits)


def arms() -> dict[str, Arm]:
    follower = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    found = [
        example("open_manipulator_x", "link1", "end_effector_link",
                "joint1", "joint2", "joint3", "joint4"),
        example("koch", "follower_base", "follower_hand", *follower),
        example("op3", "body_link", "l_el_link", "l_sho_pitch", "l_sho_roll", "l_el"),
        example("poppy_ergo_jr", "base_link", "tip", "m1", "m2", "m3", "m4", "m5", "m6"),
        six_axis(),
        six_axis(more=True),
        _built("sliding", [
            ("revolute", 2.9, "0 0 0.1", "0 0 1"), ("prismatic", 0.2, "0 0 0.05", "0 0 1"),
            ("revolute", 2.0, "0.1 0 0", "0 1 0"), ("prismatic", 0.15, "0.1 0 0", "1 0 0"),
            ("revolute", 2.9, "0.05 0 0", "1 0 0"),
        ]),
    ]  # fmt: skip
    return {arm.name: arm for arm in found}
