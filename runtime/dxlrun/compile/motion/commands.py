"""Commands: the fields of typed commands that have a meaning for every controller, and their limits.

A controller can be played when it takes a command `trajectory` (points: time s, positions, velocities,
accelerations; start_in s) or one whose fields are `positions`, `velocities` or both: values in rad and rad/s
in the order of its joints. The standard controllers do; anybody's may. What these fields, and `efforts`, ask
of a joint is compared with its limits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dxlrun.compile.joint.reach import Interval
from dxlrun.compile.motion.samples import Quantity, Sample, Target
from dxlrun.control.controllers.controller import CommandModel, Controller
from dxlrun.control.loop_plan import JointPlan
from dxlrun.errors import Mark

TRAJECTORY = "trajectory"
_TOLERANCE = 1e-6
"""rad; rounding of degrees, far below a tick."""
_ROUNDING = 1e-9
"""Part of a speed that differences of positions and times may be off."""
_FIELDS: dict[Quantity, str] = {
    "position": "positions",
    "velocity": "velocities",
    "acceleration": "accelerations",
}


class UnfitError(ValueError):
    """A sample cannot be said in the controller's command."""

    def __init__(self, mark: Mark, what: str, mend: str) -> None:
        super().__init__(what)
        self.mark = mark
        self.what = what
        self.mend = mend


def command_kind(controller: type[Controller[Any]]) -> str | None:
    """Return the name of the command by which motions are played; None when the controller takes none."""
    if TRAJECTORY in controller.Commands:
        return TRAJECTORY
    for kind, model in controller.Commands.items():
        if model.model_fields and set(model.model_fields) <= {"positions", "velocities"}:
            return kind
    return None


def group_command(
    controller: type[Controller[Any]], kind: str, joints: Sequence[str], sample: Sample
) -> dict[str, object]:
    """Return one command with a value for each joint; raises UnfitError."""
    wanted = controller.Commands[kind].model_fields
    quantities = [quantity for quantity, name in _FIELDS.items() if name in wanted]
    for joint, target in sample.targets.items():
        for quantity in _FIELDS:
            if quantity not in quantities and target.get(quantity) is not None:
                raise UnfitError(
                    target.mark,
                    f"{joint} has a target {quantity}, which this controller does not take",
                    f"take the {quantity} out, or choose another controller",
                )
    return {
        _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints] for quantity in quantities
    }


def trajectory_command(joints: Sequence[str], samples: Sequence[Sample], lead_ns: int) -> dict[str, object]:
    """Return a trajectory through all samples, starting `lead_ns` after it was taken; raises UnfitError."""
    quantities: list[Quantity] = ["position"]
    derivatives: tuple[Quantity, ...] = ("velocity", "acceleration")
    for quantity in derivatives:
        if any(target.get(quantity) is not None for sample in samples for target in sample.targets.values()):
            quantities.append(quantity)
    points: list[dict[str, object]] = [
        {
            "time": sample.t_ns * 1e-9,
            **{
                _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints]
                for quantity in quantities
            },
        }
        for sample in samples
    ]
    return {"points": points, "start_in": lead_ns * 1e-9}


def beyond_limits(joints: Sequence[JointPlan], command: CommandModel) -> list[str]:
    """Return a sentence for each value of a command that its joint cannot follow.

    `joints`: those of the controller, in its order. Positions (rad) are compared with the position limits,
    velocities (rad/s) and efforts with the lower one of the file's limit and the servo's own; between two
    points of a trajectory the mean speed, which every way through both reaches. A field that has not one
    number a joint is for the controller's `prepare` to judge.
    """
    values = command.model_dump()
    points = values.get("points")
    if isinstance(points, Sequence) and all(isinstance(point, Mapping) for point in points):
        return list(_beyond_in_points(joints, points))
    return list(_beyond(joints, values, ""))


def _beyond(joints: Sequence[JointPlan], values: Mapping[str, object], where: str) -> Iterator[str]:
    for joint, position in zip(joints, _row(joints, values, "positions"), strict=False):
        if not joint.lower - _TOLERANCE <= position <= joint.upper + _TOLERANCE:
            limits = Interval(joint.lower, joint.upper)
            angle = f"{math.degrees(position):.6g}"
            yield f"{joint.name} is sent to {angle} deg{where}, outside its limits {limits}"
    for joint, speed in zip(joints, _row(joints, values, "velocities"), strict=False):
        yield from _too_fast(joint, speed, where)
    for joint, effort in zip(joints, _row(joints, values, "efforts"), strict=False):
        if abs(effort) > joint.highest_effort:
            most, own = joint.highest_effort, joint.highest_effort != joint.effort
            whose = "the highest goal of its servo" if own else "its effort limit"
            yield f"{joint.name} is asked for {effort:.6g}{where}, more than {most:.6g}, {whose}"


def _beyond_in_points(joints: Sequence[JointPlan], points: Sequence[Mapping[str, object]]) -> Iterator[str]:
    before: tuple[float, Sequence[float]] | None = None
    for number, point in enumerate(points, 1):
        yield from _beyond(joints, point, f" in point {number}")
        time, positions = point.get("time"), _row(joints, point, "positions")
        if not isinstance(time, int | float) or not positions:
            before = None
            continue
        if before is not None and time > before[0]:
            where = f" from point {number - 1} to {number}"
            for joint, start, end in zip(joints, before[1], positions, strict=True):
                yield from _too_fast(joint, (end - start) / (time - before[0]), where)
        before = time, positions


def _too_fast(joint: JointPlan, speed: float, where: str) -> Iterator[str]:
    if abs(speed) > joint.highest_speed * (1 + _ROUNDING):
        own = joint.highest_speed != joint.velocity
        whose = "the top speed of its servo" if own else "its velocity limit"
        yield (
            f"{joint.name} is asked for {speed:.6g} rad/s{where}, more than {joint.highest_speed:.6g} rad/s, "
            f"{whose}"
        )


def _row(joints: Sequence[JointPlan], values: Mapping[str, object], name: str) -> Sequence[float]:
    """Return a field with one number a joint, else nothing."""
    row = values.get(name)
    if not isinstance(row, list | tuple) or len(row) != len(joints):
        return ()
    return row if all(isinstance(value, int | float) for value in row) else ()


def _value(sample: Sample, joint: str, quantity: Quantity) -> float:
    """Return one value; who is sent somewhere must be sent there completely."""
    target: Target | None = sample.targets.get(joint)
    value = None if target is None else target.get(quantity)
    if value is None:
        raise UnfitError(
            sample.mark if target is None else target.mark,
            f"{joint} has no target {quantity} at {sample.t_ns * 1e-9:g} s",
            f"give it one; every joint of the controller needs its {quantity}, here or, "
            "for a group controller, in a point before",
        )
    return value
