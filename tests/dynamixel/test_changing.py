"""Servo tool: what `dxlrun servo` does to one servo; `tool_cases/*.txt` has most of it."""

from functools import partial

import pytest
from tests.kit.cases import case_parameters
from tests.kit.line_faults import delay_next
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


@pytest.mark.parametrize(
    ("model", "limit"), [("XM430-W350", "max_position_limit"), ("AX-12A", "ccw_angle_limit")]
)
@pytest.mark.parametrize("late_ms", [200, 270, 300, 400, 520])
def test_a_value_that_comes_late_is_not_shown_for_the_next_register(model, limit, late_ms):
    """The host stalls again and again: what it then hears was asked before."""
    rig = ToolRig(model)
    names = [limit, "present_position"]  # of one length
    true = [rig.one.read_items([name])[name] for name in names]
    assert true[0] != true[1]
    for _ in range(40):
        delay_next(rig.line.bus, 1, late_ms * 1_000_000)
    shown = []
    for name in names * 3:
        try:
            shown.append(rig.one.read_items([name])[name])
        except ServoFault:
            shown.append(None)
    assert all(value in {None, right} for value, right in zip(shown, true * 3, strict=True)), shown
    assert None not in shown or late_ms > 250
    assert rig.one.found.garbled is False


TRUE = {"id": 1, "operating_mode": 3, "temperature_limit": 80, "shutdown": 52, "led": 0}


@pytest.mark.parametrize("at", [0, 1, 3])
@pytest.mark.parametrize(
    ("late_ms", "copies"),
    # a burst of copies behind the timeout of a tool and its drain, 0.75 s, may meet a later request
    [
        *((late, copies) for late in (0, 20, 250, 600) for copies in (1, 2, 5, 40)),
        (900, 1),
        (900, 2),
        (1500, 2),
    ],
)
def test_what_is_read_is_never_the_reply_to_an_earlier_request(rig, at, late_ms, copies):
    """Replies of equal length that come late, or several times; a status does not carry what it answers."""
    disturb = partial(
        rig.line.bus.alter_next, 1, "disturbed", bytes, delay_ns=late_ms * 1_000_000, copies=copies
    )
    if at:
        rig.line.bus.after(at, disturb)
    else:
        disturb()
    found = {}
    for name in (*TRUE, *TRUE):
        try:
            found = rig.one.read_items([name])
        except ServoFault:  # said, and nothing is shown
            continue
        assert found == {name: TRUE[name]}
    assert found
    assert rig.one.read_items(list(TRUE)) == TRUE
