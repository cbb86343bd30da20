"""Reading: a robot file -> a frozen description, or every problem of its form at once."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import msgspec
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun.description.arguments import COMMAND_LINE, Arguments
from dxlrun.description.document import Grown, KeyPath, Marks, refusal
from dxlrun.description.including import KEY, Source, merged, read_sources
from dxlrun.description.joints.groups import moved, with_groups
from dxlrun.description.joints.joints import kind_of_joint, misfits
from dxlrun.description.mistakes.foreign import kind_of_data
from dxlrun.description.mistakes.words import sections_meant
from dxlrun.description.problems import path_text, places_of, problems_of
from dxlrun.description.robot import Robot
from dxlrun.errors import InputError, Problem, told_once


class Description(msgspec.Struct, frozen=True):
    """A robot file whose form is right, with the place of everything in it."""

    robot: Robot
    marks: Marks
    path: Path
    text: str  # As it was read
    arguments: dict[str, str]  # All its arguments, with the values of this run
    left_out: frozenset[KeyPath] = frozenset()
    """`("controllers", "head")`, `("poses",)`: what the file has in a wrong form and no guess stands in for;
    only in a survey."""
    included: Mapping[str, str] = {}  # The text of each file that it includes, by name

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The joints of each group."""
        return {name: group.joints for name, group in self.robot.groups.items()}


class Survey(msgspec.Struct, frozen=True):
    """A robot file that may be wrong: what can be checked further, and what is wrong with its form."""

    description: Description | None
    """The parts whose form is right, and guesses for what a robot needs; None when too few are left."""
    problems: tuple[Problem, ...]
    otherwise: Description | None = None
    """The same with other guesses, where there are any: what is wrong with both does not depend on them."""


class Replacement(msgspec.Struct, frozen=True):
    """A value that stands in for what a robot file has at a place, or puts something there."""

    path: KeyPath
    value: object  # As the file would have it: `5 rad/s^2`, 0.5, true


def read_robot(path: Path, arguments: Mapping[str, str]) -> Description:
    """Read a robot file with the values of `name:=value`; raises InputError with all problems of its form."""
    survey = survey_robot(path, arguments)
    if survey.problems or survey.description is None:
        raise InputError(survey.problems)
    return survey.description


def survey_robot(
    path: Path, arguments: Mapping[str, str], replacements: Sequence[Replacement] = ()
) -> Survey:
    """Read as much of a robot file as its form allows, with some of its values replaced.

    Raises InputError only when it, or a file that it includes, cannot be read or is no YAML at all.
    """
    sources = read_sources(path)
    _refuse_other_files(sources[-1])
    declared = merged(source.declared for source in sources)  # without arguments, to learn which there are
    run = Arguments(declared.data.get("arguments"), arguments, declared.marks)
    grown = merged(source.grown(run.fill) for source in sources)
    for replacement in replacements:
        grown = _with(grown, replacement)
    grown = with_groups(_with_own_sections(grown))
    problems = [*run.problems, *grown.problems]
    data = grown.data
    for key in Robot.read_before:
        data.pop(key, None)
    wrong = [path for path in grown.unknown if path[0] not in Robot.read_before]
    for place, what, fix in misfits(data.get("joints")):
        problems.append(Problem(grown.marks.value(*place), what, fix))
        wrong.append(place)
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
    names = {str(path[1]) for path in grown.marks.keys if len(path) == 2 and path[0] == "joints"}
    return Survey(first, tuple(_in_order(told_once(problems, names))), last if last != first else None)


_OTHER_FILES = {
    "motions": ("motion", "run it with `dxlrun ROBOT.yaml --play {path}`"),
    "torque_constant": ("motor", "name it in a robot file, at the joint: `motor: {path}`"),
}
"""Keys by which files that are no robots are known: what they are called, and where they belong."""


def _refuse_other_files(source: Source) -> None:
    """Raise InputError for a motion or motor file: nothing in it is wrong, but it stands for a robot."""
    data, marks = source.declared.data, source.declared.marks
    if kind := kind_of_data(data, source.path):
        raise refusal(marks.value(), *kind)
    if data.keys() & {"buses", "joints", "controllers", KEY}:
        return
    for key, (called, fix) in _OTHER_FILES.items():
        if key in data:
            problem = f"this is a {called} file, and no robot"
            raise refusal(marks.key(key), problem, fix.format(path=source.path))


def _with_own_sections(grown: Grown) -> Grown:
    """Return a document whose sections are at its top, by our names; where one was not, is a problem."""
    own = {key: value for key, value in grown.data.items() if key not in Robot.read_before}
    data, problems = dict(grown.data), [*grown.problems]
    moves: dict[KeyPath, list[KeyPath]] = {}
    said: set[str] = set()
    for path, name, fix in sections_meant(Robot, own):
        *above, key = path
        inside = data[above[0]] if above else data
        assert isinstance(inside, dict)  # noqa: S101 (it has the key)
        value = inside[key]
        if above:
            data[above[0]] = {each: item for each, item in inside.items() if each != key}
        else:
            del data[key]
        data[name] = value
        moves[path] = [(name,)]
        if fix not in said:
            said.add(fix)
            where = path_text(tuple(above))
            problems.append(Problem(grown.marks.key(*path), f"{where} has an unknown key {key!r}", fix))
    if not moves:
        return grown
    emptied = {key for path in moves if len(path) > 1 and not data.get(key := str(path[0]), True)}
    data = {key: value for key, value in data.items() if key not in emptied or key in Robot.model_fields}
    return replace(moved(grown, moves), data=data, problems=tuple(problems))


