"""What a servo moves: bodies of a URDF in MuJoCo, felt through its registers and worked out by hand."""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
import serial
from tests.kit.awaited import DEADLINE_S
from tests.kit.bodies import ARM, MASS, PULL, ROTOR, STEP_S, Turned, bodies_of, joint, link, run, urdf
from tests.kit.bus_process import BusProcess
from tests.kit.packets import packet2

from dxlrun.errors import InputError
from dxlrun_mujoco.mujoco_plant import mujoco_plant
from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.motion.plant import IndependentJoints, Plant, PlantJoint
from dxlsim.simulation_plan import NO_LOAD, BusConfig, Load, ServoConfig, SimulationConfig

TICK = math.tau / 4096
START = 2048
"""Ticks; there the arm is horizontal."""

URDF = f"""<robot name="arm"><link name="base"/>
<link name="arm"><inertial><origin xyz="{ARM} 0 0"/><mass value="{MASS}"/>
<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
</robot>"""
"""About +y: the arm sinks as its angle grows; the servo, which is mounted the other way round, turns back."""


def test_the_process_of_simulated_buses_moves_bodies():
    pytest.importorskip("mujoco")
    bodies = bodies_of(URDF, (Turned("shoulder", START * TICK, -1),))
    bus = BusConfig("main", 1_000_000, (ServoConfig(1, "XM430-W350", START * TICK),), 2.0)
    config = SimulationConfig((bus,), bodies=bodies)
    read = packet2(1, 0x02, bytes.fromhex("8400 0400"))  # present position
    with (
        BusProcess(config) as process,
        serial.Serial(process.ports["main"], 1_000_000, timeout=DEADLINE_S) as port,
    ):
        for _ in range(20_000):  # limp, it falls within a second, however busy the machine
            port.write(read)
            position = int.from_bytes(port.read(15)[9:13], "little", signed=True)
            if position < START - 500:
                break
    assert position < START - 500


RUBBING = msgspec.structs.replace(ROTOR, friction=0.05, load_friction=0.1, viscous_friction=0.01)
ONE = urdf(link("arm"), joint("shoulder", "base", "arm"))
FLAT = urdf(link("arm"), joint("shoulder", "base", "arm", axis="0 0 1"))
TWO = urdf(link("upper"), link("lower"), joint("shoulder", "base", "upper"), joint("elbow", "upper", "lower"))
SHOULDER, ELBOW = Turned("shoulder", 0.0, 1), Turned("elbow", 0.0, 1)
physics = pytest.mark.needs("physics")


def plant_of(
    text: str,
    *joints: Turned,
    angles: Sequence[float] = (),
    load: Load = NO_LOAD,
    rotor: Motor = ROTOR,
) -> Plant:
    joints = joints or (SHOULDER,)
    placed = [angles[row] if angles else joint.reference for row, joint in enumerate(joints)]
    return mujoco_plant(bodies_of(text, joints))([PlantJoint(rotor, load, angle) for angle in placed])


def is_held(plant: Plant, drive: float | list[float], within: float = 1e-6) -> bool:
    """Return whether the shafts stay where they are."""
    before = plant.angle.copy()
    run(plant, 1.0, drive=drive, damping=0.5)
    return bool(np.abs(plant.angle - before).max() <= within)


@physics
@pytest.mark.parametrize("rotor", [ROTOR, RUBBING], ids=["free", "rubbing"])
def test_a_joint_without_weight_moves_as_an_independent_one(rotor):
    load = Load(inertia=MASS * ARM**2, friction=0.05)
    bodies = plant_of(FLAT, load=load, rotor=rotor)
    alone = IndependentJoints([PlantJoint(rotor, load, 0.0)])
    rng, ways = np.random.default_rng(3), []
    for _ in range(200):
        drive, damping = rng.uniform(-1, 1, 1), rng.uniform(0, 0.5, 1)
        for _ in range(25):
            bodies.step_shafts(drive, damping, STEP_S)
            alone.step_shafts(drive, damping, STEP_S)
        ways.append((bodies.angle[0], alone.angle[0]))
    moved, expected = np.array(ways).T
    assert np.ptp(expected) > 1, "it moved"
    assert np.abs(moved - expected).max() < 0.01 * np.ptp(expected)


@physics
@pytest.mark.parametrize(("reference", "direction"), [(0.0, 1), (2.5, 1), (2.5, -1), (-1.0, -1)])
@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_an_arm_is_held_by_its_weight_times_its_lever(reference, direction, angle):
    servo_angle = reference + direction * angle
    plant = plant_of(ONE, Turned("shoulder", reference, direction), angles=[servo_angle])
    assert is_held(plant, direction * PULL * math.cos(angle))
    run(plant, 0.2, drive=direction * PULL * math.cos(angle) + 0.1, damping=0.5)
    assert plant.angle[0] > servo_angle + 0.01, "a positive torque turns a servo counter-clockwise"


@pytest.mark.parametrize("bodies", [pytest.param(True, id="bodies", marks=physics), False])
@pytest.mark.parametrize(("pulled", "falls"), [(0.25, False), (0.35, True)])
def test_friction_of_the_gear_grows_with_what_pulls_at_it(pulled, falls, bodies):
    gear = msgspec.structs.replace(ROTOR, load_friction=0.2)
    # held with 1 - p of the pull: friction is 0.2 of the sum of both, which the difference must not exceed
    plant: Plant = IndependentJoints([PlantJoint(gear, Load(MASS * ARM**2, 0.0, PULL, -math.pi / 2), 0.0)])
    if bodies:
        plant = plant_of(ONE, rotor=gear)
    run(plant, 2.0, drive=(1 - pulled) * PULL, damping=0.05)
    assert (plant.angle[0] < -0.05) == falls


