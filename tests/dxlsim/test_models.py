"""Every model: each control item read and written, and each wrong access refused as in the manual.

What a model has comes from its control table; what a servo may do with it is stated here once more, by hand.
"""

import fnmatch
from collections.abc import Iterator

import pytest
from tests.kit.packets import packet1, packet2
from tests.kit.simulated_line import split_statuses

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import ControlItem, ControlTable, all_tables

OLD = [table for table in all_tables() if table.protocol == 1.0]
NEW = [table for table in all_tables() if table.protocol == 2.0]
READ, WRITE = 0x02, 0x03
RANGE_BIT, ANGLE_BIT = 0x08, 0x02
DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = 4, 5, 6, 7
STATE = {1.0: 0x01 | 0x04 | 0x20, 2.0: 0x80}
"""Bits that show the servo's state, not what came of an instruction: some limits make it an error."""
LISTED = {
    "operating_mode": {  # section "Operating Mode" of the models' pages
        "YM*": {0, 1, 3},
        "RH-P12-RN*": {0, 5},
        "L42-*": {1, 3},
        "[HLM]*-R": {0, 1, 3, 4},
        "P[HM]*": {0, 1, 3, 4, 16},
        "[HM]*-R(A)": {0, 1, 3, 4, 16},
        "2X*": {1, 3, 4, 16},
        "X[LC]430*": {1, 3, 4, 16},
        "MX-28": {1, 3, 4, 16},
        "*": {0, 1, 3, 4, 5, 16},
    },
    "protocol_type": {  # section "Protocol Type"
        "YM*": {2},
        "RH-P12-RN(A)": {2, 10},
        "P[HM]*": {2, 10},
        "X[LC]330*": {2, 20, 21, 22},
        "X[CM]335*": {2, 20, 21, 22},
        "*": {1, 2},
    },
}
PROFILES_BOUND_BY_LIMITS = ("P[HM]*", "[HM]*-R(A)", "RH-P12-RN(A)", "YM*")
GOALS_BOUND_BY_LIMITS = "YM*"
"""Models whose position limits reach over turns, so that a goal has no other bounds."""
CHANGES_THE_LINE = ("id", "baud_rate", "baud_rate_bus", "status_return_level", "protocol_type", "lock")
"""After a write of these the servo answers otherwise, or not at all: each is set back at once."""
LIMITS = ("torque_limit", "pwm_limit", "current_limit", "velocity_limit", "acceleration_limit")
MEASURED = ("current",)
"""The manual lets it be written, and the servo keeps showing what it measures (MX-64, MX-106)."""


def by_model(table: ControlTable) -> str:
    return table.model


every = pytest.mark.parametrize("table", OLD + NEW, ids=by_model)
old = pytest.mark.parametrize("table", OLD, ids=by_model)
new = pytest.mark.parametrize("table", NEW, ids=by_model)


class Desk:
    """One servo before a host of three lines."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        rate = next(iter(table.baud_rates.values()))
        config = BusConfig("main", rate, (ServoConfig(1, table.model, 0.3),), table.protocol)
        self.bus = SimulatedBus(config, Ledger(keep=False), 0)
        self.servo = self.bus.servos[0]
        self.registers = self.servo.registers
        self.open_limits()

    def open_limits(self) -> None:
        """Set what limits the goals to the widest."""
        for item in self.table.items.values():
            if item.name in (*LIMITS, "max_position_limit"):
                self.registers[item.name] = item.maximum
            if item.name == "min_position_limit":
                self.registers[item.name] = item.minimum

    def ask(self, instruction: int, *numbers: int, data: bytes = b"") -> tuple[int, bytes]:
        """Return the error, without the bits of the state, and the data of the answer."""
        width = 2 if self.table.protocol == 2.0 else 1
        words = b"".join(number.to_bytes(width, "little") for number in numbers)
        made = packet2(1, instruction, words + data) if width == 2 else packet1(1, instruction, *words, *data)
        self.bus.receive_bytes(made, self.bus.host_free_ns)
        (answer,) = split_statuses(self.bus.drain_bytes(self.bus.next_due_ns()), self.table.protocol)
        return answer.error & ~STATE[self.table.protocol], answer.parameters

    def write(self, item: ControlItem, value: int | bytes) -> int:
        data = value if isinstance(value, bytes) else wire(item, value)
        return self.ask(WRITE, item.address, data=data)[0]

    def errors(self, name: str, *values: int) -> list[int]:
        return [self.write(self.table.items[name], value) for value in values]

    def read(self, item: ControlItem) -> bytes:
        error, data = self.ask(READ, item.address, item.size)
        assert error == 0, item.name
        return data


def wire(item: ControlItem, value: int) -> bytes:
    return (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")


def in_a_series(item: ControlItem) -> bool:
    """Return whether an item is like a hundred others: then a good and a bad value are enough."""
    return item.name.startswith("indirect_address_") and not item.name.endswith("_1")


def own_items(table: ControlTable) -> list[ControlItem]:
    """Return items without indirect data, which are other items."""
    return [item for item in table.items.values() if not item.name.startswith("indirect_data")]


def values(item: ControlItem) -> Iterator[int]:
    """Yield values in and around an item's range, a good one last; all of an item that is listed."""
    if item.name in LISTED:
        yield from range(item.maximum + 2)
        yield min(allowed(item.name, "XM430-W350"))
        return
    middle = (item.minimum + item.maximum) // 2
    around = (item.minimum - 1, item.maximum + 1, item.minimum, item.maximum, middle)
    bits = 8 * item.size - item.signed
    for value in around[1:5:3] if in_a_series(item) else around:
        if (-1 << bits if item.signed else 0) <= value < 1 << bits:
            yield value


