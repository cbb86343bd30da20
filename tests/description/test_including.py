# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Arguments and included files: values with their places. Mistakes: arguments.txt, included.txt."""

import functools
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit import desk
from tests.kit.cases import read_head
from tests.kit.desk import TORSO
from tests.kit.robots import CASES, robot_text

from dxlrun.description.document import KeyPath, confined, grow, literal, parse, read_file
from dxlrun.description.including import MOST_FILES, MOST_LEVELS, merged
from dxlrun.description.joints.groups import NAMING, without_groups
from dxlrun.description.motion import parse_motion
from dxlrun.description.reading import Description
from dxlrun.errors import Mark


def figures(description: Description) -> tuple[str, float]:
    """Return port and rate of the torso."""
    return description.robot.buses["main"].port, description.robot.loop.rate


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({}, ("sim", 50.0)),
        ({"port": "/dev/ttyUSB0", "rate": "62.5"}, ("/dev/ttyUSB0", 62.5)),
        ({"port": "5"}, ("5", 50.0)),  # the default is a text, so it stays one
        ({"port": "sim}\njoints: {evil: 1"}, ("sim}\njoints: {evil: 1", 50.0)),  # no structure is smuggled in
    ],
)
def test_arguments_are_put_in_and_defaults_count_until_then(
    given: dict[str, str], found: tuple[str, float]
) -> None:
    description = desk.robot(TORSO, given)
    assert figures(description) == found
    assert description.arguments == {"port": "sim", "rate": "50"} | given
    assert set(description.robot.joints) == {"swing", "elbow"}


@pytest.mark.parametrize(
    ("right", "wrong", "found"),
    [
        ("rate: ${rate}\n", 'rate: "${rate}"\n', ("sim", 100.0)),  # inside { } YAML itself asks for quotes
        ("rate: {default: 50, ", "rate: {", ("sim", 100.0)),
        ('"loop rate, Hz"', '"used as ${rate}"', ("sim", 100.0)),  # help may explain how it is written
        ('port: "${port}"', 'port: "$${a}/${port}"', ("${a}/sim", 100.0)),  # two dollars write one
        ('port: "${port}"', 'port: "/dev/tty${rate}"', ("/dev/tty100", 100.0)),  # inside a longer text
    ],
)
def test_use_of_an_argument(right: str, wrong: str, found: tuple[str, float]) -> None:
    assert right in TORSO
    assert figures(desk.robot(TORSO.replace(right, wrong), {"rate": "100"})) == found


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rate": "fast"}, ["robot.yaml:8:9: loop.rate: 'fast' is not a rate (argument rate:=fast); write a rate such as 50, 50 Hz or 1 kHz"]),
        ({"prot": "sim", "x": "1"}, ["command line: argument prot:=sim is not declared in the robot file; did you mean port?", "command line: argument x:=1 is not declared in the robot file; known arguments: port, rate"]),
    ],
)  # fmt: skip
def test_wrong_argument_is_reported_where_it_is(given: dict[str, str], said: list[str]) -> None:
    assert desk.refusals(TORSO, given) == said


def test_without_a_block_there_are_no_arguments() -> None:
    first, second, *_ = desk.refusals("name: x\nloop: {rate: '${rate}'}\n", {"rate": "1"})
    assert first.startswith("command line: argument rate:=1 is not declared in the robot file; remove it")
    assert "has no" in second


HEAD = read_head(CASES / "included.txt").partition("---- head.yaml\n")[2]


@pytest.fixture
def including() -> str:
    (Path.cwd() / "fragments").mkdir()
    desk.write(HEAD, "fragments/head.yaml")
    return f"include: [fragments/head.yaml]\n{TORSO}"


def test_a_fragment_adds_its_keys_before_those_of_the_file(including: str) -> None:
    robot = desk.robot(including).robot
    assert list(robot.joints) == ["yaw", "swing", "elbow"]
    assert list(robot.controllers) == ["head", "broadcaster", "arm"]
    assert robot.joints["yaw"].limits.velocity == 1.0


