# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from dxlrun.description.document import Marks, grow, literal, parse
from dxlrun.description.form_problems import problems_of
from dxlrun.errors import near, suggestion


class Gains(BaseModel):
    model_config = ConfigDict(extra="forbid")

    p: float = Field(ge=0)
    i: float = 0.0


class Parameters(BaseModel):
    """A third-party controller's parameters: not strict, with unions and a validator of its own."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    joints: Annotated[list[str], Field(min_length=1)]
    gains: dict[str, Gains] = {}
    period: float | Literal["auto"] = "auto"
    shape: Gains | list[int] | None = None
    code: str = Field(default="ab", pattern="^[a-z]+$", max_length=4)

    @field_validator("joints")
    @classmethod
    def _different(cls, joints: list[str]) -> list[str]:
        if len(set(joints)) < len(joints):
            raise ValueError("a joint is listed twice; list each once")
        return joints


def problems(text: str, *, model: type[BaseModel] | None = Parameters) -> list[str]:
    """Return what is found in a controller's entry that stands below `controllers: {arm: ...}`."""
    grown = grow(parse(f"controllers:\n  arm: {text}\n", "f"), "f", literal)
    data = grown.data["controllers"]["arm"]  # type: ignore[index]  # the text above has both
    with pytest.raises(ValidationError) as caught:
        Parameters.model_validate(data)
    return [
        str(problem)
        for problem in problems_of(caught.value, grown.marks, ("controllers", "arm"), model=model)
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{}", ["f:2:3: controllers.arm has no joints; add `joints: ...`"]),
        ("{joints: [a, a]}", ["f:2:17: controllers.arm.joints: a joint is listed twice; list each once"]),
        ("{joints: [a], gains: {a: {p: -1}}}", ["f:2:37: controllers.arm.gains.a.p is -1, but must be at least 0; correct it"]),
        ("{joints: [a], gains: {a: {p: 1, d: 2}}}", ["f:2:40: controllers.arm.gains.a has an unknown key 'd'; remove it; known keys: p, i"]),
        ("{joints: [a], period: fast}", ["f:2:30: controllers.arm.period is the text 'fast', but must be a number or auto; write a number without quotes"]),
        ("{joints: [a], shape: 5}", ["f:2:29: controllers.arm.shape is 5, but must be a mapping or a list; write `key: value` lines below it, or {key: value, ...} after it"]),
        ("{joints: [a], code: A1}", ["f:2:28: controllers.arm.code is the text 'A1', but must match ^[a-z]+$; correct it"]),
        ("{joints: [a], code: abcde}", ["f:2:28: controllers.arm.code is too long; write at most 4 characters"]),
    ],
)  # fmt: skip
def test_findings_of_a_plug_ins_model_are_said_in_our_words(text: str, expected: list[str]) -> None:
    assert problems(text) == expected


def test_without_the_model_there_is_no_suggestion() -> None:
    assert problems("{joints: [a], gain: 1}", model=None) == [
        "f:2:22: controllers.arm has an unknown key 'gain'; remove it"
    ]


def test_an_unknown_kind_of_error_still_has_a_place() -> None:
    class Odd(BaseModel):
        when: Annotated[str, Field(pattern="^x")] | None = None
        where: complex = 0j

    grown = grow(parse("where: {}\n", "f"), "f", literal)
    with pytest.raises(ValidationError) as caught:
        Odd.model_validate(grown.data)
    (problem,) = problems_of(caught.value, grown.marks, model=Odd)
    assert str(problem).startswith("f:1:8: where: ")


def test_data_without_a_file_is_reported_at_its_top() -> None:
    with pytest.raises(ValidationError) as caught:
        Gains.model_validate({"p": "x"})
    (problem,) = problems_of(caught.value, Marks("f", {}, {}), model=Gains)
    assert (problem.mark.line, problem.mark.column) == (1, 1)


JOINTS = (
    "left_ankle_pitch", "left_ankle_roll", "left_elbow", "left_wrist", "right_elbow", "front_left_hip", "LKnee",
    "joint_1", "joint_2", "head_yaw_joint", "pan",
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("left_arm", ()),  # an ankle has the same side and a word of three letters in common with it
        ("left_ankle", ("left_ankle_pitch", "left_ankle_roll")),
        ("head_yaw", ("head_yaw_joint",)),
        ("elbow_left", ("left_elbow",)),
        ("elbow", ()),  # of either side
        ("Left-Elbow", ("left_elbow",)),
        ("letf_elbwo", ("left_elbow",)),
        ("letf_elbwoo", ()),  # three slips
        ("right_wrist", ()),
        ("rear_left_hip", ()),
        ("RKnee", ()),
        ("LKne", ("LKnee",)),
        ("joint_7", ()),
        ("jiont_2", ("joint_2",)),
        ("pn", ()),
        ("pam", ("pan",)),
        ("yaw", ()),  # two letters of three are another word
    ],
)
def test_near_names_are_slips_and_never_another_limb(name: str, meant: tuple[str, ...]) -> None:
    assert near(name, JOINTS) == meant
    answer = suggestion(name, JOINTS, "all: known")
    assert answer == (f"did you mean {' or '.join(meant)}?" if meant else "all: known")


def test_many_names_as_near_are_none() -> None:
    assert near("armx", ("arma", "armb", "armc", "armd")) == ()
    assert suggestion("x", ()) == "there is none"
