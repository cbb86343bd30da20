# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Robot files: places, values that replace others, and problems in our words; values: torso.txt."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.description.document import KeyPath, Marks, grow, literal, parse
from dxlrun.description.form_problems import problems_of
from dxlrun.description.reading import Replacement, read_robot
from dxlrun.errors import Mark, near, suggestion


def test_the_text_and_the_places_are_kept() -> None:
    description = desk.robot(TORSO)
    assert description.text == TORSO
    file = str(description.path)
    assert description.marks.key("joints", "elbow") == Mark(file, 12, 3)
    assert description.marks.value("controllers", "arm", "joints", 1) == Mark(file, 15, 64)
    assert description.marks.value("joints", "elbow", "limits", "position") == Mark(file, 12, 3)


TEXT = """name: one
arguments:
  rate: {default: 50}
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}
loop: {rate: "${rate}"}
joints:
  joint:
    {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: [-90 deg, 90 deg]}}
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.yaml").write_text(TEXT)
    return Path("robot.yaml")


def test_a_value_is_replaced_in_a_mapping_in_a_list_and_where_an_argument_stands(robot: Path) -> None:
    replacements = [
        Replacement(("joints", "joint", "limits", "position", 1), "1 rad"),
        Replacement(("loop", "rate"), 80),
        Replacement(("joints", "joint", "registers", "d_gain"), 8),  # the file has none
    ]
    found, untouched = read_robot(robot, {}, replacements).robot, read_robot(robot, {}).robot
    assert found.joints["joint"].limits.position == (pytest.approx(-1.5707963267948966), 1.0)
    assert found.joints["joint"].registers == {"d_gain": 8}
    assert (found.loop.rate, untouched.loop.rate) == (80.0, 50.0)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (("loop", "rate"), -1, "robot.yaml:6:14: loop.rate is -1, but must be at least 0.001; write for"),
        (("joints", "joint", "limits", "position", 1), "1", "robot.yaml:9:102: joints.joint.limits.position"),
        (("joints", "joint", "limits", "speed"), 1, "robot.yaml:9:73: joints.joint.limits has an unknown"),
        (("joints", "joint", "simulation", "inertia"), 1, "robot.yaml:8:3: joints.joint.simulation.inertia"),
    ],
)
def test_what_is_wrong_with_it_is_reported_at_its_place(
    robot: Path, place: KeyPath, value: object, problem: str
) -> None:
    (found,) = desk.caught(lambda: read_robot(robot, {}, [Replacement(place, value)]))
    assert found.startswith(problem)


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
        ("{joints: [a], period: 2 s}", ["f:2:30: controllers.arm.period is the text '2 s', but must be a number or auto; write the number without a unit"]),
        ("{joints: [a], period: fast}", ["f:2:30: controllers.arm.period is the text 'fast', but must be a number or auto; write a number without quotes"]),
        ("{joints: [a], shape: 5}", ["f:2:29: controllers.arm.shape is 5, but must be a mapping or a list; write `shape: {p: 5}`"]),
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
