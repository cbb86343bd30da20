"""Arm frames: poses of a robot's links in the base of an arm."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from dxlrun.tooling.robots import FrameTree, Urdf
from dxlrun_space.chain import Pose, rotation_of


class ArmFrames:
    """All links of a robot whose `joints` have known positions.

    Args:
        urdf: URDF of the robot.
        base: Link in which poses are; empty: the root.
        joints: Joints of this run.
    """

    def __init__(self, urdf: Urdf, base: str, joints: Collection[str]) -> None:
        self._tree, self._base = FrameTree(urdf, joints), base

    def movers(self, frame: str) -> tuple[str, ...]:
        """Return the joints that move a frame in the base.

        Raises:
            ValueError: There is no such frame, or it moves with a joint that this run does not have.
        """
        try:
            found = self._tree.movers(frame, self._base)
        except LookupError as error:
            raise ValueError(error.args[0]) from None
        for joint in found:
            if joint not in self._tree.moved:
                raise ValueError(f"frame {frame} moves with joint {joint}, which is omitted or has no servo")
        return found

    def pose(self, frame: str, positions: Mapping[str, float]) -> Pose:
        """Return the pose of a frame in the base from the positions of its `movers`, rad or m."""
        pose = self._tree.pose(frame, self._base, positions)
        return rotation_of(pose.rotation), pose.translation
