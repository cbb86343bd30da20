"""How links move when shafts turn: judged by MuJoCo's own sensors on the same bodies."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.bodies import Turned, bodies_of

from dxlrun.channels import slot
from dxlrun.channels.slot import SlotReader, SlotWriter
from dxlrun.run.source_process import RemoteBody
from dxlsim.motion.body import SensedBody, ShaftPublisher, SimulatedBody
from dxlsim.motion.control_law import LIMP
from dxlsim.motion.link_motion import Shafts
from dxlsim.motion.mechanics import STEP_NS, Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.simulation_plan import NO_LOAD, Mechanism, MechanismServo

TORSO = (Path(__file__).parents[2] / "robots/urdf/bioloid_torso.urdf").read_text()
LINK = (
    '<link name="{}"><inertial><origin xyz="0.1 0 0.02"/><mass value="0.3"/>'
    '<inertia ixx="1e-3" iyy="2e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
LIMIT = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
CRANE = f"""<robot name="crane">
  <link name="ground"/> {"".join(LINK.format(name) for name in ("mast", "trolley", "hook", "tip"))}
  <joint name="turn" type="continuous"><parent link="ground"/><child link="mast"/>
    <origin xyz="0 0.1 1" rpy="0.1 -0.2 0.3"/><axis xyz="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="mast"/><child link="trolley"/>
    <origin xyz="0.2 0 0" rpy="0 0.5 0"/><axis xyz="1 0 0"/>{LIMIT}</joint>
  <joint name="swing" type="revolute"><parent link="trolley"/><child link="hook"/>
    <origin xyz="0 0 -0.1"/><axis xyz="0 0.6 0.8"/>{LIMIT}</joint>
  <joint name="plate" type="fixed"><parent link="hook"/><child link="tip"/>
    <origin xyz="0.05 0.02 -0.3" rpy="1 2 3"/></joint>
