"""`dxlrun characterize` finds what simulated servos were given: settings, formulas on them, or shafts."""

import functools
import itertools
import math
from typing import Any

import numpy as np
import pytest
from tests.kit.experiments import Plays

from dxlrun_lab.characterize import dead_band, gaps, rates, response, speeds
from dxlrun_lab.characterize.trace import Trace
from dxlrun_lab.guided.segment import Segment
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.motion.motor import motor_of
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, Load, ServoConfig, ServoTimes
from dxlwire.control_table import find_table

pytestmark = pytest.mark.long

FIVE_PERCENT = 0.05
MS = 1_000_000
CYCLE_S = 1 / 240
READ, SYNC_WRITE = 0x02, 0x83
MODELS = ("AX-12A", "MX-64", "XL430-W250", "XM430-W350")


def known(names: str, first: tuple[object, ...] | None, *others: tuple[object, ...]) -> pytest.MarkDecorator:
    """Parametrize: CI has the first case, the campaign all."""
    campaign = pytest.mark.campaign(ci=0, night=1, release=1)
    rows = [pytest.param(*first)] if first else []
    return pytest.mark.parametrize(
        names.split(), rows + [pytest.param(*row, marks=campaign) for row in others]
    )


def protocol_of(model: str) -> float:
    return 1.0 if model in ("AX-12A", "MX-64") else 2.0


def on_a_bench(model: str, delay_ns: int = 0, **registers: int) -> SimulatedBus:
    """Return a servo with torque, without a host."""
    config = ServoConfig(1, model, 2.6, load=Load(), times=ServoTimes(response_delay_ns=delay_ns))
    bus = SimulatedBus(BusConfig("main", 1_000_000, (config,), protocol_of(model)), Ledger(), 0)
    write(bus.servo(1), **registers, torque_enable=1)
    bus.advance_to(100 * MS)
    return bus


def write(servo: SimulatedServo, **registers: int) -> None:
    for name, value in registers.items():
        servo.registers[name] = value
    servo.shaft.plan(tuple(registers))


def turn_to(bus: SimulatedBus, angle: float) -> None:
    servo = bus.servo(1)
    write(servo, goal_position=round(angle / servo.registers.table.rad_per_tick))


def keys(**values: object) -> str:
    """Return a mapping as robot files have it."""
    return "{" + ", ".join(f"{key}: {value}" for key, value in values.items()) + "}"


def sent_to(done: Any, baud_rate: int) -> list[tuple[float, bytes]]:
    """Return when the last byte of each instruction had passed the wire, ns, by the ledger."""
    entries = done.rig.robot.link.simulated.ledger.entries
    return [
        (one.t_ns + len(one.data) * 1e10 / baud_rate, one.data) for one in entries if one.direction == "in"
    ]


@pytest.mark.parametrize(("model", "instruction_at"), [("MX-64", 4), ("XM430-W350", 7)])
def test_a_trace_has_the_times_at_which_the_servo_had_goals_and_positions(measures, model, instruction_at):
    """On a slow bus, by its ledger."""
    joints = []

    def to_and_fro(joint):
        joints.append(joint)
        yield Segment("to and fro", 0.1, {joint.name: joint.middle + 0.1 * (np.arange(20) % 2)})

    plays = Plays(to_and_fro)
    done = measures(plays, model, baud_rate=57_600, rate=40)
    trace = Trace.from_recording(plays.got[0], joints[0], done.rig.plan.buses)
    origin_ns = int(plays.got[0].of_cycles("woken_ns")[0])
    for instruction, times in ((READ, trace.time), (SYNC_WRITE, trace.sent[1:][np.diff(trace.goal) != 0])):
        ends = np.array([at for at, data in sent_to(done, 57_600) if data[instruction_at] == instruction])
        assert len(times) > 15
        assert max(np.abs(ends - origin_ns - time * 1e9).min() for time in times) < 20_000


@known("model write_ms", ("XM430-W350", 3), ("AX-12A", 2), ("AX-12A", 5), ("MX-64", 4), ("XL430-W250", 1))
def test_the_rate_is_that_at_which_the_servo_can_just_answer(measures, model, write_ms):
    """A read must end after the servo's time for the goal before it, which is the longer instruction."""
    done = measures(["rate"], model, simulation=f"{{write_time: {write_ms} ms}}")
    figure = done.figure(rates.NAME)
    pairs = itertools.pairwise(sent_to(done, 1_000_000)[500:])
    reads = [later - earlier for (earlier, one), (later, goal) in pairs if len(one) < len(goal)]
    assert figure.value == pytest.approx(1e9 / (np.median(reads) + write_ms * MS), rel=FIVE_PERCENT)
    assert figure.limit.startswith("the servo:")
    assert "joint (ID 1 on bus main) are lost at" in figure.limit


