"""Controllers of machines in chains, without replies, and beside limp joints, on simulated buses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
MS = 1_000_000


def said(run: Any) -> list[str]:
    return [event.text for event in run.log.events if event.code == EventCode.CONTROLLER_SAYS]


@pytest.fixture
def arm(tmp_path: Path) -> Callable[[str], Path]:
    """The arm that is led by currents, with another upper controller in place of its trajectory."""

    def arm(upper: str) -> Path:
        text = (ROBOTS / "effort_arm.yaml").read_text()
        line = next(line for line in text.splitlines() if line.startswith("  arm: "))
        path = tmp_path / "arm.yaml"
        path.write_text(text.replace(line, upper))
        (tmp_path / "urdf").symlink_to(ROBOTS / "urdf")
        return path

    return arm


POSE = "{time: 1 s, pose: {shoulder: 0.8 rad, elbow: -0.5 rad}}"


@pytest.mark.parametrize("interface", ["position", "posvel"])
def test_a_motion_of_poses_leads_a_pid(arm, interface, tmp_path):
    upper = (
        f"  arm: {{type: keyframe_player, joints: [shoulder, elbow], into: [arm_pid], "
        f"command_interface: {interface}, motions: {{lift: {{steps: [{POSE}]}}}}}}"
    )
    run = steered(tmp_path, arm(upper), 3.0, [Ask(0.2, "arm", "play", {"motion": "lift"})])

    cycles = run.log.cycles
    assert cycles["reference"].shape[1] >= 2
    assert cycles["position"][-1] == pytest.approx([0.8, -0.5], abs=0.05)
    assert np.isnan(cycles["command_position"]).all()
    assert np.isfinite(cycles["command_effort"][-1]).all()


def test_followers_lead_a_pid(arm, tmp_path):
    upper = (
        "  arm: {type: leader_follower, into: [arm_pid], speed: 2 rad/s, timeout: 200 ms, "
        "pairs: [{joint: shoulder}, {joint: elbow}]}"
    )
    asks = [Ask(0.2 + 0.05 * n, "arm", "positions", {"positions": [0.5, 0.3]}) for n in range(40)]
    run = steered(tmp_path, arm(upper), 4.0, asks)

    assert run.log.cycles["position"][-1] == pytest.approx([0.5, 0.3], abs=0.05)
    assert said(run) == ["no positions for 0.20 s, holding"]


def test_a_wheel_that_was_silent_restarts_its_base_and_odometry_goes_on_without_its_way(tmp_path):
    asks = [Ask(0.1 + 0.1 * n, "base", "velocity", {"linear": 0.1}) for n in range(45)]
    silent_at, back_at = 1_500 * MS, 2_500 * MS

    def cut(robot: Any) -> None:
        robot.buses[0].at(silent_at, lambda: robot.buses[0].servo(1).silence(True))
        robot.buses[0].at(back_at, lambda: robot.buses[0].servo(1).silence(False))

    run = steered(tmp_path, ROBOTS / "diff_drive.yaml", 5.0, asks, before=cut)

    restarts = [
        event.text for event in run.log.events if event.source == "base" and "restarted" in event.text
    ]
    assert len(restarts) == 1, "the wheel was stopped, and is given torque at rest"


def test_followers_of_a_leader_that_does_not_answer_hold_until_it_does(tmp_path):
    def cut(robot: Any) -> None:
        robot.buses[0].at(2_000 * MS, lambda: robot.buses[0].servo(2).silence(True))
        robot.buses[0].at(3_000 * MS, lambda: robot.buses[0].servo(2).silence(False))

    run = steered(
        tmp_path,
        ROBOTS / "leader_follower.yaml",
        6.0,
        play=[ROBOTS / "motions" / "leader_follower_wave.yaml"],
        before=cut,
    )

    (sentence,) = said(run)[:1]
    assert sentence.startswith("no reply from leader left_elbow for 0.1")
    cycles, joints = run.log.cycles, run.log.joints
    held = cycles["goal_position"][440:580, joints.index("right_elbow")]
    assert np.ptp(held) == 0.0
    leader, follower = (
        cycles[what][-200:, joints.index(joint)]
        for what, joint in (("position", "left_elbow"), ("goal_position", "right_elbow"))
    )
    assert follower == pytest.approx(leader, abs=2e-3)


def test_a_limp_leader_is_moved_by_hand_and_followed(tmp_path):
    def turn(robot: Any) -> None:
        robot.buses[0].at(1_000 * MS, lambda: robot.buses[0].servo(1).turn_shaft(-0.6, 1_000 * MS))

    run = steered(
        tmp_path,
        ROBOTS / "leader_follower.yaml",
        4.0,
        arguments={"left_arm": "false", "leader_torque": "off"},
        before=turn,
    )

    end, joints = run.log.cycles[-1], run.log.joints
    leader, follower = (end["position"][joints.index(f"{side}_shoulder")] for side in ("left", "right"))
    assert leader == pytest.approx(0.6, abs=0.02)
    assert follower == pytest.approx(leader, abs=0.02)
    assert not run.robot.buses[0].servo(1).torque_on
