"""`dxlrun frames ROBOT.yaml`: print the tree of the frames of a robot's URDF, or the pose of one frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import Assignment, DebugFlag, GraphFile, JsonFlag, RobotPath, compiled, parse_pair
from dxlrun.errors import InputError, counted
from dxlrun.output.terminal import ascii_only, out, print_warning, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.description.frames.tree import Frame, FrameTree
    from dxlrun.plan.robot_plan import Plan
    from dxlsim.geometry.transform import Transform

_Positions = Annotated[
    tuple[str, ...], Parameter(name="--at", negative=(), show_default=False, consume_multiple=True)
]
_Branches = tuple[str, str, str, str, str]
_LINES: _Branches = ("├── ", "├┄┄ ", "└── ", "└┄┄ ", "│   ")
"""Branches to a moving frame, to a fixed frame, the same for the last child, and the line past other
children."""
_ASCII: _Branches = ("|-- ", "|.. ", "`-- ", "`.. ", "|   ")


def frames(
    robot: RobotPath,
    /,
    *assignments: Assignment,
    of: str | None = None,
    relative_to: str = "",
    at: _Positions = (),
    graph: GraphFile = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Draw a robot's frames as a tree, or print the pose of one frame.

    The frames are those of the URDF. A dashed line leads to a frame that is fixed in its parent frame.

    Parameters
    ----------
    of
        Frame whose pose is printed instead of the tree.
    relative_to
        Reference frame of the pose. Default: the root of the tree.
    at
        Positions of joints or groups, such as elbow=30deg jaw=5mm, in the notation of `dxlrun get` and
        `dxlrun send`. Default of each joint: 0, or the middle of its limits if they exclude 0.
    graph
        Draw the graph of the frames into an .svg or .dot file. Without a file, this option has no effect.
    """
    if of is None and (at or relative_to):
        raise InputError("--at and --relative-to need a frame; name it by --of")
    for file in graph or ():
        # Imported here because most calls draw nothing.
        from dxlrun.output.graph_picture import check_picture

        check_picture(file)
    result = compiled(robot, assignments, (), None)
    tree = _tree(result.plan, robot)
    if of is None:
        _show_tree(result.plan, tree, as_json=as_json)
    else:
        _show_pose(tree, of, relative_to, _positions(result.plan, tree, at), as_json=as_json)
    for file in graph or ():
        _draw(result.plan, tree, file)
        if not as_json:
            show_parts(f"the tree is in {file}")
    for warning in result.warnings:
        if not as_json and "URDF" in warning.what:
            print_warning(str(warning))
    return 0


def _tree(plan: Plan, robot: Path) -> FrameTree:
    # Imported here because the help of the verb does not need it.
    from dxlrun.description.frames.tree import FrameTree

    if plan.urdf is None or plan.frames is None:
        raise InputError(f"{robot} has no URDF and so no frames; write `model: {{urdf: NAME.urdf}}`")
    return FrameTree.from_urdf(plan.urdf, plan.frames)


def _show_tree(plan: Plan, tree: FrameTree, *, as_json: bool) -> None:
    if as_json:
        rows = [_row(plan, tree, frame) for frame in tree.frames]
        show_json({"robot": plan.robot, "root": tree.frames[0].name, "frames": rows})
        return
    moving = sum(frame.moves for frame in tree.frames)
    logged = (
        "are not logged"
        if plan.frames is None or not plan.frames.rate
        else f"{plan.frames.rate:g} Hz in the log"
    )
    show_parts(
        f"{plan.robot}: {counted(len(tree.frames), 'frame', 'frames')}, {moving} of them "
        f"{'moves' if moving == 1 else 'move'}; {logged}",
        *_lines(plan, tree, _ASCII if ascii_only(out()) else _LINES),
    )


def _lines(plan: Plan, tree: FrameTree, branches: _Branches) -> Iterator[str]:
    """Yield the lines of the drawn tree, one per frame with its motion, the root first."""
    below: dict[str, list[Frame]] = {}
    for frame in tree.frames:
        below.setdefault(frame.parent, []).append(frame)
    left = [("", "", frame) for frame in below.get("", ())]
    found: list[tuple[str, str]] = []
    while left:
        before, branch, frame = left.pop()
        found.append((before + branch + frame.name, _what(plan, tree, frame)))
        past = "" if not branch else "    " if branch in branches[2:4] else branches[4]
        children = below.get(frame.name, [])
        for child in reversed(children):
            kind = (2 if child is children[-1] else 0) + (not child.moves)
            left.append((before + past, branches[kind], child))
    width = max(len(name) for name, _ in found)
    yield from (f"{name:<{width}}  {what}".rstrip() for name, what in found)


