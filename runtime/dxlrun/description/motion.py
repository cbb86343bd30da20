"""Motion: the form of a motion file, and its reader."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Self

import msgspec
from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from dxlrun.description.arguments import refuse_arguments
from dxlrun.description.base_form import Form, Name, key, validation_error
from dxlrun.description.document import Marks, grow, parse, read_text, refusal
from dxlrun.description.form_problems import read_form
from dxlrun.description.joints.groups import NO_GROUPS, Groups, put_in
from dxlrun.description.joints.omitted import without_joints
from dxlrun.description.other_files import foreign_named
from dxlrun.description.units import Acceleration, Duration, Measure, Position, Speed


def _expression(value: object) -> object:
    # A constant is a formula, too, and YAML has read it as a number.
    return repr(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Expression = Annotated[
    str, BeforeValidator(_expression, json_schema_input_type=str | float), Field(min_length=1)
]
"""Formula of the time t in s since the start of the part, as text; `compile` evaluates it."""


class JointForm(Form):
    """Form of a joint's motion, with its position among other keys."""

    @model_validator(mode="before")
    @classmethod
    def _has_keys(cls, value: object) -> object:
        # The values of a pose are written like that.
        if isinstance(value, str | int | float):
            raise validation_error("the position has no key", f"write {{position: {value}}}")
        return value


class Target(JointForm):
    """Form of a joint's goal at one point: position, velocity and acceleration, one of which is required."""

    position: Position | None = key(
        "Position of the joint: an angle, or a length for a linear joint.", "30 deg", None
    )
    velocity: Speed | None = key("Velocity of the joint at the point.", "1 rad/s", None)
    acceleration: Acceleration | None = key("Acceleration of the joint at the point.", "0 rad/s^2", None)

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.position is None and self.velocity is None and self.acceleration is None:
            raise validation_error("the target is empty", "give it a position, as in {position: 30 deg}")
        return self

    @property
    def quantities(self) -> tuple[Measure | None, Measure | None, Measure | None]:
        """Position, velocity and acceleration, each None if the file does not give it."""
        return self.position, self.velocity, self.acceleration


class Point(Form):
    """Form of a point of a motion: a time, and goals of some joints."""

    time: Duration = key("Time since the start of the part.", "1 s")
    joints: dict[Name, Target] = key("Targets by joint.", "{head_joint: {position: 30 deg}}", {})
    pose: str | dict[str, object] | None = key(
        "Pose for the joints that `joints` does not name: a name of the robot file, positions by joint, or a "
        "pose of a link as in `poses`.",
        "rest",
        None,
    )

    @model_validator(mode="after")
    def _moves_something(self) -> Self:
        if not self.joints and self.pose is None:
            raise validation_error("the point has no targets", "add joints, or a pose")
        return self


class Formula(JointForm):
    """Form of one joint's motion as formulas of t, s."""

    position: Expression = key(
        "Position as a formula of t: rad, or m for a linear joint.", "0.5 * sin(2 * t)"
    )
    velocity: Expression | None = key(
        "Velocity as a formula of t: rad/s, or m/s for a linear joint.", "cos(2 * t)", None
    )
    acceleration: Expression | None = key(
        "Acceleration as a formula of t: rad/s^2, or m/s^2 for a linear joint.", "-2 * sin(2 * t)", None
    )


class PointsPart(Form):
    """Form of a part of a motion that lists points, for one controller."""

    refused: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("duration", "samples", "joints"),
        "write either points, or duration, samples and joints",
    )

    controller: str = key("Name of the controller.", "head", min_length=1)
    start: Duration = key("Start of the part, as time since the first cycle of the loop.", "1 s", 0)
    points: Annotated[tuple[Point, ...], Field(strict=False)] = key(
        "Points in ascending order of time.", "[{time: 0 s, joints: ...}]", min_length=1
    )


class FormulaPart(Form):
    """Form of a part of a motion with formulas, for one controller; they are sampled before the run."""

    controller: str = key("Name of the controller.", "head", min_length=1)
    start: Duration = key("Start of the part, as time since the first cycle of the loop.", "1 s", 0)
    duration: Annotated[Duration, Field(gt=0)] = key("Duration of the part.", "20 s")
    samples: int = key(
        "Number of points, with one at the start and one at the end of the part.", "500", ge=2, le=1_000_000
    )
    joints: dict[Name, Formula] = key("Formulas by joint.", "{head_joint: {position: sin(t)}}", min_length=1)


def _kind(part: object) -> str:
    if isinstance(part, dict):
        points = "points" in part or part.keys().isdisjoint(PointsPart.refused)
    else:
        points = not isinstance(part, FormulaPart)
    return "<points>" if points else "<formulas>"  # not a possible key, so an error's location is unambiguous


Part = Annotated[
    Annotated[PointsPart, Tag("<points>")] | Annotated[FormulaPart, Tag("<formulas>")], Discriminator(_kind)
]
"""Part of a motion file, with points or with formulas."""


class MotionForm(Form):
    """Form of a motion file: a name, and parts for one or more controllers."""

    refused: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("controller", "start", "points", *PointsPart.refused),
        "write it in a part: `motions: [{controller: head, points: [...]}]`",
    )

    name: Name = key("Name of the motion.", "three_parts")
    motions: Annotated[tuple[Part, ...], Field(strict=False)] = key(
        "Parts of the motion, each for one controller.", "[{controller: head, ...}]", min_length=1
    )

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names of the controllers that play the motion, each once."""
        return tuple(dict.fromkeys(part.controller for part in self.motions))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that the motion moves, each once."""
        named = (
            part.joints
            if isinstance(part, FormulaPart)
            else [joint for point in part.points for joint in point.joints]
            for part in self.motions
        )
        return tuple(dict.fromkeys(joint for joints in named for joint in joints))

    @property
    def seconds(self) -> float:
        """Duration of the motion, s: from its start to its last target."""
        ends = (
            part.start + (part.duration if isinstance(part, FormulaPart) else part.points[-1].time)
            for part in self.motions
        )
        return max(ends) * 1e-9


class MotionDescription(msgspec.Struct, frozen=True):
    """A motion file that was read: its contents, its text, and the places of its values."""

    motion: MotionForm
    marks: Marks
    path: Path
    text: str  # text as read
    without: tuple[str, ...] = ()  # joints and groups in the file that the run omits


def read_motion(path: Path, groups: Groups = NO_GROUPS, omitted: Collection[str] = ()) -> MotionDescription:
    """Read a motion file, replace its group names by joints; raise InputError with all mistakes.

    `omitted` are joints that the motion is played without.
    """
    with foreign_named(path):
        text = read_text(path)
    return parse_motion(text, path, groups, omitted)


def parse_motion(
    text: str, path: Path, groups: Groups = NO_GROUPS, omitted: Collection[str] = ()
) -> MotionDescription:
    """Parse the text of a motion file; `path` is for messages. Raises InputError with all mistakes."""
    with foreign_named(path, text):
        return _parsed_motion(text, path, groups, omitted)


def _parsed_motion(text: str, path: Path, groups: Groups, omitted: Collection[str]) -> MotionDescription:
    file = str(path)
    grown = put_in(grow(parse(text, file), file, refuse_arguments), groups)
    if "motions" not in grown.data and {"buses", "joints"} & grown.data.keys():
        fix = f"run it with `dxlrun {path}`, and give --play a motion file"
        raise refusal(grown.marks.value(), "this is a robot file, not a motion", fix)
    grown, without = without_joints(grown, omitted)
    return MotionDescription(read_form(grown, MotionForm), grown.marks, path, text, without)