</robot>"""
G = 9.81
ROTOR = Motor(stall_torque=1.0, damping=0.01, torque_per_ampere=1.0, voltage=12.0, inertia=0.01)


def body_of(urdf: str, names: list[str]) -> SimulatedBody:
    """Return a body whose shafts are the joints of these names themselves."""
    return SimulatedBody(bodies_of(urdf, [Turned(name, 0.0, 1.0) for name in names]))


@pytest.mark.parametrize("urdf", [TORSO, CRANE], ids=["torso", "crane"])
def test_pose_rate_and_acceleration_are_what_mujocos_sensors_measure(urdf):
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = True
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
    kinds = {
        "rate": mujoco.mjtSensor.mjSENS_GYRO,
        "force": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
        "at": mujoco.mjtSensor.mjSENS_FRAMEPOS,
        "turn": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
        "speed": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    }
    links = [each.name for each in spec.bodies if each.name != "world"]
    for each in spec.bodies:
        if each.name != "world":
            each.add_site(name=each.name)
            for kind, number in kinds.items():
                site = mujoco.mjtObj.mjOBJ_SITE
                spec.add_sensor(name=f"{kind} {each.name}", type=number, objtype=site, objname=each.name)
    model = spec.compile()
    data = mujoco.MjData(model)
    names = [model.joint(index).name for index in range(model.njnt)]
    body = body_of(urdf, names)
    generator = np.random.default_rng(3)
    for _ in range(10):
        data.qpos[:] = generator.uniform(-1, 1, model.nq)
        data.qvel[:] = generator.uniform(-3, 3, model.nv)
        data.qfrc_applied[:] = generator.uniform(-2, 2, model.nv)
        mujoco.mj_forward(model, data)
        body.set_shafts(Shafts(0, data.qpos.copy(), data.qvel.copy(), data.qacc.copy()))
        assert links
        for link in links:
            motion = body.motion(link)
            sensed = {kind: data.sensor(f"{kind} {link}").data for kind in kinds}
            assert motion.position == pytest.approx(sensed["at"], abs=1e-9)
            assert motion.linear_velocity == pytest.approx(sensed["speed"], abs=1e-9)
            w, *xyz = sensed["turn"] * (-1 if sensed["turn"][0] < 0 else 1)
            assert motion.orientation == pytest.approx([*xyz, w], abs=1e-9)
            assert motion.angular_velocity == pytest.approx(sensed["rate"], abs=1e-9)
            up = data.site(link).xmat.reshape(3, 3).T @ (0.0, 0.0, G)
            scale = max(1.0, np.abs(data.qacc).max())
            assert motion.linear_acceleration + up == pytest.approx(sensed["force"], abs=1e-8 * scale)


def test_gears_references_couplings_and_mimic_joints_move_links():
    urdf = CRANE.replace(
        '<axis xyz="0 0.6 0.8"/>',
        '<axis xyz="0 0.6 0.8"/><mimic joint="turn" multiplier="-0.5" offset="0.2"/>',
    )
    turn = Turned("turn", 0.4, -0.25)
    pair = (MechanismServo(1, 0.1, 0.01), MechanismServo(2, 0.2, -0.01))
    coupling = Mechanism(pair, ("slide",), ((0.5, 0.5),), (NO_LOAD,), ("prismatic",))
    geared = SimulatedBody(bodies_of(urdf, (turn, None, None), (coupling,)))
    shafts = [np.array(each) for each in ([1.2, 3.0, -2.0], [1.0, 2.0, 0.5], [0.3, 0.2, 0.1])]
    geared.set_shafts(Shafts(0, *shafts))
    plain = body_of(CRANE, ["turn", "slide", "swing"])
    states = []
    for order, (a, b, c) in enumerate(shafts):
        q = -0.25 * (a - (0.4 if order == 0 else 0.0))
        x = 0.5 * (0.01 * (b - (0.1 if order == 0 else 0.0)) - 0.01 * (c - (0.2 if order == 0 else 0.0)))
        states.append(np.array([q, x, -0.5 * q + (0.2 if order == 0 else 0.0)]))
    plain.set_shafts(Shafts(0, *states))
    for name in ("position", "orientation", "angular_velocity", "linear_acceleration", "linear_velocity"):
        expected = getattr(plain.motion("tip"), name)
        assert getattr(geared.motion("tip"), name) == pytest.approx(expected, abs=1e-12)


def test_the_body_in_another_process_moves_as_in_this_one():
    mechanics = Mechanics(0)
    for angle in (0.1, 0.2, -0.3):
        mechanics.add_servo(ROTOR, NO_LOAD, angle)
    sensed = bodies_of(CRANE, [Turned(name, 0.0, 1.0) for name in ("turn", "slide", "swing")])
    memory = slot.private(9)
    shown = ShaftPublisher(mechanics, SlotWriter(memory))
    remote = RemoteBody(sensed, SlotReader(memory))
    here = SensedBody(sensed, mechanics, lambda: mechanics.grid_ns)
    for index in range(3):
        command = LIMP._replace(limit=1.0, torque_limit=1.0, bias=0.2 * (index + 1))
        mechanics.command_servo(index, command)
    for ms in range(2, 60, 6):
        mechanics.step_to(ms * 1_000_000)
        shown.write_shafts()
        remote.now_ns = lambda: mechanics.grid_ns
        for name in ("position", "orientation", "linear_velocity", "angular_velocity", "linear_acceleration"):
            expected = getattr(here.motion("tip"), name)
            assert getattr(remote.motion("tip"), name) == pytest.approx(expected, abs=1e-12)
    assert np.abs(remote.motion("tip").angular_velocity).max() > 0.1


def test_accelerations_are_those_of_the_last_step_and_nothing_at_rest():
    mechanics = Mechanics(0)
    mechanics.add_servo(ROTOR, NO_LOAD, 0.0)
    sensed = bodies_of(CRANE, [Turned("turn", 0.0, 1.0)])
    here = SensedBody(sensed, mechanics, lambda: mechanics.grid_ns)
    mechanics.command_servo(0, LIMP._replace(limit=1.0, torque_limit=1.0, bias=0.5))
    before = 0.0
    for step in range(1, 20):
        mechanics.step_to(step * STEP_NS)
        velocity = mechanics.plant.velocity.item(0)
        assert mechanics.acceleration.item(0) == pytest.approx((velocity - before) * 1e9 / STEP_NS)
        before = velocity
    # the trolley is 0.2 m from the axis: what pulls it along is the acceleration, what pulls it in the rate
    motion = here.motion("trolley")
    size = 0.2 * math.hypot(mechanics.acceleration.item(0), velocity**2)
    assert np.linalg.norm(motion.linear_acceleration) == pytest.approx(size)
    assert size > 1.0
    mechanics.move_shaft(0, 0.0)
    mechanics.command_servo(0, LIMP)
    mechanics.step_to(1_000 * STEP_NS)
    assert mechanics.still
    assert here.motion("trolley").linear_acceleration.tolist() == [0.0] * 3
