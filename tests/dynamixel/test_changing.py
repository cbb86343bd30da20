"""Servo tool: what `dxlrun servo` does to one servo; `tool_cases/*.txt` has most of it."""

import pytest
from tests.kit.cases import case_parameters
from tests.kit.plans import distinct_tables
from tests.kit.servo_cases import CASES
from tests.kit.tool_cases import RATE, WRITE, ToolCase, ToolRig

from dxlrun.dynamixel.tools import servo_backup
from dxlrun.errors import ServoFault
from dxlsim.simulation_plan import ServoConfig

MODELS = pytest.mark.parametrize("model", ["AX-12A", "MX-64", "XM430-W350", "XL-320"])


@pytest.mark.parametrize("case", case_parameters(CASES.with_name("tool_cases")))
def test_tool_does_and_reports_what_the_case_says(case):
    ToolCase(case).check()


@pytest.fixture
def rig():
    return ToolRig("XM430-W350")


def test_another_servo_at_the_new_address_is_not_taken_for_it(rig):
    other = rig.line.bus.add_servo(ServoConfig(5, "XL430-W250", 1.0))
    other.silence()

    def swap():
        other.silence(False)
        rig.servo(1).silence()

    rig.line.bus.after(5, swap)
    with pytest.raises(ServoFault, match="has model number 1060, not 1020"):
        rig.one.change_id(5)


@MODELS
def test_a_servo_gets_every_rate_of_its_table_another_id_and_torque_where_it_stands(model):
    rig = ToolRig(model)
    before = RATE
    assert rig.one.table.baud_rates
    for rate in rig.one.table.baud_rates.values():
        assert rig.one.change_rate(rate) == f"runs at {rate} bit/s (before: {before})"
        assert rig.servo(1).baud_rate == pytest.approx(rate, rel=0.03)
        before = rig.one.baud_rate
        assert before == rate
    writes = rig.sent().count(WRITE)
    assert rig.one.change_id(42) == "has ID 42 (before: 1)"
    assert rig.sent().count(WRITE) == writes + 1  # EEPROM wears
    assert rig.servo(1).registers["id"] == 42
    assert rig.one.read_items(["id"]) == {"id": 42}
    assert "holds torque in position mode at its present tick" in rig.one.torque(True)[0]
    rig.wait(1)
    assert rig.servo(1).torque_on
    assert rig.servo(1).shaft_angle == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_the_backup_of_every_model_fits_that_model_and_heals_it(tmp_path, protocol):
    tables = [table for table in distinct_tables() if table.protocol == protocol and not table.firmware]
    found = [table for table in tables if RATE in table.baud_rates.values()]
    assert found
    for table in found:
        rig = ToolRig(table.model, protocol=protocol)
        names = [name for name in table.items if not name.startswith("indirect_")]
        assert list(rig.one.read_items(names, refused=True)) == names, "all of it can be read"
        values = rig.one.read_items(servo_backup.kept_items(table), refused=True)
        path = tmp_path / f"{table.model}.json"
        servo_backup.write_backup(path, servo_backup.stamped(table, 1, (1, RATE), values))
        wanted = servo_backup.registers_to_restore(path, servo_backup.read_backup(path), table)
        assert not rig.one.differences(wanted)
        changed = [each for each in wanted if each.name in {"return_delay_time", "position_p_gain", "punch"}]
        assert changed
        for each in changed:
            rig.servo(1).poke(each.name, 3)
        rig.one.write_registers(wanted)
        assert rig.sent().count(WRITE) == len(changed)
        assert all(rig.servo(1).registers[each.name] == each.value for each in changed)


def test_a_mode_that_is_restored_resets_no_gain_of_the_backup(rig, tmp_path):
    servo, table, path = rig.servo(1), rig.one.table, tmp_path / "servo.json"
    servo.poke("position_p_gain", 640)
    values = rig.one.read_items(servo_backup.kept_items(table), refused=True)
    servo_backup.write_backup(path, servo_backup.stamped(table, 1, (1, RATE), values))
    servo.poke("operating_mode", 1)
    wanted = servo_backup.registers_to_restore(path, servo_backup.read_backup(path), table)
    assert "Operating Mode (11) was changed from 1 to 3" in rig.one.restore(wanted, path)
    assert servo.registers["position_p_gain"] == 640
