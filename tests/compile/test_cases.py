"""What is said of a robot file or a motion, and where, and what it becomes: the cases of `cases/*.txt`."""

from __future__ import annotations

import pytest
from tests.kit.robot_cases import CASES, Case, cases

ALL = [
    pytest.param(case, id=f"{case.place}: {' '.join(case.changes)}")
    for path in sorted(CASES.glob("*.txt"))
    for case in cases(path.stem)
]


@pytest.mark.usefixtures("part_plugins")
@pytest.mark.parametrize("case", ALL)
def test_case_has_its_problems_and_its_facts(case: Case) -> None:
    if any("mujoco" in text for text in (case.text, *case.changes)):
        pytest.importorskip("mujoco")
    case.check()
