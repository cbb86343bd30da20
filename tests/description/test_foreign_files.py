# ruff: noqa: E501 (a file and its sentence are read best side by side)
"""Files of other programs that are given as robot files, or for other files: one sentence each."""

from __future__ import annotations

from pathlib import Path

import pytest

from dxlrun.description.mistakes.ros_types import ros_type
from dxlrun.description.motion import read_motion
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError

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
