"""Servos that are slow: a delay between an instruction and the motor, and a time after a write."""

from __future__ import annotations

import pytest
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, ServoConfig, ServoTimes

MS = 1_000_000
both = pytest.mark.parametrize(("model", "goal"), [("AX-12A", 700), ("XM430-W350", 3000)])


def bus_of(model: str, delay_ms: int = 0) -> SimulatedBus:
    servo = ServoConfig(1, model, 2.0, times=ServoTimes(response_delay_ns=delay_ms * MS))
    return SimulatedBus(
        BusConfig("main", 1_000_000, (servo,), 1.0 if model == "AX-12A" else 2.0), Ledger(), 0
    )


def command(servo: SimulatedServo, **items: int) -> None:
    for name, value in items.items():
        servo.registers[name] = value
        servo.shaft.plan((name,))


def way(bus: SimulatedBus, goal: int, until_ns: int) -> list[float]:
    """Give a goal with torque now; return how far the shaft is each 0.1 ms from now on."""
    servo, began_ns = bus.servo(1), bus.now_ns
    command(servo, torque_enable=1, goal_position=goal)
    before, moved = servo.shaft_angle, []
    for now_ns in range(began_ns, began_ns + until_ns, MS // 10):
        bus.advance_to(now_ns)
        moved.append(servo.shaft_angle - before)
    return moved


@both
@pytest.mark.parametrize("delay_ms", [1, 6, 20])
def test_a_servo_acts_a_response_delay_later_and_then_as_ever(model, goal, delay_ms):
    quick = way(bus_of(model), goal, 200 * MS)
    slow = way(bus_of(model, delay_ms), goal, 200 * MS)
    grid = 20  # points of 0.1 ms in a step of the mechanics
    shift = -(-10 * delay_ms // grid) * grid
    assert slow[shift:] == pytest.approx(quick[: len(slow) - shift], abs=1e-12)
    assert not any(slow[:shift])
    assert quick[grid]


@pytest.mark.parametrize(
    ("model", "item"),
    [
        ("XM430-W350", "torque_enable"),
        ("XM430-W350", "goal_pwm"),
        ("AX-12A", "torque_enable"),
        ("AX-12A", "torque_limit"),
    ],
)
def test_torque_off_or_a_limit_of_0_acts_at_once_and_withdraws_what_has_not_acted_yet(model, item):
    bus = bus_of(model, delay_ms=20)
    way(bus, 700, 10 * MS)
    servo = bus.servo(1)
    command(servo, **{item: 0})
    bus.advance_to(200 * MS)
    assert servo.shaft_angle == pytest.approx(2.0)
    assert servo.velocity == 0.0


def test_goals_act_in_the_order_and_at_the_distance_in_which_they_came():
    bus = bus_of("XM430-W350", delay_ms=50)
    way(bus, 1304, 400 * MS)  # 2 rad: it stays
    servo = bus.servo(1)
    unit = servo.registers.table.rad_per_tick
    for goal in (1400, 1500):
        command(servo, goal_position=goal)
        bus.advance_to(bus.now_ns + 30 * MS)
    # 60 ms after the first goal only this one acts
    assert servo.shaft.mechanics.servos["setpoint"][0] == pytest.approx(1400 * unit)
    bus.advance_to(bus.now_ns + 500 * MS)
    assert servo.shaft_angle == pytest.approx(1500 * unit, abs=0.01)


@both
def test_a_servo_receives_nothing_for_its_time_after_a_write(model, goal):
    line = Line(model, 1, write_time_ns=3 * MS)
    item = line.item("goal_position")
    ping, read = line.packet(1, 1), line.packet(1, 2, line.word(item.address) + line.word(item.size))
    goals = line.word(item.address) + line.word(item.size) + b"\x01" + goal.to_bytes(item.size, "little")

    def answers(packet: bytes) -> bool:
        line.send(packet)
        return bool(line.receive(5 * MS))

    assert answers(read)
    assert answers(read), "a read takes no such time"
    for packet, wait_ms, answered in ((ping, 2.8, False), (ping, 3.2, True), (read, 3.2, True)):
        line.instruct(0xFE, 0x83, goals)
        line.wait(wait_ms / 1000)
        assert answers(packet) is answered
