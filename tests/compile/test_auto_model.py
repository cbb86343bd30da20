from collections.abc import Callable
from pathlib import Path

from dxlrun.compile import Compiled, compile_robot
from dxlrun.description import read_robot


def test_a_servo_that_is_not_asked_yet_is_taken_for_its_neighbour(
    compile_text: Callable[..., Compiled], robot_text: str
):
    compiled = compile_text(robot_text.replace("id: 1\n    model: AX-12A", "id: 1\n    model: auto"))

    assert {servo.model for servo in compiled.plan.buses[0].servos} == {"AX-12A"}
    (warning,) = [each for each in compiled.warnings if "model" in each.what]
    assert warning.what == (
        "the servo of left_arm_joint is asked for its model at the start; "
        "until then it is taken for an AX-12A"
    )
    assert (warning.mark.line, warning.mark.column) == (9, 12)


def test_without_a_neighbour_it_is_the_usual_model(compile_text: Callable[..., Compiled], robot_text: str):
    compiled = compile_text(robot_text.replace("AX-12A", "auto"))

    assert {servo.model for servo in compiled.plan.buses[0].servos} == {"AX-12A"}


def test_the_answer_of_the_servo_counts(robot_text: str, tmp_path: Path):
    path = tmp_path / "robot.yaml"
    path.write_text(robot_text.replace("AX-12A", "auto"))
    models = {"left_arm_joint": "AX-12A", "right_arm_joint": "AX-12A"}
    compiled = compile_robot(read_robot(path, {}), [], None, models)

    assert [each for each in compiled.warnings if "model" in each.what] == []
