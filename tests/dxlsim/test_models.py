"""Every model: each control item read and written, and each wrong access refused as in the manual.

What a model has comes from its control table; what a servo may do with it is stated here once more, by hand.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator

import pytest

from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import ServoConfig
from dxlsim.wire.servo_packets import InstructionPacket
from dxlwire.control_table import ControlItem, ControlTable, all_tables

OLD = [table for table in all_tables() if table.protocol == 1.0]
NEW = [table for table in all_tables() if table.protocol == 2.0]

READ, WRITE = 0x02, 0x03
RANGE_BIT, ANGLE_BIT = 0x08, 0x02
DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = 4, 5, 6, 7
STATE = {1.0: 0x01 | 0x04 | 0x20, 2.0: 0x80}
"""Bits that show the servo's state, not what came of an instruction: some limits make it an error."""

MODES = (  # section "Operating Mode" of the models' pages
    ("YM*", {0, 1, 3}),
    ("RH-P12-RN*", {0, 5}),
    ("L42-*", {1, 3}),
    ("[HLM]*-R", {0, 1, 3, 4}),
    ("P[HM]*", {0, 1, 3, 4, 16}),
    ("[HM]*-R(A)", {0, 1, 3, 4, 16}),
    ("2X*", {1, 3, 4, 16}),
    ("X[LC]430*", {1, 3, 4, 16}),
    ("MX-28", {1, 3, 4, 16}),
    ("*", {0, 1, 3, 4, 5, 16}),
)
PROTOCOLS = (  # section "Protocol Type"
    ("YM*", {2}),
    ("RH-P12-RN(A)", {2, 10}),
    ("P[HM]*", {2, 10}),
    ("X[LC]330*", {2, 20, 21, 22}),
    ("X[CM]335*", {2, 20, 21, 22}),
    ("*", {1, 2}),
)
PROFILES_BOUND_BY_LIMITS = ("P[HM]*", "[HM]*-R(A)", "RH-P12-RN(A)", "YM*")
GOALS_BOUND_BY_LIMITS = "YM*"
"""Models whose position limits reach over turns, so that a goal has no other bounds."""

CHANGES_THE_LINE = ("id", "baud_rate", "baud_rate_bus", "status_return_level", "protocol_type", "lock")
"""After a write of these the servo answers otherwise, or not at all: each is set back at once."""
LIMITS = (
    "torque_limit",
    "pwm_limit",
    "current_limit",
    "velocity_limit",
    "acceleration_limit",
    "max_position_limit",
)
MEASURED = ("current",)
"""The manual lets it be written, and the servo keeps showing what it measures (MX-64, MX-106)."""


def by_model(table: ControlTable) -> str:
    return table.model


class Desk:
    """One servo before a host of three lines."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        rate = next(iter(table.baud_rates.values()))
        config = ServoConfig(1, table.model, 0.3)
        self.servo = make_servo(config, rate, 0, protocol=table.protocol)
        self._wide = 2 if table.protocol == 2.0 else 1
        self.open_limits()

    def open_limits(self) -> None:
        """Set what limits the goals to the widest."""
        for item in self.table.items.values():
            if item.name in LIMITS:
                self.servo.registers[item.name] = item.maximum
            if item.name == "min_position_limit":
                self.servo.registers[item.name] = item.minimum

    def write(self, item: ControlItem, data: bytes) -> int:
        """Return the error, without the bits of the state."""
        reply = self._ask(WRITE, self._word(item.address) + data)
        return reply[0] & ~STATE[self.table.protocol]

    def read(self, item: ControlItem) -> bytes:
        error, data = self._ask(READ, self._word(item.address) + self._word(item.size))
        assert error & ~STATE[self.table.protocol] == 0, item.name
        return data

    def _word(self, number: int) -> bytes:
        return number.to_bytes(self._wide, "little")

    def _ask(self, instruction: int, parameters: bytes) -> tuple[int, bytes]:
        packet = InstructionPacket(1, instruction, parameters, intact=True, end=0)
        reply = self.servo.execute_packet(packet, 0)
        assert reply is not None
        return reply.error, reply.parameters


def wire(item: ControlItem, value: int) -> bytes:
    return (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")


def fits(item: ControlItem, value: int) -> bool:
    bits = 8 * item.size - item.signed
    return (-1 << bits if item.signed else 0) <= value < 1 << bits


def in_a_series(item: ControlItem) -> bool:
    """Return whether an item is like a hundred others: then a good and a bad value are enough."""
    return item.name.startswith("indirect_address_") and not item.name.endswith("_1")


def values(item: ControlItem) -> Iterator[int]:
    """Yield values in and around an item's range, a good one last; all of an item that is listed."""
    if item.name in ("operating_mode", "protocol_type"):
        yield from range(item.maximum + 2)
        yield next(iter(allowed(item.name, "XM430-W350")))
        return
    middle = (item.minimum + item.maximum) // 2
    around = (item.minimum - 1, item.maximum + 1, item.minimum, item.maximum, middle)
    for value in around[1:5:3] if in_a_series(item) else around:
        if fits(item, value):
            yield value


def allowed(name: str, model: str) -> set[int]:
    listed = MODES if name == "operating_mode" else PROTOCOLS
    return next(values for pattern, values in listed if fnmatch.fnmatchcase(model, pattern))


def verdict1(item: ControlItem, value: int) -> int:
    """Return the error of writing a value to a servo of Protocol 1.0 as the factory made it: joint mode."""
    if item.access == "R" or not item.minimum <= value <= item.maximum:
        return RANGE_BIT
    highest = {"goal_torque": 1024 + 1023}.get(item.name, item.maximum)
    return RANGE_BIT if value > highest else 0


