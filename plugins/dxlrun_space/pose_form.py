"""Poses of links as positions of joints: those of `tip_poses`, and those in place of the name of a pose."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from dxlrun.tooling.features import PoseStage
from dxlrun.tooling.plans import JointPlan
from dxlrun.tooling.robots import Transform, read_urdf
from dxlrun_space.chain import BASE, Chain, WrongChain, chain_of
from dxlrun_space.form import TipPose, rotation_of
from dxlrun_space.path import out_of_reach
from dxlrun_space.solver import Orientation, Solver, demands_orientation, finish_search


class SolvedPose(NamedTuple):
    """Joints that have a pose."""

    solver: Solver
    positions: tuple[float, ...]
    orientation_error: float
    """Angle to the orientation that was asked for, rad; 0 if none was."""


def solve_pose(
    pose: TipPose,
    chain: Chain,
    joints: Mapping[str, JointPlan],
    orientations: Collection[Orientation | None] = (),
) -> SolvedPose:
    """Return the joints of a chain that have a pose; raise WrongChain if there are none.

    `orientations` are the parameters `orientation` of the controllers that move the tip.
    """
    for joint in pose.near:
        if joint not in chain.joints:
            raise WrongChain("near", f"{joint} does not move {pose.tip}", f"write {', '.join(chain.joints)}")
    plans = [joints[joint] for joint in chain.joints]
    near = [pose.near.get(joint) for joint in chain.joints]
    solver = Solver(chain, [plan.lower for plan in plans], [plan.upper for plan in plans], near)
    start = tuple(each or 0.0 for each in near)
    rotation = rotation_of(pose.quaternion, pose.rpy)
    exact = rotation is not None and any(
        demands_orientation(each, len(plans)) for each in orientations or (None,)
    )
    target = Transform((pose.x, pose.y, pose.z), rotation or BASE.rotation)
    search = solver.search(target, start, exact=exact) if rotation else solver.search_place(target, start)
    found = finish_search(search)
    if not found.residual.suffices(exact):
        fix = "move the pose, or give it another orientation"
        raise WrongChain("", out_of_reach(found.residual, exact), fix)
    return SolvedPose(solver, found.positions, found.residual.orientation if rotation else 0.0)


def _joints_of(pose: TipPose, urdf: str | None, joints: Mapping[str, JointPlan]) -> dict[str, float]:
    chain = chain_of(None if urdf is None else read_urdf(urdf), pose.base, pose.tip, joints)
    return dict(zip(chain.joints, solve_pose(pose, chain, joints).positions, strict=True))


STAGE = PoseStage("tip", TipPose, _joints_of)
