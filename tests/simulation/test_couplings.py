"""Joints with gears, slides, several servos and transmissions: judged by mechanics worked out by hand."""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from tests.kit.bodies import ARM, MASS, PULL, ROTOR, STEP_S, Turned, bodies_of, joint, link, run, urdf

from dxlrun_mujoco.mujoco_plant import mujoco_plant
from dxlsim.motion.coupled_joints import GIVE_RAD, CoupledJoints
from dxlsim.motion.mechanics import Mechanics, plant_of
from dxlsim.motion.motor import Motor
from dxlsim.motion.plant import IndependentJoints, Plant, PlantJoint, PlantMaker
from dxlsim.simulation_plan import NO_LOAD, Load, Mechanism, MechanismServo, SimulationConfig

S = 1_000_000_000
RUBBING = msgspec.structs.replace(ROTOR, damping=0.1, friction=0.05, load_friction=0.1, viscous_friction=0.01)
physics = pytest.mark.needs("physics")


def alone(per_rad: float, load: Load, reference: float = 0.3) -> Mechanism:
    return Mechanism((MechanismServo(0, reference, per_rad),), ("knee",), ((1.0,),), (load,))


def felt(load: Load, per_rad: float, reference: float = 0.3) -> Load:
    """Return a joint's load as its one servo feels it, through the ratio."""
    ratio = abs(per_rad)
    down = reference + load.gravity_angle / per_rad
    return Load(load.inertia * ratio**2, load.friction * ratio, load.gravity * ratio, down, turns=ratio)


def on_one_axis(load: Load = NO_LOAD, *per_rad: float, name: str = "hip") -> Mechanism:
    servos = tuple(MechanismServo(number, 0.0, each) for number, each in enumerate(per_rad or (1.0, -1.0)))
    return Mechanism(servos, (name,), ((1 / len(servos),) * len(servos),), (load,))


def differential(*loads: Load) -> Mechanism:
    servos = (MechanismServo(0, 0.0, 1.0), MechanismServo(1, 1.0, 1.0))
    return Mechanism(servos, ("pitch", "roll"), ((0.5, 0.5), (0.5, -0.5)), loads or (NO_LOAD, NO_LOAD))


def without_bodies(*mechanisms: Mechanism) -> PlantMaker:
    return plant_of(SimulationConfig((), mechanisms=mechanisms))


def plant(coupling: Mechanism, motor: Motor = ROTOR, angles: Sequence[float] = ()) -> CoupledJoints:
    placed = angles or [servo.reference for servo in coupling.servos]
    return CoupledJoints([coupling], [PlantJoint(motor, NO_LOAD, angle) for angle in placed])


def single(load: Load, angle: float, motor: Motor = ROTOR) -> IndependentJoints:
    return IndependentJoints([PlantJoint(motor, load, angle)])


@pytest.mark.parametrize("per_rad", [1.0, -1.0, 0.25, -3.0])
def test_a_load_behind_a_gear_is_felt_through_its_ratio(per_rad):
    load = Load(inertia=0.02, friction=0.03, gravity=0.2, gravity_angle=0.1)
    geared, coupled = single(felt(load, per_rad), 0.5, RUBBING), plant(alone(per_rad, load), RUBBING, [0.5])
    rng, ways = np.random.default_rng(3), []
    for _ in range(50):
        drive, damping = rng.uniform(-1, 1, 1), rng.uniform(0, 0.5, 1)
        for _ in range(10):
            geared.step_shafts(drive, damping, STEP_S)
            coupled.step_shafts(drive, damping, STEP_S)
        ways.append((geared.angle[0], coupled.angle[0]))
    alike, other = np.array(ways).T
    assert np.ptp(alike) > 0.1, "it moved"
    assert alike == pytest.approx(other, abs=1e-9)