def verdict2(table: ControlTable, item: ControlItem, value: int) -> int:
    """Return the error of writing a value to a servo of Protocol 2.0 with open limits and without torque."""
    if item.access == "R":
        return ACCESS
    if item.name in ("operating_mode", "protocol_type"):
        return 0 if value in allowed(item.name, table.model) else DATA_RANGE
    if item.name == "goal_position" and fnmatch.fnmatchcase(table.model, GOALS_BOUND_BY_LIMITS):
        return 0
    return 0 if item.minimum <= value <= item.maximum else DATA_RANGE


@pytest.mark.parametrize("table", OLD + NEW, ids=by_model)
def test_every_item_is_read_as_the_servo_holds_it(table):
    desk = Desk(table)
    for item in table.items.values():
        if not item.name.startswith("indirect_data"):  # they are other items
            assert desk.read(item) == desk.servo.registers.data(item.name), item.name
    assert desk.read(table.items["model_number"]) == table.model_number.to_bytes(2, "little")


@pytest.mark.parametrize("table", OLD + NEW, ids=by_model)
def test_every_value_is_written_or_refused_as_in_the_manual(table):
    desk = Desk(table)
    registers = desk.servo.registers
    for item in table.items.values():
        if item.name.startswith("indirect_data"):
            continue
        before = registers[item.name]
        for value in values(item):
            expected = verdict1(item, value) if table.protocol == 1.0 else verdict2(table, item, value)
            last = registers.data(item.name)
            assert desk.write(item, wire(item, value)) == expected, (item.name, value)
            now = registers.data(item.name)
            assert now == (last if expected else wire(item, value)), (item.name, value)
            if item.name in CHANGES_THE_LINE:
                registers[item.name] = before
        if item.access == "RW" and item.name not in (*CHANGES_THE_LINE, *MEASURED):
            assert desk.read(item) == now, item.name
        desk.servo.poke(item.name, before)
        if item.name == "operating_mode":
            desk.open_limits()


@pytest.mark.parametrize("table", OLD, ids=by_model)
def test_what_is_locked_is_a_range_error(table):
    desk = Desk(table)
    if "lock" not in table.items:
        return
    assert desk.write(table.items["lock"], b"\x01") == 0
    for item in table.items.values():
        now = desk.servo.registers.data(item.name)
        free = item.access == "RW" and item.area == "RAM"
        assert desk.write(item, now) == (0 if free else RANGE_BIT), item.name
    assert desk.write(table.items["lock"], b"\x00") == RANGE_BIT


@pytest.mark.parametrize("table", OLD, ids=by_model)
def test_a_goal_beyond_the_angle_limits_is_an_angle_limit_error(table):
    desk, goal = Desk(table), table.items["goal_position"]
    desk.servo.registers["cw_angle_limit"] = 100
    desk.servo.registers["ccw_angle_limit"] = 200
    errors = [desk.write(goal, wire(goal, value)) for value in (99, 100, 200, 201)]
    assert errors == [ANGLE_BIT, 0, 0, ANGLE_BIT]


@pytest.mark.parametrize("table", NEW, ids=by_model)
def test_a_wrong_length_and_a_locked_eeprom_are_the_manual_s_errors(table):
    desk = Desk(table)
    items = [
        each
        for each in table.items.values()
        if not each.name.startswith("indirect_data") and not in_a_series(each)
    ]
    for item in items:
        if item.size > 1:
            expected = ACCESS if item.access == "R" else DATA_LENGTH
            assert desk.write(item, desk.servo.registers.data(item.name)[:-1]) == expected, item.name
    assert desk.write(table.items["torque_enable"], b"\x01") == 0
    for item in items:
        if item.area == "EEPROM":
            assert desk.write(item, desk.servo.registers.data(item.name)) == ACCESS, item.name
            assert desk.write(item, desk.servo.registers.data(item.name)[:-1] or b"\x00") == ACCESS, item.name


@pytest.mark.parametrize("table", NEW, ids=by_model)
def test_a_goal_beyond_a_limit_is_a_limit_error(table):
    desk = Desk(table)
    for goal, limit in (
        ("goal_pwm", "pwm_limit"),
        ("goal_current", "current_limit"),
        ("goal_velocity", "velocity_limit"),
    ):
        if limit in table.items:
            item = table.items[goal]
            desk.servo.registers[limit] = 7
            errors = [desk.write(item, wire(item, value)) for value in (-8, -7, 7, 8)]
            assert errors == [DATA_LIMIT, 0, 0, DATA_LIMIT], goal
    for profile, limit in (
        ("profile_velocity", "velocity_limit"),
        ("profile_acceleration", "acceleration_limit"),
    ):
        if profile in table.items and limit in table.items:
            item = table.items[profile]
            desk.servo.registers[limit] = 7
            bounded = any(fnmatch.fnmatchcase(table.model, each) for each in PROFILES_BOUND_BY_LIMITS)
            assert [desk.write(item, wire(item, value)) for value in (7, 8)] == [0, DATA_LIMIT * bounded], (
                profile
            )
    if "max_position_limit" in table.items:
        item = table.items["goal_position"]
        desk.servo.registers["max_position_limit"] = 200
        desk.servo.registers["min_position_limit"] = 100
        errors = [desk.write(item, wire(item, value)) for value in (99, 100, 200, 201)]
        assert errors == [DATA_LIMIT, 0, 0, DATA_LIMIT]
