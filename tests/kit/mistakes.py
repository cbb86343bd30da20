"""Mistakes in robot files: what is changed in a robot, and what the compiler says of it, and where.

Each text in `tests/compile/mistakes` is a robot file, behind `----` a motion for it, and behind `====` cases:

    rate: 25 => rate: §20
      rate 20 Hz of states does not divide the loop's 50 Hz; write the nearest possible rate, 25

A case has a line for each change (`\\n` is a new line; `+ ` puts one at the end), and one for each problem:
at the place of §, or at its own (`9:5: ...`). A case without any is right. `HELP` is the address of the page
"It does not work".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.kit.robots import MISTAKES, problems_in

from dxlwire.exceptions import HELP


class Case(NamedTuple):
    """Changes of a text, and what is said of it then."""

    text: str
    changes: list[str]
    told: list[str]

    def check(self) -> None:
        """Compare what is said with what is to be said."""
        text = self.text
        for change in self.changes:
            right, _, wrong = change.replace("\\n", "\n").partition(" => ")
            assert right in text or right.startswith("+ "), right
            text = f"{text}{right[2:]}\n" if right.startswith("+ ") else text.replace(right, wrong, 1)
        *whole, before = text.partition("§")[0].split("----\n")
        column = len(before) - before.rfind("\n")
        place = f"{('robot', 'motion0')[len(whole)]}.yaml:{before.count(chr(10)) + 1}:{column}: "
        found = problems_in(*text.replace("§", "").split("----\n"))
        said = [str(one).removeprefix(f"{Path.cwd()}/").removeprefix(place) for one in found]
        assert [one.removeprefix("robot.yaml:").replace(HELP, "HELP") for one in said] == self.told


def cases(name: str) -> Iterator[Case]:
    """Yield the cases of a text."""
    text, _, blocks = (MISTAKES / f"{name}.txt").read_text("utf-8").partition("====\n")
    for block in blocks.strip().split("\n\n"):
        lines = [line for line in block.split("\n") if not line.startswith("#")]
        changes = [line for line in lines if not line.startswith("  ")]
        yield Case(text, changes, [line.strip() for line in lines if line.startswith("  ")])
