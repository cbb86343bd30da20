"""Start of the hardware and its inspections; hardware errors of every model, named as in its manual."""

import itertools
from contextlib import suppress
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.plans import distinct_tables
from tests.kit.rigs import Rig, VirtualLine, make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.compile.joints.register_values import UnfitRegister
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import first_reach
from dxlrun.dynamixel.servo.registers import meaning, write_registers
from dxlrun.dynamixel.tools.scanning import Search, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import PortError, StartUpError
from dxlrun.features.registers.settings import declarable, register_value
from dxlsim.simulation_plan import ServoConfig
from dxlwire.control_table import ControlTable, find_table, read_control_table, table_files


@pytest.mark.parametrize(
    ("lacks", "for_replies"),
    [(lambda servo: servo.silence(), True), (lambda servo: servo.poke("model_number", 29), False)],
)
def test_refusal_is_for_replies_only_when_one_is_missing(lacks, for_replies):
    rig = make_rig()
    lacks(rig.servo(6))
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert caught.value.for_replies is for_replies
    assert {packet[4] for packet in rig.into_bus()} <= {1, 2}


def test_the_end_of_the_set_up_without_torque_is_reported_before_the_first_torque():
    rig, seen = make_rig(), []
    rig.hardware.start(lambda: seen.append((rig.torque(), len(rig.into_bus()))))
    ((torque, packets),) = seen
    assert torque == [False] * 8
    assert packets > 8  # all were inspected


def test_first_states_that_a_standing_host_did_not_hear_are_read_again(monkeypatch):
    rig = make_rig()
    read, reads = rig.hardware.read_states, []

    def late():
        """Let no servo hear anything for 70 ms when the first states are read."""
        if not reads:
            for servo in rig.buses[0].servos:
                servo.silence()
                rig.buses[0].at(rig.clock.now_ns() + 70_000_000, partial(servo.silence, False))
        reads.append(rig.clock.now_ns())
        read()

    monkeypatch.setattr(type(rig.hardware), "read_states", lambda _: late())
    rig.hardware.start()
    assert rig.torque() == [True] * 8
    assert len(reads) > 1
    assert rig.states.valid.all()


def test_no_port_no_start():
    rig = make_rig()
    rig.ports.ports[0].unplug()
    with pytest.raises(PortError, match="bus main on sim"):
        rig.hardware.start()


def test_torque_comes_in_groups():
    rig = start_rig()
    times = [e.t_ns for e in rig.ledger.entries if e.direction == "in" and e.data[4:7] == b"\x03\x18\x01"]
    pauses = [b - a > 20_000_000 for a, b in itertools.pairwise(times)]
    assert pauses == [False, False, True, False, False, True, False]


