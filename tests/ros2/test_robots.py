"""A base in a namespace and an arm with a gripper at once: neither gets what is for the other one."""

import signal
from typing import Any, NamedTuple

import pytest
from tests.kit import wire
from tests.kit.awaited import until
from tests.ros2.started import Foreign, Place, Robot, seconds

GRIPPER, GRIPPER_ID = "gripper", 15
GOAL_VELOCITY, WHEELS = 104, (1, 2)
ACTION = "control_msgs/action/GripperCommand"
REACHED_STATUS = 4


class Two(NamedTuple):
    """A base and an arm, each with its bridge."""

    place: Place
    base: Robot
    arm: Robot
    foreign: Foreign


@pytest.fixture(scope="module")
def two(place: Place) -> Two:
    base, arm = place.robot("diff_drive"), place.robot("open_manipulator_x")
    place.bridge("diff_drive", "--ros-args", "-r", "__ns:=/second")
    place.bridge("open_manipulator_x")
    foreign = place.foreign()
    for key, topic in {"base": "/second/joint_states", "arm": "/joint_states"}.items():
        foreign.do("hear", key, topic, "sensor_msgs/msg/JointState")
        foreign.do("heard", key)
    return Two(place, base, arm, foreign)


def velocities(robot: Robot, since: int) -> list[tuple[int, int]]:
    """Return the goal velocities that each wheel was sent, in units of the servo."""
    written = (one for sent in robot.sent(since) for one in wire.writes(sent, robot.bus.protocol))
    return [
        (servo, int.from_bytes(data[:4], "little", signed=True))
        for servo, address, data in written
        if address == GOAL_VELOCITY
    ]


def test_each_namespace_has_its_own_robot(two: Two) -> None:
    names = {
        key: {name for one in two.foreign.do("heard", key, 5)["messages"] for name in one["name"]}
        for key in ("base", "arm")
    }
    assert names["base"] == {"left_wheel", "right_wheel"}
    assert names["arm"] == {"joint1", "joint2", "joint3", "joint4", GRIPPER}
    managers = {"/second/controller_manager/list_controllers", "/controller_manager/list_controllers"}
    until(lambda: managers <= {*two.foreign.do("graph")}, "both managers")
    for topic, joint in {"/robot_description": "joint4", "/second/robot_description": "left_wheel"}.items():
        two.foreign.do("hear", topic, topic, "std_msgs/msg/String", True, True)
        assert joint in two.foreign.do("heard", topic)["messages"][0]["data"]


def test_twists_drive_the_base_until_their_publisher_is_gone(two: Two) -> None:
    odometry = next(name for name, kind in two.foreign.do("graph").items() if kind == "nav_msgs/msg/Odometry")
    assert odometry.startswith("/second/")
    two.foreign.do("hear", "odometry", odometry, "nav_msgs/msg/Odometry")
    driver = two.place.foreign("driver")
    kind = until(lambda: driver.do("graph").get("/second/base/cmd_vel"), "base/cmd_vel")
    twist: dict[str, Any] = {"linear": {"x": 0.1}, "angular": {"z": 0.0}}
    row = {"twist": twist} if kind.endswith("Stamped") else twist
    marks = two.base.mark(), two.arm.mark()
    driver.do("stream", "/second/base/cmd_vel", kind, [row], 0.05)
    until(
        lambda: {servo for servo, value in velocities(two.base, marks[0]) if value} == {*WHEELS},
        "turning wheels",
    )
    until(
        lambda: two.foreign.do("heard", "odometry")["messages"][-1]["pose"]["pose"]["position"]["x"] > 0.02,
        "a way forward",
    )
    driver.end(signal.SIGKILL)
    until(lambda: not any(dict(velocities(two.base, marks[0])).values()), "wheels that stand")
    assert two.arm.moved(marks[1]) == {}


def test_a_gripper_opens_by_its_action(two: Two) -> None:
    mark = two.arm.mark()
    act = ("act", "/gripper/gripper_cmd", ACTION)
    end = two.foreign.do(*act, {"command": {"position": 0.3, "max_effort": 0.0}})
    assert (end["status"], end["reached_goal"], end["stalled"]) == (REACHED_STATUS, True, False), end
    assert end["position"] == pytest.approx(0.3, abs=0.05)
    until(lambda: any(abs(one.position - 0.3) < 0.01 for one in two.arm.goals(mark)), "the goal of its servo")
    wrong = two.foreign.do(*act, {"command": {"position": 5.0, "max_effort": 0.0}})
    assert not wrong["accepted"] or wrong["status"] != REACHED_STATUS, wrong
    assert two.foreign.do(*act, {"command": {"position": 0.0, "max_effort": 0.2}})["reached_goal"]
    until(lambda: [one.position for one in two.arm.goals(mark)][-1] < 0.01, "a closed gripper")
    assert {one.joint for one in two.arm.goals(mark) if one.position > 0.1} == {GRIPPER}
    assert max(one.position for one in two.arm.goals(mark)) < 0.31


def test_a_servo_reboots_by_a_service(two: Two) -> None:
    mark, kind = two.arm.mark(), "std_srvs/srv/Trigger"
    switch = {"deactivate_controllers": ["arm"], "strictness": 2, "timeout": seconds(5.0)}
    words = "/controller_manager/switch_controller", "controller_manager_msgs/srv/SwitchController"
    assert (switched := two.foreign.do("call", *words, switch))["ok"], switched
    assert (answer := two.foreign.do("call", "/arm/reboot", kind, {}))["success"], answer["message"]
    rebooted = until(
        lambda: [one.servo_id for one in two.arm.sent(mark) if one.instruction == wire.REBOOT], "reboots"
    )
    assert {*rebooted} == {11, 12, 13, 14}
