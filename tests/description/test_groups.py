# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Groups and defaults: put into the joints and into what names joints, with the places where they stand."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit import desk

from dxlrun.description.joints.groups import NAMING, without_groups
from dxlrun.description.motion import motion_of
from dxlrun.description.reading import read_robot
from dxlrun.errors import Mark

ROBOT = """\
name: pair
buses: {left: {port: sim, protocol: 2.0, baud_rate: 57600}, right: {port: sim, protocol: 2.0, baud_rate: 57600}}
loop: {rate: 50}
joint_defaults:
  model: XM430-W350
  reference: 180 deg
  direction: 1
  limits: {velocity: 2 rad/s}
  registers: {position_p_gain: 800, position_d_gain: 0}
groups:
  left: {bus: left, registers: {position_p_gain: 700}, joints: [shoulder, elbow]}
  right: {bus: right, direction: -1, joints: [knee]}
  body: {joints: [left, right]}
joints:
  knee: {id: 3}
  shoulder: {id: 1, limits: {position: [-1 rad, 1 rad]}, registers: {position_d_gain: 5}}
  elbow: {id: 2, direction: -1}
controllers:
  all_joints: {type: joint_group_position_controller, joints: [knee, left]}
poses:
  home: {body: 0 rad, elbow: 1 rad}
policies:
  groups: {left: {on_lost_servo: limp}, other: {joints: [right]}}
"""


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
            {
                "pose": {"shoulder": 0, "elbow": 0, "knee": 1},
                "torque": {"shoulder": 2, "elbow": 2, "knee": 2},
            }
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
    motion = motion_of(text, Path("m.yaml"), groups)

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


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("reference: 180 deg", "reference: §180", "joints.knee.reference: 180 has no unit (and 2 joints more); write an angle"),
        ("velocity: 2 rad/s", "§velocitty: 2 rad/s", "joints.knee.limits has an unknown key 'velocitty' (and 2 joints more); did you mean velocity?"),
        ("700}, joints", "700, gain: §{}}, joints", "joints.shoulder.registers.gain: this is no value of a register (and 1 joint more)"),
        ("right: {bus: right", "right: {bus: §5", "joints.knee.bus is 5, but must be text"),
        ("joints: [knee]", "joints: [knee, §ebow]", "group right has joint ebow, which is not defined; did you mean elbow?"),
        ("right: {bus: right, direction: -1, joints: [knee]", "right: {bus: §right, direction: -1, joints: [knee, elbow]", "elbow gets bus the text 'right' from group right, but the text 'left' from left"),
        ("joints: [knee]", "joints: [knee, §body]", "the group right contains itself (right -> body -> right); take one of these names out"),
        ("right: {bus: right", "§knee: {bus: right", "knee is the name of a group, and means a joint already; call the group otherwise"),
        ("body: {joints: [left, right]}", "body: {joints: [left, right]}\n  §all: {joints: [knee]}", "all is the name of a group, and means every joint already"),
        ("body: {joints: [left, right]}", "body: {joints: [left, right]}\n  §none: {bus: left}", "groups.none has no joints; add `joints: [left_shoulder, left_elbow]`"),
        ("body: {joints: [left, right]}", "body: {joints: [left, right]}\n  none: §[knee]", "groups.none is a list, but must be a mapping"),
        ("body: {joints: [left, right]}", "body: {joints: [left, right]}\n  §2nd: {joints: [knee]}", "groups.2nd: '2nd' is no name"),
        ("body: 0 rad", "left: 0 rad, §body: 0 rad", "poses.home has shoulder twice, in the groups left and body; write shoulder by itself too: that counts"),
        ("left: {on_lost_servo: limp}", "left: {§joints: [knee]}", "left is a group of the robot, whose joints it has; take joints out"),
    ],
)  # fmt: skip
def test_each_mistake_is_named_once_where_it_stands(right: str, wrong: str, expected: str) -> None:
    text, place = desk.pointed(ROBOT, right, wrong)
    problems = desk.refusals(text)

    assert [one for one in problems if one.startswith(f"robot.yaml:{place}: {expected}")], problems
    assert len(problems) == {"§knee: {bus: right": 3, "joints: [knee, §body]": 2}.get(
        wrong, 1
    )  # with what follows


def test_an_own_value_ends_a_disagreement_of_groups() -> None:
    both = ROBOT.replace("joints: [knee]", "joints: [knee, elbow]")
    (problem,) = desk.refusals(
        both.replace("elbow: {id: 2", "elbow: {bus: left, id: 2")
        .replace("direction: -1, j", "model: XL430-W250, j")
        .replace("left: {bus", "left: {model: AX-12A, bus")
    )

    assert problem == (
        "robot.yaml:12:30: elbow gets model the text 'XL430-W250' from group right, but the text 'AX-12A' from left; "
        "give elbow its own, or let one group alone give it"
    )
    assert (
        desk.robot(both.replace("elbow: {id: 2", "elbow: {bus: left, id: 2")).robot.joints["elbow"].bus
        == "left"
    )


def test_fragments_share_groups() -> None:
    desk.write(ROBOT, "pair.yaml")
    robot = desk.robot(
        "include: [pair.yaml]\ngroups: {left: {joints: [elbow]}}\njoint_defaults: {model: XL430-W250}\njoints: {shoulder: {bus: right}}\n"
    ).robot

    assert robot.groups["left"].joints == ("elbow",)
    assert {joint.model for joint in robot.joints.values()} == {"XL430-W250"}
    assert robot.controllers["all_joints"].parameters == {"joints": ["knee", "elbow"]}


def test_merge_keys_are_one_message() -> None:
    text = (
        ROBOT.replace("knee: {id: 3}", "knee: &k {id: 3}")
        .replace("{id: 2, ", "{<<: *k, id: 2, ")
        .replace("{id: 1, ", "{<<: *k, ")
    )

    assert desk.refusals(text) == [
        "robot.yaml:16:14: the merge key << is not YAML 1.2 (and 1 more of it); write what joints share into "
        "joint_defaults or groups, and parts of files into an include"
    ]


def test_wolfgangs_servos_have_their_registers() -> None:
    robot = read_robot(Path(__file__).parents[2] / "robots/wolfgang.yaml", {}).robot
    gains = {joint.registers["position_p_gain"] for joint in robot.joints.values()}

    assert {len(joint.registers) for joint in robot.joints.values()} == {12}
    assert (gains, robot.joints["RKnee"].registers["position_p_gain"]) == ({500, 800, 1200, 4000}, 4000)
    assert robot.joints["LKnee"].bus == "left_leg"
    assert (robot.joints["LKnee"].model, robot.joints["LHipYaw"].model) == ("XH540-W270", "MX-106")
