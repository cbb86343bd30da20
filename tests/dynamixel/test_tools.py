"""Tools for servos and lines: what they do to one, find on all, and take another one for."""

import math

import pytest
from tests.kit.cases import case_parameters
from tests.kit.plans import distinct_tables
from tests.kit.rigs import VirtualLine, make_plan
from tests.kit.servo_cases import CASES
from tests.kit.tool_cases import RATE, WRITE, ToolCase, ToolRig

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools import servo_backup
from dxlrun.dynamixel.tools.inspection import identify, read_models
from dxlrun.dynamixel.tools.scanning import Search, known_rates, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import PortError, ServoFault
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import all_tables

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


def test_a_rate_that_was_tried_is_left_again():
    line = VirtualLine(ServoConfig(1, "XM430-W350", 2.0))
    tool = ToolLine(line)
    assert tool.speak(2.0, 57_600)
    assert tool.can_run_at(1_000_000)
    assert line.bus.baud_rate == 57_600


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_is_known_by_its_number_and_can_be_drafted_from(protocol):
    tables = [table for table in all_tables() if table.protocol == protocol]
    servos = [ServoConfig(number, table.model, 0.5) for number, table in enumerate(tables, 1)]
    line = VirtualLine(*servos, protocol=protocol, rate=1_000_000)
    found = scan(ToolLine(line), Search((protocol,), (1_000_000,))).servos
    assert [one.model for one in found] == [table.model for table in tables]
    assert {one.return_delay for one in found} == {500_000}
    assert all(one.position is not None and one.lowest is not None for one in found)
    assert {one.remarks for one in found} == {()}


def test_the_rates_are_those_of_the_tables_and_the_usual_ones_come_first():
    assert known_rates(2.0)[:3] == (1_000_000, 115_200, 57_600)
    assert {9_600, 4_500_000, 10_500_000} <= set(known_rates(2.0))
    assert {9_600, 200_000, 2_250_000, 3_000_000} <= set(known_rates(1.0))


def test_progress_goes_from_nothing_to_everything():
    shares = []
    search = Search((1.0, 2.0), (57_600,), (1, 2))
    scan(ToolLine(VirtualLine()), search, lambda _, share: shares.append(share))
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert shares == sorted(shares)


ROBOT = """
name: arm
buses:
  main: {port: PORT, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}
loop: {rate: 20}
joints:
  shoulder: {bus: main, id: 1, model: auto, reference: 180 deg, direction: 1}
  elbow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""


def servos_of(*models):
    return tuple(ServoConfig(number + 1, model, 2.0) for number, model in enumerate(models))


def line_with(*models, protocol=1.0):
    return VirtualLine(*servos_of(*models), protocol=protocol, rate=1_000_000)


def asked(plans, joints, *lines):
    lines = dict(zip([plan.name for plan in plans], lines, strict=True))
    return identify(plans, joints, opened=lambda plan: lines[plan.name])


def test_every_servo_says_what_it_is_on_both_protocols():
    lines = line_with("AX-12A", "MX-64"), line_with("XM430-W350", "XL-320", "MX-64", protocol=2.0)
    plans = [
        make_plan((1, 2), name="head", joints=("a", "b")),
        make_plan((1, 2, 3), name="arm", protocol=2.0, model="XM430-W350", joints=("c", "d", "e")),
    ]
    found = asked(plans, "abcde", *lines)
    assert {joint: one.model for joint, one in found.items()} == {
        "a": "AX-12A",
        "b": "MX-64",
        "c": "XM430-W350",
        "d": "XL-320",
        "e": "MX-64",
    }
    assert [one.problem for one in found.values()] == [""] * 5
    heard = [data for line in lines for data in line.heard]
    assert {data[4] if data[2] != 0xFD else data[7] for data in heard} == {1, 2}  # pings and reads alone


def test_only_who_is_asked_for_is_asked():
    line = line_with("AX-12A", "AX-18A")
    found = asked([make_plan((1, 2), name="arm", joints=("a", "b"))], ["b"], line)
    assert list(found) == ["b"]
    assert found["b"].model == "AX-18A"
    assert all(data[2] == 2 for data in line.heard)


def test_a_silent_servo_and_an_unknown_one_are_named():
    line = line_with("AX-12A", "AX-12A")
    line.bus.servo(1).silence()
    line.bus.servo(2).poke("model_number", 999)
    found = asked([make_plan((1, 2), name="arm", joints=("a", "b"))], "ab", line)
    assert "a (ID 1 on bus arm) does not answer at 1000000 bit/s" in found["a"].problem
    assert "b (ID 2 on bus arm) has model number 999" in found["b"].problem
    assert [one.model for one in found.values()] == ["", ""]


def test_a_line_that_is_gone():
    line = line_with("AX-12A")
    line.ports.ports[0].unplug()
    with pytest.raises(PortError):
        asked([make_plan((1,), name="arm", joints=("a",))], "a", line)


def test_a_robot_file_is_compiled_with_what_the_servo_says(virtual_lines, tmp_path):
    config = BusConfig("main", 1_000_000, servos_of("XL-320", "XM430-W350"), 2.0)
    path, _ = virtual_lines.serve(config)
    robot = tmp_path / "robot.yaml"
    robot.write_text(ROBOT.replace("PORT", path))
    checked = compile_files(robot, {}, [])
    assert [servo.model for servo in checked.plan.buses[0].servos] == ["XM430-W350"] * 2
    assert [problem.severity for problem in checked.warnings if "is unknown until the start" in problem.what]
    compiled = compile_files(robot, {}, [], None, read_models)
    assert [servo.model for servo in compiled.plan.buses[0].servos] == ["XL-320", "XM430-W350"]
    assert [problem for problem in compiled.warnings if "is unknown until the start" in problem.what] == []
    assert compiled.plan.buses[0].servos[0].rad_per_tick == pytest.approx(math.radians(300) / 1023)


def test_a_simulated_servo_is_not_asked(tmp_path):
    robot = tmp_path / "robot.yaml"
    robot.write_text(ROBOT.replace("PORT", "sim"))
    compiled = compile_files(robot, {}, [], None, read_models)
    assert compiled.plan.buses[0].servos[0].model == "XM430-W350"
