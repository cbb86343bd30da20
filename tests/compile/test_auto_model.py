from pathlib import Path

import pytest
from tests.kit.robots import PAIR, compile_text

from dxlrun.compile.joints.compiled_joints import compile_joints
from dxlrun.compile.joints.motors import Motors
from dxlrun.compile.problems import RobotFile
from dxlrun.compile.robot_compiler import compile_robot
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError


def test_a_servo_that_is_not_asked_yet_is_taken_for_its_neighbour():
    compiled = compile_text(PAIR.replace("id: 1\n    model: AX-12A", "id: 1\n    model: auto"))

    assert {servo.model for servo in compiled.plan.buses[0].servos} == {"AX-12A"}
    (warning,) = [each for each in compiled.warnings if "model" in each.what]
    assert warning.what == ("the model of left_arm_joint is unknown until the start, and checked as AX-12A")
    assert (warning.mark.line, warning.mark.column) == (9, 12)


def test_without_a_neighbour_it_is_the_usual_model():
    compiled = compile_text(PAIR.replace("AX-12A", "auto"))

    assert {servo.model for servo in compiled.plan.buses[0].servos} == {"AX-12A"}


def test_the_answer_of_the_servo_counts():
    path = Path("robot.yaml")
    path.write_text(PAIR.replace("AX-12A", "auto"))
    models = {"left_arm_joint": "AX-12A", "right_arm_joint": "AX-12A"}
    compiled = compile_robot(read_robot(path, {}), [], None, models)

    assert [each for each in compiled.warnings if "model" in each.what] == []


@pytest.mark.parametrize(("protocol", "number"), [(1.0, 29), (2.0, 30)])
def test_of_a_model_with_two_firmwares_the_one_of_the_bus_is_taken(protocol: float, number: int):
    path = Path("robot.yaml")
    path.write_text(PAIR.replace("AX-12A", "MX-28").replace("protocol: 1.0", f"protocol: {protocol}"))
    joints = compile_joints(RobotFile(read_robot(path, {})), {}, Motors())

    assert {joint.table.model_number for joint in joints.values()} == {number}


def test_an_id_of_protocol_1_only_is_refused_on_a_bus_of_protocol_2():
    text = PAIR.replace("AX-12A", "XM430-W350").replace("protocol: 1.0", "protocol: 2.0")
    path = Path("robot.yaml")
    path.write_text(text.replace("id: 2", "id: 253"))
    file = RobotFile(read_robot(path, {}))
    compile_joints(file, {}, Motors())

    with pytest.raises(InputError, match="servo ID 253 of right_arm_joint is not valid in Protocol"):
        file.raise_errors()
