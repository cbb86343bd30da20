"""Every model: each control item read and written over the simulated bus, and each wrong access refused."""

from __future__ import annotations

from typing import Any

import pytest

from dxlrun.control_table import ControlItem, ControlTable, all_tables
from dxlrun.simulation.protocol1 import ErrorBit
from dxlrun.simulation.protocol2 import ErrorNumber

OLD = [table for table in all_tables() if table.protocol == 1.0]
NEW = [table for table in all_tables() if table.protocol == 2.0]

CHANGES_THE_LINE = {"id", "baud_rate", "baud_rate_bus", "status_return_level", "lock"}
"""Written in tests of their own: after them the servo answers otherwise, or not at all."""

NUMBER = 0x7F
"""Of an error of Protocol 2.0: without the alert bit, as some limits make the servo's state an error."""


def by_model(table: ControlTable) -> str:
    return table.model


def writable(table: ControlTable) -> list[ControlItem]:
    return [
        each for each in table.items.values() if each.access == "RW" and each.name not in CHANGES_THE_LINE
    ]


def low_high(item: ControlItem, wire: int) -> tuple[int, ...]:
    return tuple((wire & (1 << 8 * item.size) - 1).to_bytes(item.size, "little"))


def fits(item: ControlItem, value: int) -> bool:
    bits = 8 * item.size - item.signed
    return (-1 << bits if item.signed else 0) <= value < 1 << bits


def open_limits(line: Any, table: ControlTable) -> None:
    """Set what limits the goals to the widest, after a power cycle."""
    line.servo().reset()
    for name in ("pwm_limit", "current_limit", "velocity_limit", "max_position_limit", "min_position_limit"):
        if (item := table.items.get(name)) is not None:
            line.servo().poke(name, item.minimum if name.startswith("min") else item.maximum)


@pytest.mark.parametrize("table", OLD, ids=by_model)
def test_every_item_of_protocol_1_is_read(make_line: Any, table: ControlTable) -> None:
    line = make_line((1,), table.model)
    assert line.read(1, 0, 2) == table.model_number
    for item in table.items.values():
        assert line.ask(1, 2, item.address, item.size)[1:] == (
            0,
            bytes(low_high(item, line.bus.servo(1).registers[item.name])),
        )


@pytest.mark.parametrize("table", OLD, ids=by_model)
def test_every_item_of_protocol_1_is_written_in_its_range_only(make_line: Any, table: ControlTable) -> None:
    for item in writable(table):
        line = make_line((1,), table.model)
        highest = min(item.maximum, table.max_speed_tick) if item.name == "moving_speed" else item.maximum
        for value in (item.minimum, (item.minimum + highest) // 2, highest):
            assert line.write(1, item.address, *low_high(item, value)) & ErrorBit.RANGE == 0, item.name
            assert bytes(low_high(item, value)) == line.ask(1, 2, item.address, item.size).parameters, (
                item.name
            )
        last = line.read(1, item.address, item.size)
        for value in (item.minimum - 1, item.maximum + 1):
            if fits(item, value):
                assert line.write(1, item.address, *low_high(item, value)) & ErrorBit.RANGE, item.name
                assert line.read(1, item.address, item.size) == last, item.name


@pytest.mark.parametrize("table", OLD, ids=by_model)
def test_read_only_and_locked_items_of_protocol_1_are_range_errors(
    make_line: Any, table: ControlTable
) -> None:
    line = make_line((1,), table.model)
    for item in table.items.values():
        if item.access == "R":
            assert line.write(1, item.address, *[0] * item.size) == ErrorBit.RANGE, item.name
    if "lock" in table.items:
        assert line.write(1, table.items["lock"].address, 1) == 0
        for item in writable(table):
            if item.area == "EEPROM":
                now = low_high(item, line.bus.servo(1).registers[item.name])
                assert line.write(1, item.address, *now) == ErrorBit.RANGE, item.name


@pytest.mark.parametrize("table", NEW, ids=by_model)
def test_every_item_of_protocol_2_is_read(make_line2: Any, table: ControlTable) -> None:
    line = make_line2((1,), table.model)
    items = [each for each in table.items.values() if not each.name.startswith("indirect_data")]
    for item in items:
        wire = int.from_bytes(line.read_bytes(1, item.address, item.size), "little")
        assert wire == line.bus.servo(1).registers[item.name], item.name
    assert line.get("model_number") == table.model_number


@pytest.mark.parametrize("table", NEW, ids=by_model)
def test_every_item_of_protocol_2_is_written_in_its_range_only(make_line2: Any, table: ControlTable) -> None:
    line = make_line2((1,), table.model)
    for item in writable(table):
        if item.name.startswith("indirect_data"):
            continue  # they stand for other items
        open_limits(line, table)
        for value in sorted({item.minimum, (item.minimum + item.maximum) // 2, item.maximum}):
            data = bytes(low_high(item, value))
            assert line.write_bytes(1, item.address, data) & NUMBER == 0, (item.name, value)
            assert line.read_bytes(1, item.address, item.size) == data, item.name
        for value in (item.minimum - 1, item.maximum + 1):
            if fits(item, value):
                error = line.write_bytes(1, item.address, bytes(low_high(item, value)))
                assert error & NUMBER == ErrorNumber.DATA_RANGE, (item.name, value)
                assert line.read_bytes(1, item.address, item.size) == bytes(low_high(item, item.maximum))
        if item.initial is not None:
            line.servo().poke(item.name, item.initial)


@pytest.mark.parametrize("table", NEW, ids=by_model)
def test_wrong_accesses_of_protocol_2(make_line2: Any, table: ControlTable) -> None:
    line = make_line2((1,), table.model)
    for item in table.items.values():
        now = line.bus.servo(1).registers.data(item.name)
        if item.access == "R":
            assert line.write_bytes(1, item.address, now) == ErrorNumber.ACCESS, item.name
        elif item.size > 1:
            assert line.write_bytes(1, item.address, now[:-1]) == ErrorNumber.DATA_LENGTH, item.name
    assert line.set("torque_enable", 1) == 0
    for item in writable(table):
        if item.area == "EEPROM":
            now = line.bus.servo(1).registers.data(item.name)
            assert line.write_bytes(1, item.address, now) == ErrorNumber.ACCESS, item.name
