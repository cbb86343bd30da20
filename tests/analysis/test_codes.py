"""analyze.md has every code of a finding, and no other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from tests.kit.pages import page_text

import dxlrun_analysis
from dxlrun_analysis.finding import ROBOT
from dxlrun_analysis.joints.kinds import KINDS
from dxlrun_analysis.lost import CODES

PAGE = page_text("analyze.md")
FILES = Path(next(iter(dxlrun_analysis.__path__))).rglob("*.py")
MADE_BY = ("Finding", "Failing", "_Rule", "cause", "slow_servo")
"""Calls whose first argument is a code, or is computed by what else is looked at."""


def chosen(node: ast.AST | None) -> Iterator[str]:
    """Return the words that an expression may be."""
    if isinstance(node, ast.IfExp):
        yield from (*chosen(node.body), *chosen(node.orelse))
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def codes_of(file: Path) -> Iterator[str]:
    """Return the codes in a file: given, assigned to `code`, or returned by a function asked for one."""
    nodes = list(ast.walk(ast.parse(file.read_text())))
    first = [
        node.args[0]
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MADE_BY
    ]
    asked = {one.func.id for one in first if isinstance(one, ast.Call) and isinstance(one.func, ast.Name)}
    returned = [
        each.value
        for node in nodes
        if isinstance(node, ast.FunctionDef) and node.name in asked
        for each in ast.walk(node)
        if isinstance(each, ast.Return)
    ]
    assigned = [
        node.value
        for node in nodes
        if isinstance(node, ast.Assign)
        if any(isinstance(target, ast.Name) and target.id == "code" for target in node.targets)
    ]
    for node in (*first, *returned, *assigned):
        yield from chosen(node)


def test_the_page_has_every_code_of_a_finding_and_no_other() -> None:
    codes = {code for file in FILES for code in codes_of(file) if code.islower()} | {ROBOT}
    codes |= {*CODES.values(), *KINDS}
    assert {"jammed_joint", "latency_timer", "device_hangs", "slow_writes"} <= codes
    page = PAGE
    table = page[page.index("| code |") :].partition("\n\n")[0]
    documented = {
        code for row in table.splitlines()[2:] for code in re.findall(r"`([a-z_]+)`", row.split("|")[1])
    }
    assert documented == codes