@physics
@pytest.mark.parametrize("direction", [1, -1])
def test_damping_and_friction_of_the_urdf_are_added(direction):
    rubbed = FLAT.replace("</joint>", '<dynamics damping="0.3" friction="0.2"/></joint>')
    bodies = plant_of(rubbed, Turned("shoulder", 0.0, direction), load=Load(friction=0.1))
    run(bodies, 3.0, drive=0.5, damping=0.1)
    assert bodies.velocity[0] == pytest.approx((0.5 - 0.2 - 0.1) / (0.3 + 0.1), rel=0.01)


@physics
def test_the_shoulder_feels_what_the_elbow_does_and_joints_are_known_by_name():
    # both links stretched out: the lower weight hangs on two levers
    assert is_held(plant_of(TWO, SHOULDER, ELBOW), [PULL + 2 * PULL, PULL])
    assert is_held(plant_of(TWO, SHOULDER, ELBOW, angles=[0.0, math.pi / 2]), [PULL + PULL, 0.0])
    assert is_held(plant_of(TWO, Turned("elbow", 1.0, -1), Turned("shoulder", 3.0, 1)), [-PULL, 3 * PULL])


@physics
def test_what_the_urdf_does_not_turn_moves_alone_and_what_no_servo_turns_rests():
    text = urdf(
        link("upper"), link("lower"), link("finger"), joint("shoulder", "base", "upper"),
        joint("elbow", "upper", "lower"),
        joint("grip", "lower", "finger", kind="prismatic", more='<mimic joint="elbow" multiplier="2"/>'),
    )  # fmt: skip
    plant = plant_of(text, Turned("grip", 0.5, 1), SHOULDER, Turned("nowhere", 1.5, 1))
    run(plant, 1.0, drive=[0.0, PULL * (1 + 2 + 3), 0.02], damping=0.5)
    assert plant.angle[:2] == pytest.approx([0.5, 0.0], abs=1e-6)
    alone = IndependentJoints([PlantJoint(ROTOR, NO_LOAD, 1.5)])
    run(alone, 1.0, drive=0.02, damping=0.5)
    assert plant.angle[2] == alone.angle[0] > 1.5


@physics
def test_a_joint_with_a_servo_of_its_own_mimics_no_joint():
    mimic = TWO.replace('name="elbow"', 'name="wrist"').replace(
        "</joint></robot>", '<mimic joint="shoulder" multiplier="1"/></joint></robot>'
    )
    plant = plant_of(mimic, SHOULDER, Turned("wrist", 0.0, 1), angles=[0.0, math.pi / 2])
    assert is_held(plant, [2 * PULL, 0.0])


@physics
def test_missing_meshes_and_pictures_are_no_error():
    mesh = '<geometry><mesh filename="package://no_package/has/this.stl"/></geometry>'
    shapes = f"<visual>{mesh}</visual><collision>{mesh}</collision>"
    text = urdf(
        '<material name="wood"><texture filename="wood.png"/></material>',
        link("arm").replace("</link>", f"{shapes}</link>"),
        f'<link name="hand">{shapes}</link>',
        joint("shoulder", "base", "arm"),
        joint("wrist", "arm", "hand"),
    )
    assert is_held(plant_of(text, SHOULDER, Turned("wrist", 0.0, 1)), [PULL, 0.0], 1e-4)


@physics
def test_a_link_that_only_has_a_shape_weighs_as_water_does():
    box = '<collision><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.1 0.05"/></geometry></collision>'
    plant = plant_of(urdf(f'<link name="arm">{box}</link>', joint("shoulder", "base", "arm")))
    assert is_held(plant, 1000 * 0.1 * 0.1 * 0.05 * 9.81 * 0.1)


NAMES = "hinges of the URDF and joints of the robot file have different names; use"


@physics
@pytest.mark.parametrize(
    ("right", "wrong", "sentence"),
    [
        ('<parent link="base"/>', "", "MuJoCo cannot load the URDF: "),
        ("</robot>", "", "MuJoCo cannot load the URDF: "),
        ("shoulder", "schulter", NAMES),
        ("revolute", "fixed", NAMES),
    ],
)
def test_a_urdf_that_cannot_be_moved_is_reported_in_a_sentence(right, wrong, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        mujoco_plant(bodies_of(ONE.replace(right, wrong), (SHOULDER,)))
    assert len(caught.value.sentences) == 1


@physics
def test_a_hand_turns_a_body_evenly():
    mechanics = Mechanics(0, mujoco_plant(bodies_of(ONE, (SHOULDER,))))
    mechanics.add_servo(ROTOR, NO_LOAD, 0.0)
    mechanics.turn_shaft(0, 0.5, 1_000_000_000, lambda turned: pytest.fail("nothing drives it"))
    mechanics.step_to(500_000_000)
    assert mechanics.plant.angle[0] == pytest.approx(0.25)
    assert mechanics.plant.velocity[0] == pytest.approx(0.5)
    mechanics.step_to(1_000_000_000)
    assert mechanics.plant.angle[0] == pytest.approx(0.5)
    mechanics.step_to(1_300_000_000)  # then the hand lets go, and it falls
    assert mechanics.plant.angle[0] < 0.4
