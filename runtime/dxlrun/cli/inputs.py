"""Robot file, arguments and motions from the command line to a compiled robot."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.errors import InputError

if TYPE_CHECKING:
    from dxlrun.compile import Ask, Compiled

COMMANDS = (
    "analyze",
    "bench",
    "check",
    "doctor",
    "examples",
    "models",
    "replay",
    "scan",
    "schema",
    "servo",
    "sim",
)
COMMANDS_WHILE_IT_RUNS = (
    "list",
    "set",
    "switch",
    "send",
    "rate",
    "pause",
    "resume",
    "load",
    "unload",
    "stop",
)


SHORTEST_S, LONGEST_S = 1e-6, 1e9
"""Of a run, s; 31 years are nearly for ever, and still fit into the log's nanoseconds."""


def compiled(
    robot: Path,
    assignments: Sequence[str],
    play: Sequence[Path],
    duration: float | None,
    ask: Ask | None = None,
) -> Compiled:
    """Read and compile; raises InputError with everything that is wrong with the file, or with the line."""
    _known_file(robot)
    arguments = parse_assignments(assignments)
    duration_ns = None
    if duration is not None:
        if not SHORTEST_S <= duration <= LONGEST_S:  # false for nan too
            raise InputError(
                f"--duration {duration:g} is no time to run; "
                f"give a number of seconds from {SHORTEST_S:g} to {LONGEST_S:g}"
            )
        duration_ns = round(duration * 1e9)
    from dxlrun.compile import compile_files  # not above: a wrong word needs neither numpy nor pydantic

    return compile_files(robot, arguments, play, duration_ns, ask)


def parse_assignments(assignments: Sequence[str]) -> dict[str, str]:
    """Return the arguments of `name:=value` words; raises InputError for a word that is none."""
    arguments: dict[str, str] = {}
    for word in assignments:
        name, sign, value = word.partition(":=")
        if not sign or not name:
            mend = (
                "a motion needs its own --play" if word.endswith((".yaml", ".yml")) else "write name:=value"
            )
            raise InputError(f"{word!r} is no argument of the robot file; {mend}")
        if name in arguments:
            raise InputError(f"argument {name} is given twice; give it once")
        arguments[name] = value
    return arguments


def _known_file(robot: Path) -> None:
    """Refuse a word that is neither a command nor a file with one sentence that helps."""
    if robot.is_file():
        return
    word = str(robot)
    if robot.is_dir():
        raise InputError(f"{word} is a directory; give the robot file in it")
    if robot.suffix in (".yaml", ".yml") or len(robot.parts) > 1:
        raise InputError(f"there is no robot file {word}; check the path")
    known = COMMANDS + COMMANDS_WHILE_IT_RUNS
    close = difflib.get_close_matches(word, known, n=1)
    hint = (
        f"did you mean {close[0]}?"
        if close
        else f"a robot is run by `dxlrun ROBOT.yaml`, the commands are {', '.join(known)}"
    )
    raise InputError(f"{word!r} is neither a command nor a robot file; {hint}")
