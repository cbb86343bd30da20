"""Reading: a file -> a frozen description, or every problem of the file at once."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from dxlrun.description.motion import Motion
from dxlrun.description.robot import Robot
from dxlrun.description.source.arguments import COMMAND_LINE, Arguments, refuse_arguments
from dxlrun.description.source.including import merged, read_sources
from dxlrun.description.source.marks import KeyPath, Marks
from dxlrun.description.source.problems import places_of, problems_of
from dxlrun.description.source.pruning import Guess, prune
from dxlrun.description.source.syntax import parse, read_text
from dxlrun.description.source.tree import grow
from dxlrun.errors import InputError, Problem


@dataclass(frozen=True, slots=True)
class Description:
    """A robot file whose form is right, with the place of everything in it."""

    robot: Robot
    marks: Marks
    path: Path
    text: str
    """As it was read."""
    arguments: dict[str, str]
    """All its arguments, with the values of this run."""
    left_out: frozenset[KeyPath] = frozenset()
    """`("controllers", "head")`, `("poses",)`: what the file has in a wrong form and no guess stands in for;
    only in a survey."""
    included: Mapping[str, str] = field(default_factory=dict)
    """The text of each file that it includes, by name."""


@dataclass(frozen=True, slots=True)
class Survey:
    """A robot file that may be wrong: what can be checked further, and what is wrong with its form."""

    description: Description | None
    """The parts whose form is right, and guesses for what a robot needs; None when too few are left."""
    problems: tuple[Problem, ...]
    otherwise: Description | None = None
    """The same with other guesses, where there are any: what is wrong with both does not depend on them."""


@dataclass(frozen=True, slots=True)
class MotionDescription:
    """A motion file whose form is right, with the place of everything in it."""

    motion: Motion
    marks: Marks
    path: Path
    text: str
    """As it was read."""


def read_robot(path: Path, arguments: Mapping[str, str]) -> Description:
    """Read a robot file with the values of `name:=value`; raises InputError with all problems of its form."""
    survey = survey_robot(path, arguments)
    if survey.problems or survey.description is None:
        raise InputError(survey.problems)
    return survey.description


def survey_robot(path: Path, arguments: Mapping[str, str]) -> Survey:
    """Read as much of a robot file as its form allows.

    Raises InputError only when it, or a file that it includes, cannot be read or is no YAML at all.
    """
    sources = read_sources(path)
    declared = merged(source.declared for source in sources)  # without arguments, to learn which there are
    run = Arguments(declared.data.get("arguments"), arguments, declared.marks)
    grown = merged(source.grown(run.fill) for source in sources)
    problems = [*run.problems, *grown.problems]
    data = grown.data
    for key in Robot.read_before:
        data.pop(key, None)
    wrong = [path for path in grown.unknown if path[0] not in Robot.read_before]
    robot, error = _validated(data)
    if error is not None:
        problems += problems_of(error, grown.marks, model=Robot, unknown=grown.unknown)
        wrong += places_of(error, grown.marks)
    found: list[Description] = []
    guesses: tuple[Guess, ...] = (0, 1) if wrong else (0,)
    for guess in guesses:
        guessed = copy.deepcopy(data)
        left_out = prune(guessed, wrong, guess)
        if wrong:
            robot, _ = _validated(guessed)
        included = {str(source.path): source.text for source in sources[:-1]}
        text = sources[-1].text
        if robot is not None:
            found.append(Description(robot, grown.marks, path, text, run.texts, left_out, included))
    first, last = (found[0], found[-1]) if found else (None, None)
    return Survey(first, tuple(_in_order(problems)), last if last != first else None)


def _validated(data: dict[str, object]) -> tuple[Robot | None, ValidationError | None]:
    try:
        return Robot.model_validate(data), None
    except ValidationError as error:
        return None, error


def read_motion(path: Path) -> MotionDescription:
    """Read a motion file; raises InputError with all problems of its form."""
    text, file = read_text(path), str(path)
    grown = grow(parse(text, file), file, refuse_arguments)
    problems = [*grown.problems]
    try:
        motion = Motion.model_validate(grown.data)
    except ValidationError as error:
        problems += problems_of(error, grown.marks, model=Motion, unknown=grown.unknown)
        raise InputError(_in_order(problems)) from None
    if problems:
        raise InputError(_in_order(problems))
    return MotionDescription(motion, grown.marks, path, text)


def _in_order(problems: Iterable[Problem]) -> list[Problem]:
    """Return the problems as a person meets them: first what was typed, then the file from its top."""
    return sorted(problems, key=lambda problem: (problem.mark.file != COMMAND_LINE, problem.mark))
