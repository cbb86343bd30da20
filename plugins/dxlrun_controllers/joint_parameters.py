"""Joints: parameters with one value for all joints or one per joint, and helpers for arrays of joint
values.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, TypeAdapter

from dxlrun import Context, Floats, Goal, Mistake, Outcome, ParametersModel, States, nearest_turn

JointNames = Annotated[tuple[str, ...], Field(min_length=1, examples=["[shoulder, elbow]"])]
NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]

T = TypeVar("T")
CommandInterface = Literal["position", "posvel", "poseffort", "velocity", "effort", "pwm"]
"""Values of the key `command_interface`."""


def commanded_by(
    interface: CommandInterface,
) -> tuple[Literal["position", "velocity", "effort", "pwm"], ...]:
    """Return the interfaces that a value of `command_interface` commands on each joint."""
    match interface:
        case "posvel":
            return "position", "velocity"
        case "poseffort":
            return "position", "effort"
        case _:
            return (interface,)


def or_number(quantity: object) -> BeforeValidator:
    """Return a validator that converts a text with a unit of `quantity` to SI; a number is SI already."""
    # Most runs get no text with a unit, and each validator takes time to build.
    adapter: TypeAdapter[float] = TypeAdapter(
        cast("type[float]", quantity), config=ConfigDict(defer_build=True)
    )
    return BeforeValidator(lambda value: adapter.validate_python(value) if isinstance(value, str) else value)


def _kind(value: object) -> str:
    return "<by joint>" if isinstance(value, Mapping) else "<all>"


PerJoint = Annotated[
    Annotated[T, Tag("<all>")] | Annotated[dict[str, T], Tag("<by joint>")], Discriminator(_kind)
]
"""One value for all joints, or a mapping of joints to values: `3.0` or `{shoulder: 3.0, elbow: 1.5}`."""


class JointsParameters(ParametersModel):
    """Base class of parameters with `joints`; mappings by joint may only name these joints."""

    joints: JointNames
    """Joints of the controller. Commands list their values in this order."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield each name in a mapping by joint or in `wrap` that is not a joint of the controller."""
        yield from super().mistakes()
        for path, names in _names_of_joints(self, ()):
            for step, joint in names:
                if joint not in self.joints:
                    yield (*path, step), f"{joint} is {not_one_of(self.joints)}"


def not_one_of(joints: Sequence[str]) -> str:
    """Return the end of an error message about an unknown joint: the joints that the controller has."""
    return f"not one of its joints; they are {', '.join(joints)}"


def _names_of_joints(
    model: BaseModel, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Iterable[tuple[str | int, str]]]]:
    """Yield the path of each key that names joints, with pairs of the step below that key and the name."""
    for name, value in model:
        if isinstance(value, BaseModel):
            yield from _names_of_joints(value, (*path, name))
        elif isinstance(value, Mapping):
            yield (*path, name), ((joint, joint) for joint in value)
        elif (*path, name) == ("wrap",):
            yield (*path, name), enumerate(value)


def row_of(
    value: float | Mapping[str, float] | None, joints: tuple[str, ...], default: float = np.inf
) -> Floats:
    """Return a PerJoint parameter as an array, shape (joints,). Joints without a value get `default`."""
    if isinstance(value, Mapping):
        return np.array([value.get(joint, default) for joint in joints])
    return np.full(len(joints), default if value is None else value)


def value_for(value: T | Mapping[str, T] | None, joint: str) -> T | None:
    """Return the value that a PerJoint parameter has for a joint, or None if it has none."""
    return value.get(joint) if isinstance(value, Mapping) else value


def finite_or(values: Floats, default: Floats | float) -> Floats:
    """Return a copy of `values` with NaN, which marks a missing limit or an unknown value, replaced by
    `default`.
    """
    return np.where(np.isnan(values), default, values)


def clamped(values: Floats, lower: Floats | float, upper: Floats | float) -> Floats:
    """Return the values clamped to bounds, as np.clip does, in a third of its time."""
    bounded: Floats = np.minimum(np.maximum(values, lower), upper)
    return bounded


def check_size(what: str, found: int, joints: tuple[str, ...]) -> None:
    """Raise ValueError if a command has not exactly one value per joint; `what` names the values."""
    if found != len(joints):
        raise ValueError(f"{found} {what} for {len(joints)} joints ({', '.join(joints)})")


def ends_unheard(goal: Goal, position: Floats, joints: tuple[str, ...]) -> bool:
    """Abort a goal if the position of a joint is still unknown (NaN). Return True if it was aborted."""
    unknown = np.isnan(position)
    if unknown.any():
        joint = joints[int(unknown.argmax())]
        goal.end(Outcome.ABORTED, f"joint {joint} has not answered yet", joint)
    return bool(unknown.any())


def take_shorter_way(positions: Floats, near: Floats, wrap: NDArray[np.bool_]) -> Floats:
    """Return positions with those of wrapping joints shifted by whole turns, to within half a turn of `near`.

    Args:
        positions: rad, shape (joints,).
        near: rad, shape (joints,). A joint with NaN keeps its position.
        wrap: True for each joint that may be shifted.
    """
    return np.where(wrap & np.isfinite(near), nearest_turn(positions, near), positions)


def take_shorter_way_from_goals(positions: Floats, context: Context) -> Floats:
    """Return positions with those of wrapping joints shifted to the turn nearest to the last goal.

    A joint without a goal takes the turn nearest to its measured position.
    """
    near = finite_or(context.goals.position, context.states.position)
    return take_shorter_way(positions, near, np.array(context.wrap))


def hold_joints(context: Context) -> None:
    """Command the last goals, so that no joint moves. Joints without a goal get their measured position."""
    commands, goals = context.commands, context.goals
    np.copyto(commands.position, goals.position)
    np.copyto(commands.position, context.states.position, where=np.isnan(goals.position))
    if not context.into:  # for another controller it would be a velocity with its sign
        np.copyto(commands.velocity, goals.velocity)


def refer(reference: Floats, context: Context) -> None:
    """Update `reference` (rad, one row per joint) with the positions that other controllers command.

    A joint without a command keeps its last reference. A joint that has never had one (NaN) starts at its
    measured position.
    """
    states, commanded = context.states, context.references.position
    np.copyto(reference, states.position, where=np.isnan(reference) & states.valid)
    np.copyto(reference, commanded, where=np.isfinite(commanded))


def take_where_heard(position: Floats, states: States) -> bool:
    """Replace NaN in `position` by measured positions; return True while a joint has not answered yet."""
    np.copyto(position, states.position, where=np.isnan(position))
    return bool(np.isnan(position).any())
