"""Check of the section `tip_poses`: the joints of each pose, or the reason why there are none."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import msgspec
from pydantic import ValidationError

from dxlrun.tooling.features import Compilation, CompileStage, Contribution, Row
from dxlrun.tooling.plans import JointPlan
from dxlrun_space import form
from dxlrun_space.cartesian_controller import CartesianController, CartesianParameters
from dxlrun_space.chain import Chain, WrongChain, chain_of
from dxlrun_space.pose_form import solve_pose
from dxlrun_space.reach import dexterity
from dxlrun_space.solver import CLOSE_RAD, Orientation


def compile_tip_poses(compilation: Compilation) -> Contribution:
    """Return the joints of each pose, and the rows of the poses' table."""
    file, body, rows = compilation.file, compilation.body, list[Row]()
    joints = {name: joint.plan for name, joint in compilation.joints.items()}
    mistaken = file.robot.joints.keys() - joints.keys()
    arms = _arms(compilation)
    written = form.STAGE.section_of(file.robot)
    poses: dict[str, dict[str, float] | None] = dict.fromkeys(written)
    for name, pose in written.items():
        if body is None and file.robot.model is not None:
            break
        try:
            known = (*file.robot.joints, *file.description.omitted)
            chain = chain_of(None if body is None else body.urdf, pose.base, pose.tip, known)
            if omitted := next((joint for joint in chain.joints if joint in file.description.omitted), ""):
                what = f"pose {name} is omitted, because {omitted} moves {pose.tip}"
                file.warning(file.key("tip_poses", name), what, f"run with {omitted} to have it")
                poses[name] = {}
            elif mistaken.isdisjoint(chain.joints):
                orientations = [arm.orientation for arm in arms or () if arm.tip == pose.tip]
                row = _row(chain, pose, joints, orientations)
                if arms is not None and not orientations and row["orientation_error"] > CLOSE_RAD:
                    off = math.degrees(row["orientation_error"])
                    what = f"pose {name} is {off:.1f} deg from its orientation, which the arm cannot reach"
                    file.warning(file.key("tip_poses", name), what, "give it another orientation")
                poses[name] = row["joints"]
                rows.append({"name": name, "tip": pose.tip, **row})
        except WrongChain as wrong:
            file.error(file.at("tip_poses", name, wrong.key), f"{name}: {wrong.what}", wrong.fix)
    return Contribution(poses=poses, plan=msgspec.json.encode(rows))


def _arms(compilation: Compilation) -> list[CartesianParameters] | None:
    """Return the parameters of all controllers in space; None if some are not valid, which is reported."""
    found: list[CartesianParameters] = []
    for entry in compilation.file.robot.controllers.values():
        offer = compilation.plugins.controllers.get(entry.type)
        if offer is not None and issubclass(offer.controller, CartesianController):
            try:
                found.append(offer.controller.Parameters.model_validate(entry.parameters))
            except ValidationError:
                return None
    return found


def _row(
    chain: Chain,
    pose: form.TipPose,
    joints: Mapping[str, JointPlan],
    orientations: Collection[Orientation | None],
) -> Row:
    """Return the row of a pose with its joints."""
    solver, positions, orientation_error = solve_pose(pose, chain, joints, orientations)
    ends = zip(positions, solver.lower, solver.upper, strict=True)
    margins = [min(at - low, high - at) for at, low, high in ends]
    least = margins.index(min(margins))
    return {
        "joints": dict(zip(chain.joints, positions, strict=True)),
        "orientation_error": orientation_error,
        "dexterity": dexterity(chain, [positions])[1].item(),
        "margin": margins[least],
        "margin_joint": chain.joints[least],
        "margin_unit": joints[chain.joints[least]].unit.si,
    }


STAGE = CompileStage(compile_tip_poses)
