"""Examples that are steered: odometry, followers and sums of references, against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.clients import Ask, steered

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"


def messages(path: Path, topic: str) -> list[Any]:
    """Messages of a topic of a log, as a ROS 2 tool decodes them."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [decoded.decoded_message for decoded in reader.iter_decoded_messages(topics=[topic])]


def test_a_base_drives_a_circle_and_knows_it(tmp_path):
    asks = [Ask(0.1 + 0.1 * n, "base", "velocity", {"linear": 0.1, "angular": 1.0}) for n in range(60)]
    run = steered(tmp_path, ROBOTS / "diff_drive.yaml", 8.0, asks)

    odometry = messages(run.log.path, "/base/odometry")
    assert len(odometry) == pytest.approx(8.0 * 50, abs=3)
    assert odometry[0].header.frame_id == "odom"
    places = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in odometry])
    # a circle with a radius of 0.1 m on the left, but for the ramp at the beginning and the end
    distance = np.hypot(places[50:-80, 0], places[50:-80, 1] - 0.1)
    assert distance == pytest.approx(0.1, abs=0.01)
    last = odometry[-1]
    assert last.twist.twist.linear.x == pytest.approx(0.0, abs=0.001)  # it has timed out
    row = run.log.cycles["position"]
    left, right = (row[-1] - row[0]) * 0.033
    heading = 2 * math.atan2(last.pose.pose.orientation.z, last.pose.pose.orientation.w)
    assert math.remainder(heading - (right - left) / 0.16, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert abs((right - left) / 0.16) > 5.5  # about a turn


def test_followers_are_where_their_leaders_are_within_two_periods(tmp_path):
    motion = ROBOTS / "motions" / "leader_follower_wave.yaml"
    run = steered(tmp_path, ROBOTS / "leader_follower.yaml", 7.0, play=[motion])

    cycles, joints = run.log.cycles, run.log.joints
    for side in ("shoulder", "elbow"):
        leader = cycles["position"][:, joints.index(f"left_{side}")]
        sent = cycles["goal_position"][:, joints.index(f"right_{side}")]
        begun = 200  # in step long before
        errors = [np.abs(sent[begun:] - np.roll(leader, lag)[begun:]).max() for lag in range(4)]
        assert np.ptp(leader) > 0.7
        assert min(errors) == pytest.approx(0.0, abs=2e-3)  # a tick
        assert int(np.argmin(errors)) <= 2


def test_a_trajectory_of_the_whole_body_moves_three_parts(tmp_path):
    motion = ROBOTS / "motions" / "whole_body_trajectory.yaml"
    run = steered(tmp_path, ROBOTS / "bioloid_torso_whole_body.yaml", 5.0, play=[motion])

    cycles = run.log.cycles
    row = run.log.joints.index("head_yaw_joint")
    t = np.arange(len(cycles)) / 50 - 1.0  # it leads the joints to the first point in a second
    wanted = 0.5 * (np.sin(2 * t) - np.sin(4 * t))
    off = np.abs(cycles["command_position"][:, row] - wanted)[t > 0].max()
    assert 0.01 < off < 0.06  # what the part adds at most, and a cycle