def _with(grown: Grown, replacement: Replacement) -> Grown:
    """Return a document with a value at a place; what is wrong with the value is reported there.

    A place that the file does not have has the mark of the nearest one above it.
    """
    path, marks = replacement.path, grown.marks
    data = _put(grown.data, path, replacement.value)
    assert isinstance(data, dict)  # noqa: S101 (the top of a document is a mapping)
    ways = [path[:end] for end in range(1, len(path) + 1)]
    values = {**marks.values, **{way: marks.value(*way) for way in ways}}
    keys = {**marks.keys, **{way: marks.key(*way) for way in ways}}
    origins = {way: origin for way, origin in marks.origins.items() if way != path}
    placed = Marks(marks.file, values, keys, origins)
    return replace(grown, data=data, marks=placed, unknown=grown.unknown - {path})


def _put(at: object, path: KeyPath, value: object) -> object:
    """Return a tree with a value at a path, whose mappings are made where they are missing."""
    if not path:
        return value
    if isinstance(at, list):
        return [_put(item, path[1:], value) if index == path[0] else item for index, item in enumerate(at)]
    below = at if isinstance(at, dict) else {}
    return {**below, path[0]: _put(below.get(path[0]), path[1:], value)}


def _validated(data: dict[str, object]) -> tuple[Robot | None, ValidationError | None]:
    try:
        return Robot.model_validate(data), None
    except ValidationError as error:
        return None, error


def _in_order(problems: Iterable[Problem]) -> list[Problem]:
    """Return the problems as a person meets them: first what was typed, then the file from its top."""
    return sorted(problems, key=lambda problem: (problem.mark.file != COMMAND_LINE, problem.mark))


Guess = Literal[0, 1]
_RATES = (1.0, 1000.0)
_ENTRIES: Mapping[str, tuple[Mapping[str, object], Mapping[str, object]]] = {
    "buses": (
        {"port": "sim", "protocol": 1.0, "baud_rate": 9_600},
        {"port": "sim", "protocol": 2.0, "baud_rate": 4_000_000},
    ),
    "joints": (
        {"bus": "guessed", "id": 0, "model": "AX-12A", "reference": "0 deg", "direction": 1},
        {"bus": "guessed otherwise", "id": 1, "model": "XL430-W250", "reference": "9 deg", "direction": -1},
    ),
}


def prune(data: dict[str, object], wrong: Iterable[KeyPath], guess: Guess) -> frozenset[KeyPath]:
    """Take what is wrong out of `data` and put guesses where a key is needed; return what was left out.

    Single keys go, so that their default counts; an entry of buses, joints or controllers goes where its name
    is wrong, or where nothing can be guessed.
    """
    left_out: set[KeyPath] = set()
    joints = data.get("joints")
    transmitted = {  # before their wrong keys are gone: by its keys a joint shows that it has a servo
        name
        for name, entry in (joints.items() if isinstance(joints, dict) else ())
        if isinstance(entry, dict) and kind_of_joint(entry) == "<transmission>"
    }
    for path in wrong:
        if path:
            left_out |= _take_out(data, path, guess)
    data.setdefault("name", "unnamed")
    data.setdefault("buses", {"unnamed": {}})
    loop = data.setdefault("loop", {})
    if isinstance(loop, dict):
        loop.setdefault("rate", _RATES[guess])
    for section, guesses in _ENTRIES.items():
        entries = data.get(section)
        for name, entry in entries.items() if isinstance(entries, dict) else ():
            if isinstance(entry, dict) and (section != "joints" or name not in transmitted):
                for key, value in guesses[guess].items():
                    if key != "id" or "servos" not in entry:
                        entry.setdefault(key, value)
    return frozenset(left_out)


def _take_out(  # noqa: PLR0911  one return a kind of place
    data: dict[str, object], path: KeyPath, guess: Guess
) -> set[KeyPath]:
    name = str(path[0])
    section = data.get(name)
    if len(path) == 1 or not isinstance(section, dict):
        data.pop(name, None)
        return {path[:1]}
    if name not in (*_ENTRIES, "controllers"):
        section.pop(path[1], None)
        if not section:  # an empty mapping may lack what was wrong
            del data[name]
        return {path[:2]}
    entry = section.get(path[1])
    if len(path) == 2 or not isinstance(entry, dict):
        if name in _ENTRIES and path[1] in section and not isinstance(entry, dict):
            section[path[1]] = dict(_ENTRIES[name][guess])  # its name stands, and others refer to it
            return set()
        section.pop(path[1], None)
        return {path[:2]}
    entry.pop(path[2], None)
    if (name, path[2]) == ("joints", "servos"):
        return {path[:3]}
    if (name, path[2]) == ("controllers", "type"):
        del section[path[1]]
        return {path[:2]}
    if path[2:] == ("travel_per_turn",):
        entry[path[2]] = ("20 mm", "60 mm")[guess]
    if path[2:] in (("active",), ("continuous",)):
        entry[path[2]] = bool(guess)
    if name == "buses":  # what a cycle takes depends on nearly every key of a bus: with this it is guessed
        entry.pop("baud_rate", None)
    return set()
