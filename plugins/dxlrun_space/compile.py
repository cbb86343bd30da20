"""Check of the section `tip_poses`: the joints of each pose, or the reason why there are none."""

from __future__ import annotations

from typing import Final

import msgspec
from pydantic import ValidationError

from dxlrun.tooling.features import Compilation, CompileStage, Contribution, Row
from dxlrun_space import form
from dxlrun_space.chain import BASE, Chain, WrongChain
from dxlrun_space.path import out_of_reach, suffices
from dxlrun_space.reach import dexterity
from dxlrun_space.solver import FULL, Solver, finish_search
from dxlrun_space.space_goals import PoseCommand

_GOAL: Final = {"x", "y", "z", "rpy", "quaternion"}


def compile_tip_poses(compilation: Compilation) -> Contribution:
    """Return the joints of each pose, and the rows of the poses' table."""
    file, poses, rows = compilation.file, dict[str, dict[str, float]](), list[Row]()
    for name, pose in form.STAGE.section_of(file.robot).items():
        try:
            if (chain := _chain(compilation, pose)) is None:
                continue
            if omitted := next((joint for joint in chain.joints if joint in file.description.omitted), ""):
                what = f"pose {name} is omitted, because {omitted} moves {pose.tip}"
                file.warning(file.key("tip_poses", name), what, f"run with {omitted} to have it")
                poses[name] = {}
            elif (found := _solved(compilation, chain, pose)) is not None:
                poses[name] = found["joints"]
                rows.append({"name": name, "tip": pose.tip, **found})
        except WrongChain as wrong:
            file.error(file.at("tip_poses", name, wrong.key), f"{name}: {wrong.what}", wrong.fix)
    return Contribution(poses=poses, plan=msgspec.json.encode(rows))


def _chain(compilation: Compilation, pose: form.TipPose) -> Chain | None:
    """Return the chain of a pose; None if the URDF has an error already."""
    file, body = compilation.file, compilation.body
    if body is not None:
        return Chain(body.urdf, pose.base, pose.tip)
    if file.robot.model is None:
        raise WrongChain("tip", "the robot file names no URDF", "write `model: {urdf: NAME.urdf}`")
    return None


def _solved(compilation: Compilation, chain: Chain, pose: form.TipPose) -> Row | None:
    """Return the row of a pose with its joints; None if a joint has an error already."""
    for joint in chain.joints:
        if joint not in compilation.file.robot.joints:
            raise WrongChain("tip", f"{joint} moves {pose.tip}, but has no servo", f"add {joint} to `joints`")
    for joint in pose.near:
        if joint not in chain.joints:
            raise WrongChain("near", f"{joint} does not move {pose.tip}", f"write {', '.join(chain.joints)}")
    plans = [compilation.joints[joint].plan for joint in chain.joints if joint in compilation.joints]
    if len(plans) < len(chain.joints):
        return None
    near = [pose.near.get(joint) for joint in chain.joints]
    solver = Solver(chain, [plan.lower for plan in plans], [plan.upper for plan in plans], near)
    start = tuple(each or 0.0 for each in near)
    try:
        goal = PoseCommand.model_validate(pose.model_dump(include=_GOAL)).as_goal()
    except ValidationError as error:
        what, _, fix = error.errors()[0]["msg"].removeprefix("Value error, ").partition("; ")
        raise WrongChain("", what, fix or "remove the others") from None
    exact = goal.asks_orientation and len(plans) >= FULL
    target = goal.target(BASE, chain.pose(start))
    search = (
        solver.search(target, start, exact=exact)
        if goal.asks_orientation
        else solver.search_place(target, start)
    )
    found = finish_search(search)
    if not suffices(found.residual, exact):
        raise WrongChain(
            "", out_of_reach(found.residual, exact), "move the pose, or give it another orientation"
        )
    ends = zip(found.positions, solver.lower, solver.upper, strict=True)
    margins = [min(at - low, high - at) for at, low, high in ends]
    least = margins.index(min(margins))
    return {
        "joints": dict(zip(chain.joints, found.positions, strict=True)),
        "orientation_error": found.residual.orientation if goal.asks_orientation else 0.0,
        "dexterity": dexterity(chain, [found.positions])[1].item(),
        "margin": margins[least],
        "margin_joint": chain.joints[least],
        "margin_unit": plans[least].unit.si,
    }


STAGE = CompileStage(compile_tip_poses)