def _what(plan: Plan, tree: FrameTree, frame: Frame) -> str:
    """Return what moves a frame: the IMU, its joint with axis and servo, or `fixed`; empty for the root."""
    joint = frame.joint
    if frame.moved_by == "imu":
        return f"turned by the orientation of {tree.imu}"
    if joint is None or frame.moved_by == "root":
        return ""
    if frame.moved_by == "fixed":
        return "fixed"
    axis = " ".join(f"{value:.3g}" for value in joint.axis)
    words = f"{joint.name}: {joint.type}, axis {axis}"
    if frame.moved_by == "servo":
        return f"{words}, {_servo(plan, joint.name)}"
    if joint.mimic is not None:
        offset = f" {joint.mimic.offset:+g}" if joint.mimic.offset else ""
        words = f"{words}, {joint.mimic.multiplier:g} x {joint.mimic.joint}{offset}"
    return (
        words
        if frame.moved_by == "mimic"
        else f"{words}, without a servo: stays at {_rest(tree, joint.name)}"
    )


def _rest(tree: FrameTree, joint: str) -> str:
    return f"{tree.position(joint, {}):g}"


def _servo(plan: Plan, joint: str) -> str:
    return next(one.servo for one in plan.loop.joints if one.name == joint)


def _row(plan: Plan, tree: FrameTree, frame: Frame) -> dict[str, object]:
    from msgspec import to_builtins

    joint = frame.joint
    row: dict[str, object] = {"frame": frame.name, "parent": frame.parent or None, "moved_by": frame.moved_by}
    if frame.moved_by == "imu":
        row["source"] = tree.imu
    if joint is not None:
        row |= {"joint": joint.name, "type": joint.type, "xyz": joint.xyz, "rpy": joint.rpy}
        if joint.moves:
            row |= {"axis": joint.axis, "limits": to_builtins(joint.limits)}
        if joint.mimic is not None:
            row["mimic"] = to_builtins(joint.mimic)
        if frame.moved_by == "servo":
            row["servo"] = _servo(plan, joint.name)
    return row


def _show_pose(
    tree: FrameTree, of: str, relative_to: str, positions: Mapping[str, float], *, as_json: bool
) -> None:
    try:
        pose = tree.pose(of, relative_to, positions)
    except LookupError as error:
        raise InputError(str(error.args[0])) from None
    relative = relative_to or tree.frames[0].name
    if as_json:
        show_json(
            {
                "frame": of,
                "in": relative,
                "translation": pose.translation,
                "rotation": pose.rotation,
                "rpy": pose.rpy,
                "matrix": pose.matrix,
            }
        )
    else:
        show_parts(f"{of} in {relative}", *_pose_lines(pose))


def _pose_lines(pose: Transform) -> Iterator[str]:
    def numbers(values: tuple[float, ...], digits: int) -> str:
        # Adding 0.0 after rounding removes the sign of a zero.
        return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)

    yield f"  x y z           {numbers(pose.translation, 6)} m"
    yield f"  roll pitch yaw  {numbers(tuple(map(math.degrees, pose.rpy)), 3)} deg"
    yield f"  quaternion      {numbers(pose.rotation, 6)} (x y z w)"


def _positions(plan: Plan, tree: FrameTree, words: tuple[str, ...]) -> Mapping[str, float]:
    """Return the positions by joint, rad or m, of the words of `--at`, such as `elbow=30deg right_arm=0deg`.

    Raises InputError.
    """
    from dxlrun.description import units

    kinds = {frame.joint.name: frame.joint.type for frame in tree.frames if frame.joint is not None}
    found: dict[str, float] = {}
    for word in words:
        name, value = parse_pair(word, "--at elbow=30deg")
        for joint in plan.groups.get(name, (name,)):
            if joint in found:
                raise InputError(f"--at {joint} is given twice; give it once")
            try:
                found[joint] = (units.length if kinds.get(joint) == "prismatic" else units.angle)(value)
            except ValueError as error:
                raise InputError(f"--at {word}: {error}") from None
    return found


def _draw(plan: Plan, tree: FrameTree, file: Path) -> None:
    # Imported here because the help of the verb does not need it.
    from dxlrun.output.graph import Edge, Graph, Node
    from dxlrun.output.graph_picture import write_picture

    nodes = tuple(
        Node(frame.name, "controller", (frame.name,), about=_what(plan, tree, frame), active=frame.moves)
        for frame in tree.frames
    )
    edges = tuple(Edge(frame.parent, frame.name) for frame in tree.frames if frame.parent)
    write_picture(Graph(f"{plan.robot}: frames", nodes, edges), file)