def test_arguments_of_fragments_are_arguments_of_the_robot(including: str) -> None:
    description = desk.robot(including, {"speed": "2 rad/s"})
    assert description.robot.joints["yaw"].limits.velocity == 2.0
    assert description.arguments == {"speed": "2 rad/s", "port": "sim", "rate": "50"}
    assert description.robot.buses["main"].port == "sim"  # the including file's default counts


def test_the_including_file_wins_at_every_depth_but_replaces_lists(including: str) -> None:
    text = including.replace("joints:\n", "joints:\n  yaw: {id: 7, limits: {position: [-1 rad, 1 rad]}}\n", 1)
    text = text.replace("controllers:\n", "controllers:\n  head: {joints: [swing]}\n")
    description = desk.robot(text)
    joint, marks = description.robot.joints["yaw"], description.marks
    assert (joint.id, joint.bus, joint.model) == (7, "main", "AX-12A")
    assert (joint.limits.position, joint.limits.velocity) == ((-1.0, 1.0), 1.0)
    assert description.robot.controllers["head"].parameters == {"joints": ["swing"]}
    main, fragment = str(Path.cwd() / "robot.yaml"), str(Path.cwd() / "fragments/head.yaml")
    assert marks.value("joints", "yaw", "id") == Mark(main, 12, 13)
    assert marks.value("joints", "yaw", "model") == Mark(fragment, 5, 35)
    assert marks.origins["joints", "yaw", "limits", "velocity"] == "speed:=1 rad/s"
    assert marks.origins["loop", "rate"] == "rate:=50"
    assert marks.value("controllers", "head", "joints", 0) == Mark(
        main, 16, 19
    )  # that of the fragment is gone


def test_what_the_fragment_got_wrong_and_the_file_replaced_is_no_mistake_of_form(including: str) -> None:
    desk.write(HEAD.replace("id: 21", "id: x"), "fragments/head.yaml")
    robot = desk.robot(including.replace("joints:\n", "joints:\n  yaw: {id: 7}\n", 1)).robot
    assert robot.joints["yaw"].id == 7


def test_fragments_include_relative_to_themselves_and_later_ones_win() -> None:
    (Path.cwd() / "a").mkdir()
    desk.write("loop: {rate: 10}\ninclude: [b.yaml]\n", "a/a.yaml")
    desk.write("loop: {rate: 20, scheduler: {priority: 5}}\n", "a/b.yaml")
    desk.write("recording: {directory: c}\n", "c.yaml")
    text = (
        TORSO.split("loop:", maxsplit=1)[0]
        + "include: [a/a.yaml, c.yaml]\njoints:"
        + TORSO.split("joints:", 1)[1]
    )
    text = text.replace("recording: {directory: elsewhere}\n", "")
    description = desk.robot(text.replace("rate: 25", "rate: 5"))
    assert (description.robot.loop.rate, description.robot.loop.scheduler.priority) == (10, 5)
    assert description.robot.recording.directory == "c"
    assert [Path(name).name for name in description.included] == ["b.yaml", "a.yaml", "c.yaml"]


def test_a_fragment_that_two_files_include_counts_below_both() -> None:
    desk.write("recording: {directory: shared}\n", "shared.yaml")
    desk.write("include: [shared.yaml]\nrecording: {directory: left}\n", "left.yaml")
    desk.write("include: [shared.yaml]\n", "right.yaml")
    text = TORSO.replace("recording: {directory: elsewhere}", "include: [left.yaml, right.yaml]")
    assert desk.robot(text).robot.recording.directory == "left"


def test_depth_number_and_size_are_bounded() -> None:
    for number in range(MOST_LEVELS + 1):
        desk.write(f"include: [deep{number + 1}.yaml]\n", f"deep{number}.yaml")
    desk.write("{}", f"deep{MOST_LEVELS + 1}.yaml")
    names = [f"wide{number}.yaml" for number in range(MOST_FILES + 1)]
    for name in names:
        desk.write("{}", name)
    for name in ("large1.yaml", "large2.yaml"):
        desk.write("#" * 600_000 + "\n{}", name)
    for includes, expected in (
        (["deep0.yaml"], f"nested deeper than {MOST_LEVELS} files; include deep7.yaml in the robot file"),
        (names, f"more than {MOST_FILES} files are included; merge some of them"),
        (
            ["large1.yaml", "large2.yaml"],
            "with large2.yaml the robot file is larger than 1024 KiB; shorten one of its files",
        ),
    ):
        problems = desk.refusals(f"include: [{', '.join(includes)}]\n{TORSO}")
        assert any(problem.endswith(expected) for problem in problems), problems


