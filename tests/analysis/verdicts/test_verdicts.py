"""Faults of robots on virtual time: a verdict names the cause and accuses no innocent. The cases are `*.txt`.

Each number of the campaign draws a pair of a case and a robot; `--campaign=release` runs all pairs. Only it
includes pairs whose cause is known not to be named: such a pair has to stay unnamed, or lose that line.
"""

from pathlib import Path

import pytest
from tests.analysis.verdicts.cases import Case, read_cases
from tests.kit.campaigns import campaign

pytestmark = pytest.mark.long

HERE = Path(__file__).parent
CASES = [*read_cases(*sorted({*HERE.glob("*.txt")} - {HERE / "losses.txt"}))]
PAIRS = [(case, robot) for case in CASES for robot in case.robots]
DRAWN = [(case, robot) for case, robot in PAIRS if robot not in case.unnamed]
LOSSES = list(read_cases(HERE / "losses.txt"))


def check(case: Case, robot: str, directory: Path) -> None:
    found = case.judge(robot, directory)
    assert not found.accused, f"{case.place}: {robot}: {case.happens}\n{found}"
    assert bool(found.wrong) == (robot in case.unnamed), f"{case.place}: {robot}: {case.happens}\n{found}"


def test_every_case_says_what_happens(tmp_path):
    assert len({case.name for case in CASES}) == len(CASES) > 50
    for case, robot in PAIRS:
        assert case.happens.endswith(".")
        assert set(case.unnamed) <= set(case.robots)
        assert case.causes or case.good, f"{case.place}: what is expected?"
        case.prepare(robot, tmp_path)


@campaign(ci=4, night=30, release=len(PAIRS))
def test_verdict_names_the_cause_and_accuses_no_innocent(number, amount, chance, tmp_path):
    case, robot = PAIRS[number] if amount == len(PAIRS) else chance.choice(DRAWN)
    print(case.place, case.name, robot)
    check(case, robot, tmp_path)


@campaign(ci=1, night=4, release=4)
@pytest.mark.parametrize("case", LOSSES, ids=lambda case: case.name)
def test_missing_and_late_replies_are_those_of_the_part_that_fails(case, amount, tmp_path):
    """`amount` is the number of robots."""
    assert case.robots
    for robot in case.robots[:amount]:
        check(case, robot, tmp_path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("  swing\n", "bad.txt:1: write NAME: ROBOTS, of mx_bulk, mx_two"),
        ("some case: torso\n", "bad.txt:1: write NAME: ROBOTS, of mx_bulk, mx_two"),
        (
            "some case: x_fast\n  about: A.\n  swing wildly\n",
            "bad.txt:3: 'swing wildly' is no line of a case",
        ),
    ],
)
def test_mistake_in_a_case_is_named_with_its_line(text, told, tmp_path):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(ValueError, match=told):
        [case.prepare("x_fast", tmp_path) for case in read_cases(tmp_path / "bad.txt")]
