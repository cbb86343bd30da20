# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.kit.pages import page_text
from tests.kit.robots import compile_text, problems_in

from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.features.registers.settings import check_change, declarable, register_value
from dxlwire.control_table import all_tables, find_table
from dxlwire.control_table.device_table import read_device_table

ROBOT = """\
name: arm
buses:
  main: {{port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}}
loop: {{rate: 50}}
joints:
  elbow_joint:
    bus: main
    id: 1
    model: {model}
    reference: 180 deg
    direction: 1
    limits: {{position: [-90 deg, 90 deg]}}
    registers: {registers}
"""
AX = ROBOT.replace("2.0", "1.0").replace("180 deg", "150 deg")


def declared(registers, text=ROBOT, model="XM430-W350"):
    compiled = compile_text(text.format(registers=registers, model=model))
    return compiled.plan.buses[0].servos[0].settings, compiled.warnings


def test_registers_come_into_the_plan_the_eeprom_first():
    found, warnings = declared(
        "{position_p_gain: 900, temperature_limit: 70 degC, return_delay_time: 0 us, shutdown: 0x34}"
    )
    assert [(one.name, one.address, one.size, one.value, one.eeprom) for one in found] == [
        ("return_delay_time", 9, 1, 0, True),
        ("temperature_limit", 31, 1, 70, True),
        ("shutdown", 63, 1, 0x34, True),
        ("position_p_gain", 84, 2, 900, False),
    ]
    assert warnings == ()


@pytest.mark.parametrize(
    ("text", "value"),
    [("return_delay_time: 500 us", 250), ("min_voltage_limit: 9.5 V", 95), ("velocity_limit: 30 rpm", 131),
     ("max_position_limit: 270 deg", 3072), ("current_limit: 800 mA", 297), ("pwm_limit: 50 %", 442),
     ("min_position_limit: 0.0 rad", 0), ("profile_acceleration: 10 rad/s^2", 27)],
)  # fmt: skip
def test_a_quantity_becomes_the_nearest_tick(text, value):
    found, _ = declared(f"{{{text}}}")
    assert [one.value for one in found] == [value]


def outcome(table, name, value):
    try:
        return register_value(table, name, value)
    except ValueError as error:
        return str(error)


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
        found = outcome(table, name, value)
        assert "; " in found if isinstance(found, str) else found.value in range(-(1 << 31), 1 << 32)


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
    for table in all_tables():
        writable = {item.name for item in table.items.values() if item.access == "RW"}
        for name in writable.difference(declarable(table)):
            assert name in named or any(name.startswith(stem) for stem in stems), name


def test_what_the_page_declares_is_declared():
    (block,) = re.findall(r"registers: (\{.*\})\n", PAGE)
    found, _ = declared(block)
    assert [one.name for one in found] == ["return_delay_time", "temperature_limit", "position_p_gain"]


@pytest.mark.parametrize("limit", ["cw_angle_limit: 10", "ccw_angle_limit: 1000"])
def test_angle_limits_of_protocol_1_choose_the_mode_and_those_of_an_xl320_do_not(limit):
    (problem,) = problems_in(AX.format(registers=f"{{{limit}}}", model="AX-12A"))
    assert "both angle limits choose" in problem.what
    found, _ = declared(f"{{{limit}}}", ROBOT.replace("180 deg", "150 deg"), "XL-320")
    assert [f"{one.name}: {one.value}" for one in found] == [limit]


def test_nothing_that_dxlrun_owns_is_declarable_on_any_model():
    own = {"id", "baud_rate", "torque_enable", "goal_position", "moving_speed", "goal_velocity", "goal_current",
           "goal_pwm", "goal_torque", "bus_watchdog", "operating_mode", "control_mode", "lock"}  # fmt: skip
    for table in all_tables():
        assert not own.intersection(declarable(table))
        assert ("max_torque" in table.items) <= ("torque_limit" not in declarable(table))
        assert not [name for name in declarable(table) if name.startswith("indirect")]


def test_what_is_declarable_is_declared_on_every_model():
    for table in all_tables():
        for name in declarable(table):
            item = table.items[name]
            value = max(item.minimum, min(item.maximum, 0))
            if item.deviation.may_refuse and not item.deviation.planned:
                value = item.initial
            found = register_value(table, name, value)
            assert item.decode(found.data) == value


@pytest.mark.parametrize(
    ("name", "said"),
    [("temperature_limit", "is in the EEPROM"), ("status_return_level", "cannot be changed"), ("goal_pwm", "controllers command it")],
)  # fmt: skip
def test_a_client_may_change_only_ram_of_its_own(name, said):
    table = find_table("XM430-W350", 2.0)
    assert check_change(table, "position_p_gain", 640).value == 640
    with pytest.raises(ValueError, match=said):
        check_change(table, name, 2)


def test_of_a_model_that_is_still_to_be_asked_what_fits_the_usual_one_is_taken():
    found, warnings = declared("{position_p_gain: 900, p_gain: 3}", model="auto")
    assert [one.name for one in found] == ["position_p_gain"]
    assert "is unknown until the start" in " ".join(one.what for one in warnings)
