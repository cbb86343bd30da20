# ruff: noqa: E501 (a file and its sentence are read best side by side)
"""The page of robot files and the schema say what the program does; files of other programs are one sentence."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.kit import desk
from tests.kit.pages import page_text

from dxlrun.cli.examples import schema_text
from dxlrun.description.base_form import Form
from dxlrun.description.document import Marks
from dxlrun.description.joints.motor_file import read_motor
from dxlrun.description.mistakes.ros_types import ros_type
from dxlrun.description.motion import read_motion
from dxlrun.description.reading import read_robot
from dxlrun.description.robot import robot_form
from dxlrun.errors import InputError, Mark

PAGE = page_text("robot-file.md")
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
TABLES = set(re.findall(r"^<!-- keys: (\w+) -->$", PAGE, re.MULTILINE))
"""Sections whose tables docs/generate.py writes."""
WITHOUT_TABLE = {
    "Argument", "BareJoint", "Formula", "Group", "JointForm", "LoadForm", "MotionForm", "MotorForm", "PlugInEntry",
    "Point", "Processes", "Robot", "ServoEntry", "ServoJoint", "SharedJoint", "StribeckForm", "Target",
    "UncertaintyForm",
}  # fmt: skip
"""Forms that another table, or the text of the page, describes."""


def forms(kind: type[Form]) -> Iterator[type[Form]]:
    """Yield all forms of the program that are made of one."""
    for below in kind.__subclasses__():
        if below.__module__.startswith(("dxlrun.description.", "dxlrun.features.", "dxlrun_space.")):
            yield below
        yield from forms(below)


FORMS = {robot_form(), *forms(Form)}


def test_the_examples_of_the_page_are_read() -> None:
    robot, variant, groups, slide, shared, wrist, chain, motor, motion = EXAMPLES
    assert set(desk.robot(robot, {"port": "/dev/ttyUSB0"}).robot.joints) == {
        "head_pitch_joint",
        "head_yaw_joint",
    }
    desk.write(robot, "two_joints.yaml")
    assert (desk.robot(variant).robot.name, desk.robot(variant).robot.loop.rate) == ("two_joints_slow", 10)
    without = robot[: robot.index("controllers:")]
    assert desk.robot(without + chain).robot.controllers["arm"].into == ("arm_pid",)
    head = robot[: robot.index("joints:")]
    moved = {groups: "left_elbow", slide: "gripper", shared: "hip", wrist: "wrist_roll"}
    joints = [set(desk.robot(head + example).robot.joints) for example in moved]
    assert [joint in found for joint, found in zip(moved.values(), joints, strict=True)] == [True] * 4
    assert len(desk.motion(motion).motion.motions) == 2
    assert read_motor(desk.write(motor, "elbow.motor.yaml")).motor.p_gain == 32


def test_every_form_has_a_table_and_every_key_a_description_and_an_example() -> None:
    assert {one.__name__ for one in FORMS if one.model_fields} - WITHOUT_TABLE == TABLES - {"robot", "motor"}
    fields = [(one, key, field) for one in FORMS for key, field in one.model_fields.items()]
    assert [(one, key) for one, key, field in fields if not field.description] == []
    assert {key for _, key, field in fields if not field.examples} == {"parameters"}


@pytest.mark.parametrize(
    ("part", "key"),
    [
        ("Adapter", "latency"),
        ("Bus", "return_delay_time"),
        ("Policies", "on_returned_servo"),
        ("Policies", "exit_timeout"),
    ],
)
def test_a_default_of_the_schema_is_that_of_the_program(part: str, key: str) -> None:
    value = json.loads(schema_text("robot"))["$defs"][part]["properties"][key]["default"]
    written = {
        "Bus": ("57600", f"57600, {key}: {value}"),
        "Adapter": ("57600", f"57600, adapter: {{{key}: {value}}}"),
        "Policies": ("loop:", f"policies: {{{key}: {value}}}\nloop:"),
    }
    robot = (
        "name: x\nbuses:\n  m: {port: sim, protocol: 1.0, baud_rate: 57600}\nloop: {rate: 1}\n"
        "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
    )
    given = robot.replace(*written[part])
    assert given != robot
    assert desk.robot(given).robot == desk.robot(robot).robot


def test_marks_are_those_of_the_nearest_parent_that_is_in_the_file() -> None:
    at = {(): Mark("f", 2, 1), ("a",): Mark("f", 3, 3), ("a", 0): Mark("f", 3, 5)}
    marks = Marks("f", values=at, keys={("a",): Mark("f", 2, 1)})
    assert (marks.key("a"), marks.value("a")) == (Mark("f", 2, 1), Mark("f", 3, 3))
    assert marks.key("a", 0) == marks.value("a", 0) == Mark("f", 3, 5)  # an item of a list has only a value
    assert marks.value("a", 7, "x") == marks.key("nowhere") == Mark("f", 2, 1)
    assert Marks("f", {}, {}).value("a") == Mark("f", 1, 1)


CALIBRATION = (
    '{"pan": {"id": 1, "drive_mode": 0, "homing_offset": -1196, "range_min": 725, "range_max": 3449}}'
)
FOREIGN = [
    ("a.yaml", "robot: {type: omx_follower, port: /dev/ttyACM0}", "LeRobot; `dxlrun scan PORT --output"),
    ("a.yaml", "robot: {type: so101_follower, port: /dev/ttyACM0}", "LeRobot; use arms with Dynamixel servos"),
    ("a.yaml", "teleop: {type: koch_leader, port: x, id: y}", "LeRobot; `dxlrun examples koch`"),
    ("a.yaml", "type: koch_follower\nport: /dev/ttyACM0\ncameras: {}", "a configuration of LeRobot"),
    ("a.json", CALIBRATION, "a calibration of LeRobot; `dxlrun import a.json --type"),
    ("a.json", '{"homing_offset": [1], "drive_mode": [0], "motor_names": ["a"]}', "a calibration of LeRobot"),
    ("a.yaml", "/**:\n  controller_manager:\n    ros__parameters: {update_rate: 100}", "file of ROS 2"),
    ("a.yaml", "arm_controller:\n  ros__parameters: {joints: [a], buses: 3}", "file of ROS 2"),
    ("a.yaml", "arm: {pan: {type: effort_controllers/JointPositionController, joint: pan}}", "file of ROS"),
    ("a.json", '{"controllers": {"bus": {}}, "motorgroups": {}, "motors": {}}', "a configuration of pypot; `dxlrun import a.json --output robot.yaml`"),
    ("a.urdf", '<?xml version="1.0"?>\n<robot name="x"/>', "a URDF without servos"),
    ("a.urdf", '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="x"><xacro:arm/></robot>', "by `xacro a.urdf > a.urdf`"),
    ("a.mtn", "type=motion\nversion=1.01\npage_begin\nname=march\n", "a motion file of RoboPlus; `dxlrun import a.mtn --output robot.yaml`"),
    ("a.yaml", "pan: {ID: 1, Return_Delay_Time: 0}\ntilt: {ID: 2}", "dynamixel_workbench"),
    ("a.py", "# pan and tilt\nimport numpy as np\n", "a program in Python"),
    ("a.bag", "#ROSBAG V2.0\nE\0\0\0", "a ROS 1 bag; `rosbags-convert --src a.bag --dst a --dst-storage mcap`"),
    ("a.db3", "SQLite format 3\0x", "a ROS 2 bag in SQLite"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "said"), FOREIGN)
def test_a_file_of_another_program_is_one_problem_with_its_name(
    name: str, text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(text.encode())
    for read in (lambda path: read_robot(path, {}), read_motion):
        with pytest.raises(InputError) as caught:
            read(Path(name))
        (problem,) = caught.value.problems
        assert said in f"{problem.what}; {problem.fix}"
        assert problem.what.startswith("this ")
        assert "{path}" not in problem.fix
        assert "{{" not in problem.fix


def test_a_log_as_robot_file_names_the_verbs_for_logs(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n\x01" + bytes(8) + b"\4\0\0\0ros2\6\0\0\0dxlrun")
    with pytest.raises(InputError, match=r"a log of dxlrun; `dxlrun analyze .*a\.mcap`"):
        read_robot(tmp_path / "a.mcap", {})


@pytest.mark.parametrize(
    "text",
    [
        "name: a\nbuses: {}\nrobot_type: x",
        "name: a\njoints: {lower: {id: 1, bus: main}}",
        "controllers: {a: {type: ./wave.py:Wave}}",
        "joints: {a: {homing_offset: 1, id: 3}}",
    ],
)
def test_a_robot_file_with_foreign_words_is_read_as_robot_file(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_robot(tmp_path / "a.yaml", {})
    assert not any(problem.what.startswith("this ") for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("written", "fix"),
    [
        ("position_controllers/JointGroupPositionController", "write joint_group_position_controller"),
        ("imu_sensor_broadcaster/IMUSensorBroadcaster", "write imu_sensor_broadcaster"),
        ("position_controllers/GripperActionController", "write gripper_controller"),
        ("admittance_controller/AdmittanceController", "choose a type of dxlrun"),
    ],
)
def test_a_type_of_ros_is_answered_with_ours(written: str, fix: str) -> None:
    known = ("joint_group_position_controller", "imu_sensor_broadcaster", "gripper_controller")
    found = ros_type(written, known)
    assert found is not None
    assert found[0] == f"{written} is a type of ROS"
    assert found[1].startswith(fix)
    assert ros_type("./wave.py:Wave", known) is None
