"""Faults that were written without a look at the analysis: is the cause named, and is no innocent accused?

`DXLRUN_STRANGERS` is how many pairs of a case and a robot run, drawn by `DXLRUN_STRANGERS_SEED`, which is the
commit's as in tests/conftest.py. What takes real time or is not named is drawn only where all are: it has
to stay unnamed then, or leave the list. The table of all: `python -m tests.analysis.stranger.campaign`.
"""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

import pytest
from tests.analysis.stranger.campaign import CASES, PAIRS
from tests.analysis.stranger.expectation import Case, judged
from tests.conftest import SEED as COMMIT

UNNAMED = {
    ("shared_cable_flickers", "x_fast"): "losses of the servos after the cut ones make the line look lossy",
    ("first_of_the_chain_is_slow", "x_fast"): "a fast reply has no times of its servos",
    ("first_of_the_chain_is_slow", "mx_two"): "the first reply of a chain is compared with none",
}
"""Pairs that are known not to be named, and why."""
COUNT = int(os.environ.get("DXLRUN_STRANGERS", "4"))
SEED = os.environ.get("DXLRUN_STRANGERS_SEED", COMMIT)
DRAWN = [(case, robot) for case, robot in PAIRS if not case.live and (case.name, robot) not in UNNAMED]
CHOSEN = PAIRS if len(PAIRS) <= COUNT else Random(SEED).sample(DRAWN, min(COUNT, len(DRAWN)))


def test_every_case_says_what_happens_and_what_is_expected() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert UNNAMED.keys() <= {(case.name, robot) for case, robot in PAIRS}
    for case in CASES:
        assert case.happens.endswith(".")
        assert case.robots
        assert (case.kind == "fine") == (not case.cause)


@pytest.mark.campaign
@pytest.mark.parametrize(("case", "robot"), CHOSEN, ids=[f"{case.name}-{robot}" for case, robot in CHOSEN])
def test_the_cause_is_named_and_no_innocent_accused(case: Case, robot: str, tmp_path: Path) -> None:
    found = judged(case, robot, tmp_path)
    print(found.row)
    assert not found.accused
    assert found.right == ((case.name, robot) not in UNNAMED), f"{case.happens}\n{found.row}"
