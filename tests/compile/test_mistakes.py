"""What is said of a mistake in a robot file or a motion, and where: the cases of `mistakes/*.txt`."""

from __future__ import annotations

import pytest
from tests.kit.mistakes import MISTAKES, Case, cases

CASES = [
    pytest.param(case, id=f"{path.stem}: {' '.join(case.changes)}")
    for path in sorted(MISTAKES.glob("*.txt"))
    for case in cases(path.stem)
]


@pytest.mark.usefixtures("part_plugins")
@pytest.mark.parametrize("case", CASES)
def test_each_mistake_is_named_where_it_stands(case: Case) -> None:
    if any("mujoco" in change for change in case.changes):
        pytest.importorskip("mujoco")
    case.check()
