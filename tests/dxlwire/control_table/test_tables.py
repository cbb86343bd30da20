import math
import re
from fractions import Fraction

import pytest

from dxlwire.control_table import CAPABILITIES, ControlTable, all_tables, find_table, models_by_number

TABLES = all_tables()
PROTOCOL1 = {
    "AX-12A": 12, "AX-18A": 18, "RX-24F": 24, "RX-28": 28, "MX-28": 29, "RX-64": 64, "MX-12W": 104,
    "EX-106+": 107, "DX-113": 113, "DX-116": 116, "DX-117": 117, "AX-12W": 300, "MX-64": 310, "MX-106": 320,
    "RX-10": 10,
}  # fmt: skip


def _id(table: ControlTable) -> str:
    return f"{table.model} {table.protocol}"


every_table = pytest.mark.parametrize("table", TABLES, ids=_id)


def test_the_models_of_protocol_1_are_all_there() -> None:
    assert {table.model: table.model_number for table in TABLES if table.protocol == 1.0} == PROTOCOL1


@every_table
def test_every_end_of_a_range_and_initial_value_can_be_written_and_read_back(table: ControlTable) -> None:
    assert table.items
    for item in table.items.values():
        ends = (item.minimum, item.maximum) if item.encoding != "sign_magnitude" else (0, 1023, -1023)
        for ticks in ends:
            assert item.decode(item.encode(ticks)) == ticks, item.name
        if item.initial is not None:
            assert item.minimum <= item.initial <= item.maximum, item.name
            assert item.decode(item.encode(item.initial)) == item.initial, item.name


@every_table
def test_what_the_loop_needs_is_there_and_of_the_right_kind(table: ControlTable) -> None:
    items = table.items
    assert {"model_number", "firmware_version", "id", "torque_enable", "status_return_level"} <= items.keys()
    assert {"return_delay_time", "goal_position", "present_position"} <= items.keys()
    assert [items[name].access for name in ("goal_position", table.goal_speed_item)] == ["RW", "RW"]
    assert [items[name].access for name in (table.present_speed_item, table.effort_item)] == ["R", "R"]
    assert items["present_position"].access == items["model_number"].access == "R"
    assert items["model_number"].initial == table.model_number
    assert items["goal_position"].unit == items["present_position"].unit == "rad"
    assert items[table.present_speed_item].unit == items[table.goal_speed_item].unit == "rad/s"
    assert items[table.effort_item].unit == table.effort_unit
    assert items["goal_position"].scale == items["present_position"].scale == table.rad_per_tick
    assert items["torque_enable"].area == "RAM"
    assert items["id"].area == items["model_number"].area == "EEPROM"
    assert all(item.page for item in items.values())


@every_table
def test_the_units_are_those_of_a_servo(table: ControlTable) -> None:
    assert table.min_tick <= 0 < table.max_tick
    travel = math.degrees((table.max_tick - table.min_tick) * table.rad_per_tick)
    assert 100 < travel < 360.01
    assert 0.1 < table.max_speed < 600
    assert table.max_speed_tick * table.rad_s_per_tick > 0.8 * table.max_speed
    assert 0 < table.effort_per_tick < 0.02
    assert table.stall_torque >= 0
    assert table.capabilities <= CAPABILITIES.keys()
    assert "sync_write" in table.capabilities
    assert ("fast_sync_read" in table.capabilities) == (table.fast_sync_read_firmware is not None)


@every_table
def test_the_factory_baud_rate_is_one_of_the_list(table: ControlTable) -> None:
    name = "baud_rate" if "baud_rate" in table.items else "baud_rate_bus"
    assert table.items[name].initial in table.baud_rates
    assert all(value <= table.items[name].maximum for value in table.baud_rates)


def test_a_model_number_belongs_to_one_model_of_a_protocol() -> None:
    for table in TABLES:
        same = models_by_number(table.model_number, table.protocol)
        assert table in same
        assert len({each.firmware for each in same}) == len(same), "told apart by the firmware alone"
    assert models_by_number(12, 2.0) == ()
    assert models_by_number(9999, 1.0) == ()


