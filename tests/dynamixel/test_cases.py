"""Servos whose registers differ, that fail, are lost and return: the cases of `cases/*.txt`."""

import re

import pytest
from tests.kit.cases import TextCase, case_parameters, read_cases
from tests.kit.rigs import make_x, start_rig
from tests.kit.servo_cases import CASES, Case

from dxlrun.dynamixel.servo.checks import CHECKS


@pytest.mark.parametrize("case", case_parameters(CASES))
def test_runtime_does_and_reports_what_the_case_says(case: TextCase) -> None:
    Case(case).check()


def test_every_check_of_the_start_has_a_case() -> None:
    """A check that never fails guards nothing."""
    texts = ["\n".join(line.text for line in case.lines) for case in read_cases(CASES)]
    refused = [one for one in texts if re.search("^=> (refused|register differs)", one, re.MULTILINE)]
    changed = {name for one in refused for name in re.findall(r"(\w+) -?\d+", one)}
    # overheating is in the error byte, `firmware 44` lacks an item; test_hardware_errors.py has the Y series
    assert {check.item for check in CHECKS} <= changed | {"status_error", "firmware_version", "error_code"}


def test_requests_are_done_in_their_order_and_no_cycle_is_late() -> None:
    rig, answers = start_rig(make_x((11, 12))), []
    for value in (500, 600, 700):
        for row in (0, 1):
            rig.hardware.write_register(
                row, "position_p_gain", value, lambda why, _, at=(row, value): answers.append((*at, why))
            )
    rig.cycles(6)  # each asserts that it ends in its period
    assert answers == [(row, value, "") for value in (500, 600, 700) for row in (0, 1)]
    assert rig.registers("position_p_gain") == [700, 700]
