"""Each robot file with each of its motions: it compiles, runs, and is replayed without a difference."""

from pathlib import Path

import numpy as np
import pytest
from tests.kit.examples import as_parameters, command_of
from tests.kit.virtual_run import VirtualRun

from dxlrun.compile.robot_compiler import compile_files
from dxlwire.joint_unit import LINEAR

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
MOTIONS = sorted(ROBOTS.glob("motions/*.yaml"))
LONGEST_S = 4.0
ODD_TWIN = "right_shoulder_lateral_joint is not a mirror image"


@pytest.mark.parametrize("path", as_parameters(sorted(ROBOTS.glob("*.yaml"))))
def test_every_robot_compiles_and_has_motions(path, tmp_path):
    compiled = compile_files(path, {}, [])

    assert [w.what for w in compiled.warnings if not w.what.startswith(ODD_TWIN)] == []
    # motions of poses are in the robot file; others play the motions of the robots that they include
    others = {"bioloid_torso_imu", "bioloid_torso_keyframes", "single_joint_feed_forward", "stand_up"}
    others |= {
        "koch_leads_open_manipulator_x",
        "koch_space",
        "leader_follower_two_ports",
        "open_manipulator_x_space",
        "wave",
    }
    if path not in {command_of(motion).robot for motion in MOTIONS}:
        assert path.stem in others
        VirtualRun(path, tmp_path / "run.mcap", duration_s=0.5).finish()


@pytest.mark.parametrize("path", as_parameters(MOTIONS))
def test_every_motion_runs_by_the_command_that_it_names(path, tmp_path):
    command = command_of(path)
    assert command.motion == path
    plan = compile_files(command.robot, command.arguments, [path]).plan
    assert plan.loop.end_ns is not None
    whole_s = plan.loop.end_ns * 1e-9
    options = {"arguments": command.arguments, "play": [path], "duration_s": min(LONGEST_S, whole_s)}
    run = VirtualRun(command.robot, tmp_path / "run.mcap", **options)
    log = run.finish()

    result, cycles = run.result, log.cycles
    assert (result.detail, result.skipped, run.failures) == ("", 0, ())
    assert cycles["valid"].all()
    ends = {command.controller: command for command in plan.loop.commands}
    assert ends
    for controller in plan.loop.controllers:
        rows = [log.joints.index(joint) for joint in controller.joints if controller.name in ends]
        least = [0.01 if plan.loop.joints[row].unit is LINEAR else 0.3 for row in rows]  # m, rad
        travel = np.ptp(cycles["position"][:, rows], axis=0)
        assert not rows or (travel > least).any()  # each controller that is played moves something
    for bus, servos in zip(run.buses, plan.buses, strict=True):
        for servo in servos.servos:
            assert not bus.servo(servo.servo_id).torque_on
    # a limit of the position, never of the step in the first second, would be a mistake of the motion
    assert not (cycles["clamped"] & 0b11).any()
