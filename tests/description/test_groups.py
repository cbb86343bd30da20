# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Groups and defaults: put into the joints and into what names joints, with the places where they stand."""

from __future__ import annotations

from pathlib import Path

from tests.kit import desk
from tests.kit.robots import robot_text

from dxlrun.description.joints.groups import NAMING, without_groups
from dxlrun.description.motion import parse_motion
from dxlrun.errors import Mark

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
