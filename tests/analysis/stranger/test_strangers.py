"""Faults that were written without a look at the analysis: is the cause named, and is no innocent accused?

`DXLRUN_STRANGERS` is how many pairs of a case and a robot run, drawn by `DXLRUN_STRANGERS_SEED`; CI runs
none yet, as many are not named today. The table of all: `python -m tests.analysis.stranger.campaign`.
"""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

import pytest
from tests.analysis.stranger.campaign import OWN, cases_of, pairs_of
from tests.analysis.stranger.expectation import Case, judged

CASES = cases_of(OWN)
PAIRS = pairs_of(CASES)
COUNT = int(os.environ.get("DXLRUN_STRANGERS", "0"))
SEED = os.environ.get("DXLRUN_STRANGERS_SEED", "1")
CHOSEN = PAIRS if len(PAIRS) <= COUNT else Random(SEED).sample(PAIRS, COUNT)


def test_every_case_says_what_happens_and_what_is_expected() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    for case in CASES:
        assert case.happens.endswith(".")
        assert len(case.robots) > 1
        assert (case.kind == "fine") == (not case.cause)


@pytest.mark.campaign
@pytest.mark.parametrize(("case", "robot"), CHOSEN, ids=[f"{case.name}-{robot}" for case, robot in CHOSEN])
def test_the_cause_is_named_and_no_innocent_accused(case: Case, robot: str, tmp_path: Path) -> None:
    found = judged(case, robot, tmp_path)
    print(found.row)
    assert found.right, f"{case.happens}\n{found.row}"
