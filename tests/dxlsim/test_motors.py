"""Simulated MX-64, MX-106, XL330 and XL-320 against published identifications of real ones (Rhoban BAM).

The reference is worked out here, from BAM's equations and from the parameters of two of its models: the
simplest (M1: Coulomb and viscous friction) and the fullest (M6). The simulation has those of a third, M3.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from msgspec import structs

from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import motor_of
from dxlsim.motor_model import MotorModel, Stribeck
from dxlsim.servo.making import make_servo
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import ServoConfig
from dxlwire.control_table import all_tables, find_table

S, STEP_NS = 1_000_000_000, 2_000_000
START = 1.0
"""rad"""


class Identified(NamedTuple):
    """A model of bam/params: base, and load times |torque|; more of both (`slow`) below `speed`."""

    kt: float
    resistance: float
    armature: float
    base: float
    viscous: float
    load: float = 0.0
    slow_base: float = 0.0
    slow_load: float = 0.0
    speed: float = 1.0
    alpha: float = 1.0

    def friction(self, torque: float, velocity: float) -> float:
        slow = math.exp(-(abs(velocity / self.speed) ** self.alpha))
        held = self.base + self.load * abs(torque) + slow * (self.slow_base + self.slow_load * abs(torque))
        return held + self.viscous * abs(velocity)


class Bench(NamedTuple):
    """A servo as BAM had it on its bench, bam/dynamixel/actuator.py, and as it is simulated here."""

    protocol: float
    voltage: float
    stiffness: float  # Duty per rad at the P gain that the servo is shipped with
    most_duty: float
    steps: tuple[int, ...]  # degrees; an XL-320 does not come to 90 % of a smaller one
    slow: tuple[str, int]  # A speed of about 0.06 rad/s
    rests: tuple[float, float]  # degrees of error in which it comes to rest without load
    gain: str  # The item of the P gain
    constant_s: float = 0.0  # J R / kt^2 of M1


STEPS, XL330 = (10, 30, 60, 90), 400 * 4096 / math.tau / 256 / 885
BENCH = {
    "MX-64": Bench(1.0, 15.0, 32 * 0.158, 0.9625, STEPS, ("moving_speed", 5), (0.15, 0.19), "p_gain", 0.0179),
    "MX-106": Bench(
        1.0, 15.0, 32 * 0.158, 0.9625, STEPS, ("moving_speed", 5), (0.08, 0.13), "p_gain", 0.0164
    ),
    "XL330-M288": Bench(
        2.0, 7.5, XL330, 1.0, STEPS, ("profile_velocity", 3), (0.5, 0.75), "position_p_gain", 0.0487
    ),
    "XL-320": Bench(2.0, 7.5, 32 * 0.05048199, 1.0, (60, 90), ("moving_speed", 5), (2.0, 5.0), "p_gain"),
}
M1 = {
    "MX-64": Identified(1.622467, 3.949434, 0.01195124, 0.09038677, 0.01169160),
    "MX-106": Identified(2.191376, 2.964990, 0.02660923, 0.1035203, 0.03520238),
    "XL330-M288": Identified(0.3866958, 4.017129, 0.001814167, 0.01283272, 0.003661672),
    "XL-320": Identified(0.9869471, 35.60910, 0.001118951, 0.02751450, 0.003317608),
}
# of the fullest model's terms those of the load's torque are left out, as there is none here
M6_ROWS = {
    "MX-64": "1.601683 2.316404 0.01226589 0 0.02533701 0.3114720 0.1226953 0.1877438 2.575277 0.8409018",
    "MX-106": "2.209828 2.033662 0.02601618 0 0.05071567 0.1980055 0.1219541 0.1985997 1.746325 1.142828",
    "XL330-M288": "0.3660135 2.811392 0.001807743 0.004771183 0.005359668 0.2667861 0.004676346 0 2.890372 "
    "8.68326",
    "XL-320": "1.008827 31.58588 0.001162986 0 0.007225172 0 0.01630551 0 2.301054 1.706736",
}
M6 = {model: Identified(*map(float, row.split())) for model, row in M6_ROWS.items()}
both = pytest.mark.parametrize("parameters", [M1, M6], ids=["M1", "M6"])
four = pytest.mark.parametrize("model", BENCH)

Way = npt.NDArray[np.float64]


def reference(parameters: Identified, bench: Bench, way: float, seconds: float, dt: float = 2e-4) -> Way:
    """Return the angles, rad, of a step, as BAM computes it: duty, torque, friction, motion."""
    angle = velocity = 0.0
    angles = []
    for _ in range(round(seconds / dt)):
        duty = max(-bench.most_duty, min(bench.most_duty, bench.stiffness * (way - angle)))
        torque = parameters.kt * (duty * bench.voltage - parameters.kt * velocity) / parameters.resistance
        stopping = parameters.armature / dt * velocity + torque
        rubbing = math.copysign(min(abs(stopping), parameters.friction(torque, velocity)), stopping)
        velocity += (torque - rubbing) / parameters.armature * dt
        angle += velocity * dt
        angles.append(angle)
    return np.array(angles)


def simulated(model: str, motor: MotorModel | None = None) -> tuple[SimulatedServo, Mechanics]:
    mechanics, bench = Mechanics(0), BENCH[model]
    config = ServoConfig(1, model, START, motor=motor)
    servo = make_servo(config, 1_000_000, 0, None, bench.protocol, mechanics=mechanics)
    servo.poke("shutdown", 0)  # BAM fed the XL330 with more than its limit
    servo.set_voltage(bench.voltage)
    servo.poke("torque_enable", 1)
    return servo, mechanics


def move(servo: SimulatedServo, mechanics: Mechanics, goal: float, seconds: float) -> tuple[Way, float]:
    """Return the angles after each step on the way to a goal, rad, and the goal as the register holds it."""
    unit = servo.registers.table.rad_per_tick
    tick = round(goal / unit)
    servo.poke("goal_position", tick)
    angles = []
    for _ in range(round(seconds * S / STEP_NS)):
        mechanics.step_to(mechanics.grid_ns + STEP_NS)
        angles.append(float(mechanics.plant.angle[0]))
    return np.array(angles), tick * unit


def rise_s(part: Way, dt: float) -> float:
    """Return the time from 10 to 90 % of a way."""

    def crossing(level: float) -> float:
        after = int(np.argmax(part > level))
        return (after - (part[after] - level) / (part[after] - part[after - 1])) * dt

    return crossing(0.9) - crossing(0.1)


@both
@four
def test_rise_times_are_within_15_percent_of_the_identified_servo(model, parameters):
    assert BENCH[model].steps
    for degrees in BENCH[model].steps:
        servo, mechanics = simulated(model)
        angles, goal = move(servo, mechanics, START + math.radians(degrees), 1.0)
        way = goal - START
        expected = rise_s(reference(parameters[model], BENCH[model], way, 1.0) / way, 2e-4)
        assert rise_s((angles - START) / way, 2e-3) == pytest.approx(expected, rel=0.15), f"{degrees} deg"


@pytest.mark.parametrize(
    ("model", "parameters"), [("MX-64", M1), ("XL330-M288", M6), ("XL-320", M6)], ids=["M1", "M6", "M6 slow"]
)
def test_a_servo_with_a_motor_file_is_that_motor(model, parameters):
    """As BAM's own equations of its parameters; its two small servos stick more near standstill."""
    known, bench = parameters[model], BENCH[model]
    stribeck = Stribeck(known.slow_base, known.speed, known.alpha) if known.slow_base else None
    electric = known.kt, known.resistance, known.armature
    motor = MotorModel(model, bench.voltage, *electric, known.base, known.load, known.viscous, stribeck)
    expected = reference(known, bench, math.radians(60), 1.0)[9::10]

    def off(motor: MotorModel | None) -> tuple[float, float]:
        """Return the greatest distance on the way, and that at its end, rad."""
        servo, mechanics = simulated(model, motor)
        angles, _ = move(servo, mechanics, START + math.radians(60), 1.0)
        distances = np.abs(angles - START - expected)
        return float(distances.max()), float(distances[-1])

    # a step of 2 ms in place of 0.2 ms, and the goal's tick
    (way, end), (own_way, _) = off(motor), off(None)
    assert way < 0.045
    assert end < 0.001
    assert own_way > 1.3 * way
    assert stribeck is None or off(structs.replace(motor, stribeck=None))[1] > 3 * end