def others(table):
    """Return for each declarable item of a model a value that it has not at first, where there is one."""
    for name in declarable(table):
        item = table.items[name]
        for value in (item.maximum, item.minimum, (item.minimum + item.maximum) // 2):
            with suppress(UnfitRegister):
                if value != item.initial:
                    yield register_value(table, name, value)
                    break


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_whatever_may_be_declared_of_any_model_is_written_once_and_then_there(protocol):
    tables = [table for table in distinct_tables() if table.protocol == protocol]
    assert tables
    for table in tables:
        plan = make_plan((5,), protocol=protocol, model=table.model, reference=1.5, lower=-0.1, upper=0.1)
        wanted = tuple(sorted(others(table), key=lambda one: not one.eeprom))
        plan = replace(plan, servos=(replace(plan.servos[0], settings=wanted),))
        rig, counts = make_rig(plan, position=1.5), []
        for _ in range(2):
            found = Findings()
            rig.lines.run_programs([write_registers(first_reach(plan, plan.servos[0]), wanted, found)])
            assert found.problems == []
            counts.append(len(found.texts(EventCode.REGISTER_WRITTEN)))
        assert counts == [len(rig.writes()), 0]
        assert counts[0] > 5, table.model
        memory = rig.buses[0].servos[0].registers
        assert all(bytes(memory.image)[one.address : one.address + one.size] == one.data for one in wanted)


X = {
    0x01: "input voltage",
    0x04: "overheating",
    0x08: "motor encoder",
    0x10: "electrical shock",
    0x20: "overload",
}
PRO = {**X, 0x02: "motor hall sensor"}
Y = {
    1: "over voltage",
    2: "low voltage",
    3: "inverter overheating",
    4: "motor overheating",
    5: "overload",
    7: "inverter",
    13: "encoder",
    14: "hall sensor",
    17: "following",
    19: "over speed",
}
MANUALS = {  # e-Manual, section Shutdown of each model, or Error Code (153)
    "AX-12A": {0x01: "input voltage", 0x04: "overheating", 0x20: "overload"},
    "MX-64": X,
    "XL-320": {0x01: "overload", 0x02: "overheating", 0x04: "input voltage"},
    "XL330-M288": X,
    "XM430-W350": X,
    "PH54-200-S500": PRO,
    "H54-200-S500-R": PRO,
    "RH-P12-RN": X,
    "YM070-210-M001": Y,
}
FAULTS = {
    1: (lambda servo: servo.trigger_overload(), {"overload error"}),
    2: (lambda servo: servo.set_temperature(200.0), {"overheating error", "motor overheating error"}),
    3: (lambda servo: servo.set_voltage(0.5), {"input voltage error", "low voltage error"}),
    4: (lambda servo: servo.set_voltage(90.0), {"input voltage error", "over voltage error"}),
}
"""Faults that the simulation can set, by the servo: how to set one, and the names that are right for it"""
TABLES = distinct_tables()
every_table = pytest.mark.parametrize("table", TABLES, ids=lambda table: f"{table.model} {table.protocol}")
reporting = pytest.mark.parametrize(
    "table",
    [table for table in TABLES if table.errors.item],
    ids=lambda table: f"{table.model} {table.protocol}",
)


def rig_of(table: ControlTable, *ids: int) -> Rig:
    middle = (table.min_tick + table.max_tick) / 2 * table.rad_per_tick
    ends = {"reference": middle, "lower": -0.02, "upper": 0.02, "return_delay_ns": 0}
    plan = make_plan(ids, protocol=table.protocol, model=table.model, **ends)
    firmware = max(table.firmware, 45) if table.protocol == 2.0 else 24
    return make_rig(plan, position=middle or 1e-9, firmware=firmware)


@every_table
def test_each_simulated_fault_is_reported_by_its_name(table):
    rig = rig_of(table, *FAULTS)
    rig.hardware.start()
    rig.cycles(3)
    rig.events.list.clear()
    for servo_id, (hurt, _) in FAULTS.items():
        hurt(rig.servo(servo_id))
    rig.cycles(12)
    told = dict(rig.events.of(EventCode.SERVO_ERROR))  # the last of each
    for servo_id, (_, names) in FAULTS.items():
        text = told[f"main_{servo_id}_joint"].partition(" on bus main) ")[2]
        if table.errors.item:
            assert text.startswith(f"has {table.items[table.errors.item].title} = ")
            assert text.rpartition(": ")[2] in names
        else:
            assert text.removeprefix("reports ").partition(":")[0] in names


@pytest.mark.parametrize("model", MANUALS)
def test_bits_and_codes_are_those_of_the_manual(model):
    errors = find_table(model, 1.0 if model == "AX-12A" else 2.0).errors
    for value, name in MANUALS[model].items():
        assert errors.describe_errors(value) == f"{name} error"
    assert errors.has_codes == model.startswith("Y")
    assert errors.has_codes or sorted(errors.values.values()) == sorted(MANUALS[model])


@reporting
def test_each_error_refuses_the_start_by_its_name(table):
    title = table.items[table.errors.item].title
    assert table.errors.values
    for name, value in table.errors.values.items():
        rig, words = rig_of(table, 1), name.replace("_", " ")
        rig.stick(1, table.errors.item, value)
        if name.endswith("_warning"):
            rig.hardware.start()
            (text,) = rig.events.texts(EventCode.REGISTER_DIFFERS)
            assert text.endswith(f"in {title}: {words}")
        else:
            assert f"reports in {title}: {words} error; find the cause" in "".join(rig.refused())


@reporting
def test_scan_names_the_error_of_a_servo(table):
    line = VirtualLine(ServoConfig(1, table.model, 0.0))
    (servo,) = line.bus.servos
    servo.trigger_overload()
    (found,) = scan(ToolLine(line), Search((2.0,), (57_600,))).servos
    item = table.items[table.errors.item]
    assert found.remarks == (f"{item.title} is {servo.registers[item.name]}: overload error",)


def test_several_errors_are_named_and_those_that_the_table_does_not_have():
    errors = find_table("XL-320").errors
    assert errors.describe_errors(0x03) == "overload error; overheating error"
    assert errors.describe_errors(0) == "no hardware error"
    assert errors.describe_errors(0x28) == "bits 28, not defined in the control table"
    code = find_table("YM070-210-M001").errors.describe_errors(6)
    assert code == "code 6, not defined in the control table"


def test_a_register_that_reports_errors_is_shown_by_its_meaning():
    for model, value, words in (("XL-320", 2, "overheating error"), ("YM070-210-M001", 9, "battery warning")):
        table = find_table(model)
        assert meaning(table.items[table.errors.item], value, table.errors) == words
        assert meaning(table.items["id"], 1, table.errors) == ""


def test_a_warning_neither_takes_the_goals_nor_marks_the_joint_as_broken():
    rig = rig_of(find_table("YM070-210-M001"), 1, 2)
    rig.hardware.start()
    rig.cycles(3)
    rig.events.list.clear()
    rig.servo(1).registers[rig.servo(1).registers.table.errors.item] = 9
    rig.cycles(120)
    told = [
        text
        for code, severity, _, text in rig.events.list
        if (code, severity) == (EventCode.SERVO_ERROR, Severity.WARNING)
    ]
    assert told == ["main_1_joint (ID 1 on bus main) has Error Code (153) = 9: battery warning"]
    assert rig.states.hardware_error.tolist() == [0, 0]
    since = len(rig.into_bus())
    rig.goals.position[:] += 0.01
    rig.cycles(1)
    assert [ids for _, ids in rig.goals_sent(since)] == [[1, 2]]


def test_a_table_without_errors_names_none():
    """As a plug-in may have one of Protocol 2.0."""
    text = (table_files._TABLES / "protocol2/XM/XM430-W350.toml").read_text("utf-8")
    before, _, rest = text.partition("[errors]")
    errors = read_control_table(f"{before}[items]{rest.partition('[items]')[2]}").errors
    assert errors.describe_errors(0x20) == "bits 20, not defined in the control table"
