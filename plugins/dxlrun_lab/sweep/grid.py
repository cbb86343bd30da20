"""Grid: ranges on a robot file become points, each compiled like a run; every mistake is reported at once."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from dxlrun.compile.robot import Compiled, compile_files
from dxlrun.description.arguments import COMMAND_LINE
from dxlrun.description.document import text_of
from dxlrun.description.motion import read_motion
from dxlrun.description.reading import Description, Replacement, survey_robot
from dxlrun.errors import InputError, Mark, Problem
from dxlrun.run.virtual_run import require_simulated
from dxlrun_lab.desired import DesiredPath, desired_paths, motion_samples
from dxlrun_lab.sweep.places import find_place
from dxlrun_lab.sweep.ranges import Parameter, Value, parse_range

MOST_RUNS = 10_000
_MOST_TRIED = 16
"""Combinations with a value, of which one must compile; else the value is a mistake."""
_MOST_CHECKED = 64
"""Values of each parameter, evenly spaced, its ends among them; of more, a mistake may be a row."""
Point = tuple[int, ...]
"""Of each parameter, which of its values."""


class Grid:
    """All points of a sweep: each value of each parameter with each of the others.

    Raises InputError with every mistake of the command line, of the files, and of the values.
    """

    def __init__(
        self, robot: Path, arguments: Mapping[str, str], motions: Sequence[Path], ranges: Sequence[str]
    ) -> None:
        self._robot, self._arguments, self._files = robot, arguments, tuple(motions)
        self.parameters = self._parameters(ranges)
        self.first = self._checked()
        """The first point that the robot file allows, compiled."""
        require_simulated(self.first.plan)
        read = [read_motion(path, self.first.plan.groups) for path in motions]
        self.motions = tuple(motion.text for motion in read)
        """Text of each motion file."""
        self._samples = motion_samples(read)

    @property
    def size(self) -> int:
        """How many points there are."""
        return math.prod(len(parameter.values) for parameter in self.parameters)

    @property
    def points(self) -> Iterator[Point]:
        """Yield every point, the last parameter changing first."""
        return itertools.product(*(range(len(parameter.values)) for parameter in self.parameters))

    def values(self, point: Point) -> tuple[Value, ...]:
        """Return the values of a point, in the order of the parameters."""
        return tuple(parameter.values[index] for parameter, index in zip(self.parameters, point, strict=True))

    def compiled(self, point: Point) -> Compiled:
        """Return a point as a run would have it; raises InputError with what the file does not allow."""
        arguments = dict(self._arguments)
        replacements: list[Replacement] = []
        for parameter, value in zip(self.parameters, self.values(point), strict=True):
            if parameter.argument is not None:
                arguments[parameter.argument] = text_of(value)
            else:
                replacements.append(Replacement(parameter.place, value))
        return compile_files(self._robot, arguments, self._files, replacements=replacements)

    def paths(self, compiled: Compiled) -> tuple[DesiredPath, ...]:
        """Return what the motions want of the joints, at a point."""
        return desired_paths(compiled, self._samples)

    def _parameters(self, texts: Sequence[str]) -> tuple[Parameter, ...]:
        """Return the ranges with their places; raises InputError also for what is wrong with the file's form.

        Where a range is wrong, the values cannot be checked; the file is, as it stands.
        """
        problems: list[Problem] = []
        ranges: list[tuple[str, Parameter]] = []
        for text in texts:
            try:
                ranges.append((text, parse_range(text)))
            except ValueError as error:
                problems.append(_mistake(text, error))
        description = self._description(problems)
        parameters = [] if description is None else self._placed(description, ranges, problems)
        runs = math.prod(len(found.values) for _, found in ranges)
        if runs > MOST_RUNS:
            what = f"this is {runs} runs, and {MOST_RUNS} are allowed"
            problems.append(Problem(Mark(COMMAND_LINE), what, "give fewer points, or one parameter less"))
        if problems:
            raise InputError(self._with_those_of_the_file(problems, parameters))
        return tuple(parameters)

    def _placed(
        self, description: Description, ranges: Sequence[tuple[str, Parameter]], problems: list[Problem]
    ) -> list[Parameter]:
        parameters: list[Parameter] = []
        for text, found in ranges:
            try:
                place = find_place(description, found.steps)
                one = replace(found, place=place, mark=description.marks.value(*place))
                if one.argument is not None and one.argument in self._arguments:
                    given = self._arguments[one.argument]
                    raise ValueError(f"argument {one.argument} is given as {given}, too; give one of them")
                if any(parameter.place == place for parameter in parameters):
                    raise ValueError(f"{one.place_text} is swept twice; give one range for it")
                parameters.append(one)
            except ValueError as error:
                problems.append(_mistake(text, error))
        return parameters

    def _description(self, problems: list[Problem]) -> Description | None:
        try:
            survey = survey_robot(self._robot, self._arguments)
        except InputError as error:
            problems += error.problems
            return None
        if survey.description is None:
            problems += survey.problems
        return survey.description

    def _with_those_of_the_file(self, problems: list[Problem], found: Sequence[Parameter]) -> list[Problem]:
        """Return problems and what is wrong with the files, with a value for each swept argument."""
        arguments = {
            parameter.argument: text_of(parameter.values[0])
            for parameter in found
            if parameter.argument is not None
        }
        try:
            compile_files(self._robot, {**arguments, **self._arguments}, self._files)
        except InputError as error:
            problems += [problem for problem in error.problems if problem not in problems]
        return problems

    def _checked(self) -> Compiled:
        """Check the values of each parameter; return a point that compiles.

        A value is a mistake when no combination with it compiles that was tried; one that only some others
        forbid is the result of these points.
        """
        first: Compiled | None = None
        bad: dict[tuple[int, int], tuple[Problem, ...]] = {}
        start = (0,) * len(self.parameters)
        tried = functools.cache(self._tried)
        for axis, parameter in enumerate(self.parameters):
            for index in _some_of(len(parameter.values)):
                point = (*start[:axis], index, *start[axis + 1 :])
                found = tried(point)
                if isinstance(found, Compiled):
                    first = first or found
                else:
                    bad[axis, index] = found
        if not first and _in_all(bad.values()):
            raise InputError(self._mistakes(bad))
        for axis, index in list(bad):
            for point in itertools.islice(self._with_value(axis, index), _MOST_TRIED):
                found = tried(point)
                if isinstance(found, Compiled):
                    first = first or found
                    del bad[axis, index]
                    break
        if first is None or bad:
            raise InputError(self._mistakes(bad))
        return first

    def _tried(self, point: Point) -> Compiled | tuple[Problem, ...]:
        try:
            return self.compiled(point)
        except InputError as error:
            return error.problems or (Problem(Mark(str(self._robot)), str(error), "correct it"),)

    def _with_value(self, axis: int, index: int) -> Iterator[Point]:
        """Yield the points with a value, those first that have other values than the first ones."""
        counts = [len(parameter.values) for parameter in self.parameters]
        return itertools.product(
            *((index,) if other == axis else reversed(range(count)) for other, count in enumerate(counts))
        )

    def _mistakes(self, bad: Mapping[tuple[int, int], tuple[Problem, ...]]) -> list[Problem]:
        """Return what is wrong: of the file, if that is so with every value, else with the values named.

        A problem belongs to the parameter at whose place it is, else to the one of which the fewest values
        have it.
        """
        found = [tuple(problem for problem in each if problem.severity == "error") for each in bad.values()]
        everywhere = len(bad) == sum(len(_some_of(len(one.values))) for one in self.parameters)
        own = {parameter.mark for parameter in self.parameters}
        shared = [problem for problem in _in_all(found) if everywhere and problem.mark not in own]
        of_axes: dict[tuple[Mark, str], dict[int, list[tuple[str, Problem]]]] = {}
        for (axis, index), problems in zip(bad, found, strict=True):
            value = text_of(self.parameters[axis].values[index])
            for problem in problems:
                if problem not in shared:
                    axes = of_axes.setdefault((problem.mark, problem.fix), {})
                    axes.setdefault(axis, []).append((value, problem))
        named: list[Problem] = []
        for (mark, _), axes in of_axes.items():
            axis = min(axes, key=lambda axis: (self.parameters[axis].mark != mark, len(axes[axis])))
            values, problem = [value for value, _ in axes[axis]], axes[axis][0][1]
            what = f"with {self.parameters[axis].name}={_listed(values)}: {problem.what}"
            named.append(dataclasses.replace(problem, what=what))
        return sorted(
            (*shared, *named), key=lambda problem: (problem.mark.file != COMMAND_LINE, problem.mark)
        )


def _some_of(count: int) -> list[int]:
    if count <= _MOST_CHECKED:
        return list(range(count))
    return [round(step * (count - 1) / (_MOST_CHECKED - 1)) for step in range(_MOST_CHECKED)]


def _in_all(found: Collection[Sequence[Problem]]) -> list[Problem]:
    first = next(iter(found), ())
    return [one for one in first if one.severity == "error" and all(one in each for each in found)]


def _listed(values: Sequence[str]) -> str:
    return values[0] if len(values) == 1 else f"{values[0]} (and {len(values) - 1} more of its values)"


def _mistake(text: str, error: ValueError) -> Problem:
    what, _, fix = str(error).partition("; ")
    return Problem(Mark(COMMAND_LINE), f"--over {text}: {what}", fix or "correct it")