@four
@pytest.mark.parametrize("direction", [1, -1])
def test_it_comes_to_rest_as_far_from_its_goal_as_real_ones_do(model, direction):
    servo, mechanics = simulated(model)
    servo.poke(*BENCH[model].slow)
    angles, goal = move(servo, mechanics, START + direction * 0.2, 6.0)
    assert angles[-1] == angles[-10]
    low, high = BENCH[model].rests
    assert low <= math.degrees(goal - angles[-1]) * direction <= high


@four
def test_time_constant_and_gain_are_those_that_were_identified(model):
    parameters, bench = M1[model], BENCH[model]
    table = find_table(model, bench.protocol)
    if bench.constant_s:
        constant_s = parameters.armature * parameters.resistance / parameters.kt**2
        assert constant_s == pytest.approx(bench.constant_s, abs=1e-4)
        motor = motor_of(table)
        # in M3 a part l of the torque goes into friction: 1 / (1 - l) of its J R / kt^2 compares
        assert motor.time_constant / (1 - motor.load_friction) == pytest.approx(constant_s, rel=0.1)
    servo, mechanics = simulated(model)
    # an error of 0.02 rad: less than friction holds, or caught before it moves
    goal = round((START + 0.02) / table.rad_per_tick)
    servo.poke("goal_position", goal)
    mechanics.step_to(STEP_NS)
    duty = float(mechanics.servos["duty"][0]) / (goal * table.rad_per_tick - START)
    assert duty == pytest.approx(bench.stiffness, rel=0.02)
    assert servo.registers[bench.gain] == table.items[bench.gain].initial


