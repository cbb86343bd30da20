"""Command lines and what they print: texts in this folder; `tests/kit/commands.py` has their form."""

from __future__ import annotations

import pytest
from tests.kit.commands import Case, Dxlrun, cases, play

TEXTS = ("refusals", "check", "frames", "models")


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("case", [case for name in TEXTS for case in cases(f"{name}.txt")])
def test_command_prints_what_its_text_has(dxlrun: Dxlrun, case: Case) -> None:
    play(case, dxlrun)