def test_the_newest_firmware_comes_first_and_has_the_plain_name() -> None:
    newest, older = models_by_number(1200, 2.0)
    assert (newest.model, newest.firmware) == ("XL330-M288", 52)
    assert (older.model, older.firmware) == ("XL330-M288-FW51", 0)
    assert newest.items["indirect_data_1"].address == 208
    assert older.items["indirect_data_1"].address == 224


@pytest.mark.parametrize("table", [each for each in TABLES if each.protocol == 1.0], ids=_id)
def test_protocol_1_baud_rates_follow_the_formula_of_the_manual(table: ControlTable) -> None:
    assert table.baud_rates
    for value, rate in table.baud_rates.items():
        if value < 250:
            assert Fraction(2_000_000, value + 1) == pytest.approx(rate, rel=0.03)


@pytest.mark.parametrize("table", [each for each in TABLES if each.protocol == 1.0], ids=_id)
def test_only_mx_has_bulk_read_in_protocol_1(table: ControlTable) -> None:
    assert ("bulk_read" in table.capabilities) == table.model.startswith("MX-")
    assert "sync_read" not in table.capabilities
    assert {"posvel", "state_block"} <= table.capabilities
    assert table.effort_unit == "1"


@pytest.mark.parametrize(
    ("model", "protocol", "degrees", "ticks"),
    [
        ("AX-18A", 1.0, 300, 1023),
        ("RX-28", 1.0, 300, 1023),
        ("DX-117", 1.0, 300, 1023),
        ("EX-106+", 1.0, 250.92, 4095),
        ("MX-64", 1.0, 360, 4096),
        ("MX-64", 2.0, 360, 4096),
        ("XM430-W350", 2.0, 360, 4096),
        ("XL-320", 2.0, 300, 1023),
        ("PH54-200-S500", 2.0, 360, 1_003_846),
        ("YM070-210-M001", 2.0, 360, 524_288),
        ("YM070-210-R051", 2.0, 360, 26_738_688),
    ],
)
def test_degrees_a_tick(model: str, protocol: float, degrees: float, ticks: int) -> None:
    assert math.degrees(find_table(model, protocol).rad_per_tick) == pytest.approx(degrees / ticks, rel=1e-8)


RPM = math.tau / 60


@pytest.mark.parametrize(
    ("model", "protocol", "item", "tick", "si"),
    [
        ("MX-64", 1.0, "moving_speed", 300, 34.2 * RPM),  # "if it is set to 300, it is about 34.2 rpm"
        ("MX-12W", 1.0, "moving_speed", 300, 274.8 * RPM),
        ("MX-28", 1.0, "goal_acceleration", 254, math.radians(2180)),
        ("MX-28", 1.0, "return_delay_time", 250, 500e-6),
        ("EX-106+", 1.0, "sensed_current", 100, 1.0),
        ("XM430-W350", 2.0, "present_current", 1000, 2.69),
        ("MX-106", 2.0, "goal_current", 1000, 3.36),
        ("XL330-M288", 2.0, "current_limit", 1750, 1.75),
        ("XL430-W250", 2.0, "present_load", 1000, 1.0),
        ("XM430-W350", 2.0, "present_input_voltage", 120, 12.0),
        ("XM430-W350", 2.0, "bus_watchdog", 5, 0.1),
        ("XM430-W350", 2.0, "profile_velocity", 100, 22.9 * RPM),
        ("XM430-W350", 2.0, "profile_acceleration", 1, 214.577 * RPM / 60),
        ("PH54-200-S500", 2.0, "velocity_limit", 2900, 29.0 * RPM),
        ("YM070-210-M001", 2.0, "present_current", 100, 1.0),
    ],
)
def test_units_by_examples_of_the_manual(
    model: str, protocol: float, item: str, tick: int, si: float
) -> None:
    assert find_table(model, protocol).items[item].scale * tick == pytest.approx(si, rel=1e-3)


