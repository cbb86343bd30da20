"""Motor, load, control law and trajectory of simulated servos, against paper and pencil."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlsim.motion.compiled_mechanics import library
from dxlsim.motion.control_law import LIMP, ServoCommand
from dxlsim.motion.mechanics import AMBIENT_C, COOLING_S, STALLED_RISE_C, STEP_NS, Mechanics
from dxlsim.motion.motor import Motor, motor_of
from dxlsim.simulation_plan import NO_LOAD, Load
from dxlwire.control_table import all_tables

MOTOR = Motor(stall_torque=2.0, damping=1 / 3, torque_per_ampere=2.0, voltage=12.0, inertia=0.003)
S = 1_000_000_000
FULL = ServoCommand(bias=1.0, limit=1.0)
PENDULUM = Load(gravity=0.8, gravity_angle=1.0 - math.pi / 2)
"""Horizontal at 1 rad."""


def one(command: ServoCommand = LIMP, load: Load = NO_LOAD, angle: float = 0.0) -> Mechanics:
    mechanics = Mechanics(0)
    mechanics.add_servo(MOTOR, load, angle)
    mechanics.command_servo(0, command)
    return mechanics


def state(mechanics: Mechanics) -> tuple[float, float]:
    return float(mechanics.plant.angle[0]), float(mechanics.plant.velocity[0])


def after(seconds: float, *arrangement: object, angle: float = 0.0) -> tuple[float, float]:
    """Return angle and velocity of a command and a load after a time."""
    mechanics = one(*arrangement, angle=angle)  # type: ignore[arg-type]
    mechanics.step_to(round(seconds * S))
    return state(mechanics)


def pid(p: float, goal: float, **rest: float) -> ServoCommand:
    return ServoCommand(goal=goal, p_ccw=p, p_cw=p, limit=1.0)._replace(**rest)


# Motor


@pytest.mark.parametrize(
    ("seconds", "command", "load", "velocity"),
    [
        (1, FULL, NO_LOAD, 6.0),
        (1, FULL._replace(bias=0.5), NO_LOAD, 3.0),
        (1, FULL._replace(bias=-0.25), NO_LOAD, -1.5),
        # speed falls with torque in a line down to stall
        (1, FULL, Load(friction=1.0), 3.0),
        (1, FULL, Load(friction=2.01), 0.0),
        # 0.033 kg m^2 * 6 rad/s / 2 Nm = 0.099 s
        (0.1, FULL, Load(inertia=0.03), 6.0 * (1 - math.exp(-0.1 / 0.099))),
        # current control holds the torque up to what the voltage gives
        (1, FULL._replace(torque_limit=0.5), Load(inertia=1.0), 0.5 / 1.003),
        (1, FULL._replace(torque_limit=0.5), NO_LOAD, 6.0),
        (0.5, pid(5.0, 9.0, limit=0.2), NO_LOAD, 1.2),
    ],
)
def test_a_motor_turns_with_the_speed_of_duty_and_torque(seconds, command, load, velocity):
    assert after(seconds, command, load)[1] == pytest.approx(velocity, rel=0.02 if load.inertia else 1e-6)


def test_viscous_friction_slows_a_motor_in_its_time_constant():
    motor = msgspec.structs.replace(MOTOR, viscous_friction=1.0)
    mechanics = Mechanics(0)
    mechanics.add_servo(motor, NO_LOAD, 0.0)
    mechanics.command_servo(0, FULL)
    mechanics.step_to(2 * STEP_NS)
    assert state(mechanics)[1] == pytest.approx(1.5 * (1 - math.exp(-2 * DT / (0.003 / (4 / 3)))), rel=0.03)
    mechanics.step_to(S)
    assert state(mechanics)[1] == pytest.approx(1.5)


def test_less_voltage_is_less_speed_and_less_torque():
    mechanics = one(FULL, Load(friction=0.5))
    mechanics.supply(0, 9.0)
    mechanics.step_to(S)
    assert state(mechanics)[1] == pytest.approx(6.0 * 0.75 - 0.5 / MOTOR.damping)


def test_every_model_has_a_motor_that_turns():
    mechanics, tables = Mechanics(0), all_tables()
    for table in tables:
        mechanics.command_servo(mechanics.add_servo(motor_of(table), NO_LOAD, 0.0), FULL)
    mechanics.step_to(S // 2)
    speeds = [motor_of(table).no_load_speed for table in tables]
    assert mechanics.plant.velocity == pytest.approx(speeds, rel=1e-3)


# Load


def test_a_held_pendulum_sags_by_gravity_over_stiffness_but_for_an_integral():
    sag = 1.0 - after(2, pid(5.0, 1.0), PENDULUM)[0]
    assert 5.0 * 2.0 * sag == pytest.approx(0.8 * math.cos(sag), rel=1e-3)
    assert after(3, pid(5.0, 1.0, i=20.0), PENDULUM)[0] == pytest.approx(1.0, abs=1e-3)


def test_a_limp_link_falls_to_where_it_hangs_and_its_friction_holds_a_light_one():
    assert after(10, LIMP, Load(gravity=0.5), angle=1.5) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert after(10, LIMP, Load(gravity=0.5, friction=0.6), angle=1.5) == (1.5, 0.0)


def test_friction_leaves_the_error_that_its_torque_needs_until_an_integral_moves_it():
    angle, velocity = after(3, pid(5.0, 1.0, speed=1.0), Load(friction=0.2))
    assert 0 < 5.0 * 2.0 * (1.0 - angle) <= 0.2 + 1e-6
    assert velocity == 0.0
    mechanics = one(pid(5.0, 1.0, i=0.8), Load(friction=0.2), angle=0.99)
    mechanics.step_to(5 * S)
    assert state(mechanics) == (0.99, 0.0)
    mechanics.step_to(15 * S)
    assert state(mechanics)[0] == pytest.approx(1.0, abs=0.005)


# Position control


def highest_of(mechanics: Mechanics) -> float:
    """Return the highest angle of 2 s."""
    angles = [0.0]
    for now in range(0, 2 * S, STEP_NS):
        mechanics.step_to(now)
        angles.append(state(mechanics)[0])
    return max(angles)


def test_an_integral_waits_while_the_output_is_at_its_limit():
    assert highest_of(one(pid(5.0, 1.0, i=5.0, limit=0.2))) < 1.01


def test_a_step_settles_with_little_overshoot_and_a_servo_at_rest_wakes_for_a_new_goal():
    mechanics = one(pid(5.0, 1.0))
    assert highest_of(mechanics) < 1.02
    assert state(mechanics) == pytest.approx((1.0, 0.0), abs=1e-5)
    mechanics.step_to(5 * S)
    mechanics.aim(0, 0.5, 1.0, 100.0)
    mechanics.step_to(8 * S)
    assert state(mechanics)[0] == pytest.approx(0.5, abs=1e-5)


def test_within_the_margin_nothing_drives_and_beyond_it_the_punch_does():
    soft = pid(2.0, 1.0, margin_ccw=0.1, margin_cw=0.1, punch=0.05)
    assert after(1, soft, angle=0.91) == (0.91, 0.0)
    assert 0.9 <= after(1, soft, Load(friction=0.09), angle=0.89)[0] < 0.95  # the punch gives 0.1 Nm


def test_a_gain_given_later_acts_as_if_no_other_servo_had_one():
    def angle(alone: bool) -> float:
        mechanics = one(pid(5.0, 1.0), PENDULUM)
        if not alone:
            mechanics.command_servo(mechanics.add_servo(MOTOR, NO_LOAD, 0.0), pid(5.0, 1.0, i=9.0))
        mechanics.step_to(S)
        mechanics.command_servo(0, pid(5.0, 1.0, i=20.0))
        mechanics.step_to(S + 50_000_000)
        return state(mechanics)[0]

    assert angle(alone=False) == pytest.approx(angle(alone=True), abs=1e-4)


# Time


def test_steps_do_not_depend_on_when_somebody_looks():
    def run(period_ns: int) -> tuple[float, float]:
        mechanics = one(pid(5.0, 1.0, speed=2.0, acceleration=9.0), Load(gravity=0.3, friction=0.05))
        for now in range(period_ns, 730_000_001, period_ns):
            mechanics.step_to(now)
        return state(mechanics)

    assert run(1_000_000) == run(10_000_000) == run(730_000_000)


def test_a_servo_keeps_its_state_when_another_servo_is_added():
    """Motion, voltage, integral, temperature and time under overload."""

    def told(joins: bool) -> list[object]:
        noted: list[object] = []
        mechanics = one(pid(0.3, 1.0, i=2.0), Load(friction=0.8))
        mechanics.supply(0, 8.0)
        mechanics.heat(0, 50.0)
        mechanics.watch_servo(0, lambda: noted.append((mechanics.grid_ns, mechanics.overloaded(0))))
        mechanics.step_to(700_000_000)
        if joins:
            mechanics.add_servo(MOTOR, NO_LOAD, -1.0)
        mechanics.step_to(950_000_000)
        moved = state(mechanics)
        mechanics.command_servo(0, pid(50.0, 9.0))
        mechanics.plant.jam(0, True)
        mechanics.step_to(1_500_000_000)
        if joins:
            mechanics.add_servo(MOTOR, NO_LOAD, -1.0)
            mechanics.plant.jam(0, True)
        mechanics.step_to(4 * S)
        assert not joins or mechanics.plant.angle[1] == -1.0
        return [moved, state(mechanics), float(mechanics.servos["temperature"][0]), noted]

    alone = told(False)
    assert told(True) == alone
    assert any(overloaded for _, overloaded in alone[3])  # type: ignore[attr-defined]


def test_what_is_planned_happens_at_its_time_moving_or_at_rest():
    for command in (LIMP, FULL):
        mechanics, times = one(command), list[int]()
        for t_ns in (1_500_000_001, 300_000_000):
            mechanics.call_at(t_ns, lambda: times.append(mechanics.grid_ns))  # noqa: B023  run at once
        mechanics.step_to(2 * S)
        assert times == [300_000_000, 1_502_000_000]


@pytest.mark.parametrize("by", [-0.45, 0.3, 0.45])
def test_geared_load_turns_with_a_shaft_that_is_put_within_half_a_turn(by):
    speeds = []
    for put in (Mechanics.move_shaft, Mechanics.recount_turns):
        mechanics = one(LIMP, Load(gravity=1.0, gravity_angle=0.5, turns=0.5), 2.0)
        put(mechanics, 0, 2.0 + by * math.tau)
        mechanics.step_to(50_000_000)
        speeds.append(mechanics.plant.velocity.item(0))
    assert speeds[1] == speeds[0] != 0.0


def test_geared_load_whose_turns_were_recounted_hangs_as_before_when_a_servo_is_added():
    speeds = []
    for turns in (0, 1):
        mechanics = one(LIMP, Load(gravity=1.0, gravity_angle=0.5, turns=0.5), 2.0)
        mechanics.recount_turns(0, 2.0 + turns * math.tau)
        mechanics.add_servo(MOTOR, NO_LOAD, 0.0)
        mechanics.step_to(50_000_000)
        speeds.append(mechanics.plant.velocity.item(0))
    assert speeds[1] == pytest.approx(speeds[0])
    assert speeds[0] != 0.0


# Heat and overload


def test_copper_warms_by_the_square_of_the_torque_and_cools_again():
    mechanics = one(FULL._replace(bias=0.5), Load(friction=2.0))
    mechanics.step_to(60 * S)
    warm = AMBIENT_C + STALLED_RISE_C * 0.25 * (1 - math.exp(-60 / COOLING_S))
    assert mechanics.servos["temperature"][0] == pytest.approx(warm, rel=0.01)
    mechanics.command_servo(0, LIMP)
    mechanics.step_to(660 * S)
    cool = AMBIENT_C + (warm - AMBIENT_C) * math.exp(-600 / COOLING_S)
    assert mechanics.servos["temperature"][0] == pytest.approx(cool, rel=0.01)


def test_a_load_that_cannot_be_held_is_reported_after_a_second_and_a_hard_start_is_not():
    noted = []
    blocked = one(pid(5.0, 1.0), Load(friction=3.0))
    blocked.watch_servo(0, lambda: noted.append(blocked.grid_ns) if blocked.overloaded(0) else None)
    blocked.step_to(3 * S)
    assert noted[0] == pytest.approx(S, abs=200_000_000)
    starting = one(pid(5.0, 50.0), Load(inertia=0.1))
    starting.step_to(3 * S)
    assert not starting.overloaded(0)


def test_overload_that_ends_is_not_added_to_the_next_one():
    mechanics = one()
    for burst in range(3):
        begun = 2 * burst * S
        mechanics.command_servo(0, pid(50.0, 9.0))
        mechanics.plant.jam(0, True)
        mechanics.step_to(begun + 700_000_000)
        assert not mechanics.overloaded(0)
        mechanics.command_servo(0, LIMP)
        mechanics.step_to(begun + 2 * S)


def next_step(mechanics: Mechanics) -> int:
    return int(library().motion_next_step(mechanics.address))


def test_in_real_time_it_advances_often_while_it_moves_and_seldom_while_it_cools():
    mechanics = one(pid(5.0, 1.0))
    mechanics.step_to(100_000_000)
    assert next_step(mechanics) == mechanics.grid_ns + 8_000_000
    mechanics.step_to(3 * S)
    mechanics.heat(0, 30.01)
    mechanics.step_to(4 * S)
    assert next_step(mechanics) == mechanics.grid_ns + S
    mechanics.step_to(2_000 * S)
    assert next_step(mechanics) > 1 << 62
    mechanics.call_at(2_001 * S, lambda: None)
    assert next_step(mechanics) == 2_001 * S + STEP_NS
    mechanics.call_at(2_000 * S + 1, lambda: None)
    mechanics.step_to(2_000 * S + STEP_NS)  # The action is due, and the next step does it
    assert next_step(mechanics) == 2_000 * S + 2 * STEP_NS


DT = 0.002


def profile(command: ServoCommand, start: float = 0.0) -> Mechanics:
    """A servo with a command, whose torque nobody asks for."""
    mechanics = Mechanics(0)
    mechanics.add_servo(MOTOR, NO_LOAD, start)
    mechanics.command_servo(0, command._replace(limit=1.0))
    return mechanics


def run(mechanics: Mechanics, seconds: float) -> list[tuple[float, float]]:
    """Return setpoint and its velocity after each step."""
    seen = []
    for _ in range(round(seconds / DT)):
        mechanics.step_to(mechanics.grid_ns + STEP_NS)
        seen.append(mechanics.servos[["setpoint", "setpoint_velocity"]][0].item())
    return seen


@settings(max_examples=25, deadline=None)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(1, 10), st.floats(5, 200))
def test_from_rest_it_reaches_the_goal_in_time_within_its_bounds_and_never_passes_it(
    start, goal, speed, acceleration
):
    mechanics = profile(ServoCommand(goal=goal, speed=speed, acceleration=acceleration), start)
    distance, ramps = abs(goal - start), speed**2 / acceleration  # rad; to the speed, and back to rest
    trapezoid_s = distance / speed + speed / acceleration
    takes_s = trapezoid_s if distance > ramps else 2 * (distance / acceleration) ** 0.5
    seen = run(mechanics, takes_s + 0.1)
    arrived = next(index for index, (position, _) in enumerate(seen) if abs(position - goal) < 1e-6)
    assert arrived * DT == pytest.approx(takes_s, abs=4 * DT)
    low, high = min(start, goal) - 1e-9, max(start, goal) + 1e-9
    assert all(low <= position <= high for position, _ in seen)
    assert max(abs(velocity) for _, velocity in seen) <= speed + 1e-9
    steps = np.abs(np.diff([0.0, *(velocity for _, velocity in seen)]))
    assert steps.max() <= acceleration * DT + 1e-9
    assert seen[-1] == pytest.approx((goal, 0.0), abs=1e-9)


def test_another_goal_on_the_way_is_taken_up_with_the_velocity_that_it_has():
    mechanics = profile(ServoCommand(goal=3.0, speed=2.0, acceleration=10.0))
    before = run(mechanics, 0.5)[-1]
    mechanics.aim(0, -1.0, 2.0, 10.0)
    after = run(mechanics, 3.0)
    assert after[0][1] == pytest.approx(before[1] - 10.0 * DT)
    assert max(position for position, _ in after) == pytest.approx(before[0] + 2.0**2 / 20, abs=0.01)
    assert after[-1][0] == pytest.approx(-1.0)
