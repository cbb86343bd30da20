"""`dxlrun calibrate` with a scripted hand, on simulated servos and virtual time; dialogues/calibrate.txt."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head
from tests.kit.dialogues import Dialogue, check_dialogue

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.tool_line import TunablePort
from dxlwire.port.serial_open import open_serial

TEXT = Path(__file__).parent / "dialogues" / "calibrate.txt"
ROBOT, SERVOS = read_head(TEXT).split("----\n")


@pytest.mark.parametrize("told", case_parameters(TEXT))
def test_dialogue(tmp_path: Path, capsys: pytest.CaptureFixture[str], told: TextCase) -> None:
    check_dialogue(tmp_path, told, lambda: capsys.readouterr().err)


def test_reference_direction_and_limits_are_measured_and_nothing_else_changes(tmp_path: Path) -> None:
    case = Dialogue(
        tmp_path,
        ROBOT,
        SERVOS,
        [
            "run calibrate",
            "hold the joints",
            "zero pose: elbow, wrist, wheel -> turn 1 by 20 and 2 by -30",
            "Move elbow to its end in the positive direction -> turn 1 by -60",
            "Move elbow to its end in the negative direction -> turn 1 by 100",
            "Move wrist to its end in the positive -> turn 2 by 45",
            "Move wrist to its end in the negative -> turn 2 by -145",
            "Move wheel in its positive direction -> turn 3 by -90",
            "Write this into -> y",
        ],
    )
    case.perform()
    assert case.code == 0
    assert not any(servo.torque_on for servo in case.line.bus.servos)
    text = case.path.read_text()
    (found,) = [line for line in text.splitlines() if "elbow:" in line]
    lower, upper = (float(word) for word in found.split("[")[1].split("]")[0].replace("deg", "").split(","))
    assert (lower, upper) == (pytest.approx(-40, abs=0.2), pytest.approx(60, abs=0.2))
    assert lower > -40
    assert upper < 60
    expected = ROBOT
    for before, after in (
        ("reference: 180 deg", "reference: 169.98 deg"),
        (
            "direction: 1}  # 180",
            f"direction: -1, limits: {{position: [{lower:g} deg, {upper:g} deg]}}}}  # 180",
        ),
        ("reference: 3.1 rad", "reference: 2.9667 rad"),
        ("direction: -1\n", "direction: 1\n"),
        ("[-1 rad,  0.5 rad]", "[-1.7453 rad,  0.7854 rad]"),
        ("reference: 0 deg, direction: 1", "reference: 39.99 deg, direction: -1"),
    ):
        assert before in expected
        expected = expected.replace(before, after)
    assert text == expected
    assert "+    reference: 2.9667 rad   # of the horn" in case.script.text
    compile_files(case.path, {}, [])


def test_a_port_that_another_program_has_is_refused(tmp_path: Path) -> None:
    master, slave = os.openpty()
    case = Dialogue(tmp_path, ROBOT.replace("/dev/null", os.ttyname(slave)), SERVOS, ["run calibrate"])
    held = open_serial(os.ttyname(slave), 57600)
    try:
        case.line.open = TunablePort
        case.perform()
    finally:
        held.close()
        os.close(master)
        os.close(slave)
    assert "is in use by" in case.error
    assert case.path.read_bytes() == case.before
