"""What is said of a robot file or a motion, and where, and what it becomes: the cases of `cases/*.txt`."""

import pytest
from tests.kit.cases import TextCase, case_parameters
from tests.kit.robot_cases import check_case
from tests.kit.robots import CASES, whole_text


@pytest.mark.usefixtures("part_plugins")
@pytest.mark.parametrize("case", case_parameters(CASES))
def test_case_has_its_problems_and_its_facts(case: TextCase) -> None:
    texts = (whole_text(case.head), case.name, *(line.text for line in case.lines))
    if any("mujoco" in text for text in texts):
        pytest.importorskip("mujoco")
    check_case(case)