def test_fragment_that_is_a_directory_is_named_at_the_include() -> None:
    (Path.cwd() / "folder.yaml").mkdir()
    said = "robot.yaml:1:11: folder.yaml: this is a directory; name a YAML file"
    assert desk.refusals(f"include: [folder.yaml]\n{TORSO}") == [said]


@pytest.mark.parametrize("way", ["../secret.yaml", "inner/../../secret.yaml", "link.yaml"])
def test_file_outside_of_the_permitted_folder_is_not_read(way: str) -> None:
    folder = Path.cwd() / "robot"
    (folder / "inner").mkdir(parents=True)
    desk.write("loop: {rate: 10}\n", "secret.yaml")
    (folder / "link.yaml").symlink_to(Path.cwd() / "secret.yaml")
    (folder / "own.yaml").write_text("loop: {rate: 10}\n")
    with confined(folder):
        assert read_file(folder / "inner/../own.yaml")
        with pytest.raises(PermissionError, match="outside the permitted folder"):
            read_file(folder / way)


KEYS = st.sampled_from(["a", "b", "c"])
DOCUMENTS = st.dictionaries(
    KEYS, st.recursive(st.integers(0, 9), lambda below: st.dictionaries(KEYS, below), max_leaves=6)
)


def laid_over(low: dict[str, Any], high: dict[str, Any]) -> dict[str, Any]:
    both = {
        key: laid_over(low[key], high[key])
        for key in low.keys() & high.keys()
        if isinstance(low[key], dict) and isinstance(high[key], dict)
    }
    return low | high | both


def leaves(value: object, path: KeyPath = ()) -> dict[KeyPath, object]:
    if not isinstance(value, dict) or not value:
        return {path: value}
    return {k: v for key, below in value.items() for k, v in leaves(below, (*path, key)).items()}


@settings(max_examples=150, deadline=None)
@given(st.lists(DOCUMENTS, min_size=1, max_size=4))
def test_merging_is_deep_and_each_value_keeps_the_mark_of_its_file(documents: list[dict[str, Any]]) -> None:
    grown = [grow(parse(json.dumps(each), str(n)), str(n), literal) for n, each in enumerate(documents)]
    result = merged(grown)
    assert result.data == functools.reduce(laid_over, documents)
    for path, value in leaves(result.data).items():
        file = int(result.marks.value(*path).file)
        assert leaves(documents[file])[path] == value
        assert not any(path in leaves(later) for later in documents[file + 1 :])
    places = {path[:end] for path in leaves(result.data) for end in range(len(path) + 1)}
    assert set(result.marks.values) == places  # none of what was replaced
    assert set(result.marks.keys) == set(result.marks.values) - {()}


ROBOT = robot_text("shared")


def test_joints_have_what_they_share() -> None:
    robot = desk.robot(ROBOT).robot
    assert list(robot.joints) == ["knee", "shoulder", "elbow"]  # the order of `joints`, which is that of rows
    assert [joint.bus for joint in robot.joints.values()] == ["right", "left", "left"]
    assert [joint.direction for joint in robot.joints.values()] == [-1, 1, -1]
    assert robot.joints["shoulder"].limits.position == (-1.0, 1.0)
    assert {joint.limits.velocity for joint in robot.joints.values()} == {2.0}
    assert [joint.registers for joint in robot.joints.values()] == [
        {"position_p_gain": 800, "position_d_gain": 0},
        {"position_p_gain": 700, "position_d_gain": 5},
        {"position_p_gain": 700, "position_d_gain": 0},
    ]


