"""Joints: the names of a controller's joints, parameters with one value for all of them or one for each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, Discriminator, Field, Tag, TypeAdapter

from dxlrun import Context, Floats, Goal, Mistake, Outcome, ParametersModel, States, nearest_turn

JointNames = Annotated[tuple[str, ...], Field(min_length=1)]
NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]

T = TypeVar("T")
CommandInterface = Literal["position", "posvel", "poseffort", "velocity", "effort", "pwm"]
"""Values of `command_interface`"""


def commanded_by(
    interface: CommandInterface,
) -> tuple[Literal["position", "velocity", "effort", "pwm"], ...]:
    """Return what is commanded of each joint."""
    match interface:
        case "posvel":
            return "position", "velocity"
        case "poseffort":
            return "position", "effort"
        case _:
            return (interface,)


def or_number(adapter: TypeAdapter[float]) -> BeforeValidator:
    """Let a field of a command accept text with a unit beside a bare number, which is in SI units."""
    return BeforeValidator(lambda value: adapter.validate_python(value) if isinstance(value, str) else value)


def _kind(value: object) -> str:
    return "<by joint>" if isinstance(value, Mapping) else "<all>"


PerJoint = Annotated[
    Annotated[T, Tag("<all>")] | Annotated[dict[str, T], Tag("<by joint>")], Discriminator(_kind)
]
"""One value for all joints, or a mapping of joints to values: `3.0` or `{shoulder: 3.0, elbow: 1.5}`."""


class JointsParameters(ParametersModel):
    """Base of parameters with `joints`; mappings by joint name only these joints."""

    joints: JointNames
    """The joints, in the order in which commands name them."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield the keys of mappings, and the joints that wrap, that are not among the joints."""
        yield from super().mistakes()
        for path, names in _names_of_joints(self, ()):
            for step, joint in names:
                if joint not in self.joints:
                    yield (*path, step), f"{joint} is {not_one_of(self.joints)}"


def not_one_of(joints: Sequence[str]) -> str:
    """Return the end of a sentence about a joint that a controller does not have, and the remedy."""
    return f"not one of its joints; they are {', '.join(joints)}"


def _names_of_joints(
    model: BaseModel, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Iterable[tuple[str | int, str]]]]:
    """Yield the paths of the keys that name joints, and the names with their steps below these."""
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
    """Return a PerJoint parameter as an array, shape (joints,); `default` where it is left out."""
    if isinstance(value, Mapping):
        return np.array([value.get(joint, default) for joint in joints])
    return np.full(len(joints), default if value is None else value)


def value_for(value: T | Mapping[str, T] | None, joint: str) -> T | None:
    """Return a PerJoint parameter's value for a joint; None where it is left out."""
    return value.get(joint) if isinstance(value, Mapping) else value


def finite_or(values: Floats, default: Floats | float) -> Floats:
    """Return a copy with `default` in place of NaN: a limit that there is not, a value that is not known."""
    return np.where(np.isnan(values), default, values)


def clamped(values: Floats, lower: Floats | float, upper: Floats | float) -> Floats:
    """Return values within bounds: in a third of the time of np.clip, which is written in Python."""
    bounded: Floats = np.minimum(np.maximum(values, lower), upper)
    return bounded


def check_size(what: str, found: int, joints: tuple[str, ...]) -> None:
    """Raise ValueError when a command does not have one value a joint."""
    if found != len(joints):
        raise ValueError(f"{found} {what} for {len(joints)} joints ({', '.join(joints)})")


def ends_unheard(goal: Goal, position: Floats, joints: tuple[str, ...]) -> bool:
    """Abort a goal that cannot begin, as the position of a joint is not known yet (NaN)."""
    unknown = np.isnan(position)
    if unknown.any():
        joint = joints[int(unknown.argmax())]
        goal.end(Outcome.ABORTED, f"joint {joint} has not answered yet", joint)
    return bool(unknown.any())


def take_shorter_way(positions: Floats, near: Floats, wrap: NDArray[np.bool_]) -> Floats:
    """Return positions with those of the joints of `wrap` at most half a turn from `near`, rad.

    They stay as they are where `near` is not known (NaN).
    """
    return np.where(wrap & np.isfinite(near), nearest_turn(positions, near), positions)


def take_shorter_way_from_goals(positions: Floats, context: Context) -> Floats:
    """Return positions by the shorter way from what was last sent, or from where the joints were read."""
    near = finite_or(context.goals.position, context.states.position)
    return take_shorter_way(positions, near, np.array(context.wrap))


def hold(context: Context) -> None:
    """Command what was last sent, or the position that was read where nothing was sent: nothing moves."""
    commands, goals = context.commands, context.goals
    np.copyto(commands.position, goals.position)
    np.copyto(commands.position, context.states.position, where=np.isnan(goals.position))
    if not context.into:  # for another controller it would be a velocity with its sign
        np.copyto(commands.velocity, goals.velocity)


def refer(reference: Floats, context: Context) -> None:
    """Take the positions that are commanded; where none is, the last one stays, or where the joint was heard.

    `reference` is NaN where there was none yet.
    """
    states, commanded = context.states, context.references.position
    np.copyto(reference, states.position, where=np.isnan(reference) & states.valid)
    np.copyto(reference, commanded, where=np.isfinite(commanded))


def take_where_heard(position: Floats, states: States) -> bool:
    """Write the measured positions over NaN, of joints that had not answered; return whether some still have
    not."""
    np.copyto(position, states.position, where=np.isnan(position))
    return bool(np.isnan(position).any())
