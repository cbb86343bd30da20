"""feed_forward: the inverse of the servo's model, look-ahead, references, bounds, live scale."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.stages import Stage

from dxlrun import MotorLoad, MotorModel, Stribeck
from dxlrun_controllers.feed_forward import FeedForward, FeedForwardParameters
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
TWO = {"joints": ["a", "b"]}


@pytest.mark.parametrize("seed", range(20))
def test_the_torque_gives_the_acceleration_on_the_simulated_plant(seed: int) -> None:
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


def test_friction_has_no_jump_at_rest() -> None:
    speeds = np.linspace(-0.5, 0.5, 1001)
    inverse = InverseServo((replace(MOTOR, load=MotorLoad()),) * 1001, np.full(1001, 0.1))
    inverse.update(np.zeros(1001), speeds, np.zeros(1001))
    assert inverse.torque[500] == 0.0
    assert inverse.torque == pytest.approx(-inverse.torque[::-1])
    assert np.abs(np.diff(inverse.torque)).max() < 0.003
    assert inverse.torque[-1] > 0.1


@pytest.mark.parametrize("given", [True, False])
def test_the_motion_ahead_is_that_of_a_constant_acceleration(given: bool) -> None:
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


def test_a_late_cycle_is_counted_with_its_length() -> None:
    ahead = MotionAhead(1)
    for t, period in ((0.0, 0.02), (0.02, 0.02), (0.08, 0.06)):
        ahead.update(np.array([5.0 * t]), np.array([5.0 * t]), period)
    assert ahead.acceleration == pytest.approx(5.0)


def started(parameters: dict[str, object] | None = None, **more: Any) -> Any:
    motors = more.pop("motors", (PLAIN, replace(PLAIN, load=MotorLoad(0.0, 0.5, 0.0))))
    robot = Stage(FeedForward, TWO | (parameters or {}), motors=motors, **more)
    robot.states.velocity[:] = 0.0
    robot.activate()
    return robot


def commanded(robot: Any, interface: str = "position", at_s: float = 0.0) -> np.ndarray:
    robot.controller.update(round(at_s * 1e9), round(PERIOD_S * 1e9))
    return getattr(robot.commands, interface).copy()


STIFF = 0.16 * 32
HOLD = 0.5 * math.sin(-0.2) * 3.6 / 1.6 / 12.0
"""Duty with which b, at -0.2 rad, holds its weight"""


def test_without_a_reference_joints_are_held_where_they_were() -> None:
    robot = started()
    assert commanded(robot) == pytest.approx([0.3, -0.2 + HOLD / STIFF])
    robot.states.position[:] = 1.0
    assert commanded(robot) == pytest.approx([0.3, -0.2 + HOLD / STIFF])
    robot.context.references.position[:] = [0.5, np.nan]
    robot.context.references.velocity[:] = 0.0
    assert commanded(robot) == pytest.approx([0.5, -0.2 + HOLD / STIFF])
    robot.context.references.position[:] = np.nan
    robot.context.references.velocity[:] = np.nan
    assert commanded(robot)[0] == pytest.approx(0.5)


def test_a_joint_that_was_never_read_gets_nothing_yet() -> None:
    robot = started(present=(np.nan, -0.2))
    robot.states.valid[:] = [False, True]
    assert np.isnan(commanded(robot)).tolist() == [True, False]
    robot.states.position[0], robot.states.valid[0] = 0.1, True
    assert commanded(robot)[0] == pytest.approx(0.1)
    robot = started({"command_interface": "pwm"}, present=(np.nan, -0.2))
    robot.states.valid[:] = [False, True]
    assert commanded(robot, "pwm") == pytest.approx([0.0, HOLD])


def test_a_constant_speed_needs_the_back_emf_and_is_met_ahead() -> None:
    motor = replace(PLAIN, delay_ns=5_000_000)
    robot = started({"lead": "2 ms"}, motors=(motor, motor))
    references = robot.context.references
    references.position[:], references.velocity[:] = 0.3, 2.0
    commanded(robot)
    ahead = 0.002 + 0.005 + PERIOD_S / 2
    # the first update knows no acceleration, so it is that of a constant speed
    assert robot.commands.position == pytest.approx(0.3 + 2.0 * ahead + 1.6 * 2.0 / 12.0 / STIFF)
    robot.change(0.0, scale={"a": 0.5, "b": 0.0})
    offset = commanded(robot) - 0.3
    assert offset == pytest.approx([(2.0 * ahead + 1.6 * 2.0 / 12.0 / STIFF) / 2, 0.0])


@pytest.mark.parametrize(
    ("parameters", "interface", "most"),
    [
        ({"most": {"a": 0.01, "b": 0.02}}, "position", [0.01, 0.02]),
        ({"most": 0.3, "command_interface": "pwm"}, "pwm", [0.3, 0.3]),
        ({"command_interface": "pwm"}, "pwm", [1.0, 1.0]),
        ({"command_interface": "effort"}, "effort", [0.7, 0.7]),
    ],
)
def test_what_is_added_has_a_bound(parameters: dict[str, object], interface: str, most: list[float]) -> None:
    robot = started(parameters, limits={"effort": 0.7})
    references = robot.context.references
    references.position[:], references.velocity[:] = 0.0, 0.0
    commanded(robot)
    for sign in (1, -1):
        references.velocity[:] = sign * 50.0
        assert commanded(robot, interface) == pytest.approx(sign * np.array(most))


def test_positions_stay_within_the_limits() -> None:
    robot = started(limits={"lower": -0.5, "upper": 0.5})
    references = robot.context.references
    references.position[:], references.velocity[:] = [0.499, -0.499], [3.0, -3.0]
    assert commanded(robot).tolist() == [0.5, -0.5]


def test_a_jump_of_the_reference_is_no_faster_than_the_joint() -> None:
    robot = started({"scale": 1.0}, limits={"velocity": 2.0, "acceleration": 5.0}, motors=(PLAIN,) * 2)
    robot.context.references.position[:] = 0.0
    commanded(robot)
    robot.context.references.position[:] = 1.0
    needed = (0.011 * 5.0 * 3.6 / 1.6 + 1.6 * (2.0 + 5.0 * PERIOD_S / 2)) / 12.0
    ahead = 2.0 * PERIOD_S / 2 + 5.0 * (PERIOD_S / 2) ** 2 / 2
    assert commanded(robot) == pytest.approx(1.0 + ahead + needed / STIFF)


def test_efforts_are_in_the_unit_of_the_servo_and_the_reference_goes_on() -> None:
    parameters = {"command_interface": "effort", "pass_on": True}
    robot = started(parameters, into=("pid",))
    references = robot.context.references
    references.position[:], references.velocity[:] = -0.2, np.nan
    commanded(robot)
    commands = robot.commands
    assert commands.effort == pytest.approx([0.0, 0.5 * math.sin(-0.2) / 1.6])
    assert (commands.position.tolist(), commands.velocity.tolist()) == ([-0.2, -0.2], [0.0, 0.0])


def test_the_measured_voltage_counts_slowly_and_never_wildly() -> None:
    robot = started({"voltage_filter": "180 ms", "command_interface": "pwm"})
    voltage = robot.states.voltage
    assert commanded(robot, "pwm")[1] == pytest.approx(HOLD)
    voltage[:] = [np.nan, 10.0]
    assert commanded(robot, "pwm")[1] == pytest.approx(HOLD * 12.0 / 11.8)  # a tenth of the way
    for _ in range(200):
        commanded(robot, "pwm")
    assert robot.commands.pwm[1] == pytest.approx(HOLD * 12.0 / 10.0)
    voltage[:] = 0.0
    for _ in range(200):
        commanded(robot, "pwm")
    assert robot.commands.pwm[1] == pytest.approx(HOLD * 2.0)
    voltage[:] = 11.0
    robot.activate()
    assert commanded(robot, "pwm")[1] == pytest.approx(HOLD * 12.0 / 11.0)


def test_the_state_is_published_fifty_times_a_second() -> None:
    robot = started()
    for k in range(50):
        robot.controller.update(k * 5_000_000, 5_000_000)
    assert len(robot.messages) == 13
    topic, state = robot.messages[-1]
    assert topic == "state"
    assert state.duty == pytest.approx([0.0, HOLD])


@pytest.mark.parametrize(
    ("parameters", "motors", "what"),
    [
        ({}, (MOTOR, None), "no motor file for "),
        ({}, (MOTOR, replace(MOTOR, p_gain=0)), "the P gain of a servo is declared as 0"),
        (
            {"command_interface": "effort", "pass_on": True},
            (MOTOR, MOTOR),
            "pass_on needs the key `into`",
        ),
    ],
)
def test_what_it_cannot_work_with_is_refused_at_the_start(
    parameters: dict[str, object], motors: tuple[MotorModel | None, ...], what: str
) -> None:
    with pytest.raises(ValueError, match=what):
        Stage(FeedForward, TWO | parameters, motors=motors)


def test_the_interfaces_name_what_they_need_of_the_motors() -> None:
    def of(**more: object) -> Any:
        return FeedForward.interfaces(FeedForwardParameters.model_validate(TWO | more), ("a", "b"))

    assert (of().command, of().motors) == (("position",), ("resistance", "position_gain"))
    assert of(command_interface="effort").motors == ("resistance", "torque_per_effort")
    assert of(command_interface="pwm", pass_on=True).command == ("position", "velocity", "pwm")
