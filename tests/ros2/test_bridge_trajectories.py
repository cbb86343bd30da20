"""Trajectories of ROS 2 as the bridge takes them: judged in the Python of a ROS environment."""

import json
import os
import subprocess
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S

PYTHON = os.getenv("DXLRUN_ROS2_PYTHON", "")
pytestmark = pytest.mark.skipif(
    not PYTHON, reason="DXLRUN_ROS2_PYTHON names no Python that has rclpy and dxlrun_ros2"
)
BEGIN = """
import json, sys
import numpy as np
from builtin_interfaces.msg import Duration, Time
from control_msgs.msg import JointTolerance
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from dxlrun.errors import InputError
from control_msgs.action import FollowJointTrajectory
from dxlrun_ros2.trajectories import goal_fields, tolerances, wanted

def at(seconds, **values):
    duration = Duration(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    return JointTrajectoryPoint(time_from_start=duration, **values)

def trajectory(joints, *points, stamp=0):
    found = JointTrajectory(joint_names=joints, points=points)
    found.header.stamp = Time(sec=stamp)
    return found

def why(call):
    try:
        return call()
    except InputError as error:
        return str(error)

JOINTS = ("pan", "tilt", "roll")
"""


def result_of(code: str) -> Any:
    """Run code in the environment of ROS; return what it prints as JSON."""
    ran = subprocess.run(
        [PYTHON, "-c", BEGIN + code], capture_output=True, text=True, check=False, timeout=DEADLINE_S
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_a_trajectory_becomes_the_goal_of_some_joints() -> None:
    goal, chunk = result_of("""
points = [at(0, positions=[9, 9]), at(0.5, positions=[1, 2], velocities=[3, 4])]
points.append(at(1, positions=[5, 6], velocities=[0, 0], accelerations=[0, 1]))
plan = wanted(trajectory(["roll", "pan"], *points), JOINTS, 100.0)
print(json.dumps([plan.build_command(), plan.chunk(50.0)]))""")
    first = {"time": 0.5, "positions": [1, 2], "velocities": [3, 4]}
    last = {"time": 1.0, "positions": [5, 6], "velocities": [0, 0], "accelerations": [0, 1]}
    assert goal == {"points": [first, last], "joints": ["roll", "pan"], "start_in": 0.0}
    assert chunk["now"] == 50.0
    assert [point["time"] for point in chunk["points"]] == [50.5, 51.0]


def test_a_stamp_says_when_it_begins() -> None:
    ahead, late, past = result_of("""
points = [at(1, positions=[0.1]), at(3, positions=[0.2])]
plans = [wanted(trajectory(["pan"], *points, stamp=100), JOINTS, now) for now in (98.0, 102.0)]
print(json.dumps([[one.start_in, *one.times.tolist()] for one in plans]
    + [why(lambda: wanted(trajectory(["pan"], *points, stamp=100), JOINTS, 104.0))]))""")
    assert ahead == [2.0, 1.0, 3.0]
    assert late == [0.0, 1.0]
    assert past == "all points are in the past"


WRONG = {
    'trajectory(["nose"], at(1, positions=[0]))': "has no joint nose; its joints: pan, tilt, roll",
    'trajectory(["pan", "pan"], at(1, positions=[0, 0]))': "repeat a joint",
    "trajectory([], at(1, positions=[]))": "must not be empty",
    'trajectory(["pan"], at(1, positions=[0, 1]))': "point 1 has 2 positions for 1 joints",
    'trajectory(["pan"], at(1, velocities=[0]))': "point 1 has 0 positions",
    'trajectory(["pan"], at(1, positions=[0], accelerations=[0, 1]))': "2 accelerations",
    'trajectory(["pan"], at(1, positions=[float("nan")]))': "NaN or infinite",
    'trajectory(["pan"], at(1, positions=[0]), at(1, positions=[0]))': "increase from point to point",
    'trajectory(["pan"], at(-1, positions=[0]))': "must not be negative",
}


def test_what_is_wrong_is_refused_with_its_reason() -> None:
    calls = ", ".join(f"why(lambda: wanted({wrong}, JOINTS, 1.0))" for wrong in WRONG)
    for found, why in zip(result_of(f"print(json.dumps([{calls}]))"), WRONG.values(), strict=True):
        assert why in found


def test_tolerances_of_an_action_are_those_of_the_robots_goal() -> None:
    fields, none, unknown = result_of("""
given = [JointTolerance(name="pan", position=0.1), JointTolerance(name="tilt", position=-1.0, velocity=0.5)]
goal = FollowJointTrajectory.Goal(goal_tolerance=given)
goal.goal_time_tolerance.nanosec = 500_000_000
print(json.dumps([goal_fields(goal, JOINTS), goal_fields(FollowJointTrajectory.Goal(), JOINTS),
    why(lambda: tolerances(given, ("pan",)))]))""")
    tolerances = {"pan": {"position": 0.1}, "tilt": {"position": "inf", "velocity": 0.5}}
    assert fields == {"goal_tolerance": tolerances, "goal_time_tolerance": 0.5}
    assert none == {}
    assert unknown == "the trajectory does not move tilt; remove the tolerance"


def test_the_desired_state_is_that_of_the_controllers_spline() -> None:
    """A quintic way from rest to rest is half done in half of its time, and at 30/16 of the mean velocity."""
    position, velocity, index = result_of("""
from dxlrun_controllers.laws.spline import SplineSample
plan = wanted(trajectory(["pan"], at(2, positions=[1], velocities=[0], accelerations=[0])), JOINTS, 1.0)
sample = SplineSample(1)
plan.spline(np.zeros(1)).sample(1.0, sample)
print(json.dumps([*sample.position, *sample.velocity, plan.index(5.0)]))""")
    assert position == pytest.approx(0.5)
    assert velocity == pytest.approx(30 / 16 / 2)
    assert index == 0