@every_table
def test_the_figures_of_a_motor_fit_one_another(table: ControlTable) -> None:
    # of an ideal motor and gear, Nm/A and V s/rad are equal; real ones lose up to two thirds, and the
    # manual's figures give three models up to a fifth too much (RX-24F, XC430-W150, XL330-M077); the speed
    # of the AX-12W is what its firmware holds it to in joint mode
    if table.stall_current and table.model != "AX-12W":
        efficiency = table.stall_torque / table.stall_current * table.max_speed / table.nominal_voltage
        assert 0.3 < efficiency < 1.2


@every_table
def test_the_gear_is_the_one_in_the_name(table: ControlTable) -> None:
    # XM430-W350, PH54-200-S500, YM070-210-R051: the last number is the gear, rounded
    named = re.fullmatch(r".*-[WTVMSR]0?(\d{2,3})(-R\(A\))?(-FW\d+)?", table.model)
    if named and table.gear_ratio:
        assert table.gear_ratio == pytest.approx(int(named[1]), rel=0.065)
    if table.model.endswith(("M001", "B001")):
        assert table.gear_ratio == 1


@pytest.mark.parametrize(
    ("model", "protocol", "gear", "amperes", "volts"),
    [
        ("AX-12A", 1.0, 254, 1.5, 12),
        ("RX-64", 1.0, 200, 2.6, 18.5),
        ("DX-113", 1.0, 192.6, 0, 12),
        ("MX-106", 1.0, 225, 5.2, 12),
        ("MX-106", 2.0, 225, 5.2, 12),
        ("XL-320", 2.0, 238, 1.1, 7.4),
        ("XL330-M288", 2.0, 288.4, 1.47, 5),
        ("XL330-M288-FW51", 2.0, 288.4, 1.47, 5),
        ("XM430-W350", 2.0, 353.5, 2.3, 12),
        ("XH540-V270", 2.0, 272.5, 2.4, 24),
        ("PH54-200-S500", 2.0, 501.923, 0, 24),
        ("YM080-230-A099", 2.0, 99, 22.4, 24),
        ("XW430-T333", 2.0, 0, 0, 0),
    ],
)
def test_the_motor_is_that_of_the_specifications(
    model: str, protocol: float, gear: float, amperes: float, volts: float
) -> None:
    table = find_table(model, protocol)
    assert (table.gear_ratio, table.stall_current, table.nominal_voltage) == (gear, amperes, volts)


@pytest.mark.parametrize(
    ("model", "initial"),
    [  # e-Manual, Control Table of each page: Max Voltage Limit, Velocity Limit, Velocity I, Position D and P
        ("XL430-W250", (140, 265, 1000, 4000, 640)),
        ("2XL430-W250", (140, 250, 1800, 2000, 640)),
        ("XC430-W150", (160, 460, 1920, 0, 460)),
        ("XC430-W240", (160, 306, 1920, 0, 700)),
        ("2XC430-W250", (160, 275, 1920, 0, 700)),
    ],
)
def test_factory_values_of_the_430s_without_current(model: str, initial: tuple[int, ...]) -> None:
    items = find_table(model).items
    names = ("max_voltage_limit", "velocity_limit", "velocity_i_gain", "position_d_gain", "position_p_gain")
    assert tuple(items[name].initial for name in names) == initial
    assert items["min_voltage_limit"].maximum == items["max_voltage_limit"].maximum == initial[0]


@pytest.mark.parametrize("model", ["H42-20-S300-R", "H54-200-S500-R", "M42-10-S260-R", "L54-50-S500-R"])
def test_the_first_pro_takes_the_ranges_of_its_pages(model: str) -> None:
    table = find_table(model, 2.0)
    assert (table.items["baud_rate"].maximum, table.items["return_delay_time"].maximum) == (13, 255)
    assert max(table.baud_rates) == 8  # the page gives no rate for 9 to 13
    assert table.items["goal_position"].maximum == table.items["max_position_limit"].initial  # half a turn