def test_a_group_stands_for_its_joints_wherever_they_are_named() -> None:
    description = desk.robot(ROBOT)
    robot = description.robot
    assert description.groups == {
        "left": ("shoulder", "elbow"),
        "right": ("knee",),
        "body": ("shoulder", "elbow", "knee"),
    }
    assert robot.controllers["all_joints"].parameters == {"joints": ["knee", "shoulder", "elbow"]}
    home = robot.poses["home"]
    assert home == {"shoulder": 0.0, "knee": 0.0, "elbow": 1.0}
    groups = {name: group.joints for name, group in robot.policies.groups.items()}
    assert groups == {"left": ("shoulder", "elbow"), "other": ("knee",)}
    steps = [{"pose": {"left": 0, "knee": 1}, "torque": {"body": 2}}]
    assert without_groups({"steps": steps, "into": ["left"]}, description.groups) == {
        "steps": [
            {"pose": {"shoulder": 0, "elbow": 0, "knee": 1}, "torque": {"shoulder": 2, "elbow": 2, "knee": 2}}
        ],
        "into": ["left"],  # a controller of that name
    }
    assert set(NAMING) == {"joints", "pose", "torque"}


def test_values_keep_their_places() -> None:
    description = desk.robot(ROBOT)
    file, marks = str(description.path), description.marks
    assert marks.key("joints", "knee", "model") == Mark(file, 5, 3)
    assert marks.value("joints", "elbow", "registers", "position_p_gain") == Mark(file, 11, 50)
    assert marks.value("joints", "shoulder", "registers", "position_d_gain") == Mark(file, 16, 87)
    assert marks.value("controllers", "all_joints", "joints", 0) == Mark(file, 19, 64)
    assert marks.value("controllers", "all_joints", "joints", 2) == Mark(file, 19, 70)
    turned = desk.robot(ROBOT.replace("[knee, left]", "[left, knee]")).marks  # one behind a group
    columns = [turned.value("controllers", "all_joints", "joints", index).column for index in range(3)]
    assert columns == [64, 64, 70]
    assert marks.key("poses", "home", "knee") == Mark(file, 21, 10)
    assert marks.key("poses", "home", "elbow") == Mark(file, 21, 23)


def test_motions_name_groups() -> None:
    groups = desk.robot(ROBOT).groups
    text = (
        "name: m\nmotions:\n- controller: all_joints\n  points:\n"
        "  - {time: 1 s, joints: {left: {position: 0 rad}, knee: {position: 1 rad}}}\n"
    )
    motion = parse_motion(text, Path("m.yaml"), groups)
    assert list(motion.motion.motions[0].points[0].joints) == ["shoulder", "elbow", "knee"]
    where = motion.marks.key("motions", 0, "points", 0, "joints", "elbow")
    assert where == Mark("m.yaml", 5, 26)


def test_a_joint_of_a_transmission_gets_no_keys_of_a_servo() -> None:
    wrist = """\
  pitch: {}
  roll: {}
transmissions:
  wrist:
    type: differential
    joints: [hand]
    servos:
      a: {bus: left, id: 8, model: XL430-W250, reference: 180 deg, direction: 1}
      b: {bus: left, id: 9, model: XL430-W250, reference: 180 deg, direction: -1}
controllers:"""
    text = ROBOT.replace("controllers:", wrist).replace(
        "groups:\n", "groups:\n  hand: {bus: left, joints: [pitch, roll]}\n", 1
    )
    robot = desk.robot(text).robot
    assert robot.joints["pitch"].limits.velocity == 2.0
    assert not hasattr(robot.joints["pitch"], "bus")


def test_fragments_share_groups() -> None:
    desk.write(ROBOT, "pair.yaml")
    robot = desk.robot(
        "include: [pair.yaml]\ngroups: {left: {joints: [elbow]}}\njoint_defaults: {model: XL430-W250}\njoints: {shoulder: {bus: right}}\n"
    ).robot
    assert robot.groups["left"].joints == ("elbow",)
    assert {joint.model for joint in robot.joints.values()} == {"XL430-W250"}
    assert robot.controllers["all_joints"].parameters == {"joints": ["knee", "elbow"]}
