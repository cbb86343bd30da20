"""Simulated servos that share joints or bodies, MuJoCo that is missing, and motor files."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.robots import PAIR, compile_text, problems_in, robot_text

from dxlrun import MotorModel, Stribeck
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.compile.simulation import simulation_of
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.joints.motor_file import read_motor
from dxlrun.errors import InputError
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlsim.simulation_plan import Load, Mechanism, MechanismServo, UrdfBodies

URDF = """<robot name="pair"><link name="body"/><link name="left"/><link name="right"/>
<joint name="left_arm_joint" type="revolute"><parent link="body"/><child link="left"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="right_arm_joint" type="continuous"><parent link="body"/><child link="right"/></joint></robot>
"""
BODIES = PAIR.replace("/dev/ttyUSB0", "sim") + "model: {urdf: pair.urdf}\nsimulation: {physics: mujoco}\n"
PHYSICS = pytest.mark.needs("physics")


@pytest.fixture(autouse=True)
def _urdf(here: None) -> None:
    Path("pair.urdf").write_text(URDF, encoding="utf-8")


def _with_load(words: str) -> str:
    """Give the left arm a load."""
    return BODIES.replace("    direction: -1\n", f"    direction: -1\n    simulation: {words}\n", 1)


@PHYSICS
def test_servos_that_share_joints_are_simulated_together() -> None:
    plan = compile_text(_with_load("{inertia: 0.02 kg m^2}")).plan
    coupling = CouplingPlan("arms", (0, 1), (1, 0), ((0.5, 0.5), (0.5, -0.5)), ((1, 1), (1, -1)))
    coupled = replace(plan, mechanics=MechanicsPlan((coupling,), servos=("left", "right")))
    simulation = simulation_of(coupled)
    left, right = plan.buses[0].servos
    assert simulation.mechanisms == (
        Mechanism(
            (MechanismServo(1, right.reference, 1.0), MechanismServo(0, left.reference, -1.0)),
            ("left_arm_joint", "right_arm_joint"),
            coupling.matrix,
            (Load(0.02), Load()),
        ),
    )
    assert simulation.bodies is not None
    assert simulation.bodies.mechanisms == simulation.mechanisms
    assert [servo.load for servo in simulation.buses[0].servos] == [Load(), Load()], "it is the joints'"
    real = replace(plan.buses[0], port="/dev/x", servos=(right,))
    elsewhere = replace(coupled, buses=(replace(plan.buses[0], servos=(left,)), real))
    (alone,) = simulation_of(elsewhere).mechanisms
    assert alone.is_single, "one of them is on a real port"


@PHYSICS
def test_bodies_are_turned_by_the_servos_in_the_order_of_the_buses() -> None:
    # the first joint of the file is on the second bus
    two = BODIES.replace("loop:", "  second: {port: sim, protocol: 1.0, baud_rate: 1_000_000}\nloop:", 1)
    two = two.replace("bus: main\n    id: 1", "bus: second\n    id: 1", 1)
    simulation = simulation_of(compile_text(two).plan)
    assert [each.servo_id for bus in simulation.buses for each in bus.servos] == [2, 1]
    assert simulation.bodies == UrdfBodies(
        URDF,
        (
            Mechanism((MechanismServo(0, pytest.approx(math.radians(240)), 1),), ("right_arm_joint",)),
            Mechanism((MechanismServo(1, pytest.approx(math.radians(60)), -1),), ("left_arm_joint",)),
        ),
    )


@PHYSICS
def test_with_mujoco_the_urdf_says_what_a_joint_moves() -> None:
    found = problems_in(_with_load("{inertia: 1 kg cm^2, friction: 0.1 Nm}"))
    told = [each.what for each in found if "physics" in each.what]
    assert told == ["with physics: mujoco the URDF defines the inertia of left_arm_joint"]


def test_mujoco_that_is_not_installed_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    (problem,) = [each for each in problems_in(BODIES) if each.severity == "error"]
    assert problem.what == "MuJoCo, needed for physics: mujoco, is not installed"
    assert "pip install 'dxlrun[physics]'" in problem.fix
    (warning,) = [one for one in problems_in(BODIES.replace("sim,", "/dev/x,")) if "MuJoCo" in one.what]
    assert (warning.what, warning.severity) == (problem.what, "warning")  # a real port does not need it


@PHYSICS
@pytest.mark.parametrize(
    ("urdf", "missing", "message"),
    [
        (
            URDF.replace(
                '<link name="left"/>', '<link name="left"><inertial><mass value="-1"/></inertial></link>'
            ),
            False,
            "MuJoCo cannot load the URDF",
        ),
        (URDF, True, r"MuJoCo, needed.*pip install 'dxlrun\[physics\]'"),
    ],
    ids=["bodies that cannot be moved", "mujoco that cannot be imported"],
)
def test_bodies_are_refused_before_a_process_starts(
    urdf: str, missing: bool, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("pair.urdf").write_text(urdf, encoding="utf-8")
    plan = compile_text(BODIES).plan
    if missing:
        monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=message):
        simulation_of(plan)


def test_bodies_without_a_urdf_are_refused_when_a_real_port_is_simulated_after_all() -> None:
    plan = compile_text(f"{PAIR}simulation: {{physics: mujoco}}\n").plan
    with pytest.raises(InputError, match=r"needs a URDF; write `model: \{urdf: \.\.\.\}`"):
        simulation_of(plan)


@PHYSICS
def test_package_of_physics_runs_where_servos_are_simulated() -> None:
    robot = Path(__file__).parents[2] / "robots" / "held_arm.yaml"
    simulated = compile_files(robot, {}, []).plan.packages
    assert simulated["dxlrun_mujoco"] == "dxlrun"
    real = compile_files(robot, {"port": "/dev/ttyUSB0"}, []).plan.packages
    assert set(simulated) - set(real) == {"dxlrun_mujoco"}


def test_simulated_servo_has_the_homing_offset_of_the_robot_file() -> None:
    joint = (
        "{bus: main, model: XM430-W350, reference: 200 deg, direction: -1, limits: {velocity: 3 rad/s}, "
        "simulation: {gravity: 0.4 Nm, gravity_angle: 30 deg}"
    )
    plan = compile_text(
        "name: two\nbuses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}\nloop: {rate: 50}\n"
        f"joints: {{a: {joint}, id: 1}}, b: {joint}, id: 2, homing_offset: -700}}}}\n"
        "controllers: {arm: {type: joint_group_position_controller, joints: [a, b]}}\n",
        duration_ns=1_000_000_000,
    ).plan
    robot = VirtualRobot(plan)
    assert robot.run().reason == "ended"
    first, second = robot.buses[0].servos
    assert second.registers.ticks("homing_offset") == -700
    assert second.shaft_angle == pytest.approx(first.shaft_angle, abs=1e-4), "the load pulls as much"
    assert first.shaft_angle == pytest.approx(math.radians(200), abs=0.05)


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
