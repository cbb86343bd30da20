"""feed_forward: the inverse of the model of a servo, and its look-ahead; with `scripts/feed_forward.txt`."""

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.stages import Stage

from dxlrun import MotorLoad, MotorModel, Stribeck
from dxlrun_controllers.feed_forward import FeedForward
from dxlrun_controllers.laws.inverse_model import InverseServo, MotionAhead
from dxlsim.motion.motor import identified_motor
from dxlsim.motion.plant import IndependentJoints, PlantJoint
from dxlsim.simulation_plan import Load

MOTOR = MotorModel(
    "MX-64", 12.0, 1.6, 3.6, 0.011, 0.1, 0.08, 0.01, Stribeck(0.06, 0.5), 0.16, 32, 0,
    MotorLoad(0.01, 0.6, 0.4), torque_per_effort=1.6,
)  # fmt: skip
PLAIN = replace(MOTOR, stribeck=None, load=MotorLoad(), friction=0.0, load_friction=0.0, viscous_friction=0.0)
PERIOD_S = 0.02


@pytest.mark.parametrize("seed", range(20))
def test_the_torque_gives_the_acceleration_on_the_simulated_plant(seed):
    """The simulation's own equations, in small steps: where friction drives nothing, the model is theirs."""
    dice = np.random.default_rng(seed)
    q, w, a = dice.uniform(-2, 2), dice.choice((-1, 1)) * dice.uniform(0.3, 4), dice.uniform(-15, 15)
    inverse = InverseServo((MOTOR,), np.array([1e-3]))
    inverse.update(np.array([q]), np.array([w]), np.array([a]))
    load = MOTOR.load
    joint = PlantJoint(
        identified_motor(MOTOR), Load(load.inertia, 0.0, load.gravity, load.gravity_angle), float(q)
    )
    plant, dt = IndependentJoints([joint]), 1e-6
    plant.velocity[:] = w
    plant.step_shafts(inverse.torque.copy(), np.zeros(1), dt)
    assert (plant.velocity.item() - w) / dt == pytest.approx(a, abs=0.02)
    # and the duty gives that torque at that speed: stall torque and damping are the simulation's
    motor = joint.motor
    assert inverse.duty * motor.stall_torque - motor.damping * w == pytest.approx(inverse.torque)


def test_friction_has_no_jump_at_rest():
    speeds = np.linspace(-0.5, 0.5, 1001)
    inverse = InverseServo((replace(MOTOR, load=MotorLoad()),) * 1001, np.full(1001, 0.1))
    inverse.update(np.zeros(1001), speeds, np.zeros(1001))
    assert inverse.torque[500] == 0.0
    assert inverse.torque == pytest.approx(-inverse.torque[::-1])
    assert np.abs(np.diff(inverse.torque)).max() < 0.003
    assert inverse.torque[-1] > 0.1


@pytest.mark.parametrize("given", [True, False])
def test_the_motion_ahead_is_that_of_a_constant_acceleration(given):
    ahead = MotionAhead(1)
    ahead.ahead_s[:] = 0.015
    for k in range(4):
        t = k * PERIOD_S
        velocity = np.array([3.0 - 2.0 * t if given else np.nan])
        ahead.update(np.array([1.0 + 3.0 * t - t * t]), velocity, PERIOD_S)
    then = 3 * PERIOD_S + 0.015
    assert ahead.acceleration == pytest.approx(-2.0)
    # the difference of two positions is the velocity half a period ago
    late = 0.0 if given else PERIOD_S / 2 * 2.0
    assert ahead.velocity == pytest.approx(3.0 - 2.0 * then + late)
    assert ahead.position == pytest.approx(1.0 + 3.0 * then - then * then, abs=1e-9 if given else 4e-4)


def test_a_late_cycle_is_counted_with_its_length():
    ahead = MotionAhead(1)
    for t, period in ((0.0, 0.02), (0.02, 0.02), (0.08, 0.06)):
        ahead.update(np.array([5.0 * t]), np.array([5.0 * t]), period)
    assert ahead.acceleration == pytest.approx(5.0)


TWO = {"joints": ["a", "b"]}


def test_a_constant_speed_needs_the_back_emf_and_is_met_ahead():
    motor = replace(PLAIN, delay_ns=5_000_000)
    robot = Stage(FeedForward, TWO | {"lead": "2 ms"}, motors=(motor, motor)).activate()
    robot.context.references.position[:], robot.context.references.velocity[:] = 0.3, 2.0
    robot.step()
    ahead = 2.0 * (0.002 + 0.005 + PERIOD_S / 2) + 1.6 * 2.0 / 12.0 / (0.16 * 32)
    # the first update knows no acceleration, so it is that of a constant speed
    assert robot.commands.position == pytest.approx(0.3 + ahead)
    robot.change(scale={"a": 0.5, "b": 0.0})
    robot.step()
    assert robot.commands.position - 0.3 == pytest.approx([ahead / 2, 0.0])


@pytest.mark.parametrize(
    ("parameters", "motor", "what"),
    [
        ({}, replace(MOTOR, p_gain=0), "the P gain of a servo is declared as 0"),
        ({"command_interface": "effort", "pass_on": True}, MOTOR, "pass_on needs the key `into`"),
    ],
)
def test_what_it_cannot_work_with_is_refused_at_the_start(parameters, motor, what):
    with pytest.raises(ValueError, match=what):
        Stage(FeedForward, TWO | parameters, motors=(MOTOR, motor))
