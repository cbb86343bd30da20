"""Servos that are slow: a delay between an instruction and the motor, and a time after a write."""

from __future__ import annotations

from typing import Any

import pytest
from tests.kit.packets import packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig, ServoConfig, ServoTimes

MS = 1_000_000


def bus_of(model: str, protocol: float, **slow: int) -> SimulatedBus:
    servo = ServoConfig(1, model, 2.0, times=ServoTimes(**slow))
    return SimulatedBus(BusConfig("main", 1_000_000, (servo,), protocol), Ledger(), 0)


def way(bus: SimulatedBus, goal: int, until_ns: int) -> list[float]:
    """Give a goal with torque now; return how far the shaft is each 0.1 ms from now on."""
    servo, began_ns = bus.servo(1), bus.now_ns
    for name, value in (("torque_enable", 1), ("goal_position", goal)):
        servo.registers[name] = value
        servo.shaft.plan((name,))
    before, moved = servo.shaft_angle, []
    for now_ns in range(began_ns, began_ns + until_ns, MS // 10):
        bus.advance_to(now_ns)
        moved.append(servo.shaft_angle - before)
    return moved


@pytest.mark.parametrize(("model", "protocol", "goal"), [("AX-12A", 1.0, 700), ("XM430-W350", 2.0, 3000)])
@pytest.mark.parametrize("delay_ms", [1, 6, 20])
def test_a_servo_acts_a_response_delay_later_and_then_as_ever(model, protocol, goal, delay_ms):
    quick = way(bus_of(model, protocol), goal, 200 * MS)
    slow = way(bus_of(model, protocol, response_delay_ns=delay_ms * MS), goal, 200 * MS)
    grid = 20  # points of 0.1 ms in a step of the mechanics
    shift = -(-10 * delay_ms // grid) * grid
    assert slow[shift:] == pytest.approx(quick[: len(slow) - shift], abs=1e-12)
    assert not any(slow[:shift])
    assert quick[grid]


@pytest.mark.parametrize("after_ms", [0.1, 1.0, 1.9])
def test_a_goal_between_two_points_of_the_grid_acts_at_the_next_one(after_ms):
    bus = bus_of("XM430-W350", 2.0)
    bus.advance_to(round((10 + after_ms) * MS))
    moved = way(bus, 3000, 10 * MS)
    ends = round((4.0 - after_ms) * 10)  # 0.1 ms until the end of the first step that begins after the goal
    assert not any(moved[: ends - 1])
    assert moved[ends + 1] > 0.0


@pytest.mark.parametrize(
    ("model", "protocol", "item"),
    [
        ("XM430-W350", 2.0, "torque_enable"),
        ("XM430-W350", 2.0, "goal_pwm"),
        ("AX-12A", 1.0, "torque_enable"),
        ("AX-12A", 1.0, "torque_limit"),
    ],
)
def test_torque_off_acts_at_once_and_withdraws_what_has_not_acted_yet(model, protocol, item):
    """By Torque Enable, and by a limit of 0."""
    bus = bus_of(model, protocol, response_delay_ns=20 * MS)
    way(bus, 700, 10 * MS)
    servo = bus.servo(1)
    servo.registers[item] = 0
    servo.shaft.plan((item,))
    bus.advance_to(200 * MS)
    assert servo.shaft_angle == pytest.approx(2.0)
    assert servo.velocity == 0.0


def test_goals_act_in_the_order_and_at_the_distance_in_which_they_came():
    bus = bus_of("XM430-W350", 2.0, response_delay_ns=50 * MS)
    way(bus, 1304, 400 * MS)  # 2 rad: it stays
    servo = bus.servo(1)
    for goal in (1400, 1500):
        servo.registers["goal_position"] = goal
        servo.shaft.plan(("goal_position",))
        bus.advance_to(bus.now_ns + 30 * MS)
    # 60 ms after the first goal only this one acts
    assert servo.shaft.mechanics.profiles.position[0] == pytest.approx(
        1400 * servo.registers.table.rad_per_tick
    )
    bus.advance_to(bus.now_ns + 500 * MS)
    assert servo.shaft_angle == pytest.approx(1500 * servo.registers.table.rad_per_tick, abs=0.01)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_a_servo_receives_nothing_for_its_time_after_a_write(make_line, make_line2, protocol):
    line = (make_line if protocol == 1.0 else make_line2)((1,), write_time_ns=3 * MS)
    if protocol == 1.0:
        ping = packet1(1, 1)
        write = packet1(0xFE, 0x83, 30, 2, 1, 0, 2)
        read = packet1(1, 2, 36, 2)
    else:
        ping = packet2(1, 1)
        write = packet2(0xFE, 0x83, bytes((116, 0, 4, 0, 1, 0, 4, 0, 0)))
        read = packet2(1, 2, bytes((132, 0, 4, 0)))
    port = line.ports.ports[0]
    assert ask(line, port, read)
    assert ask(line, port, read), "a read takes no such time"
    for packet, wait_ms, answered in ((ping, 2.8, False), (ping, 3.2, True), (read, 3.2, True)):
        port.write_packet(write)
        line.clock.wait_until(line.clock.now_ns() + round(wait_ms * MS))
        assert ask(line, port, packet) is answered


def ask(line: Any, port: Any, packet: bytes) -> bool:
    port.write_packet(packet)
    return bool(line.receive(5 * MS))
