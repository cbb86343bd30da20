"""Verdicts on totals of runs: what may not be in a good run, what is said first, and who is accused of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec import structs
from tests.analysis.judged import COMMANDS, NO_LOOP, check_case
from tests.kit.cases import TextCase, case_parameters, read_cases

from dxlrun.channels.event_records import GoalTotals
from dxlrun.plan.played_goals import find_unreached_goals


@pytest.mark.parametrize("case", case_parameters(Path(__file__).with_name("totals.txt")))
def test_verdict_on_totals(case: TextCase) -> None:
    check_case(case)


@pytest.mark.parametrize("begun", [0, 1, 2])
def test_each_goal_of_a_motion_that_is_played_twice_has_to_begin(begun: int) -> None:
    loop, goals = (
        structs.replace(NO_LOOP, commands=COMMANDS[:1] * 2),
        GoalTotals(begun={COMMANDS[0].origin: begun}),
    )
    never = [goal.sentence for goal in find_unreached_goals(loop, goals, 60_000_000_000)]
    assert never == ["wave of arm never began"] * (2 - begun)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a\n  machine lazy\n  => good\n", "a.txt:2: 'machine lazy' is no line of a run"),
        ("a\n  => not good\n", "a.txt:2: not good"),
        ("a\n  => 0: Bad\n", "a.txt:2: 0: Bad"),
        ("a\n  => has noise\n", "a.txt:2: has noise"),
        ("a\n  servos elbow\n  => none: answered\n", "a.txt:3: none: answered"),
        ("a\n  machine busy\n  => no busy_machine\n", "a.txt:3: no busy"),
        ("a\n  machine busy\n  => no fix busy_machine machine: End other\n", "a.txt:3: no fix"),
    ],
)
def test_what_does_not_hold_is_named_with_its_line(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    (case,) = read_cases(tmp_path / "a.txt")
    with pytest.raises(AssertionError, match=told):
        check_case(case)
