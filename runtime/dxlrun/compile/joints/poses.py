"""Poses: converts the names of poses into positions of joints, for files and for commands of clients.

A class declares each field that can have a name by `NAMED_POSE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from types import UnionType
from typing import Annotated, Final, Union, get_args, get_origin

import msgspec
from pydantic import BaseModel

from dxlrun.contract.controller import NAMED_POSE
from dxlrun.description.base_form import ParametersModel
from dxlrun.description.document import KeyPath
from dxlrun.errors import suggestion, what_and_fix
from dxlrun.plan.loop_plan import JointPlan

_EACH: Final = -1
"""Step of a path to every entry of a list or mapping."""


class WrongPose(ValueError):
    """Raised for a pose without positions of joints, as text `problem; fix`."""


class Poses(msgspec.Struct, frozen=True):
    """Poses of a robot by name."""

    named: Mapping[str, Mapping[str, float]] = {}
    """Positions of joints, rad or m; empty: the pose needs a joint that the run omits."""
    joints: Mapping[str, JointPlan] = {}
    omitted: Sequence[str] = ()
    """Joints and groups that the run omits."""

    def find_positions(self, name: str) -> Mapping[str, float]:
        """Return the positions of a pose; raise WrongPose if it is unknown, or needs an omitted joint."""
        if positions := self.named.get(name):
            return {joint: at for joint, at in positions.items() if joint in self.joints}
        if name in self.named:
            joints = ", ".join(self.omitted)
            raise WrongPose(f"pose {name} needs a joint that is omitted ({joints}); run with {joints}")
        known = [each for each, positions in self.named.items() if positions]
        fix = suggestion(name, known) if known else "add it to `poses` of the robot file"
        raise WrongPose(f"the robot has no pose {name}; {fix}")

    def put_in(
        self, written: object, model: type[BaseModel]
    ) -> tuple[object, list[tuple[KeyPath, str, str]]]:
        """Return a command or parameters with positions in place of names, and the mistakes.

        A wrong name becomes a pose without joints. Parameters get texts with units, commands numbers in SI.
        Each mistake is the path of the name, the problem and the fix.
        """
        wrong: list[tuple[KeyPath, str, str]] = []

        def put_positions(value: object, at: KeyPath) -> object:
            if not isinstance(value, str):
                return value
            try:
                found = self.find_positions(value)
            except WrongPose as error:
                wrong.append((at, *what_and_fix(error)))
                return {}
            if not issubclass(model, ParametersModel):
                return found
            return {joint: f"{float(value)!r} {self.joints[joint].unit.si}" for joint, value in found.items()}

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