def test_a_gear_of_four_holds_four_times_the_weight():
    held = single(felt(Load(0.1, gravity=2.0), 0.25), 0.3 + math.tau)
    # a turn of the servo: the link is horizontal
    assert held.angle[0] - 0.3 == pytest.approx(4 * math.pi / 2)
    run(held, 0.5, drive=0.5)
    assert held.angle[0] == pytest.approx(0.3 + math.tau)
    run(held, 0.5, drive=0.45)
    assert held.angle[0] < 0.3 + math.tau - 0.1


@pytest.mark.parametrize("coupled", [True, False])
def test_a_weight_on_a_slide_pulls_everywhere_alike(coupled):
    load = Load(0.01, steady=0.2)
    for angle in (0.0, 1.0, 50.0):
        slide = plant(alone(1.0, load), angles=[angle]) if coupled else single(load, angle)
        run(slide, 0.2, drive=0.2)
        assert slide.angle[0] == pytest.approx(angle)
        run(slide, 0.1, drive=0.0)
        assert slide.angle[0] - angle == pytest.approx(-0.2 / 0.02 * 0.1**2 / 2, rel=0.05)


def test_torques_of_servos_on_one_axis_add():
    moved = plant(on_one_axis(Load(inertia=0.08), 1.0, -1.0, 1.0))
    run(moved, 0.2, drive=[0.2, -0.3, 0.1])
    hip = (moved.angle @ [1, -1, 1]) / 3
    assert hip == pytest.approx(0.6 / (3 * 0.01 + 0.08) * 0.2**2 / 2, rel=0.02)
    assert moved.angle == pytest.approx([hip, -hip, hip], abs=0.5 * GIVE_RAD)


def test_what_works_against_the_others_bends_its_bracket():
    moved = plant(on_one_axis())
    run(moved, 3.0, drive=[0.9, 0.9], damping=0.3)
    # both pull counter-clockwise, and one is mounted the other way round: the axis stays
    assert moved.angle == pytest.approx([0.9 * GIVE_RAD] * 2, rel=1e-3)
    run(moved, 3.0, drive=[0.9, 0.0], damping=0.3)
    assert moved.angle[0] == pytest.approx(-moved.angle[1], abs=GIVE_RAD), "a limp one is dragged along"
    assert moved.angle[0] > 0.3


def test_a_blocked_servo_blocks_its_axis_but_for_what_gives():
    moved = plant(on_one_axis())
    moved.jam(0, True)
    run(moved, 3.0, drive=[-1.0, -1.0], damping=0.3)
    assert moved.angle[0] == pytest.approx(0.0, abs=1e-6)
    # the axis is between both: with two brackets in a row, and half of the way each
    assert moved.angle[1] == pytest.approx(-2 * GIVE_RAD, rel=1e-3)
    moved.jam(0, False)
    run(moved, 1.0, drive=[0.0, -1.0], damping=0.3)
    assert moved.angle[0] > 0.5


@pytest.mark.parametrize(("other", "inertia"), [(1, 0.06), (-1, 0.02)], ids=["sum", "difference"])
def test_a_differential_moves_one_joint_by_the_sum_and_one_by_the_difference(other, inertia):
    moved = plant(differential(Load(inertia=0.06), Load(inertia=0.02)))
    run(moved, 0.1, drive=[0.2, 0.2 * other])
    # each rotor feels a half of what its joint has: q is half of the sum
    way = 0.2 / (0.01 + inertia / 2) * 0.1**2 / 2
    assert moved.angle - [0, 1] == pytest.approx([way, way * other], rel=0.03)


def test_friction_of_servo_and_joint_holds_what_it_can_hold():
    motor = msgspec.structs.replace(ROTOR, friction=0.05)
    for drive, holds in ((0.095, True), (0.115, False)):  # 0.05 of each servo's own, and half of the joint's
        pushed = plant(differential(Load(0.02, friction=0.1), NO_LOAD), motor)
        run(pushed, 0.5, drive=[drive, drive])
        assert (pushed.angle == pytest.approx([0.0, 1.0], abs=1e-6)) == holds
        assert holds or pushed.angle[0] > 0.01