def test_a_slow_bus_is_named_as_what_limits_the_rate(measures):
    done = measures(["rate"], "MX-64", baud_rate=57_600)
    figure = done.figure(rates.NAME)
    assert figure.value == pytest.approx(done.rig.plan.buses[0].budget.highest_rate_hz, rel=0.01)
    assert figure.limit.startswith("the bus: at 57600 bit/s")


def risen_s(model: str, delay_ns: int, step: float) -> float:
    """Return the time to 63 % of a step of one packet, of a servo that is looked at each 0.1 ms."""
    bus = on_a_bench(model, delay_ns)
    for angle in (2.6 - step, 2.6):
        turn_to(bus, angle)
        bus.advance_to(bus.now_ns + 1000 * MS)
    rest, began_ns, way = bus.servo(1).shaft_angle, bus.now_ns, []
    turn_to(bus, 2.6 + step)
    for now_ns in range(began_ns, began_ns + 1000 * MS, MS // 10):
        bus.advance_to(now_ns)
        way.append(bus.servo(1).shaft_angle - rest)
    return next(number for number, one in enumerate(way) if one >= response.PART * way[-1]) * 1e-4


@known("model delay_ms", ("MX-64", 40), ("MX-64", 25), ("AX-12A", 50), ("XL430-W250", 50), ("XM430-W350", 40))
def test_the_response_is_the_delay_and_what_the_motor_needs(measures, model, delay_ms):
    done = measures(["response"], model, simulation=f"{{response_delay: {delay_ms} ms}}")
    first, most = done.figure(response.ONSET), done.figure(response.RISE)
    assert first.value == pytest.approx(delay_ms * 1e-3, rel=FIVE_PERCENT)
    assert abs(first.value - delay_ms * 1e-3) < first.uncertainty + 0.5e-3
    step = done.result.joints[0].steps[0].height
    assert most.value == pytest.approx(risen_s(model, delay_ms * MS, step), rel=FIVE_PERCENT)
    assert most.spread < 2e-3


@known("model delay_ms", ("AX-12A", 30), ("AX-12A", 10), ("XL430-W250", 5), ("XM430-W350", 12), ("MX-64", 0))
def test_a_response_that_few_loop_rates_show_is_within_its_interval(measures, model, delay_ms):
    """A controller of 50 Hz leaves multiples of it: samples that are 7 ms apart, of few ticks."""
    done = measures(
        ["response"],
        model,
        rate=50,
        direction=-1,
        simulation=f"{{response_delay: {delay_ms} ms}}",
        more="controllers: {states: {type: joint_state_broadcaster, rate: 50}}\n",
    )
    first = done.figure(response.ONSET)
    assert abs(first.value - delay_ms * 1e-3) < first.uncertainty
    assert first.value >= 0


@known(
    "model register ticks",
    ("XM430-W350", "profile_acceleration", 60),
    ("XM430-W350", "profile_acceleration", 20),
    ("MX-64", "goal_acceleration", 40),
    ("MX-64", "goal_acceleration", 100),
    ("XL430-W250", "profile_acceleration", 40),
)
def test_acceleration_and_braking_are_those_of_the_profile(measures, model, register, ticks):
    done = measures(["speed"], model, registers=keys(**{register: ticks}), reach=1.2)
    truth = ticks * find_table(model, protocol_of(model)).items[register].scale
    assert done.figure(speeds.ACCELERATION).value == pytest.approx(truth, rel=FIVE_PERCENT)
    assert done.figure(speeds.BRAKING).value == pytest.approx(truth, rel=FIVE_PERCENT)


@known("model", None, *((model,) for model in MODELS))
def test_the_top_speed_without_a_profile_is_the_motors(measures, model):
    done = measures(["speed"], model)
    motor = motor_of(find_table(model, protocol_of(model)))
    # its goals move as fast as the manual's no-load speed, which most of these motors have
    assert done.figure(speeds.TOP).value == pytest.approx(motor.no_load_speed, rel=FIVE_PERCENT)
    assert done.figure(speeds.ACCELERATION).value is not None


def resting_error(bus: SimulatedBus, friction: float) -> float:
    """Return how far a servo may rest from its goal, rad: margin, and friction over the gain.

    The motor holds while p (e - margin) + punch <= friction, which grows by load_friction of its torque.
    """
    motor, servo = motor_of(bus.servo(1).registers.table), bus.mechanics.servos[0]
    held = (motor.friction + friction) / (1 - motor.load_friction) / motor.stall_torque
    error = (held - servo["punch"]) / servo["p_ccw"]
    return float(servo["margin_ccw"] + max(0.0, error))


@known(
    "model friction registers",
    ("AX-12A", 0.0, {"cw_compliance_margin": 8, "ccw_compliance_margin": 8}),
    ("MX-64", 0.5, {}),
    ("MX-64", 0.3, {"p_gain": 16}),
    ("AX-12A", 0.15, {"cw_compliance_slope": 128, "ccw_compliance_slope": 128}),
    ("XL430-W250", 0.1, {}),
    ("XM430-W350", 0.2, {"position_p_gain": 400}),
)
def test_the_dead_band_is_margin_and_friction_over_the_gain(measures, model, friction, registers):
    truth = resting_error(on_a_bench(model, **registers), friction)
    friction_keys = keys(friction=f"{friction} Nm")
    done = measures(["dead_band"], model, simulation=friction_keys, registers=keys(**registers))
    band, change = done.figure(dead_band.NAME), done.figure(dead_band.REVERSAL)
    assert band.value == pytest.approx(truth, rel=FIVE_PERCENT)
    assert abs(band.value - truth) < band.uncertainty
    assert change.value == pytest.approx(2 * truth, rel=FIVE_PERCENT)
    if model == "AX-12A":
        tick = done.result.joints[0].joint.servo.rad_per_tick
        margin = math.degrees(registers.get("cw_compliance_margin", 1) * tick)
        assert band.limit.startswith(f"{margin:.2f} deg by the compliance margin")
    else:
        assert "the model has no compliance margin" in band.limit


@functools.cache
def way_of(model: str, gap_s: float, size: float, fastest: float, speeds_too: bool) -> tuple[float, ...]:
    """Return where the shaft is in a motion that is sent with gaps, rad.

    In cycles of 1 / 240 s, in each of which the gate lets the goal move by `fastest` / 240.
    """
    bus = on_a_bench(model)
    servo, began_ns, way, step, last, goal = bus.servo(1), bus.now_ns, [], 0, 0.0, 0.0
    table = servo.registers.table
    for number in range(round((gaps.MOTION_S + gaps.FADE_S) / CYCLE_S)):
        if number * CYCLE_S >= step * gap_s - 1e-9:
            place = float(gaps.motion(np.array([step * gap_s]), size)[0][0])
            speed = max(1, round(abs(place - last) / gap_s / table.rad_s_per_tick))
            if speeds_too:
                write(servo, **{table.goal_speed_item: speed})
            last, step = place, step + 1
        goal = min(max(last, goal - fastest * CYCLE_S), goal + fastest * CYCLE_S)
        turn_to(bus, 2.6 + goal)
        for part in (0.0, 0.25, 0.5, 0.75):
            bus.advance_to(began_ns + round((number + part) * CYCLE_S * 1e9))
            if number * CYCLE_S > gaps.FADE_S:
                way.append(servo.shaft_angle)
    return tuple(way)


def deviation(model: str, gap_s: float, *motion: Any) -> float:
    """Return by how much a motion with gaps leaves that which is sent in each cycle, rad."""
    ways = way_of(model, gap_s, *motion), way_of(model, CYCLE_S, *motion)
    return max(abs(a - b) for a, b in zip(*ways, strict=True))


@known("model degrees", ("MX-64", 1), ("MX-64", 4), ("AX-12A", 5), ("XM430-W350", 4))
def test_the_longest_gap_is_that_of_the_simulated_shaft(measures, model, degrees):
    tolerance = math.radians(degrees)
    done = measures(["gap"], model, tolerance=tolerance, reach=0.6)
    joint = done.result.joints[0].joint
    size = (joint.inner[1] - joint.inner[0]) / 2 / gaps.LARGEST
    for interface in ("position", "posvel"):
        figure = done.figure(f"longest gap, {interface}")
        motion = size, joint.plan.highest_speed, interface == "posvel"
        near = [round(figure.value * factor / CYCLE_S) * CYCLE_S for factor in (0.9, 1.1)]
        below, above = (deviation(model, gap_s, *motion) for gap_s in near)
        assert below <= tolerance <= above, interface
