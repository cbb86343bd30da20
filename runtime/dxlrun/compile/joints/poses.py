"""Poses: converts names of poses, and poses in the form of a feature, into positions of joints.

Files, and commands of clients, find their poses here.

A class declares each field that can have a name by `NAMED_POSE`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from types import UnionType
from typing import Annotated, Final, Union, get_args, get_origin

import msgspec
from msgspec.structs import replace
from pydantic import BaseModel, ValidationError

from dxlrun.contract.named_pose import NAMED_POSE
from dxlrun.description.base_form import Mistakes, ParametersModel
from dxlrun.description.document import KeyPath
from dxlrun.description.form_problems import data_problems
from dxlrun.description.robot import pose_stages
from dxlrun.errors import suggestion, what_and_fix
from dxlrun.features.feature import SolvedPose
from dxlrun.plan.loop_plan import JointPlan

_MOST_MISTAKES: Final = 5
_EACH: Final = -1
"""Step of a path to every entry of a list or mapping."""


class WrongPose(ValueError):
    """Raised for a pose without positions of joints.

    Args:
        problems: Path of a key in the pose, the problem and the fix; none if the mistake is already reported.
        lacking: Joint that the pose needs, and that the run does not have.
    """

    def __init__(self, *problems: tuple[KeyPath, str, str], lacking: str = "") -> None:
        super().__init__("; ".join(f"{what}; {fix}" for _, what, fix in problems))
        self.problems, self.lacking = problems, lacking


class Poses(msgspec.Struct, frozen=True):
    """Poses of a robot: those with names, and those that features solve."""

    named: Mapping[str, SolvedPose] = {}
    joints: Mapping[str, JointPlan] = {}
    omitted: Sequence[str] = ()
    """Joints and groups that the run omits."""
    urdf: str | None = None
    """Text of the robot's URDF."""
    has_mistakes: bool = False
    """True if a joint or the URDF has a mistake, which is reported; features solve no poses then."""
    mistaken: Collection[str] = ()
    """Poses with a mistake, which is reported."""

    def find_pose(self, written: object) -> SolvedPose | None:
        """Return the pose with a name, or a pose in the form of a feature; None: neither.

        Raises:
            WrongPose: The name is unknown, a joint of the pose is omitted, or a feature refuses the pose.
        """
        if isinstance(written, str):
            return self.find_named(written)
        if not isinstance(written, Mapping) or written.keys() <= self.joints.keys():
            return None
        for stage in pose_stages():
            if stage.name in written:
                try:
                    return self.solve_pose(stage.form.model_validate(written))
                except ValidationError as error:
                    found = data_problems(error, "the pose", stage.form, _MOST_MISTAKES)
                    raise WrongPose(*(((), problem.what, problem.fix) for problem in found)) from None
        return None

    def solve_pose(self, pose: BaseModel) -> SolvedPose:
        """Return a pose in the form of a feature; raise WrongPose as `find_pose`."""
        if self.has_mistakes:
            raise WrongPose
        stage = next(one for one in pose_stages() if isinstance(pose, one.form))
        limits = {name: (joint.lower, joint.upper) for name, joint in self.joints.items()}
        try:
            solved = stage.solve(pose, self.urdf, limits)
        except Mistakes as error:
            raise WrongPose(*((path, *what_and_fix(text)) for path, text in error.found)) from None
        if joint := solved.lacking:
            what = f"the pose needs {joint}, which is omitted or has no servo"
            fix = f"run with {joint}, or add it to `joints`"
            raise WrongPose(((stage.name,), what, fix), lacking=joint)
        return solved

    def find_named(self, name: str) -> SolvedPose:
        """Return the pose with a name; raise WrongPose as `find_pose`."""
        if (pose := self.named.get(name)) and pose.positions:
            own = {joint: at for joint, at in pose.positions.items() if joint in self.joints}
            return replace(pose, positions=own)
        if name in self.mistaken:
            raise WrongPose
        if name in self.named:
            joints = ", ".join(self.omitted)
            what = f"pose {name} needs a joint that is omitted ({joints})"
            raise WrongPose(((), what, f"run with {joints}"))
        known = [each for each, pose in self.named.items() if pose.positions]
        fix = suggestion(name, known) if known else "add it to `poses` of the robot file"
        raise WrongPose(((), f"the robot has no pose {name}", fix))

    def put_in(
        self, written: object, model: type[BaseModel]
    ) -> tuple[object, list[tuple[KeyPath, str, str]]]:
        """Return a command or parameters with positions of joints in place of poses, and the mistakes.

        A wrong pose becomes one without joints. Parameters get texts with units, commands the data of a
        `JointPose`. Each mistake is the path of the pose, the problem and the fix.
        """
        wrong: list[tuple[KeyPath, str, str]] = []

        def put_positions(value: object, at: KeyPath) -> object:
            try:
                found = self.find_pose(value)
            except WrongPose as error:
                wrong.extend(((*at, *path), what, fix) for path, what, fix in error.problems)
                return {}
            if found is None:
                return value
            if not issubclass(model, ParametersModel):
                return {"positions": found.positions, "remark": found.remark}
            own = found.positions.items()
            return {joint: f"{float(at)!r} {self.joints[joint].unit.si}" for joint, at in own}

        for place in pose_places(model):
            written = _replaced(written, place, (), put_positions)
        return written, wrong


@cache
def pose_places(model: type[BaseModel]) -> tuple[KeyPath, ...]:
    """Return the paths of all poses in the data of a model."""
    return tuple(_places(model, ()))


def _places(kind: object, above: tuple[object, ...]) -> Iterator[KeyPath]:
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        yield from [()] if NAMED_POSE in args else _places(args[0], above)
    elif origin is not None:
        step = () if origin in {Union, UnionType} else (_EACH,)
        yield from ((*step, *place) for each in args for place in _places(each, above))
    elif isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in above:
        for key, field in kind.model_fields.items():
            own = NAMED_POSE in field.metadata
            yield from (
                (key, *place) for place in ([()] if own else _places(field.annotation, (*above, kind)))
            )


def _replaced(value: object, place: KeyPath, at: KeyPath, put: Callable[[object, KeyPath], object]) -> object:
    """Return a value in which `put` has replaced all values at a place; `at` is the path of the value."""
    if not place:
        return put(value, at)
    step, rest = place[0], place[1:]
    if isinstance(value, list):
        return [_replaced(item, rest, (*at, index), put) for index, item in enumerate(value)]
    if not isinstance(value, dict):
        return value
    return {
        key: _replaced(item, rest, (*at, key), put) if step in {key, _EACH} else item
        for key, item in value.items()
    }
