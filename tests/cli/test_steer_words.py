"""What is said of the verbs for a robot that runs when none does, and how their words are read."""

from __future__ import annotations

from pathlib import Path

import pytest

from dxlrun.cli.steering.robots import command, controllers, headline, state
from dxlrun.cli.steering.written import Written, is_played

NOBODY = "dxlrun: no robot runs that could be steered; `dxlrun ROBOT.yaml` starts one"


@pytest.fixture
def nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer on which no robot runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


# Nobody runs


@pytest.mark.parametrize(
    "words",
    [
        ("pause",),
        ("resume",),
        ("stop",),
        ("rate", "100"),
        ("switch", "--activate", "head"),
        ("send", "head", "posvel", "positions=[0 deg]"),
        ("load", "spare", "type=joint_state_broadcaster"),
        ("unload", "spare"),
    ],
)
def test_without_a_robot_a_verb_says_how_to_start_one(dxlrun, nobody: None, words: tuple[str, ...]) -> None:
    assert dxlrun(*words) == (1, "", NOBODY + "\n")


def test_a_list_of_no_robots_is_no_failure(dxlrun, nobody: None) -> None:
    assert dxlrun("list") == (0, NOBODY.removeprefix("dxlrun: ") + "\n", "")
    assert dxlrun("list", "--json") == (0, "[]\n", "")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("switch",), "nothing to switch; write --activate NAME, --deactivate NAME, or both"),
        (("rate", "0"), "0 is no rate; give a number of Hz above 0"),
        (("rate", "nan"), "nan is no rate; give a number of Hz above 0"),
        (("rate", "inf"), "inf is no rate; give a number of Hz above 0"),
        (("send", "head", "posvel", "fast"), "'fast' says nothing; write key=value, such as"),
        (("send", "head", "posvel", "p q=1"), "'p q=1' says nothing; write key=value"),
        (("send", "head", "posvel", "a=[1"), "a comma is missing, or a bracket"),
        (("send", "head", "posvel", "a=1", "a=2"), "a was already given"),
        (("send", "head", "posvel", "a=1", "--file", "f.yaml"), "'a=1' and --file say two things"),
        (("load", "spare", "joints=[a]"), "spare has no type; give it one, such as type="),
        (("list", "--robot", "torso"), "no robot torso runs; there is none"),
    ],
)
def test_wrong_words_are_said_without_a_robot(dxlrun, nobody: None, words, sentence) -> None:
    said = dxlrun(*words)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("dxlrun: ")
    assert sentence in said.err


def test_a_wrong_file_is_said_with_its_places(dxlrun, nobody: None, tmp_path: Path) -> None:
    file = tmp_path / "look.yaml"
    file.write_text("positions: [1 deg]\npositions: [2 deg]\n")
    said = dxlrun("send", "head", "posvel", "--file", file)
    assert (said.code, said.errors) == (
        2, [f"{file}:2:1: positions was already given in line 1; keep one of the two"],
    )  # fmt: skip
    said = dxlrun("load", "spare", "--file", tmp_path / "none.yaml")
    assert (said.code, said.errors) == (
        2, [f"{tmp_path}/none.yaml:1:1: there is no such file; check the path; it counts from here"],
    )  # fmt: skip


# What is written


def test_quantities_become_si() -> None:
    words = ["points=[{time: 500 ms, positions: [180 deg, -1 rad], velocities: [60 deg/s, 30 rpm]}]"]
    assert Written.read([*words, "start_in=1 min"], None).in_si() == {
        "points": [
            {
                "time": 0.5,
                "positions": [pytest.approx(3.14159265), -1.0],
                "velocities": [pytest.approx(1.04719755), pytest.approx(3.14159265)],
            }
        ],
        "start_in": 60.0,
    }


