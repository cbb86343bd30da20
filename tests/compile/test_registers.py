# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

import re
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.kit.robots import compile_text, problems_in

from dxlrun.compile.joints.registers import declarable, register_value, steered_value
from dxlrun.dynamixel.control_table import all_tables, control_table

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
    return compiled.plan.buses[0].servos[0].registers, compiled.warnings


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


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("position_q_gain: 1", "elbow_joint: an XM430-W350 has no register position_q_gain; did you mean position_d_gain or position_i_gain or position_p_gain?"),
        ("position_p_gain: 16384", "elbow_joint: Position P Gain (84) of an XM430-W350 is 0..16383, not 16384; write a value in this range"),
        ("temperature_limit: 120 degC", "elbow_joint: Temperature Limit (31) of an XM430-W350 is 0..100 (0..100 degC), not 120 degC (120); write a value in this range"),
        ("temperature_limit: 70 V", "temperature_limit of elbow_joint: '70 V' has the unit V, which is not one of a temperature; write it as 70 degC"),
        ("position_p_gain: 5 V", "elbow_joint: Position P Gain (84) has no unit, but is '5 V'; write a whole number"),
        ("present_temperature: 3", "elbow_joint: Present Temperature (146) can only be read; take it out"),
        ("id: 3", "elbow_joint: ID (7) is not to be declared: dxlrun finds the servo by it; take it out; `dxlrun servo` changes it"),
        ("baud_rate: 3", "elbow_joint: Baud Rate (8) is not to be declared: dxlrun finds the servo by it"),
        ("torque_enable: 1", "elbow_joint: Torque Enable (64) is not to be declared: dxlrun switches the torque, after its checks; take it out"),
        ("goal_position: 2048", "elbow_joint: Goal Position (116) is not to be declared: controllers command it"),
        ("profile_velocity: 20", "elbow_joint: Profile Velocity (112) is not to be declared: controllers command it"),
        ("operating_mode: 1", "elbow_joint: Operating Mode (11) is not to be declared: the interfaces of the active controllers choose the mode"),
        ("bus_watchdog: 5", "elbow_joint: Bus Watchdog (98) is not to be declared: dxlrun arms it"),
        ("indirect_address_1: 64", "elbow_joint: Indirect Address 1 (168) is not to be declared"),
        ("homing_offset: 10", "elbow_joint: Homing Offset (20) cannot be 10: every position would be shifted; `reference` is there for that; write 0, or take it out"),
        ("startup_configuration: 3", "elbow_joint: Startup Configuration (60) = 3 switches torque on by itself at power-up; write 2"),
        ("status_return_level: 1", "elbow_joint: Status Return Level (68) cannot be 1: no write would be acknowledged; write 2, or take it out"),
        ("max_position_limit: 2100", "elbow_joint declares max_position_limit = 2100, but its limits reach to tick 3072, and the servo would refuse goals there; declare 3072"),
        ("position_p_gain: 1.5", "joints.elbow_joint.registers.position_p_gain: this is no value of a register; write the raw integer, or a quantity with its unit: 500 us"),
        ("position_p_gain: true", "joints.elbow_joint.registers.position_p_gain: this is no value of a register; write the raw integer, or a quantity with its unit: 500 us"),
    ],
)  # fmt: skip
def test_a_register_that_cannot_be_declared_is_refused_with_the_reason(text, said):
    (problem,) = problems_in(ROBOT.format(registers=f"{{{text}}}", model="XM430-W350"))
    assert said in f"{problem.what}; {problem.fix}"
    assert problem.mark.line == 13


def test_all_mistakes_come_at_once():
    text = "{id: 3, position_p_gain: 99999, punch: 4, return_delay_time: 500 us}"
    assert len(problems_in(ROBOT.format(registers=text, model="XM430-W350"))) == 4


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
    table = control_table("XM430-W350", 2.0)
    for name in ("max_voltage_limit", "homing_offset", "velocity_limit", "return_delay_time", "shutdown"):
        found = outcome(table, name, value)
        assert "; " in found if isinstance(found, str) else found.value in range(-(1 << 31), 1 << 32)


PAGE = (Path(__file__).parents[2] / "docs" / "registers.md").read_text()


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


def test_a_wheel_knows_no_position_limits():
    text = ROBOT.format(registers="{max_position_limit: 2100}", model="XM430-W350")
    text = text.replace("    limits: {position: [-90 deg, 90 deg]}", "    continuous: true")
    assert [one.what for one in problems_in(text) if one.severity == "error"] == []


@pytest.mark.parametrize("limit", ["cw_angle_limit: 10", "ccw_angle_limit: 1000"])
def test_angle_limits_of_protocol_1_choose_the_mode_and_those_of_an_xl320_do_not(limit):
    (problem,) = problems_in(AX.format(registers=f"{{{limit}}}", model="AX-12A"))
    assert "both angle limits choose the mode" in problem.what
    found, _ = declared(f"{{{limit}}}", ROBOT.replace("180 deg", "150 deg"), "XL-320")
    assert [f"{one.name}: {one.value}" for one in found] == [limit]


def test_a_return_delay_beside_the_bus_is_told():
    _, warnings = declared("{return_delay_time: 500 us}")
    (warning,) = [one for one in warnings if "return delay" in one.what]
    assert "declares a return delay of 500 us, but bus main is reckoned with 0 us" in warning.what
    assert warning.fix.startswith("write `return_delay_time: 500 us` at the bus")


def test_nothing_that_dxlrun_owns_is_declarable_on_any_model():
    own = {"id", "baud_rate", "torque_enable", "goal_position", "moving_speed", "goal_velocity", "goal_current",
           "goal_pwm", "goal_torque", "torque_limit", "bus_watchdog", "operating_mode", "control_mode", "lock"}  # fmt: skip
    for table in all_tables():
        assert not own.intersection(declarable(table))
        assert not [name for name in declarable(table) if name.startswith("indirect")]


def test_what_is_declarable_is_declared_on_every_model():
    for table in all_tables():
        for name in declarable(table):
            item = table.items[name]
            wanted = {"resolution_divider": 1, "status_return_level": 2, "startup_configuration": 0}
            value = wanted.get(name, max(item.minimum, min(item.maximum, 0)))
            found = register_value(table, name, value)
            assert item.decode(found.data) == value


@pytest.mark.parametrize(
    ("name", "said"),
    [("temperature_limit", "is in the EEPROM"), ("status_return_level", "is not to be changed"), ("goal_pwm", "controllers command it")],
)  # fmt: skip
def test_a_client_may_change_only_ram_of_its_own(name, said):
    table = control_table("XM430-W350", 2.0)
    assert steered_value(table, "position_p_gain", 640).value == 640
    with pytest.raises(ValueError, match=said):
        steered_value(table, name, 2)


def test_of_a_model_that_is_still_to_be_asked_what_fits_the_usual_one_is_taken():
    found, warnings = declared("{position_p_gain: 900, p_gain: 3}", model="auto")
    assert [one.name for one in found] == ["position_p_gain"]
    assert "reports its model at the start" in " ".join(one.what for one in warnings)
