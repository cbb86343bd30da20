import math

import pytest
from tests.kit.rigs import VirtualLine, make_plan

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.inspection import identify, read_models
from dxlrun.errors import PortError
from dxlsim.simulation_plan import BusConfig, ServoConfig

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


def servos(*models):
    return tuple(ServoConfig(number + 1, model, 2.0) for number, model in enumerate(models))


def line_of(*models, protocol=1.0):
    return VirtualLine(*servos(*models), protocol=protocol, rate=1_000_000)


def asked(plans, joints, *lines):
    lines = dict(zip([plan.name for plan in plans], lines, strict=True))
    return identify(plans, joints, opened=lambda plan: lines[plan.name])


def test_every_servo_says_what_it_is_on_both_protocols():
    lines = line_of("AX-12A", "MX-64"), line_of("XM430-W350", "XL-320", "MX-64", protocol=2.0)
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
    line = line_of("AX-12A", "AX-18A")
    found = asked([make_plan((1, 2), name="arm", joints=("a", "b"))], ["b"], line)
    assert list(found) == ["b"]
    assert found["b"].model == "AX-18A"
    assert all(data[2] == 2 for data in line.heard)


def test_a_silent_servo_and_an_unknown_one_are_named():
    line = line_of("AX-12A", "AX-12A")
    line.bus.servo(1).silence()
    line.bus.servo(2).poke("model_number", 999)
    found = asked([make_plan((1, 2), name="arm", joints=("a", "b"))], "ab", line)
    assert "a (ID 1 on bus arm) does not answer at 1000000 bit/s" in found["a"].problem
    assert "b (ID 2 on bus arm) has model number 999" in found["b"].problem
    assert [one.model for one in found.values()] == ["", ""]


def test_a_line_that_is_gone():
    line = line_of("AX-12A")
    line.ports.ports[0].unplug()
    with pytest.raises(PortError):
        asked([make_plan((1,), name="arm", joints=("a",))], "a", line)


def test_a_robot_file_is_compiled_with_what_the_servo_says(simulated_line, tmp_path):
    config = BusConfig("main", 1_000_000, servos("XL-320", "XM430-W350"), 2.0)
    path, _ = simulated_line(config)
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
