"""gravity_compensation: the law against pinocchio, shifts, floating, payload, orientation, mistakes."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.stages import Stage

from dxlrun import InputError, MotorLoad, MotorModel
from dxlrun.compile.robot_compiler import compile_files
from dxlrun_controllers.feed_forward import FeedForward
from dxlrun_controllers.gravity_compensation import GravityCompensation
from dxlrun_controllers.laws.gravity import GRAVITY, gravity_law, up_of

ROBOTS = Path(__file__).parents[3] / "robots"
MOTOR = MotorModel("MX-64", 12.0, 1.6, 3.6, 0.011, 0.1, 0.0, 0.0, None, 0.16, 32, torque_per_effort=1.6)
INERTIAL = (
    '<inertial><origin xyz="{0}"/><mass value="{1}"/>'
    '<inertia ixx="1" iyy="9" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
URDF = f"""<robot name="arm"><link name="base"/>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 1"/><axis xyz="0 -1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<link name="upper">{INERTIAL.format("0 0 -0.2", 0.5)}
<collision><geometry><box size="1 1 1"/></geometry></collision></link>
<joint name="b" type="continuous"><parent link="upper"/><child link="lower"/>
<origin xyz="0 0 -0.4" rpy="0.1 0.2 0.3"/>
<axis xyz="0 0.6 0.8"/></joint>
<link name="lower">{INERTIAL.format("0.02 0 -0.1", 0.2)}</link>
<joint name="finger" type="prismatic"><parent link="lower"/><child link="tip"/>
<origin xyz="0 0 -0.2"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<link name="tip">{INERTIAL.format("0 0.01 0", 0.1)}</link>
<joint name="rest" type="revolute"><parent link="upper"/><child link="lamp"/>
<origin xyz="0.1 0 -0.1"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<link name="lamp">{INERTIAL.format("0 0 -0.05", 0.05)}</link></robot>"""
UP = np.array([0.0, 0.0, 1.0])


def test_the_law_is_pinocchios():
    pin = pytest.importorskip("pinocchio", reason="pin has 380 MB, so only the extra `full` has it")
    names = ["finger", "b", "a"]  # `rest` is in no robot file: it stays at 0
    law = gravity_law(URDF, names, 3, ("tip", (0.01, 0.02, -0.03)))
    model = pin.buildModelFromXML(URDF)
    tip = model.frames[model.getFrameId("tip")]
    own, data, dice = model.inertias[tip.parentJoint].copy(), model.createData(), np.random.default_rng(1)
    at = [model.joints[model.getJointId(name)] for name in names]
    up, torque = np.zeros(3), np.zeros(3)
    for _ in range(200):
        q, turn, mass = dice.uniform(-2, 2, 3), dice.normal(size=4), dice.uniform()
        up_of(turn, up)
        law(q, up, mass, torque)
        base = pin.Quaternion(turn[3], *turn[:3]).normalized().toRotationMatrix()
        model.gravity.linear = base.T @ [0.0, 0.0, -GRAVITY]
        hung = pin.Inertia(mass, np.array([0.01, 0.02, -0.03]), np.zeros((3, 3)))
        model.inertias[tip.parentJoint] = own + tip.placement.act(hung)
        whole = pin.neutral(model)
        for joint, angle in zip(at, q, strict=True):
            whole[joint.idx_q : joint.idx_q + joint.nq] = (
                [math.cos(angle), math.sin(angle)] if joint.nq == 2 else [angle]
            )
        expected = pin.computeGeneralizedGravity(model, data, whole)[[joint.idx_v for joint in at]]
        assert torque == pytest.approx(expected, abs=1e-12)


def rod(name: str, mimic: str = "") -> str:
    """Return a rod of 1 kg on a level axis, 0.1 m from it."""
    return (
        f'<joint name="{name}" type="continuous"><parent link="base"/><child link="{name}_rod"/>'
        f'<axis xyz="0 -1 0"/>{mimic}</joint>'
        f'<link name="{name}_rod">{INERTIAL.format("0 0 -0.1", 1)}</link>'
    )


@pytest.mark.needs("physics")
def test_joints_that_mimic_another_move_and_count_for_it():
    """A second rod turns twice as far from 0.5 rad on, a third one against that one."""
    shape = '<collision><origin xyz="0 0 9"/><geometry><box size="1 1 1"/></geometry></collision>'
    text = (
        '<robot name="rods"><link name="base"/>'
        + rod("a")
        + rod("b", '<mimic joint="a" multiplier="2" offset="0.5"/>')
        + rod("c", '<mimic joint="b" multiplier="-1"/>')
        + '<joint name="fixed" type="fixed"><parent link="a_rod"/><child link="lamp"/></joint>'
        f'<link name="lamp">{shape}</link></robot>'  # without `inertial` it weighs nothing
    )
    law, torque = gravity_law(text, ["a", "unknown"], 2), np.full(2, np.nan)
    for q in (0.0, 0.4, -1.1):
        law(np.array([q, 5.0]), UP, 0.0, torque)
        follower = 2 * q + 0.5
        turned = math.sin(q) + 2 * math.sin(follower) - 2 * math.sin(-follower)
        assert torque == pytest.approx([0.1 * GRAVITY * turned, 0.0])
    law(np.array([np.nan, np.nan]), UP, 0.0, torque)  # not heard yet: at 0
    assert torque[0] == pytest.approx(0.1 * GRAVITY * 4 * math.sin(0.5))


def started(more: dict[str, object], **keys: Any) -> Any:
    parameters = {"joints": ["a", "b"]} | more
    keys = {"motors": (MOTOR, MOTOR), "urdf": URDF} | keys
    return Stage(GravityCompensation, parameters, **keys).activate()


def needed(q: tuple[float, float], up: np.ndarray = UP, payload: float = 0.0) -> np.ndarray:
    torque = np.zeros(2)
    gravity_law(URDF, ["a", "b"], 2, ("tip", (0, 0, 0)))(np.array(q), up, payload, torque)
    return torque


@pytest.mark.needs("physics")
def test_positions_are_shifted_as_a_feed_forward_shifts_them():
    """The same weight from a motor file's load: m g l sin(q) at a level axis."""
    urdf = URDF[: URDF.index('<joint name="b"')] + "</robot>"
    one = {"motors": (MOTOR,), "present": (0.7,)}
    robot = started({"joints": ["a"], "most": 0.3}, urdf=urdf, **one)
    load = MotorLoad(gravity=0.5 * GRAVITY * 0.2)
    forward = Stage(FeedForward, {"joints": ["a"]}, **one | {"motors": (replace(MOTOR, load=load),)})
    forward.activate()
    for each in (robot, forward):
        each.states.voltage[:] = 11.0
    assert robot.update(0.0, follow=False) == pytest.approx(forward.update(0.0, follow=False), abs=1e-12)
    assert robot.commands.position[0] > 0.7 + 0.02  # and where nothing is commanded it holds
    for at_s in (0.02, 0.04):
        for each in (robot, forward):
            each.context.references.position[:] = 1.2
            each.context.references.velocity[:] = 0.0
            each.update(at_s, follow=False)
    shift = robot.commands.position[0] - 1.2
    assert shift == pytest.approx(forward.commands.position[0] - 1.2, abs=1e-12)
    (_, state), *_ = robot.messages
    assert state.torque[0] == pytest.approx(load.gravity * math.sin(1.2))
    robot.change(0.06, scale=0.5)
    assert robot.update(0.06, follow=False)[0] - 1.2 == pytest.approx(shift / 2, rel=0.01)
    assert started({"joints": ["a"], "most": 0.001}, urdf=urdf, **one).update(0)[0] == pytest.approx(0.701)
    assert started({"joints": ["a"]}, urdf=urdf, limits={"upper": 0.71}, **one).update(0)[0] == 0.71


