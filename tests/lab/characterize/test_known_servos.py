"""`dxlrun characterize` finds what simulated servos were given: response, rate, dead band, speed, gaps.

The truths come from the simulation: its settings, formulas on them, or its own shaft looked at closely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from dxlrun_lab.characterize import dead_band, gaps, rates, response, speeds
from dxlrun_lab.characterize.trace import Trace
from dxlrun_lab.guided.experiment import Procedure, Situation
from dxlrun_lab.guided.segment import Segment, SegmentRecording
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.motion.control_law import ROWS
from dxlsim.motion.motor import motor_of
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, Load, ServoConfig, ServoTimes

pytestmark = pytest.mark.long

FIVE_PERCENT = 0.05
MS = 1_000_000
PROTOCOLS = {"AX-12A": 1.0, "MX-64": 1.0, "XL430-W250": 2.0, "XM430-W350": 2.0}
Measures = Callable[..., Any]
campaign = pytest.mark.campaign(ci=0, night=1, release=1)
CYCLE_S = 1 / 240
READ, SYNC_WRITE = 0x02, 0x83


def on_a_bench(model: str, load: Load | None = None, delay_ns: int = 0, **registers: int) -> SimulatedBus:
    """Return a servo with torque, without a host."""
    config = ServoConfig(1, model, 2.6, load=load or Load(), times=ServoTimes(response_delay_ns=delay_ns))
    bus = SimulatedBus(BusConfig("main", 1_000_000, (config,), PROTOCOLS[model]), Ledger(), 0)
    write(bus.servo(1), **registers, torque_enable=1)
    bus.advance_to(100 * MS)
    return bus


def write(servo: SimulatedServo, **registers: int) -> None:
    for name, value in registers.items():
        servo.registers[name] = value
    servo.shaft.plan(tuple(registers))


def go(bus: SimulatedBus, angle: float) -> None:
    servo = bus.servo(1)
    write(servo, goal_position=round(angle / servo.registers.table.rad_per_tick))


# Times


class OneSegment:
    """An experiment of one segment; its result is the joint's trace, and the time from which that counts."""

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        return ()

    def procedure(self, situation: Situation) -> Procedure:
        (joint,) = situation.joints
        yield Segment("to and fro", 0.1, {joint.name: joint.middle + 0.1 * (np.arange(20) % 2)})

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> tuple[Trace, int]:
        trace = Trace.from_recording(recorded[0], situation.joints[0], situation.plan.buses)
        return trace, int(recorded[0].of_cycles("woken_ns")[0])


@pytest.mark.parametrize(("model", "instruction_at"), [("MX-64", 4), ("XM430-W350", 7)])
def test_a_trace_has_the_times_at_which_the_servo_had_goals_and_positions(measures, model, instruction_at):
    """On a slow bus, by its ledger: when the last bytes of reads and goals had passed the wire."""
    done = measures(OneSegment(), model, protocol=PROTOCOLS[model], baud_rate=57_600, rate=40)
    trace, origin_ns = done.result
    sent = [entry for entry in done.rig.robot.link.simulated.ledger.entries if entry.direction == "in"]
    for instruction, times in ((READ, trace.time), (SYNC_WRITE, trace.sent[1:][np.diff(trace.goal) != 0])):
        ends = np.array(
            [
                one.t_ns + len(one.data) * 1e10 / 57_600
                for one in sent
                if one.data[instruction_at] == instruction
            ]
        )
        assert len(times) > 15
        assert max(np.abs(ends - origin_ns - time * 1e9).min() for time in times) < 20_000


# Rate