def mechanics_of(maker: PlantMaker, *angles: float) -> Mechanics:
    mechanics = Mechanics(0, maker)
    for angle in angles:
        mechanics.add_servo(ROTOR, NO_LOAD, angle)
    return mechanics


def test_a_hand_moves_what_is_on_one_axis_together():
    hip = mechanics_of(without_bodies(on_one_axis()), 0.0, 0.0, 0.0)
    hip.move_shaft(0, 0.4)
    assert hip.plant.angle == pytest.approx([0.4, -0.4, 0.0])
    wrist = mechanics_of(without_bodies(differential()), 0.0, 1.0)
    wrist.move_shaft(1, 1.3)
    assert wrist.plant.angle == pytest.approx([0.0, 1.3])


@pytest.mark.parametrize("later", [True, False])
@pytest.mark.parametrize("coupled", [True, False])
def test_a_servo_that_counts_again_moves_nothing(coupled, later):
    load = Load(0.02, gravity=0.4, gravity_angle=0.3)
    mechanics = Mechanics(0, without_bodies(*([alone(0.25, load)] if coupled else [])))
    braked = msgspec.structs.replace(ROTOR, damping=0.05)
    mechanics.add_servo(braked, NO_LOAD if coupled else felt(load, 0.25), 0.3 + 1.2 + math.tau)
    mechanics.recount_turns(0, 0.3 + 1.2)
    if later:
        mechanics.add_servo(ROTOR, NO_LOAD, 0.0)  # the plant is made again, and still knows
    mechanics.step_to(12 * S)
    # it hangs down where the joint is at 0.3 rad, a whole turn of the servo lower than it was counted
    assert mechanics.plant.angle[0] == pytest.approx(0.3 + 4 * 0.3 - math.tau, abs=2e-2)


def test_all_servos_of_one_simulation_move_as_if_each_coupling_were_alone():
    joints = [PlantJoint(ROTOR, NO_LOAD, angle) for angle in (0.0, 0.0, 2.0)]
    moved, one, pair = (
        CoupledJoints([on_one_axis()], joints),
        single(NO_LOAD, 2.0),
        plant(on_one_axis()),
    )
    run(moved, 0.3, drive=[0.1, -0.2, 0.3], damping=0.05)
    run(one, 0.3, drive=0.3, damping=0.05)
    run(pair, 0.3, drive=[0.1, -0.2], damping=0.05)
    assert [*moved.angle] == [*pair.angle, *one.angle]


# The same in MuJoCo

ARMS = urdf(link("a"), joint("pitch", "base", "a"), link("b"), joint("roll", "base", "b"))
LIFT = link("a") + joint("lift", "base", "a", kind="prismatic", axis="0 0 1")


def bodies(text: str, joints: Sequence[Turned | None], *couplings: Mechanism) -> Plant:
    references = {servo.index: servo.reference for one in couplings for servo in one.servos}
    references |= {row: one.reference for row, one in enumerate(joints) if one is not None}
    made = mujoco_plant(bodies_of(text, joints, couplings))
    return made([PlantJoint(ROTOR, NO_LOAD, references[row]) for row in sorted(references)])


@physics
@pytest.mark.parametrize("in_bodies", [True, False])
def test_servos_keep_their_order_whatever_that_of_their_coupling(in_bodies):
    servos = (MechanismServo(1, 2.0, -1.0), MechanismServo(0, 0.5, 1.0))
    reverse = Mechanism(servos, ("pitch",), ((0.5, 0.5),), (NO_LOAD,))
    made = mujoco_plant(bodies_of(ARMS, (), [reverse])) if in_bodies else without_bodies(reverse)
    moved = made([PlantJoint(ROTOR, NO_LOAD, 0.5), PlantJoint(ROTOR, NO_LOAD, 2.0)])
    assert moved.angle == pytest.approx([0.5, 2.0])
    moved.place_shaft(0, 0.8)
    assert moved.angle == pytest.approx([0.8, 1.7])