def test_models_that_nothing_was_published_of_keep_the_manual_s_figures_marked_so():
    assert all_tables()
    for table in all_tables():
        motor, identified = motor_of(table), table.model.partition("-FW")[0] in BENCH
        assert motor.source.startswith("[i] scaled from the ") != identified, table.model
        assert "Rhoban BAM" in motor.source
        if not identified:
            assert motor.no_load_speed == pytest.approx(table.max_speed), table.model
            assert motor.stall_torque == table.stall_torque or not table.stall_torque, table.model


@pytest.mark.parametrize(
    ("like", "models"),
    [
        ("XL330-M288", ("XL330-M077", "XL430-W250", "2XL430-W250", "AX-12A")),
        ("MX-106", ("EX-106+", "XM540-W270", "PH54-200-S500", "H54-200-S500-R(A)", "L54-50-S500-R")),
        ("MX-64", ("MX-28", "XM430-W350", "XC330-T288", "RX-28", "PH42-020-S300")),
    ],
)
def test_a_model_is_scaled_from_the_identified_motor_of_its_kind(like, models):
    for model in models:
        tables = [table for table in all_tables() if table.model == model]
        assert tables
        for table in tables:
            assert motor_of(table).source.startswith(f"[i] scaled from the {like}: "), model


def test_every_model_settles_where_it_should_without_much_overshoot():
    mechanics, tables = Mechanics(0), [table for table in all_tables() if table.model != "XL-320"]
    servos = [
        make_servo(ServoConfig(1, each.model, 1.0), 57_600, 0, None, each.protocol, mechanics=mechanics)
        for each in tables
    ]
    goals = []
    for servo, table in zip(servos, tables, strict=True):
        goals.append(round(min(1.5, 0.9 * table.max_tick * table.rad_per_tick) / table.rad_per_tick))
        servo.poke("torque_enable", 1)
        servo.poke("goal_position", goals[-1])
    highest = [0.0] * len(servos)
    for now in range(0, 3 * S, 10_000_000):
        mechanics.step_to(now)
        highest = [max(pair) for pair in zip(highest, mechanics.plant.angle.tolist(), strict=True)]
    torques = mechanics.servos["torque"].tolist()
    for servo, goal, top, torque in zip(servos, goals, highest, torques, strict=True):
        servo.advance_to(3 * S)
        table, margin = servo.registers.table, servo.registers.get("cw_compliance_margin")
        motor = motor_of(table)
        assert abs(torque) <= 1.001 * motor.friction / (1 - motor.load_friction)
        # so much friction leaves where gains are weakest, those of YM070
        rest = math.radians(2.3) + margin * table.rad_per_tick
        assert servo.shaft_angle == pytest.approx(goal * table.rad_per_tick, abs=rest)
        assert top < goal * table.rad_per_tick + 0.25 * 0.5, table.model  # most: the quick XL330-M077
        assert servo.registers.get("moving") == 0
