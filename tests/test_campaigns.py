"""Campaigns: the mark `campaign` gives a test its count at each level, and a generator."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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


@pytest.fixture(name="run")
def _run(tmp_path: Path):
    path = tmp_path / "test_made_up.py"
    path.write_text(MADE_UP)
    (tmp_path / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text())
    config = ("-c", str(ROOT / "pyproject.toml"), f"--rootdir={tmp_path}", "-p", "no:cacheprovider")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "COV_"))}
    environment = inherited | {"PYTHONPATH": str(ROOT)}

    def run(*options: str) -> str:
        words = [sys.executable, "-m", "pytest", "-rP", "-n", "0", *config, *options, str(path)]
        ran = subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return ran.stdout

    return run


@pytest.mark.parametrize(
    ("level", "passed", "amount", "examples"),
    [("ci", 6, 1.5, 10), ("night", 8, 2, 12), ("release", 9, 2, 14)],
)
def test_level_decides_the_counts(run, level: str, passed: int, amount: float, examples: int) -> None:
    output = run(f"--campaign={level}")
    assert f"{passed} passed" in output
    assert f"amount {amount}\n" in output
    assert f"examples {examples}\n" in output


def test_seed_decides_what_is_drawn(run) -> None:
    drawn = [re.findall(r"^drawn .*", run(*words), re.MULTILINE) for words in ((), (), ("--seed", "2"))]
    assert drawn[0] == drawn[1]
    assert len({*drawn[0], *drawn[2]}) == 6


def test_table_has_every_campaign_and_runs_nothing(run) -> None:
    output = run("--campaigns", "-n", "2")
    rows = re.findall(r"^ +(\S+) +(\S+) +(\S+)  \S+::test_(\w+)$", output, re.MULTILINE)
    assert rows == [
        ("1.5", "2", "2", "amount"),
        ("2", "3", "4", "numbered"),
        ("0", "1", "1", "only_at_night"),
        ("5", "6", "7", "property"),
        ("5", "6", "7", "property_with_settings"),
    ]
    assert "passed" not in output