@physics
@pytest.mark.parametrize("per_rad", [0.25, -0.25, 2.0])
def test_a_body_behind_a_gear_is_held_through_its_ratio(per_rad):
    held = bodies(ARMS, [Turned("pitch", 1.5, per_rad)])
    run(held, 0.5, drive=PULL * per_rad, damping=0.2)
    assert held.angle[0] == pytest.approx(1.5, abs=1e-5)
    run(held, 0.3, drive=1.2 * PULL * per_rad, damping=0.2)
    assert (held.angle[0] - 1.5) * per_rad > 0.01


@physics
def test_a_body_on_a_slide_is_held_by_its_weight():
    per_rad = 0.01
    held = bodies(urdf(LIFT), [Turned("lift", 0.5, per_rad, ("prismatic",))])
    run(held, 0.5, drive=MASS * 9.81 * per_rad, damping=0.1)
    assert held.angle[0] == pytest.approx(0.5, abs=1e-5)
    run(held, 0.3, drive=0.0)
    # it falls 0.01 m for each rad of the servo, whose rotor falls with it
    fall = MASS * 9.81 / (MASS + ROTOR.inertia / per_rad**2) * 0.3**2 / 2
    assert held.angle[0] - 0.5 == pytest.approx(-fall / per_rad, rel=0.02)


@physics
def test_a_differential_holds_two_bodies_and_moves_as_coupled_joints_do():
    held = bodies(ARMS, [None, None], differential())
    # half of the sum is pitch, half of the difference roll: torques M' t
    run(held, 1.0, drive=[PULL, 0.0], damping=0.3)
    assert held.angle == pytest.approx([0.0, 1.0], abs=2e-3)
    run(held, 0.3, drive=[1.3 * PULL, 0.3 * PULL], damping=0.3)
    assert held.angle[0] > 0.02
    assert held.angle[1] > 1.02
    load = Load(MASS * ARM**2, gravity=PULL, gravity_angle=-math.pi / 2)
    coupled, swinging = plant(differential(load, load)), bodies(ARMS, [None, None], differential())
    for drive in ([0.3, 0.1], [0.9, 0.4], [0.0, 0.6]):
        for moved in (coupled, swinging):
            run(moved, 0.2, drive=drive, damping=0.2)
        assert swinging.angle == pytest.approx(coupled.angle, abs=0.03)
    assert abs(coupled.angle[0]) > 0.3


@physics
def test_a_joint_that_mimics_moves_with_the_one_it_mimics():
    grip = urdf(
        link("a"), joint("pitch", "base", "a"), link("b"),
        joint("roll", "base", "b", more='<mimic joint="pitch" multiplier="-0.5" offset="0.0"/>'),
        link("c"), joint("yaw", "base", "c", more='<mimic joint="roll" multiplier="2"/>'),
        link("d"), joint("stiff", "base", "d", more='<mimic joint="nowhere" multiplier="2"/>'),
    )  # fmt: skip
    held = bodies(grip, [Turned("pitch", 0.0, 1.0)])
    # its own weight, and those that hang on it the other way round: 1 - 0.5 - 1
    run(held, 1.0, drive=-0.5 * PULL, damping=0.3)
    assert held.angle[0] == pytest.approx(0.0, abs=5e-3)
    run(held, 0.3, drive=0.0, damping=0.3)
    assert held.angle[0] > 0.05


@physics
def test_a_blocked_body_stays():
    held = bodies(ARMS, [Turned("pitch", 0.0, 1.0), Turned("roll", 0.0, 1.0)])
    held.jam(0, True)
    run(held, 0.5)
    assert held.angle[0] == pytest.approx(0.0, abs=5e-3)
    assert held.angle[1] < -0.3
    held.jam(0, False)
    run(held, 0.5)
    assert held.angle[0] < -0.3
