"""Faults that were written without a look at the analysis: a verdict names the cause and accuses no innocent.

Each number draws a pair of a case and a robot; `--campaign=release` runs all pairs. Only these include pairs
that take real time, and pairs whose cause is known not to be named: such a pair has to stay unnamed, or leave
the list. The table of all: `python -m tests.analysis.stranger.campaign`.
"""

from __future__ import annotations

import random
from pathlib import Path

from tests.analysis.stranger.campaign import CASES, PAIRS
from tests.analysis.stranger.expectation import judged
from tests.kit.campaigns import campaign

UNNAMED = {
    ("shared_cable_flickers", "x_fast"): "losses of the servos after the cut ones make the line look lossy",
    ("first_of_the_chain_is_slow", "x_fast"): "a fast reply has no times of its servos",
    ("first_of_the_chain_is_slow", "mx_two"): "the first reply of a chain is compared with none",
}
"""Pairs that are known not to be named, and why."""
DRAWN = [(case, robot) for case, robot in PAIRS if not case.live and (case.name, robot) not in UNNAMED]


def test_every_case_says_what_happens_and_what_is_expected() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert UNNAMED.keys() <= {(case.name, robot) for case, robot in PAIRS}
    for case in CASES:
        assert case.happens.endswith(".")
        assert case.robots
        assert (case.kind == "fine") == (not case.cause)


@campaign(ci=4, night=30, release=len(PAIRS))
def test_verdict_names_the_cause_and_accuses_no_innocent(
    number: int, amount: float, chance: random.Random, tmp_path: Path
) -> None:
    case, robot = PAIRS[number] if amount == len(PAIRS) else chance.choice(DRAWN)
    print(case.name, robot)
    found = judged(case, robot, tmp_path)
    print(found.row)
    assert not found.accused
    assert found.right == ((case.name, robot) not in UNNAMED), f"{case.happens}\n{found.row}"
