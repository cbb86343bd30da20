"""`dxlrun calibrate` with a scripted hand, on simulated servos and virtual time; dialogues/calibrate.txt."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head
from tests.kit.dialogues import Dialogue, check_dialogue

from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlwire.port.serial_open import open_serial

TEXT = Path(__file__).parent / "dialogues" / "calibrate.txt"
ROBOT, SERVOS = read_head(TEXT).split("----\n")


@pytest.mark.parametrize("told", case_parameters(TEXT))
def test_dialogue(tmp_path: Path, capsys: pytest.CaptureFixture[str], told: TextCase) -> None:
    check_dialogue(tmp_path, told, lambda: capsys.readouterr().err)


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