def test_what_is_no_quantity_stays_as_it_was_written() -> None:
    words = ["label=30 deg", "count=3", "loud=true", "empty=", "positions=[null]"]
    assert Written.read(words, None).in_si() == {
        "label": "30 deg", "count": 3, "loud": True, "empty": None, "positions": [None],
    }  # fmt: skip


def test_efforts_and_pwm_are_numbers_and_text_there_is_explained() -> None:
    assert Written.read(["positions=[0 deg]", "efforts=[0.1]"], None).in_si() == {
        "positions": [0.0], "efforts": [0.1],
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"efforts.*'100 mA' is text; write the number in what the model"):
        Written.read(["efforts=[100 mA]"], None).in_si()
    with pytest.raises(ValueError, match=r"pwm.*'20 %' is text; write the fraction of the full voltage"):
        Written.read(["pwm=[20 %]"], None).in_si()


def test_every_missing_unit_is_said_at_its_place(tmp_path: Path) -> None:
    file = tmp_path / "step.yaml"
    file.write_text("positions:\n  - 30\n  - 1 rad/s\nvelocities: [true]\n")
    with pytest.raises(ValueError, match="has no unit") as raised:
        Written.read((), file).in_si()
    assert str(raised.value).splitlines() == [
        f"{file}:2:5: positions[0]: 30 has no unit; write an angle with its unit, such as 60 deg or 1.05 rad",
        f"{file}:3:5: positions[1]: '1 rad/s' has the unit rad/s, which is not one of an angle; "
        "write it as 60 deg or 1.05 rad",
        f"{file}:4:14: velocities[0]: this is not an angular velocity; "
        "write an angular velocity such as 2 rad/s, 30 deg/s or 5 rpm",
    ]


@pytest.mark.parametrize(
    ("kind", "keys", "played"),
    [
        ("positions", ("positions",), True),
        ("posvel", ("positions", "velocities"), True),
        ("trajectory", ("points", "start_in"), True),
        ("grip", ("positions", "force"), False),
        ("speeds", ("velocities",), True),
        ("poseffort", ("positions", "efforts"), True),
        ("pwm", ("pwm",), True),
        ("reset", (), False),
    ],
)
def test_only_what_standard_controllers_take_needs_units(
    kind: str, keys: tuple[str, ...], played: bool
) -> None:
    assert is_played(kind, {"properties": {key: {} for key in keys}}) is played


# What is listed


def test_a_list_says_how_a_robot_is() -> None:
    info = {"name": "arm", "rate": 320.0, "paused": True, "cycles": 7, "skipped": 1, "log": "logs/arm.mcap"}
    assert headline(info) == "arm: 320 Hz, paused, 7 cycles, 1 period skipped, log logs/arm.mcap"
    info |= {"paused": False, "skipped": 0, "log": None}
    assert headline(info) == "arm: 320 Hz, 7 cycles, 0 periods skipped, no log"
    assert [state({"active": a, "held": h}) for a, h in ((True, False), (True, True), (False, False))] == [
        "active", "held", "inactive",
    ]  # fmt: skip
    assert command("go", {"properties": {"a": {}, "b": {}}, "required": ["a"]}) == "go: a, [b]"
    assert command("reset", {}) == "reset"


@pytest.mark.parametrize("width", [20, 60, 200])
def test_no_name_is_broken_on_a_narrow_terminal(width: int) -> None:
    joints = [f"a_rather_long_name_of_joint_{number}" for number in range(8)]
    arm = {"name": "arm", "active": True, "held": False, "rate": 50.0, "takes": {}, "joints": joints}
    head = {**arm, "name": "head", "command": (), "takes": {"go": {}, "stop": {}}}
    first, below, second = controllers({"controllers": [arm | {"command": ("position",)}, head]}, width)
    assert (first, second) == ("  arm   active        50 Hz", "  head  active        50 Hz  go; stop")
    assert below.split() == ["moves", *", ".join(joints).split()]
    assert max(map(len, below.splitlines())) < max(width, 45)
