"""Motor files: what a joint feels of servos behind a gear, where a file is looked for, and who needs it."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.robots import compile_text, robot_text

from dxlrun import MotorModel, Stribeck
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.joints.motor_file import read_motor
from dxlrun.errors import InputError
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun_analysis.replay.changes import Setting, with_settings

ROBOT = robot_text("motors")
MOTOR_FILE = Path("shoulder.yaml")


@pytest.fixture
def motor(here: None) -> MotorModel:
    """The motor of the cases, in its file."""
    text = (Path(__file__).with_name("cases") / "motors.txt").read_text()
    MOTOR_FILE.write_text(text.partition("---- shoulder.yaml\n")[2].partition("====")[0])
    return read_motor(MOTOR_FILE).motor


@pytest.mark.parametrize(
    ("more", "turns", "count"),
    [("gear_ratio: 2", 2.0, 1), ("servos: [{id: 1}, {id: 3, direction: 1}]", 1.0, 2)],
)
def test_joint_has_the_motor_that_it_feels(motor: MotorModel, more: str, turns: float, count: int) -> None:
    """Torque, speed without load, power and friction are those of the servos behind the gear."""
    text = ROBOT.replace("motor: shoulder.yaml}", f"motor: shoulder.yaml, {more}}}")
    plan = compile_text(text.replace("id: 1, model", "model") if count == 2 else text).plan
    assert from_json(to_json(plan)) == plan
    joint, model = plan.loop.joints[0].motor, plan.loop.joints[0].servo_model
    assert joint is not None
    assert joint.stiffness is not None
    assert motor.stiffness is not None

    def torque(motor: MotorModel, duty: float, speed: float) -> float:
        drive = duty * motor.voltage - motor.torque_constant * speed
        return motor.torque_constant / motor.resistance * drive

    for error, speed in ((0.1, 0.0), (0.02, 1.5), (-0.05, -3.0)):
        at_servo = torque(motor, motor.stiffness * error * turns, speed * turns)
        assert torque(joint, joint.stiffness * error, speed) == pytest.approx(count * turns * at_servo)
    assert joint.inertia == pytest.approx(count * turns**2 * motor.inertia)
    assert joint.friction == pytest.approx(count * turns * motor.friction)
    assert joint.viscous_friction == pytest.approx(count * turns**2 * motor.viscous_friction)
    assert joint.stribeck == Stribeck(0.05 * count * turns, 0.2 / turns)
    assert joint.load == motor.load
    if count == 2:
        assert model is None  # of several servos each has a heat of its own
    else:
        assert model is not None
        assert (model.stall_torque, model.stall_current) == (12.0, 4.1)
        assert model.no_load_speed == pytest.approx(6.6 / 2, abs=0.01)


def test_file_is_looked_for_beside_the_file_that_names_it(motor: MotorModel) -> None:
    Path("arms").mkdir()
    MOTOR_FILE.rename(Path("arms", "shoulder.yaml"))
    head, joints = ROBOT.split("joints:\n")
    Path("arms", "joints.yaml").write_text(f"joints:\n{joints}")
    plan = compile_text(f"include: [arms/joints.yaml]\n{head}").plan
    assert plan.simulation.motors["shoulder"] == motor
    assert sorted(plan.included) == ["arms/joints.yaml", "arms/shoulder.yaml"]


def test_controller_of_a_running_robot_or_a_replay_needs_motors_too(motor: MotorModel) -> None:
    law = "controllers:\n  law: {type: feed_forward, joints: [shoulder]}\n"
    loop, plugins = compile_text(ROBOT + law).plan.loop, load_plugins()
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins)
    entry = {"name": "more", "type": "feed_forward", "joints": ["shoulder"]}
    assert preparation.controller(entry, {}, 200.0).joints == ("shoulder",)
    with pytest.raises(RefusedRequest, match="more needs the motor of elbow, but elbow has no motor file"):
        preparation.controller(entry | {"joints": ["elbow"]}, {}, 200.0)
    assert with_settings(loop, [Setting("law", ("scale",), 0.5)], plugins) != loop
    with pytest.raises(InputError, match="--set law: law needs the motor of elbow"):
        with_settings(loop, [Setting("law", ("joints",), ["elbow"])], plugins)
