"""Restarts of either side, and frames compared with pinocchio."""

import math
import random
import signal
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.ros2.started import ROBOTS, Foreign, Place, Robot, seconds, stamp_ns

ABORTED = 6
"""Of action_msgs/msg/GoalStatus"""
ELBOW = "right_elbow_joint"


@pytest.fixture
def empty(place: Place) -> Iterator[Place]:
    """The place, in which nothing runs."""
    yield place
    place.end()


def logged(robot: Robot) -> dict[int, Any]:
    """Return the positions of each message of /joint_states in a log, by its stamp."""
    with robot.log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = (one for *_, one in reader.iter_decoded_messages(["/joint_states"]))
        return {one.header.stamp.sec * 10**9 + one.header.stamp.nanosec: list(one.position) for one in rows}


def comes(foreign: Foreign, least: int = 10) -> int:
    """Wait for new joint states; return the number of the first."""
    since = int(foreign.do("count", "states"))
    foreign.do("heard", "states", least, since)
    return since


@campaign(ci=1, night=10, release=50)
@pytest.mark.timeout(180)
def test_either_side_restarts_and_every_stamp_is_the_logs(empty: Place, amount: float) -> None:
    robot, bridge, foreign = empty.robot("bioloid_torso"), empty.bridge("bioloid_torso"), empty.foreign()
    foreign.do("hear", "states", "/joint_states", "sensor_msgs/msg/JointState")
    for number in range(int(amount)):
        comes(foreign)
        bridge.send_signal((signal.SIGKILL, signal.SIGINT)[number % 2])
        bridge.wait()
        bridge = empty.bridge("bioloid_torso")
        of_bridge = comes(foreign, 20)
        commanded(robot, foreign, 0.2 + 0.1 * (number % 2))
        mark = robot.mark()
        foreign.ask("act", *elbow(1.5, 30.0))
        until(lambda: robot.moved(mark), "motion")  # noqa: B023
        robot.end()
        assert foreign.answer()["status"] == ABORTED
        of_run = foreign.do("heard", "states", 0, of_bridge)["messages"]
        judged_by_the_log(robot, of_run)
        robot = empty.robot("bioloid_torso")
        comes(foreign)
        commanded(robot, foreign, 0.1)
        assert bridge.poll() is None, empty.said()
    bridge.send_signal(signal.SIGINT)
    assert bridge.wait(DEADLINE_S) == 0
    assert "Traceback" not in empty.said()


def commanded(robot: Robot, foreign: Foreign, position: float) -> None:
    """Move a joint, and judge by what its servo was sent."""
    mark = robot.mark()
    end = foreign.do("act", *elbow(position, 1.0))
    assert end["error_code"] == 0, end
    assert robot.held(mark)[ELBOW][-1] == pytest.approx(position, abs=0.01)


def elbow(position: float, time_s: float) -> tuple[str, str, Any]:
    """Return the words of a goal."""
    points = [{"positions": [position], "time_from_start": seconds(time_s)}]
    goal = {"trajectory": {"joint_names": [ELBOW], "points": points}}
    return "/right_arm/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory", goal


def judged_by_the_log(robot: Robot, received: list[Mapping[str, Any]]) -> None:
    """Every message is one of the log, in order, and none between the first and the last is missing."""
    rows = logged(robot)
    stamps = [stamp_ns(one) for one in received]
    assert stamps == [stamp for stamp in sorted(rows) if stamps[0] <= stamp <= stamps[-1]]
    for one in received:
        assert one["position"] == pytest.approx(rows[stamp_ns(one)], nan_ok=True)


# Frames


@campaign(ci=30, night=250, release=1000)
@pytest.mark.timeout(150)
def test_frames_equal_those_of_pinocchio(empty: Place, amount: float, chance: random.Random) -> None:
    pin = pytest.importorskip("pinocchio", reason="pin has 380 MB, so only the extra `full` has it")
    model = pin.buildModelFromUrdf(str(ROBOTS / "urdf/bioloid_torso.urdf"))
    data = model.createData()
    robot, foreign = empty.robot("bioloid_torso"), empty.foreign()
    empty.bridge("bioloid_torso")
    kinds = {"states": "/joint_states sensor_msgs/msg/JointState", "tf": "/tf tf2_msgs/msg/TFMessage"}
    for key, words in kinds.items():
        foreign.do("hear", key, *words.split())
    foreign.do("hear", "still", "/tf_static", "tf2_msgs/msg/TFMessage", True, True)
    limits = list(zip(model.lowerPositionLimit, model.upperPositionLimit, strict=True))
    joints = [servo.joint for servo in robot.bus.servos]
    order = [model.joints[model.getJointId(joint)].idx_q for joint in joints]
    rows = [{"data": [0.5 * chance.uniform(*limits[at]) for at in order]} for _ in range(500)]
    switched = {
        "activate_controllers": ["whole_body_position"],
        "deactivate_controllers": ["head", "left_arm", "right_arm"],
    }
    words = "/controller_manager/switch_controller", "controller_manager_msgs/srv/SwitchController"
    assert foreign.do("call", *words, {**switched, "strictness": 2, "timeout": seconds(5.0)})["ok"]
    foreign.do("stream", "/whole_body_position/commands", "std_msgs/msg/Float64MultiArray", rows, 0.1)
    (still,) = foreign.do("heard", "still")["messages"]
    judged: set[tuple[float, ...]] = set()
    states: dict[int, Any] = {}
    seen = {"states": 0, "tf": 0}
    while len(judged) < amount:
        new = {key: foreign.do("heard", key, 10, seen[key])["messages"] for key in seen}
        seen = {key: seen[key] + len(new[key]) for key in seen}
        states |= {stamp_ns(one): one for one in new["states"]}
        for message in new["tf"]:
            of_cycle = states.get(stamp_ns(message["transforms"][0]))
            if of_cycle is None or any(map(math.isnan, of_cycle["position"])):
                continue
            q = pin.neutral(model)
            for name, position in zip(of_cycle["name"], of_cycle["position"], strict=True):
                q[model.joints[model.getJointId(name)].idx_q] = position
            judged.add(tuple(q))
            pin.framesForwardKinematics(model, data, q)
            frames = {one["child_frame_id"]: one for one in still["transforms"] + message["transforms"]}
            for frame in (frame.name for frame in model.frames if frame.type == pin.BODY):
                found, above = pin.SE3.Identity(), frame
                while above in frames:
                    local = frames[above]["transform"]
                    row = [local["translation"][key] for key in "xyz"] + [
                        local["rotation"][key] for key in "xyzw"
                    ]
                    found, above = (
                        pin.XYZQUATToSE3(np.array(row)) * found,
                        frames[above]["header"]["frame_id"],
                    )
                expected = data.oMf[model.getFrameId(frame, pin.BODY)].homogeneous
                assert np.abs(found.homogeneous - expected).max() < 1e-6, (frame, q)
