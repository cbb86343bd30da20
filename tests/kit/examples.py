"""Examples as parameters of tests, marked with their extra, and the command that a motion file names."""

import shlex
from collections.abc import Iterable
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
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


class TypedCommand(NamedTuple):
    """`dxlrun ROBOT name:=value ... --play MOTION`, as a person would type it in the clone."""

    robot: Path
    arguments: dict[str, str]
    motion: Path


def command_of(motion: Path) -> TypedCommand:
    """Return the command that a motion file tells its reader to type; there is exactly one."""
    (line,) = [line for line in motion.read_text().splitlines() if line.startswith("#   dxlrun ")]
    _, _, robot, *words = shlex.split(line)
    *assignments, option, motion_name = words
    assert option == "--play"
    return TypedCommand(ROOT / robot, dict(word.split(":=") for word in assignments), ROOT / motion_name)
