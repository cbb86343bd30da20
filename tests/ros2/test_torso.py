"""The torso by foreign ROS programs, as ros2_control's clients are written; judged by the servos' ledger."""

import math
import signal
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.kit.awaited import until
from tests.ros2.started import ROBOTS, Foreign, Place, Robot, seconds

import dxlrun

LEFT = ["left_shoulder_swing_joint", "left_shoulder_lateral_joint", "left_elbow_joint"]
RIGHT = ["right_shoulder_swing_joint", "right_shoulder_lateral_joint", "right_elbow_joint"]
BODY = [*LEFT, *RIGHT, "head_pitch_joint", "head_yaw_joint"]
ELBOW = LEFT[2]
HOME, AWAY, LAST = [-1.2, 0.2, 0.3], [-0.8, 0.4, -0.3], [-1.0, 0.0, 0.5]
TICK = math.radians(300) / 1023
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Of action_msgs/msg/GoalStatus"""
PATH_TOLERANCE, GOAL_TOLERANCE, INVALID = -4, -5, {(ABORTED, -1), (ABORTED, -2)}
"""Of control_msgs/action/FollowJointTrajectory"""
STRICT = 2
"""Of controller_manager_msgs/srv/SwitchController"""
Message = Mapping[str, Any]


class Torso(NamedTuple):
    """A torso with its bridge, and a foreign program that looks and commands."""

    place: Place
    robot: Robot
    foreign: Foreign

    def follow(self, goal: Message, cancel_after: int | None = None, by: Foreign | None = None) -> Any:
        return (by or self.foreign).do("act", *arm(goal), cancel_after)

    def say(self, message: Message) -> None:
        """Publish a trajectory of the left arm."""
        self.foreign.do("say", "/left_arm/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", message)

    def now(self) -> dict[str, float]:
        since = self.foreign.do("count", "states")
        newest = self.foreign.do("heard", "states", 1, since)["messages"][-1]
        return dict(zip(newest["name"], newest["position"], strict=True))

    def home(self) -> int:
        """Bring the left arm home, and return where the ledger is then."""
        mark = self.robot.mark()
        end = self.follow(goal(LEFT, (1.0, HOME)))
        assert (end["status"], end["error_code"]) == (SUCCEEDED, 0), end["error_string"]
        self.robot.held(mark)
        return self.robot.mark()

    def cm(self, service: str, **fields: Any) -> Any:
        """Call a service of the controller manager."""
        kind = "".join(word.title() for word in service.split("_"))
        return self.foreign.do(
            "call", f"/controller_manager/{service}", f"controller_manager_msgs/srv/{kind}", fields
        )

    def states(self) -> dict[str, str]:
        return {one["name"]: one["state"] for one in self.cm("list_controllers")["controller"]}

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> bool:
        words = {"activate_controllers": activate, "deactivate_controllers": deactivate}
        return bool(self.cm("switch_controller", **words, strictness=STRICT, timeout=seconds(5.0))["ok"])


def trajectory(joints: Sequence[str], *points: tuple[float, Sequence[float]]) -> dict[str, Any]:
    rows = [{"positions": list(where), "time_from_start": seconds(at)} for at, where in points]
    return {"joint_names": list(joints), "points": rows}


def goal(joints: Sequence[str], *points: tuple[float, Sequence[float]], **fields: Any) -> dict[str, Any]:
    return {"trajectory": trajectory(joints, *points), **fields}


def arm(goal: Message) -> tuple[str, str, Message]:
    return "/left_arm/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory", goal


LONG = goal(LEFT, (40.0, [0.0, 0.2, 1.5]))


@pytest.fixture(scope="module")
def torso(place: Place) -> Iterator[Torso]:
    robot = place.robot("bioloid_torso")
    place.bridge("bioloid_torso")
    foreign = place.foreign()
    foreign.do("hear", "states", "/joint_states", "sensor_msgs/msg/JointState")
    foreign.do("heard", "states")
    return Torso(place, robot, foreign)


# What comes out


def test_a_late_joiner_gets_what_does_not_change(torso: Torso) -> None:
    latched = {"/robot_description": "std_msgs/msg/String", "/tf_static": "tf2_msgs/msg/TFMessage"}
    for topic, kind in latched.items():
        assert torso.foreign.do("qos", topic) == [[True, True]], topic
        torso.foreign.do("hear", topic, topic, kind, True, True)
    (description,) = torso.foreign.do("heard", "/robot_description")["messages"]
    assert description["data"] == (ROBOTS / "urdf/bioloid_torso.urdf").read_text()
    still = torso.foreign.do("heard", "/tf_static")["messages"][0]["transforms"]
    assert {one["child_frame_id"] for one in still} >= {"odom", "imu", "base_link", "torso_link"}


def test_joint_states_come_to_reliable_and_best_effort_subscribers(torso: Torso) -> None:
    assert torso.foreign.do("qos", "/joint_states") == [[True, False]]
    torso.foreign.do("hear", "best", "/joint_states", "sensor_msgs/msg/JointState", False)
    (*_, newest) = torso.foreign.do("heard", "best", 10)["messages"]
    assert sorted(newest["name"]) == sorted(BODY)
    assert all(len(newest[field]) == len(BODY) for field in ("position", "velocity", "effort"))
    for topic, kind in {"/tf": "tf2_msgs/msg/TFMessage", "/rosout": "rcl_interfaces/msg/Log"}.items():
        assert torso.foreign.do("graph")[topic] == kind
    torso.foreign.do("hear", "diagnostics", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    assert torso.foreign.do("heard", "diagnostics")["messages"][0]["status"]


# Trajectories


def test_a_whole_trajectory_moves_the_arm_and_reports_how_it_goes(torso: Torso) -> None:
    mark = torso.home()
    order = [LEFT[2], LEFT[0], LEFT[1]]  # another one than the controller's
    points = (0.6, AWAY), (1.0, AWAY), (1.6, LAST)
    end = torso.follow(goal(order, *((at, [row[2], row[0], row[1]]) for at, row in points)))
    assert (end["accepted"], end["status"], end["error_code"]) == (True, SUCCEEDED, 0), end
    goals = torso.robot.held(mark)
    for joint, via, last in zip(LEFT, AWAY, LAST, strict=True):
        assert goals[joint][-1] == pytest.approx(last, abs=TICK)
        assert min(abs(each - via) for each in goals[joint]) < TICK
    assert all(len(set(goals.get(joint, []))) <= 1 for joint in {*BODY} - {*LEFT})
    feedback = end["feedback"]
    assert feedback
    for one in feedback:
        assert sorted(one["joint_names"]) == sorted(LEFT)
        desired, actual, error = (np.array(one[key]["positions"]) for key in ("desired", "actual", "error"))
        assert error == pytest.approx(desired - actual, abs=1e-6)
    assert len({tuple(one["desired"]["positions"]) for one in feedback}) > 1


def test_a_trajectory_of_some_joints_leaves_the_others(torso: Torso) -> None:
    mark = torso.home()
    end = torso.follow(goal([ELBOW], (0.5, [-0.2])))
    assert end["status"] == SUCCEEDED, end
    torso.say(trajectory(LEFT[:1], (0.5, [-1.0])))
    until(lambda: any(abs(one.position + 1.0) < TICK for one in torso.robot.goals(mark)), "the topic's goal")
    goals = torso.robot.held(mark)
    assert [goals[joint][-1] for joint in (LEFT[0], ELBOW)] == pytest.approx([-1.0, -0.2], abs=TICK)
    assert all(len(set(goals.get(joint, []))) <= 1 for joint in {*BODY} - {LEFT[0], ELBOW})


@pytest.mark.parametrize("empty", [{}, {"joint_names": LEFT}], ids=["nothing", "joints"])
def test_an_empty_trajectory_stops_in_place(torso: Torso, empty: Message) -> None:
    mark = torso.home()
    torso.say(LONG["trajectory"])
    until(lambda: torso.robot.moved(mark), "motion")
    torso.say(empty)
    goals = torso.robot.held(mark)
    assert HOME[0] < goals[LEFT[0]][-1] < -0.1
    assert HOME[2] < goals[ELBOW][-1] < 1.4


WRONG = {
    "unknown joint": goal(["left_knee_joint"], (1.0, [0.5])),
    "joint of another arm": goal([*LEFT, RIGHT[0]], (1.0, [*AWAY, 0.0])),
    "too few positions": goal(LEFT, (1.0, AWAY[:2])),
    "NaN": goal(LEFT, (1.0, [math.nan, 0.4, -0.3])),
    "times that fall": goal(LEFT, (1.0, AWAY), (0.5, HOME)),
    "beyond a limit": goal(LEFT, (2.0, [*AWAY[:2], 3.0])),
}


def test_wrong_trajectories_are_rejected_and_nothing_moves(torso: Torso) -> None:
    mark = torso.home()
    ends = {}
    for name, wrong in WRONG.items():
        if name != "beyond a limit":  # the topic's are clamped, as set-points are
            torso.say(wrong["trajectory"])
        ends[name] = torso.follow(wrong)
    taken = {name: end for name, end in ends.items() if end["accepted"]}
    assert [end for end in taken.values() if (end["status"], end["error_code"]) not in INVALID] == []
    assert "unknown joint" not in taken
    assert torso.follow(goal(LEFT, (0.5, HOME)))["status"] == SUCCEEDED
    assert torso.robot.moved(mark) == {}


def test_tolerances_of_a_goal_are_those_of_that_goal_alone(torso: Torso) -> None:
    mark = torso.home()
    # wider than its friction, which holds it a tick off, and narrower than its lag of a cycle
    tight = {"path_tolerance": [{"name": ELBOW, "position": 0.05}]}
    end = torso.follow(goal(LEFT, (4.0, [*HOME[:2], -1.0]), **tight))
    assert (end["status"], end["error_code"]) == (ABORTED, PATH_TOLERANCE), end
    assert ELBOW in end["error_string"]
    assert -0.9 < torso.robot.held(mark)[ELBOW][-1] < HOME[2] - TICK
    torso.home()
    tight = {"goal_tolerance": [{"name": ELBOW, "position": 1e-5}], "goal_time_tolerance": seconds(0.2)}
    end = torso.follow(goal(LEFT, (0.6, [*HOME[:2], 0.1]), **tight))
    assert (end["status"], end["error_code"]) == (ABORTED, GOAL_TOLERANCE), end
    assert ELBOW in end["error_string"]
    end = torso.follow(goal(LEFT, (0.6, HOME)))
    assert (end["status"], end["error_code"]) == (SUCCEEDED, 0), end


def test_a_cancelled_arm_stands_still(torso: Torso) -> None:
    mark = torso.home()
    end = torso.follow(LONG, 2)
    assert end["status"] == CANCELED, end
    goals = torso.robot.held(mark)
    assert HOME[0] <= goals[LEFT[0]][-1] < -0.1
    until(lambda: len({torso.now()[ELBOW] for _ in range(10)}) == 1, "an elbow that stands still")
    assert torso.now()[ELBOW] == pytest.approx(goals[ELBOW][-1], abs=0.15)


def test_a_second_client_takes_over_and_its_death_leaves_the_arm_at_rest(torso: Torso) -> None:
    mark = torso.home()
    other = torso.place.foreign("other")
    other.ask("act", *arm(LONG))
    until(lambda: torso.robot.moved(mark), "motion")
    torso.home()
    assert other.answer()["status"] == ABORTED
    mark = torso.robot.mark()
    other.ask("act", *arm(goal(LEFT, (6.0, [-1.0, 0.2, 0.8]))))
    until(lambda: torso.robot.moved(mark), "motion")
    other.end(signal.SIGKILL)
    assert HOME[2] < torso.robot.held(mark)[ELBOW][-1] < 0.8 + TICK
    assert {*torso.robot.torque().values()} == {1}
    torso.home()


# Group commands


@pytest.fixture
def group(torso: Torso) -> Iterator[Torso]:
    """The torso with all its joints in whole_body_position."""
    torso.home()
    before = [name for name in ("head", "left_arm", "right_arm") if torso.states()[name] == "active"]
    assert torso.switch(["whole_body_position"], before)
    yield torso
    assert torso.switch(before, ["whole_body_position"])


def test_a_publisher_of_set_points_that_dies_leaves_the_joints_holding(group: Torso) -> None:
    commands = "/whole_body_position/commands", "std_msgs/msg/Float64MultiArray"
    here = [group.now()[joint] for joint in BODY]
    mark = group.robot.mark()
    group.foreign.do("say", *commands, {"data": [0.0] * 3})
    rows = [{"data": [position + step for position in here]} for step in (-0.1, 0.1)]
    other = group.place.foreign("publisher")
    other.do("stream", *commands, rows, 0.1)
    until(lambda: len({one.position for one in group.robot.goals(mark) if one.joint == ELBOW}) > 1, "motion")
    other.end(signal.SIGKILL)
    goals = group.robot.held(mark)
    assert max(abs(goals[joint][0] - position) for joint, position in zip(BODY, here, strict=True)) < 0.15
    with dxlrun.connect("bioloid_torso") as robot:
        until(lambda: "whole_body_position" in stale(robot), "the event")
    assert {*group.robot.torque().values()} == {1}
    # what is published once counts as long as its publisher lives
    group.foreign.do(
        "say", *commands, {"data": [position + 0.5 * (number == 2) for number, position in enumerate(here)]}
    )
    until(lambda: abs(group.now()[ELBOW] - here[2] - 0.5) < 0.1, "the elbow's new position")
    group.robot.held(mark)
    assert group.now()[ELBOW] == pytest.approx(here[2] + 0.5, abs=0.1)


def stale(robot: dxlrun.RemoteRobot) -> str:
    return str([one for one in robot.events()["events"] if one["name"] == "stale_command"])


# Services


def test_controllers_are_listed_and_switched_as_by_ros2_control(torso: Torso) -> None:
    listed = {one["name"]: one for one in torso.cm("list_controllers")["controller"]}
    assert "trajectory" in listed["left_arm"]["type"].lower()
    assert listed["left_arm"]["claimed_interfaces"] == [f"{joint}/position" for joint in LEFT]
    assert listed["whole_body_position"]["claimed_interfaces"] == []
    assert len(listed["whole_body_position"]["required_command_interfaces"]) == len(BODY)
    before = torso.states()
    assert (before["left_arm"], before["whole_body_position"]) == ("active", "inactive")
    assert not torso.switch(["whole_body_position"], [])
    assert not torso.switch(["no_such_controller"], [])
    assert torso.states() == before
    assert torso.switch(["whole_body_position"], ["head", "left_arm", "right_arm"])
    assert torso.states()["whole_body_position"] == "active"
    assert torso.follow(goal(LEFT, (1.0, HOME)))["accepted"] is False
    assert torso.switch(["head", "left_arm", "right_arm"], ["whole_body_position"])
    for _ in range(3):  # the answer of a switch is when it holds
        assert torso.follow(goal(LEFT, (1.0, HOME)), 0)["accepted"]
        assert torso.switch([], ["left_arm"])
        assert torso.follow(goal(LEFT, (1.0, HOME)))["accepted"] is False
        assert torso.switch(["left_arm"], [])
    assert torso.states() == before
    assert torso.cm("configure_controller", name="whole_body_position")["ok"]
    assert not torso.cm("configure_controller", name="no_such_controller")["ok"]
    assert not torso.cm("load_controller", name="no_such_controller")["ok"]
    if "/controller_manager/unload_controller" in torso.foreign.do("graph"):
        assert torso.cm("unload_controller", name="whole_body_posvel")["ok"]
        assert "whole_body_posvel" not in torso.states()
        assert torso.cm("load_controller", name="whole_body_posvel")["ok"]
        assert torso.cm("configure_controller", name="whole_body_posvel")["ok"]
        assert torso.states() == before


def test_torque_halt_and_reboot_are_services(torso: Torso) -> None:
    torso.home()
    trigger, switch = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
    assert torso.foreign.do("call", "/left_arm/torque", switch, {"data": False})["success"]
    until(lambda: {joint for joint, on in torso.robot.torque().items() if not on} == {*LEFT}, "a limp arm")
    assert torso.foreign.do("call", "/left_arm/torque", switch, {"data": True})["success"]
    until(lambda: {*torso.robot.torque().values()} == {1}, "torque")
    if torso.states()["left_arm"] != "active":
        assert torso.switch(["left_arm"], [])
    mark = torso.home()
    other = torso.place.foreign("moves")
    other.ask("act", *arm(LONG))
    until(lambda: torso.robot.moved(mark), "motion")
    assert torso.foreign.do("call", "/dxlrun/halt", trigger, {})["success"]
    assert other.answer()["status"] == ABORTED
    other.end()
    assert torso.robot.held(mark)[LEFT[0]][-1] < -0.1
    assert torso.switch(["head", "left_arm", "right_arm"], [])
    rebooted = torso.foreign.do("call", "/left_arm/reboot", trigger, {})
    assert not rebooted["success"]  # Protocol 1.0 has no such instruction
    assert "shoulder" in rebooted["message"]


def test_parameters_of_controllers_are_those_of_nodes_of_their_names(torso: Torso) -> None:
    def sets(value: float) -> Any:
        one = {"name": "speed", "value": {"type": 3, "double_value": value}}
        words = "/left_arm/set_parameters", "rcl_interfaces/srv/SetParameters", {"parameters": [one]}
        return torso.foreign.do("call", *words)["results"][0]

    def gets() -> float:
        words = "/left_arm/get_parameters", "rcl_interfaces/srv/GetParameters", {"names": ["speed"]}
        return float(torso.foreign.do("call", *words)["values"][0]["double_value"])

    before = gets()
    assert sets(0.25)["successful"]
    with dxlrun.connect("bioloid_torso") as robot:
        assert (robot.parameters("left_arm")["speed"], gets()) == (0.25, 0.25)
        refused = sets(-1.0)
        assert (refused["successful"], gets()) == (False, 0.25)
        assert refused["reason"]
        robot.set_parameters("left_arm", {"speed": before})
    until(lambda: gets() == before, "what another client has set")
