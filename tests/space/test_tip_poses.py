"""Poses of tips in the robot file, in motions and from Python, judged by our own forward kinematics."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.commands import Dxlrun
from tests.kit.judged_arms import Arm, example, turn

from dxlrun import DxlrunError, InputError, Refused, RemoteRobot
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlrun_space import reach, space_robot
from dxlrun_space.space_robot import SpaceRobot

ROBOTS = Path(__file__).parents[2] / "robots"
FOLLOWER = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
RIGHT = ("r_sho_pitch", "r_sho_roll", "r_el")


def arm_of(name: str) -> Arm:
    """Return the arm of a robot whose poses are judged; its base is the root."""
    base, tip, *joints = {
        "koch_space": ("desk", "follower_hand", *FOLLOWER),
        "op3_space": ("body_link", "r_hand", *RIGHT),
        "open_manipulator_x_space": ("link1", "end_effector_link", "joint1", "joint2", "joint3", "joint4"),
    }[name]
    return example(name, base, tip, *joints)


@pytest.mark.parametrize("name", ["koch_space", "op3_space", "open_manipulator_x_space"])
def test_joints_of_each_pose_have_it_and_its_row_is_true(name: str) -> None:
    compiled, arm = compile_files(ROBOTS / f"{name}.yaml", {}, []), arm_of(name)
    rows = compiled.report["poses"]
    assert [row["name"] for row in rows] == [*compiled.plan.poses] != []
    for row in rows:
        at = [row["positions"][joint] for joint in arm.joints]
        written = SECTION[name][row["name"]]
        matrix = arm.matrix(at)
        assert matrix[:3, 3] == pytest.approx(np.array(written[:3]) / 100, abs=1e-4)
        assert arm.within(at)
        assert name != "op3_space" or (at[0] > 0 and at[2] > 0)  # the solution that is `near`
        if len(written) > 3:
            roll, pitch, yaw = map(math.radians, written[3:])
            asked = turn((0, 0, 1), yaw) @ turn((0, 1, 0), pitch) @ turn((1, 0, 0), roll)
            cosine = (np.trace(asked.T @ matrix[:3, :3]) - 1) / 2
            off = math.degrees(math.acos(min(1.0, cosine)))
            assert float(row["remark"].partition(" deg ")[0] or 0) == pytest.approx(off, abs=0.06)
        margins = [min(x - low, high - x) for x, low, high in zip(at, arm.lower, arm.upper, strict=True)]
        assert (row["margin"], row["margin_joint"]) == (min(margins), arm.joints[np.argmin(margins)])
        steps = np.eye(len(at)) * 1e-6
        columns = [(arm.matrix(at + step) - arm.matrix(at - step))[:3, 3] / 2e-6 for step in steps]
        speeds = np.linalg.svd(np.array(columns).T, compute_uv=False)
        assert row["figures"]["dexterity"] == pytest.approx(speeds[-1] / speeds[0], abs=1e-5)


SECTION = {
    "koch_space": {"above": (18, -12, 12, 0, -60, 180), "at_cube": (18, -10, 6, 0, -60, 180)},
    "op3_space": {"right_forward": (14, -10, 10), "right_up": (8, -14, 20), "right_out": (6, -22, 16)},
    "open_manipulator_x_space": {"above": (20, 0, 15, 0, 60, 0), "at_cube": (20, 0, 6, 0, 60, 0)},
}
"""Poses of the robot files, cm and deg."""


def test_six_joints_refuse_a_missed_orientation_only_if_exact(tmp_path: Path) -> None:
    file = tmp_path / "six.yaml"
    joints = "[m1, m2, m3, m4, m5, m6]"

    def compiled(orientation: str) -> Any:
        file.write_text(
            f"include: [{ROBOTS}/poppy_ergo_jr.yaml]\nname: six\n"
            f"controllers: {{arm: {{active: false}}, hand: {{type: cartesian_controller, joints: {joints}, "
            f"tip: tip{orientation}}}}}\n"
            "poses: {turned: {tip: tip, x: 0 cm, y: -10 cm, z: 15 cm, rpy: [0 deg, 0 deg, 90 deg]}}\n"
        )
        return compile_files(file, {}, [])

    solved = compiled(", orientation: nearest").plan.poses["turned"]
    arm = example("poppy_ergo_jr", "base_link", "tip", *solved.positions)
    place = arm.matrix([*solved.positions.values()])[:3, 3]
    assert place == pytest.approx([0, -0.1, 0.15], abs=1e-4)
    assert solved.remark.endswith("deg from the orientation, which the arm cannot reach")
    for orientation in ("", ", orientation: exact"):
        with pytest.raises(
            InputError, match=r"3:.* hand refuses pose turned: it is .* deg from the orientat"
        ):
            compiled(orientation)


def robot_of(name: str, kind: type[RemoteRobot] = RemoteRobot) -> Any:
    return kind(name, VirtualLink(plan_of(ROBOTS / f"{name}.yaml")))


def tip(robot: RemoteRobot) -> Any:
    """Return the measured place of the tip, cm."""
    measured = dict(zip(robot.states().joints, robot.states().position.tolist(), strict=True))
    arm = arm_of(robot.name)
    return arm.matrix([measured[joint] for joint in arm.joints])[:3, 3] * 100


def test_motion_file_and_keyframes_lead_the_tip_to_poses(tmp_path: Path) -> None:
    op3 = robot_of("op3_space")
    done = op3.play(ROBOTS / "motions/op3_space_wave.yaml")
    assert op3.wait(done.goal).status == "reached"
    assert tip(op3) == pytest.approx(SECTION["op3_space"]["right_forward"], abs=0.3)
    wrong = tmp_path / "wrong.yaml"
    points = "[{time: 1 s, pose: right_upp}]"
    wrong.write_text(f"name: wrong\nmotions:\n  - {{controller: right_hand, points: {points}}}\n")
    with pytest.raises(DxlrunError, match="the robot has no pose right_upp; did you mean right_up"):
        op3.play(wrong)
    wrong.write_text(wrong.read_text().replace("right_upp", "{tip: r_hand, x: 6 cm, y: -22 cm, z: 16 cm}"))
    assert op3.wait(op3.play(wrong).goal).status == "reached"
    assert tip(op3) == pytest.approx((6, -22, 16), abs=0.3)
    koch = robot_of("koch_space")
    done = koch.send("hand", "pose", {"pose": "at_cube"}).goal.wait()
    assert (done.status, done.text) == ("reached", "2.8 deg from the orientation, which the arm cannot reach")
    koch.switch(activate=["moves"], deactivate=["hand"])
    assert koch.send("moves", "play", {"motion": "pick"}).goal.wait().status == "reached"
    assert tip(koch) == pytest.approx(SECTION["koch_space"]["above"][:3], abs=0.3)
    player = {"type": "keyframe_player", "joints": [*FOLLOWER]}
    koch.pause()
    with pytest.raises(DxlrunError, match="the robot has no pose abov; did you mean above"):
        koch.load("more", player | {"motions": {"go": {"steps": [{"time": "1 s", "pose": "abov"}]}}})
    koch.load("more", player | {"motions": {"go": {"steps": [{"time": "1 s", "pose": "above"}]}}})


def test_move_to_waits_for_the_pose_and_raises_what_refused_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(space_robot.dxlrun, "connect", lambda *_: robot_of("open_manipulator_x_space"))
    with space_robot.connect() as robot:
        assert robot.move_to(x=0.2, y=0, z="15 cm", rpy=[0, "60 deg", 0], path="joints").reached
        assert tip(robot) == pytest.approx((20, 0, 15), abs=0.3)
        before = robot.states().position.tolist()
        with pytest.raises(Refused, match=r"out of reach; the nearest is \d+\.\d mm away") as refused:
            robot.move_to("arm", x=0.9)
        assert refused.value.code == "goal_refused"
        assert robot.states().position.tolist() == pytest.approx(before, abs=2e-3)
        assert robot.move_to(x=0.2, y=0, z=0.15, quaternion=(0, 0.5, 0, 0.866)).reached
        assert robot.move_to(dz=-0.03, seconds=2.0).seconds == pytest.approx(2.0, abs=0.3)
        named = robot.link.gateways_link.plan.poses["above"]
        assert robot.move_to(pose="above").reached
        assert robot.states().position[:4] == pytest.approx([*named.positions.values()], abs=5e-3)
        for wrong, text in (
            ({"x": math.nan}, "nan"),
            ({"x": "3deg"}, "3deg"),
            ({"dz": "5"}, "has no unit"),
            ({"x": 0.2, "frame": "no"}, "frame no not"),
            ({"rpy": [0, 90, 0]}, "90 rad is more than a turn"),
        ):
            with pytest.raises(Refused, match=text) as refused:
                robot.move_to(**wrong)
            assert refused.value.code == "invalid"
        with pytest.raises(DxlrunError, match="there is no controller amr; did you mean arm"):
            robot.move_to("amr", dz=0.01)
        monkeypatch.setattr(robot, "_arms", lambda: ["left", "right"])
        with pytest.raises(
            DxlrunError, match="_space has 2 arms that move to poses; name one of left, right"
        ):
            robot.move_to(dz=0.01)
    with pytest.raises(DxlrunError, match="bioloid_torso has no arms that move to poses; add a `cart"):
        robot_of("bioloid_torso", SpaceRobot).move_to(dz=0.01)


@pytest.mark.needs("report")
def test_reach_draws_what_a_link_gets_to(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reach, "POSTURES", 500)
    file, picture = ROBOTS / "koch_space.yaml", tmp_path / "reach.png"
    said = dxlrun("reach", file, "follower_hand", picture)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("follower_hand: x -2")
    assert picture.read_bytes().startswith(b"\x89PNG")
    for words, text in [
        ((file, "hand", tmp_path / "a.png"), "tip hand is not a link of the URDF"),
        ((file, "follower_hand", tmp_path / "a.pdf"), "end it in .png or .svg"),
        ((ROBOTS / "leader_follower.yaml", "hand", tmp_path / "a.svg"), "names no URDF"),
        ((file, "follower_hand", picture), "it exists"),
    ]:
        said = dxlrun("reach", *words)
        assert said.code == 2
        assert text in said.err
