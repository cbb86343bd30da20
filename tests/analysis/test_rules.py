"""The table of rules: every code that is emitted is in it; docs/generate.py writes it into the page."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import dxlrun_analysis
from dxlrun_analysis.lost import CODES
from dxlrun_analysis.rules import RULES, Needs

ROOM = Path(next(iter(dxlrun_analysis.__path__)))
FILES = [file for file in ROOM.rglob("*.py") if file != ROOM / "rules.py"]
MADE_BY = ("Finding", "FollowingFailure", "cause", "joint_finding")
"""Calls whose first argument is a code, or a name that holds one."""
NAMES = {"port", "servo_id", "name", "bus"}


def _words(node: ast.AST) -> Iterator[str]:
    """Return the words that an expression may be."""
    if isinstance(node, ast.IfExp):
        yield from (*_words(node.body), *_words(node.orelse))
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def _emitted() -> set[str]:
    calls = (
        node
        for file in FILES
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MADE_BY
    )
    return {word for call in calls if call.args for word in _words(call.args[0])} | {*CODES.values()}


def test_every_emitted_code_has_a_rule_and_every_rule_is_emitted() -> None:
    assert _emitted() == set(RULES)


@pytest.mark.parametrize("code", RULES)
def test_rule_has_a_signal_and_a_bound(code: str) -> None:
    rule = RULES[code]
    assert rule.signal
    assert rule.bound
    assert set(re.findall(r"\{(\w+)\}", rule.remedy.replace("{{", "").replace("}}", ""))) <= NAMES
    if rule.accuses.startswith("joint"):
        assert rule.needs & Needs.INTACT, "a joint is not judged by positions of spoilt replies"
    assert rule.accuses or not rule.needs, "what accuses nothing is always told"
