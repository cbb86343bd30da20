"""The examples that are steered: what they do on virtual time, by their logs, and by their replays."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"


def messages(path: Path, topic: str) -> list[Any]:
    """Messages of a topic of a log, as a ROS 2 tool decodes them."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [decoded.decoded_message for decoded in reader.iter_decoded_messages(topics=[topic])]


def results(run: Any) -> list[tuple[str, str]]:
    """Outcomes and texts of the goals that ended."""
    ended = [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]
    return [(report["status"], report["text"]) for report in ended]


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


def test_a_gripper_reaches_a_width(tmp_path):
    asks = [
        Ask(0.5, "gripper", "grip", {"width": "30 mm"}),
        Ask(3.0, "gripper", "grip", {"width": 0.06}),
    ]
    run = steered(tmp_path, ROBOTS / "open_manipulator_x.yaml", 6.0, asks)

    assert [outcome for outcome, _ in results(run)] == ["reached", "reached"]
    widths = [message.width for message in messages(run.log.path, "/gripper/state")]
    assert max(widths) == pytest.approx(0.06, abs=0.002)
    assert min(widths[:50]) == pytest.approx(0.03, abs=0.002)


def test_a_gripper_that_is_held_back_stalls_with_its_effort(tmp_path):
    """A weight that its effort cannot lift is what an object is to a gripper."""
    text = (ROBOTS / "open_manipulator_x.yaml").read_text()
    held = tmp_path / "held.yaml"
    joint = "limits: {position: [-1.26 rad, 0.66 rad], velocity: 4.8 rad/s}"
    assert text.count(joint) == 1
    held.write_text(text.replace(joint, f"{joint}, simulation: {{gravity: 2.0 Nm}}"))
    (tmp_path / "urdf").symlink_to(ROBOTS / "urdf")
    run = steered(tmp_path, held, 4.0, [Ask(0.5, "gripper", "grip", {"position": 0.6})])

    ((outcome, reason),) = results(run)
    assert outcome == "reached"
    assert reason.startswith("stalled, holds something at 0.")
    effort = run.log.cycles["effort"][-50:, run.log.joints.index("gripper")]
    assert effort == pytest.approx(0.3, abs=0.01)


def test_followers_are_where_their_leaders_are_within_two_periods(tmp_path):
    run = steered(
        tmp_path,
        ROBOTS / "leader_follower.yaml",
        7.0,
        play=[ROBOTS / "motions" / "leader_follower_wave.yaml"],
    )

    cycles, joints = run.log.cycles, run.log.joints
    for side in ("shoulder", "elbow"):
        leader = cycles["position"][:, joints.index(f"left_{side}")]
        sent = cycles["goal_position"][:, joints.index(f"right_{side}")]
        begun = 200  # in step long before
        errors = [np.abs(sent[begun:] - np.roll(leader, lag)[begun:]).max() for lag in range(4)]
        assert np.ptp(leader) > 0.7
        assert min(errors) == pytest.approx(0.0, abs=2e-3)  # a tick
        assert int(np.argmin(errors)) <= 2


def test_a_trajectory_leads_a_pid_that_commands_currents(tmp_path):
    run = steered(
        tmp_path, ROBOTS / "effort_arm.yaml", 6.0, play=[ROBOTS / "motions" / "effort_arm_lift.yaml"]
    )

    cycles = run.log.cycles
    assert np.isnan(cycles["command_position"]).all()
    assert np.isfinite(cycles["command_effort"][10:]).all()
    for row, top in ((0, 1.0), (1, 0.8)):
        position = cycles["position"][:, row]
        assert position.max() == pytest.approx(top, abs=0.06)
        t = np.arange(len(position)) / 400
        rest = (t > 3.0) & (t < 3.05)
        assert position[rest] == pytest.approx(top, abs=0.08)


def test_motions_of_poses_are_played_by_their_names(tmp_path):
    asks = [
        Ask(0.5, "motions", "play", {"motion": "wave", "speed": 1.5, "repeat": 2}),
        Ask(6.0, "motions", "play", {"motion": "bow"}),
        Ask(6.5, "", "cancel", {"controller": "motions"}),
        Ask(7.5, "motions", "play", {"motion": "stand"}),
        Ask(7.6, "motions", "play", {"motion": "stand", "speed": 2.0}),
    ]
    run = steered(tmp_path, ROBOTS / "bioloid_torso_keyframes.yaml", 10.0, asks)

    assert [outcome for outcome, _ in results(run)] == ["reached", "cancelled", "preempted", "reached"]
    goals = run.log.cycles["goal_position"]
    at = {name: run.log.joints.index(name) for name in ("left_elbow_joint", "head_pitch_joint")}
    elbow = np.degrees(goals[:, at["left_elbow_joint"]])
    assert (elbow[110:200].max(), elbow[110:200].min()) == (
        pytest.approx(10, abs=1),
        pytest.approx(-50, abs=1),
    )
    assert elbow[-1] == pytest.approx(-20, abs=0.5)
    nod = goals[300:370, at["head_pitch_joint"]]
    change = np.diff(nod, n=2)[26:] * 50**2  # from the cancel on
    assert np.abs(change).max() < 20.5  # rad/s^2
    assert 10 < np.degrees(nod.max()) < 49


def test_a_trajectory_of_the_whole_body_goes_through_three_parts(tmp_path):
    run = steered(
        tmp_path,
        ROBOTS / "bioloid_torso_whole_body.yaml",
        5.0,
        play=[ROBOTS / "motions" / "whole_body_trajectory.yaml"],
    )

    cycles = run.log.cycles
    row = run.log.joints.index("head_yaw_joint")
    t = np.arange(len(cycles)) / 50 - 1.0  # it leads the joints to the first point in a second
    moving = t > 0
    wanted = 0.5 * (np.sin(2 * t) - np.sin(4 * t))
    command = cycles["command_position"][:, row]
    assert np.abs(command - wanted)[moving].max() < 0.06  # what the part adds at most, and a cycle
    assert np.abs(command - wanted)[moving].max() > 0.01  # it does add something


def test_a_lamp_is_lit_by_a_command_and_dark_when_its_controller_leaves(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(
        "name: with_board\nloop: {rate: 50}\n"
        "buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}\n"
        "joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}\n"
        "devices:\n  board: {bus: main, id: 102, model: generic, states: [led, register_7, register_8],\n"
        "    commands: [led, register_7, register_8], safe: {register_7: 3}}\n"
        "controllers:\n  lamps: {type: device_command_controller,\n"
        "    commands: [board/led, board/register_7, board/register_8]}\n"
    )
    asks = [
        Ask(0.2, "lamps", "device_commands", {"values": {"board/led": 1, "board/register_7": 7}}),
        Ask(0.3, "lamps", "device_commands", {"values": {"board/register_8": 8}}),
        Ask(0.6, "", "switch", {"deactivate": ["lamps"]}),
    ]
    run = steered(tmp_path, file, 1.0, asks)
    led, register_7, register_8 = run.log.cycles["source_state"].T
    rows = [round(at * run.robot.plan.loop.period_ns**-1 * 1e9) for at in (0.15, 0.5, 0.9)]
    assert led[rows].tolist() == [0, 1, 0]  # by its table
    assert register_7[rows].tolist() == [0, 7, 3]  # by the robot file
    assert register_8[rows].tolist() == [0, 8, 8]  # neither says anything
