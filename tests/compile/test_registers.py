"""Registers of servos that a robot file or a client may set, of every model."""

import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.kit.pages import page_text
from tests.kit.robots import compile_text, robot_text

from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.features.registers.settings import check_change, declarable, register_value
from dxlwire.control_table import all_tables, find_table
from dxlwire.control_table.device_table import read_device_table


@given(
    st.one_of(
        st.integers(), st.text(), st.from_regex(r"[-+0-9.e]{1,8} ?(V|deg|rpm|us|mA|%|degC)", fullmatch=True)
    )
)
@example("1e308 V")
@settings(max_examples=40)
def test_any_value_is_taken_or_refused_with_a_sentence(value):
    table = find_table("XM430-W350", 2.0)
    for name in ("max_voltage_limit", "homing_offset", "velocity_limit", "return_delay_time", "shutdown"):
        try:
            assert register_value(table, name, value).value in range(-(1 << 31), 1 << 32)
        except ValueError as error:
            assert "; " in str(error)  # noqa: PT017  both are right


def test_quantity_for_an_item_of_a_device_counts_from_its_offset():
    table = read_device_table(
        'kind = "device"\nmodel = "heater"\nprotocol = 2.0\n[items]\n'
        'aim = {address = 30, size = 1, access = "RW", tick = "0.5 V", offset = "5 V", maximum = 20}\n'
    )
    assert any_value(table, "aim", "8 V").value == 6
    with pytest.raises(UnfitRegister, match=re.escape("is 0..20 (5..15 V), not 4 V (-2)")):
        any_value(table, "aim", "4 V")


PAGE = page_text("registers.md")


def test_the_page_names_what_cannot_be_declared():
    named = set(re.findall(r"`([a-z_0-9]+\*?)`", PAGE))
    stems = {name[:-1] for name in named if name.endswith("*")}
    assert "id" in named
    for table in all_tables():
        writable = {item.name for item in table.items.values() if item.access == "RW"}
        for name in writable.difference(declarable(table)):
            assert name in named or any(name.startswith(stem) for stem in stems), name


def test_what_the_page_declares_is_declared():
    (block,) = re.findall(r"registers: (\{.*\})\n", PAGE)
    plan = compile_text(robot_text("registers").replace("registers: {}", f"registers: {block}")).plan
    names = [one.name for one in plan.buses[0].servos[0].settings]
    assert names == ["return_delay_time", "temperature_limit", "position_p_gain"]


OWN = {"id", "baud_rate", "torque_enable", "goal_position", "moving_speed", "goal_velocity", "goal_current",
       "goal_pwm", "goal_torque", "bus_watchdog", "operating_mode", "control_mode", "lock"}  # fmt: skip


@pytest.mark.parametrize("table", all_tables(), ids=lambda table: f"{table.model} {table.protocol}")
def test_what_is_declarable_is_declared_and_nothing_that_dxlrun_owns(table):
    names = declarable(table)
    assert not OWN.intersection(names)
    assert ("max_torque" in table.items) <= ("torque_limit" not in names)
    assert not [name for name in names if name.startswith("indirect")]
    assert names
    for name in names:
        item = table.items[name]
        value = max(item.minimum, min(item.maximum, 0))
        if item.deviation.may_refuse and not item.deviation.planned:
            value = item.initial
        assert item.decode(register_value(table, name, value).data) == value


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("temperature_limit", "is in the EEPROM"),
        ("status_return_level", "cannot be changed"),
        ("goal_pwm", "controllers command it"),
    ],
)
def test_a_client_may_change_only_ram_of_its_own(name, said):
    table = find_table("XM430-W350", 2.0)
    assert check_change(table, "position_p_gain", 640).value == 640
    with pytest.raises(ValueError, match=said):
        check_change(table, name, 2)
