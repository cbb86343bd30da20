"""Examples as parameters of tests: those that need an extra are marked with it."""

from collections.abc import Iterable
from pathlib import PurePath
from typing import Any

import pytest

NEEDED = {"held_arm": "physics"}
"""Robots, and motions of them, whose file is compiled only with an extra."""


def as_parameters(names: Iterable[str | PurePath]) -> list[Any]:
    """Return robots or motions as parameters, each with the stem of its file as its ID."""
    found = []
    for name in names:
        stem = PurePath(name).stem
        marks = [pytest.mark.needs(extra) for robot, extra in NEEDED.items() if stem.startswith(robot)]
        found.append(pytest.param(name, id=stem, marks=marks))
    return found