def allowed(name: str, model: str) -> set[int]:
    return next(found for pattern, found in LISTED[name].items() if fnmatch.fnmatchcase(model, pattern))


def verdict(table: ControlTable, item: ControlItem, value: int) -> int:
    """Return the error of writing a value to a servo as the factory made it, with open limits."""
    if table.protocol == 1.0:
        highest = {"goal_torque": 1024 + 1023}.get(item.name, item.maximum)
        return 0 if item.access == "RW" and item.minimum <= value <= highest else RANGE_BIT
    if item.access == "R":
        return ACCESS
    if item.name in LISTED:
        return 0 if value in allowed(item.name, table.model) else DATA_RANGE
    if item.name == "goal_position" and fnmatch.fnmatchcase(table.model, GOALS_BOUND_BY_LIMITS):
        return 0
    return 0 if item.minimum <= value <= item.maximum else DATA_RANGE


@every
def test_every_item_is_read_as_the_servo_holds_it(table):
    desk = Desk(table)
    for item in own_items(table):
        assert desk.read(item) == desk.registers.data(item.name), item.name
    assert desk.read(table.items["model_number"]) == table.model_number.to_bytes(2, "little")


@every
def test_every_value_is_written_or_refused_as_in_the_manual(table):
    desk = Desk(table)
    registers = desk.registers
    for item in own_items(table):
        before = registers[item.name]
        for value in values(item):
            expected, last = verdict(table, item, value), registers.data(item.name)
            assert desk.write(item, value) == expected, (item.name, value)
            now = registers.data(item.name)
            assert now == (last if expected else wire(item, value)), (item.name, value)
            if item.name in CHANGES_THE_LINE:
                registers[item.name] = before
        if item.access == "RW" and item.name not in (*CHANGES_THE_LINE, *MEASURED):
            assert desk.read(item) == now, item.name
        desk.servo.poke(item.name, before)
        if item.name == "operating_mode":
            desk.open_limits()


@old
def test_what_is_locked_is_a_range_error(table):
    desk = Desk(table)
    if "lock" not in table.items:
        return
    assert desk.errors("lock", 1) == [0]
    for item in table.items.values():
        free = item.access == "RW" and item.area == "RAM"
        assert desk.write(item, desk.registers.data(item.name)) == (0 if free else RANGE_BIT), item.name
    assert desk.errors("lock", 0) == [RANGE_BIT]


@old
def test_a_goal_beyond_the_angle_limits_is_an_angle_limit_error(table):
    desk = Desk(table)
    desk.registers["cw_angle_limit"], desk.registers["ccw_angle_limit"] = 100, 200
    assert desk.errors("goal_position", 99, 100, 200, 201) == [ANGLE_BIT, 0, 0, ANGLE_BIT]


@new
def test_a_wrong_length_and_a_locked_eeprom_are_the_manual_s_errors(table):
    desk = Desk(table)
    items = [item for item in own_items(table) if not in_a_series(item)]
    for item in items:
        if item.size > 1:
            expected = ACCESS if item.access == "R" else DATA_LENGTH
            assert desk.write(item, desk.registers.data(item.name)[:-1]) == expected, item.name
    assert desk.errors("torque_enable", 1) == [0]
    for item in items:
        if item.area == "EEPROM":
            data = desk.registers.data(item.name)
            assert [desk.write(item, each) for each in (data, data[:-1] or b"\x00")] == [ACCESS] * 2, (
                item.name
            )


@new
def test_a_goal_beyond_a_limit_is_a_limit_error(table):
    desk, items = Desk(table), table.items
    for name in ("pwm", "current", "velocity"):
        if f"{name}_limit" in items:
            desk.registers[f"{name}_limit"] = 7
            assert desk.errors(f"goal_{name}", -8, -7, 7, 8) == [DATA_LIMIT, 0, 0, DATA_LIMIT], name
    bounded = any(fnmatch.fnmatchcase(table.model, each) for each in PROFILES_BOUND_BY_LIMITS)
    for name in ("velocity", "acceleration"):
        if {f"profile_{name}", f"{name}_limit"} <= items.keys():
            desk.registers[f"{name}_limit"] = 7
            assert desk.errors(f"profile_{name}", 7, 8) == [0, DATA_LIMIT * bounded], name
    if "max_position_limit" in items:
        desk.registers["max_position_limit"], desk.registers["min_position_limit"] = 200, 100
        assert desk.errors("goal_position", 99, 100, 200, 201) == [DATA_LIMIT, 0, 0, DATA_LIMIT]
