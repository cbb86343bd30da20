"""Simulated servos that share joints or bodies, MuJoCo that is missing, and controllers that need motors."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.cases import read_head
from tests.kit.robots import CASES, PAIR, compile_text, problems_in

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.compile.simulation import simulation_of
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.errors import InputError
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlsim.simulation_plan import Load, Mechanism, MechanismServo

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


@PHYSICS
def test_servos_that_share_joints_are_simulated_together() -> None:
    load = "    direction: -1\n    simulation: {inertia: 0.02 kg m^2}\n"
    plan = compile_text(BODIES.replace("    direction: -1\n", load, 1)).plan
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


def test_controller_of_a_running_robot_or_a_replay_needs_motors_too() -> None:
    robot, _, motor = read_head(CASES / "motors.txt").partition("---- shoulder.yaml\n")
    Path("shoulder.yaml").write_text(motor)
    law = "controllers:\n  law: {type: feed_forward, joints: [shoulder]}\n"
    loop, plugins = compile_text(robot + law).plan.loop, load_plugins()
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins)
    entry = {"name": "more", "type": "feed_forward", "joints": ["shoulder"]}
    assert preparation.controller(entry, {}, 200.0).joints == ("shoulder",)
    with pytest.raises(RefusedRequest, match="more needs the motor of elbow, but elbow has no motor file"):
        preparation.controller(entry | {"joints": ["elbow"]}, {}, 200.0)
    assert with_settings(loop, [Setting("law", ("scale",), 0.5)], plugins) != loop
    with pytest.raises(InputError, match="--set law: law needs the motor of elbow"):
        with_settings(loop, [Setting("law", ("joints",), ["elbow"])], plugins)
