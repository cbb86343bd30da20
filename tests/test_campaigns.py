"""Campaigns: the mark `campaign` gives a test its count at each level, and a generator."""

import re
from pathlib import Path

import pytest
from tests.kit.nested import run_pytest

MADE_UP = """
from hypothesis import given, settings, strategies as st
from tests.kit.campaigns import campaign

EXAMPLES = []

@campaign(ci=2, night=3, release=4)
def test_numbered(number, chance):
    print("drawn", number, chance.random())

@campaign(ci=0, night=1, release=1)
def test_only_at_night(number):
    pass

@campaign(ci=1.5, night=2, release=2)
def test_amount(amount):
    print("amount", amount)

@campaign(ci=5, night=6, release=7)
@given(st.integers())
def test_property(value):
    EXAMPLES.append(value)

@campaign(ci=5, night=6, release=7)
@settings(deadline=None)
@given(st.integers())
def test_property_with_settings(value):
    assert settings().deadline is None
    EXAMPLES.append(value)

def test_examples():
    print("examples", len(EXAMPLES))
    print("drawn", EXAMPLES)
"""


def run(folder: Path, *options: str) -> str:
    ran = run_pytest(folder, {"test_made_up.py": MADE_UP}, "-rP", "-n", "0", *options, "test_made_up.py")
    assert ran.code == 0, ran.out
    return ran.out


@pytest.mark.parametrize(
    ("level", "passed", "amount", "examples"),
    [("ci", 6, 1.5, 10), ("night", 8, 2, 12), ("release", 9, 2, 14)],
)
def test_level_decides_the_counts(
    tmp_path: Path, level: str, passed: int, amount: float, examples: int
) -> None:
    output = run(tmp_path, f"--campaign={level}")
    assert f"{passed} passed" in output
    assert f"amount {amount}\n" in output
    assert f"examples {examples}\n" in output


def test_seed_decides_what_is_drawn(tmp_path: Path) -> None:
    drawn = [
        re.findall(r"^drawn .*", run(tmp_path, *words), re.MULTILINE) for words in ((), (), ("--seed", "2"))
    ]
    assert drawn[0] == drawn[1]
    assert len({*drawn[0], *drawn[2]}) == 6


def test_table_has_every_campaign_and_runs_nothing(tmp_path: Path) -> None:
    output = run(tmp_path, "--campaigns", "-n", "2")
    rows = re.findall(r"^ +(\S+) +(\S+) +(\S+)  \S+::test_(\w+)$", output, re.MULTILINE)
    assert rows == [
        ("1.5", "2", "2", "amount"),
        ("2", "3", "4", "numbered"),
        ("0", "1", "1", "only_at_night"),
        ("5", "6", "7", "property"),
        ("5", "6", "7", "property_with_settings"),
    ]
    assert "passed" not in output