@pytest.mark.needs("physics")
@pytest.mark.parametrize("interface", ["effort", "pwm"])
def test_an_arm_floats_and_carries_what_is_commanded_beside(interface):
    robot = started({"command_interface": interface}, present=(0.5, -0.4))
    torque = needed((0.5, -0.4))
    expected = torque / 1.6 if interface == "effort" else torque * 3.6 / 1.6 / 12.0
    robot.update(0.0, follow=False)
    command = getattr(robot.commands, interface)
    assert command == pytest.approx(expected)
    getattr(robot.context.references, interface)[0] = 0.25
    robot.states.position[1] = np.nan  # never heard: nothing is known to be held
    robot.update(0.02, follow=False)
    alone = needed((0.5, math.nan))[0] * expected[0] / torque[0]
    assert command == pytest.approx([0.25 + alone, 0.0])


@pytest.mark.needs("physics")
def test_payload_other_joints_and_orientation_count():
    more = {
        "joints": ["a"],
        "command_interface": "effort",
        "orientation": "imu/orientation",
        "payload": {"link": "tip", "mass": "300 g"},
    }
    robot = started(more, motors=(MOTOR,), present=(0.3,), others=("b",))
    assert robot.context.read_names == ("b/position", *(f"imu/orientation.{axis}" for axis in "xyzw"))

    def output(payload: float, up: np.ndarray = UP) -> None:
        robot.update(0.0, follow=False)
        assert robot.commands.effort * 1.6 == pytest.approx(needed((0.3, 0.9), up, payload)[:1])

    robot.context.reads[0] = 0.9
    output(0.3)  # no orientation yet: level
    robot.change(0.0, payload={"link": "tip", "mass": "0 g"})
    output(0.0)
    half = math.sqrt(0.5)
    robot.context.reads[1:] = (half, 0.0, 0.0, half)  # rolled by 90 degrees: up is along y
    output(0.0, np.array([0.0, 1.0, 0.0]))
    robot.context.reads[1:] = np.nan
    output(0.0, np.array([0.0, 1.0, 0.0]))


@pytest.mark.needs("physics")
def test_a_velocity_is_passed_on():
    keys: dict[str, Any] = {"limits": {"velocity": 3.0}}
    robot = started({"command_interface": "posvel"}, **keys)
    robot.context.references.velocity[:] = (-0.4, np.nan)
    robot.update(0.0)
    assert robot.commands.velocity.tolist() == [0.4, 3.0]  # a servo's is a magnitude
    robot = started({"command_interface": "posvel"}, into=("below",), **keys)
    robot.context.references.velocity[:] = (-0.4, np.nan)
    robot.update(0.0)
    assert robot.commands.velocity.tolist() == [-0.4, 0.0]


# What is missing: `tests/compile/cases/gravity.txt`


def test_without_mujoco_it_is_refused(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mujoco" else find(name))
    sentence = r"gravity needs MuJoCo, which is not installed; `pip install 'dxlrun\[physics\]'`"
    with pytest.raises(InputError, match=sentence):
        compile_files(ROBOTS / "held_arm.yaml", {}, [])
