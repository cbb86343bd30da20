"""Goals in sync writes, which compiled code executes: they act and are refused as if Python executed them."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from tests.kit.simulated_line import Line

from dxlsim.wire.compiled_line import Task

Execute = Callable[[int, int], int | None]
MS = 1_000_000
ITEMS = ("goal_position", "moving_speed", "profile_velocity", "profile_acceleration", "goal_acceleration")
OTHERS = (
    *("cw_angle_limit", "ccw_angle_limit", "min_position_limit", "max_position_limit", "torque_enable"),
    *("torque_enable", "torque_enable", "operating_mode", "drive_mode", "homing_offset", "torque_limit"),
    *("velocity_limit", "acceleration_limit", "goal_pwm", "bus_watchdog", "led", "secondary_id"),
)


def story(model: str, protocol: float, seed: int, *, compiled: bool) -> tuple[list[object], int]:
    """Return everything that passed on the line or was noted, with angles and registers, and the number of
    instructions that Python executed."""
    chance, shown, executed = random.Random(seed), list[object](), 0
    line = Line(model, 1, 2, protocol=protocol)
    for servo in line.bus.servos:
        servo.shaft.response_delay_ns = chance.choice((0, 0, 5 * MS))
        if not compiled:
            servo.line.goal_count = 0
    registers = line.bus.servo(1).registers
    items = registers.table.items
    for task in (Task.EXECUTE, Task.WRITTEN):
        executes = line.bus._tasks[task]

        def count(first: int, second: int, executes: Execute = executes) -> int | None:
            nonlocal executed
            executed += 1
            return executes(first, second)

        line.bus._tasks[task] = count
    aims = [items[name] for name in ITEMS if name in items and items[name].access == "RW"]
    for number in range(150):
        if number % 10 < 2:
            name = (
                "torque_enable" if number < 2 else chance.choice([each for each in OTHERS if each in items])
            )
            item, wire = items[name], chance.choice((0, 1, 3, 4, 16, chance.randrange(1 << 16)))
            value = 1 if number < 2 or (name == "torque_enable" and chance.random() < 0.8) else wire
            data = line.word(item.address) + (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")
            line.instruct(1 + number % 2, 3, data)
        else:
            item = chance.choice(aims)
            span = chance.choice((item.maximum, 2 * item.maximum, (1 << 8 * item.size) - 1))
            wires = [chance.randint(0, min(span, (1 << 8 * item.size) - 1)) for _ in range(2)]
            data = b"".join(
                bytes((i, *wire.to_bytes(item.size, "little"))) for i, wire in enumerate(wires, 1)
            )
            line.instruct(0xFE, 0x83, line.word(item.address) + line.word(item.size) + data)
        line.receive(chance.choice((1, 2, 7, 40)) * MS)
        shown += [servo.shaft_angle for servo in line.bus.servos]
        shown += [bytes(servo.registers._memory) for servo in line.bus.servos]
    return [*shown, *line.ledger.entries], executed


@pytest.mark.parametrize(
    ("model", "protocol"),
    [("AX-12A", 1.0), ("MX-64", 1.0), ("XL-320", 2.0), ("XM430-W350", 2.0), ("PH42-020-S300-R", 2.0)],
)
def test_a_goal_acts_as_if_python_had_executed_it(model: str, protocol: float) -> None:
    saved = 0
    for seed in range(3):
        (there, few), (here, all_of_them) = (
            story(model, protocol, seed, compiled=compiled) for compiled in (True, False)
        )
        assert there == here
        saved += all_of_them - few
    assert saved > 100