def least_period_ns(done: Any, write_time_ns: int) -> float:
    """Return the shortest period in which a read ends after the servo's time for the goal before it is over.

    By the ledger: in each cycle a read is followed by a goal, which is the longer instruction.
    """
    byte_ns = 1e10 / done.rig.plan.buses[0].baud_rate
    sent = [entry for entry in done.rig.robot.link.simulated.ledger.entries if entry.direction == "in"][500:]
    ends = [entry.t_ns + len(entry.data) * byte_ns for entry in sent]
    between = [
        later - earlier
        for earlier, later, first, second in zip(ends, ends[1:], sent, sent[1:], strict=False)
        if len(first.data) < len(second.data)
    ]
    return sorted(between)[len(between) // 2] + write_time_ns


@pytest.mark.parametrize(
    ("model", "write_ms"),
    [
        ("XM430-W350", 3),
        pytest.param("AX-12A", 2, marks=campaign),
        pytest.param("AX-12A", 5, marks=campaign),
        pytest.param("MX-64", 4, marks=campaign),
        pytest.param("XL430-W250", 1, marks=campaign),
    ],
)
def test_the_rate_is_that_at_which_the_servo_can_just_answer(measures, model, write_ms):
    simulation = f"{{write_time: {write_ms} ms}}"
    done = measures(["rate"], model, protocol=PROTOCOLS[model], simulation=simulation)
    truth = 1e9 / least_period_ns(done, write_ms * MS)
    figure = done.figure(rates.NAME)
    assert figure.value == pytest.approx(truth, rel=FIVE_PERCENT)
    assert figure.limit.startswith("the servo:")
    assert "joint (ID 1 on bus main) are lost at" in figure.limit


def test_a_slow_bus_is_named_as_what_limits_the_rate(measures):
    done = measures(["rate"], "MX-64", baud_rate=57_600, rate=100)
    bus = done.rig.plan.buses[0]
    figure = done.figure(rates.NAME)
    assert figure.value == pytest.approx(bus.budget.highest_rate_hz, rel=0.01)
    assert figure.limit.startswith("the bus: at 57600 bit/s")


# Response


def risen_s(model: str, delay_ns: int, step: float) -> float:
    """Return the time to 63 % of a step of one packet, of a servo that is looked at each 0.1 ms."""
    bus = on_a_bench(model, delay_ns=delay_ns)
    for angle in (2.6 - step, 2.6):
        go(bus, angle)
        bus.advance_to(bus.now_ns + 1000 * MS)
    rest, began_ns, way = bus.servo(1).shaft_angle, bus.now_ns, []
    go(bus, 2.6 + step)
    for now_ns in range(began_ns, began_ns + 1000 * MS, MS // 10):
        bus.advance_to(now_ns)
        way.append(bus.servo(1).shaft_angle - rest)
    return next(number for number, one in enumerate(way) if one >= response.PART * way[-1]) * 1e-4


@pytest.mark.parametrize(
    ("model", "delay_ms"),
    [
        ("MX-64", 40),
        pytest.param("MX-64", 25, marks=campaign),
        pytest.param("AX-12A", 50, marks=campaign),
        pytest.param("XL430-W250", 50, marks=campaign),
        pytest.param("XM430-W350", 40, marks=campaign),
    ],
)
def test_the_response_is_the_delay_and_what_the_motor_needs(measures, model, delay_ms):
    simulation = f"{{response_delay: {delay_ms} ms}}"
    done = measures(["response"], model, protocol=PROTOCOLS[model], simulation=simulation)
    first, most = done.figure(response.ONSET), done.figure(response.RISE)
    assert first.value == pytest.approx(delay_ms * 1e-3, rel=FIVE_PERCENT)
    assert abs(first.value - delay_ms * 1e-3) < first.uncertainty + 0.5e-3
    step = done.result.joints[0].steps[0].height
    assert most.value == pytest.approx(risen_s(model, delay_ms * MS, step), rel=FIVE_PERCENT)
    assert most.spread < 2e-3


BROADCASTER = "controllers: {states: {type: joint_state_broadcaster, rate: 50}}\n"


@pytest.mark.parametrize(
    ("model", "delay_ms"),
    [
        ("AX-12A", 30),
        pytest.param("AX-12A", 10, marks=campaign),
        pytest.param("XL430-W250", 5, marks=campaign),
        pytest.param("XM430-W350", 12, marks=campaign),
        pytest.param("MX-64", 0, marks=campaign),
    ],
)
def test_a_response_that_few_loop_rates_show_is_within_its_interval(measures, model, delay_ms):
    """A controller of 50 Hz leaves multiples of it: samples that are 7 ms apart, of few ticks."""
    done = measures(
        ["response"],
        model,
        protocol=PROTOCOLS[model],
        rate=50,
        direction=-1,
        simulation=f"{{response_delay: {delay_ms} ms}}",
        more=BROADCASTER,
    )
    first = done.figure(response.ONSET)
    assert abs(first.value - delay_ms * 1e-3) < first.uncertainty
    assert first.value >= 0


# Speed


@pytest.mark.parametrize(
    ("model", "register", "ticks"),
    [
        ("XM430-W350", "profile_acceleration", 60),
        pytest.param("XM430-W350", "profile_acceleration", 20, marks=campaign),
        pytest.param("MX-64", "goal_acceleration", 40, marks=campaign),
        pytest.param("MX-64", "goal_acceleration", 100, marks=campaign),
        pytest.param("XL430-W250", "profile_acceleration", 40, marks=campaign),
    ],
)
def test_acceleration_and_braking_are_those_of_the_profile(measures, model, register, ticks):
    registers = f"{{{register}: {ticks}}}"
    done = measures(["speed"], model, protocol=PROTOCOLS[model], registers=registers, reach=1.2)
    truth = ticks * done.rig.robot.link.simulated.buses[0].servo(1).registers.table.items[register].scale
    assert done.figure(speeds.ACCELERATION).value == pytest.approx(truth, rel=FIVE_PERCENT)
    assert done.figure(speeds.BRAKING).value == pytest.approx(truth, rel=FIVE_PERCENT)


@pytest.mark.parametrize("model", [pytest.param(model, marks=campaign) for model in PROTOCOLS])
def test_the_top_speed_without_a_profile_is_the_motors(measures, model):
    done = measures(["speed"], model, protocol=PROTOCOLS[model])
    motor = motor_of(done.rig.robot.link.simulated.buses[0].servo(1).registers.table)
    figure = done.figure(speeds.TOP)
    # its goals go as fast as the manual's no-load speed, which most of these motors have: either may limit it
    assert figure.value == pytest.approx(motor.no_load_speed, rel=FIVE_PERCENT)
    assert done.figure(speeds.ACCELERATION).value is not None


# Dead band


def resting_error(bus: SimulatedBus, friction: float) -> float:
    """Return how far a servo may rest from its goal, rad: margin, and friction over the gain.

    The motor holds while p (e - margin) + punch <= friction, which grows by load_friction of its torque.
    """
    motor, commands = motor_of(bus.servo(1).registers.table), bus.mechanics._commands[:, 0]
    held = (motor.friction + friction) / (1 - motor.load_friction) / motor.stall_torque
    error = (held - commands[ROWS["punch"]]) / commands[ROWS["p_ccw"]]
    return float(commands[ROWS["margin_ccw"]] + max(0.0, error))


@pytest.mark.parametrize(
    ("model", "friction", "registers"),
    [
        ("AX-12A", 0.0, {"cw_compliance_margin": 8, "ccw_compliance_margin": 8}),
        pytest.param("MX-64", 0.5, {}, marks=campaign),
        pytest.param("MX-64", 0.3, {"p_gain": 16}, marks=campaign),
        pytest.param(
            "AX-12A", 0.15, {"cw_compliance_slope": 128, "ccw_compliance_slope": 128}, marks=campaign
        ),
        pytest.param("XL430-W250", 0.1, {}, marks=campaign),
        pytest.param("XM430-W350", 0.2, {"position_p_gain": 400}, marks=campaign),
    ],
)
def test_the_dead_band_is_margin_and_friction_over_the_gain(measures, model, friction, registers):
    truth = resting_error(on_a_bench(model, **registers), friction)
    text = ", ".join(f"{name}: {value}" for name, value in registers.items())
    done = measures(
        ["dead_band"],
        model,
        protocol=PROTOCOLS[model],
        simulation=f"{{friction: {friction} Nm}}",
        registers=f"{{{text}}}",
    )
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


# Gaps


def deviation(model: str, gap_s: float, size: float, fastest: float, speeds_too: bool) -> float:
    """Return by how much a motion that is sent with gaps leaves that which is sent in each cycle, rad.

    In cycles of 1 / 240 s, in each of which the gate lets the goal go on by `fastest` / 240.
    """
    ways = []
    for each in (gap_s, CYCLE_S):
        bus = on_a_bench(model)
        servo, began_ns, way, step, last, goal = bus.servo(1), bus.now_ns, [], 0, 0.0, 0.0
        table = servo.registers.table
        for number in range(round((gaps.MOTION_S + gaps.FADE_S) / CYCLE_S)):
            if number * CYCLE_S >= step * each - 1e-9:
                place = float(gaps.motion(np.array([step * each]), size)[0][0])
                speed = max(1, round(abs(place - last) / each / table.rad_s_per_tick))
                if speeds_too:
                    write(servo, **{table.goal_speed_item: speed})
                last, step = place, step + 1
            goal = min(max(last, goal - fastest * CYCLE_S), goal + fastest * CYCLE_S)
            go(bus, 2.6 + goal)
            for part in (0.0, 0.25, 0.5, 0.75):
                bus.advance_to(began_ns + round((number + part) * CYCLE_S * 1e9))
                if number * CYCLE_S > gaps.FADE_S:
                    way.append(servo.shaft_angle)
        ways.append(way)
    return max(abs(a - b) for a, b in zip(*ways, strict=True))


def true_gap(  # noqa: PLR0917  the measured one, and what deviation() takes
    model: str, near: float, tolerance: float, size: float, fastest: float, speeds_too: bool
) -> float:
    """Return the gap at which the deviation is the tolerance, between two whole numbers of cycles."""
    number = math.floor(near / CYCLE_S)
    known: dict[int, float] = {}
    for _ in range(8):
        for each in (number, number + 1):
            known.setdefault(each, deviation(model, each * CYCLE_S, size, fastest, speeds_too))
        below, above = known[number], known[number + 1]
        if below <= tolerance < above:
            return (number + (tolerance - below) / (above - below)) * CYCLE_S
        number += 1 if above <= tolerance else -1
    raise AssertionError(f"the tolerance is not left near {near}: {known}")


@pytest.mark.parametrize(
    ("model", "degrees"),
    [
        ("MX-64", 1),
        pytest.param("MX-64", 4, marks=campaign),
        pytest.param("AX-12A", 5, marks=campaign),
        pytest.param("XM430-W350", 4, marks=campaign),
    ],
)
def test_the_longest_gap_is_that_of_the_simulated_shaft(measures, model, degrees):
    tolerance = math.radians(degrees)
    done = measures(["gap"], model, protocol=PROTOCOLS[model], tolerance=tolerance, reach=0.6)
    joint = done.result.joints[0]
    low, high = joint.joint.inner
    size = (high - low) / 2 / gaps.LARGEST
    for interface in ("position", "posvel"):
        figure = done.figure(f"longest gap, {interface}")
        fastest = joint.joint.plan.highest_speed
        truth = true_gap(model, figure.value, tolerance, size, fastest, interface == "posvel")
        assert figure.value == pytest.approx(truth, rel=2 * FIVE_PERCENT), (
            interface
        )  # counted in cycles of 4 ms
        assert abs(figure.value - truth) < figure.uncertainty
