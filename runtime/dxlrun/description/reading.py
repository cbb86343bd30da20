"""Reading: reads a robot file with fragments, arguments and groups, and validates it as a whole."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec.structs import replace

from dxlrun.description.arguments import COMMAND_LINE, Arguments
from dxlrun.description.document import KeyPath, Marks, PlainDocument, refusal
from dxlrun.description.form_problems import path_text, read_form
from dxlrun.description.including import KEY, Source, merged, read_sources
from dxlrun.description.joints.groups import with_groups
from dxlrun.description.joints.joint_forms import misfits
from dxlrun.description.joints.omitted import omit_joints
from dxlrun.description.mistakes.words import misplaced_sections
from dxlrun.description.other_files import foreign_named
from dxlrun.description.robot import Robot, robot_form
from dxlrun.errors import InputError, Problem, told_once


class Description(msgspec.Struct, frozen=True):
    """A robot file that was read: its contents, its text, its arguments, and the places of its values."""

    robot: Robot
    marks: Marks
    path: Path
    text: str  # text as read
    arguments: dict[str, str]  # all arguments, with their values in this run
    included: Mapping[str, str] = {}  # text of each included file, by name
    omitted: tuple[str, ...] = ()
    """Joints that are omitted, then groups that have no other joint; `robot` is without them."""
    remarks: tuple[Problem, ...] = ()
    """Warnings of reading, such as what is omitted together with a joint."""
    uneven: tuple[KeyPath, ...] = ()
    """Lists of controllers that may have a value for a joint that is omitted."""
    omitted_poses: tuple[str, ...] = ()
    """Poses that are omitted because all their joints are."""

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of the joints in each group, by the group's name."""
        return {name: group.joints for name, group in self.robot.groups.items()}


class Replacement(msgspec.Struct, frozen=True):
    """A change of a robot file after reading: a path, and the value to put there."""

    path: KeyPath
    value: object  # in the notation of a file: `5 rad/s^2`, 0.5, true


def read_robot(
    path: Path,
    arguments: Mapping[str, str],
    replacements: Sequence[Replacement] = (),
    without: Sequence[str] = (),
) -> Description:
    """Read a robot file with values for its arguments (`name:=value`), and with replaced values.

    Args:
        path: The robot file.
        arguments: Values of its arguments.
        replacements: Values that replace those of the file.
        without: Joints and groups that are omitted, as those with `installed: false`.

    Raises:
        InputError: The file or a fragment cannot be read or is not YAML; otherwise all problems of its form.
    """
    with foreign_named(path):
        return _read_robot(path, arguments, replacements, without)


def _read_robot(
    path: Path, arguments: Mapping[str, str], replacements: Sequence[Replacement], without: Sequence[str]
) -> Description:
    sources = read_sources(path)
    _refuse_other_files(sources[-1])
    # Without arguments first, to learn which arguments are declared.
    declared = merged(source.declared for source in sources)
    run = Arguments(declared.data.get("arguments"), arguments, declared.marks)
    grown = merged(source.grown(run.insert_arguments) for source in sources)
    grown = replace(grown, problems=(*run.problems, *grown.problems))
    for replacement in replacements:
        grown = _with(grown, replacement)
    _refuse_misplaced_sections(grown)
    omitted = omit_joints(with_groups(grown), without)
    grown = omitted.document
    wrong = [
        Problem(grown.marks.value(*at), what, fix) for at, what, fix in misfits(grown.data.get("joints"))
    ]
    data = {key: value for key, value in grown.data.items() if key not in Robot.read_before}
    grown = replace(grown, data=data, problems=(*grown.problems, *wrong))
    try:
        robot = read_form(grown, robot_form())
    except InputError as error:
        joints = {str(at[1]) for at in grown.marks.keys if len(at) == 2 and at[0] == "joints"}
        raise InputError(_in_order(told_once(error.problems, joints))) from None
    included = {str(source.path): source.text for source in sources[:-1]}
    return Description(
        robot,
        grown.marks,
        path,
        sources[-1].text,
        run.texts,
        included,
        omitted.names,
        omitted.remarks,
        omitted.uneven,
        omitted.poses,
    )


_OTHER_FILES = {
    "motions": ("motion", "run it with `dxlrun ROBOT.yaml --play {path}`"),
    "torque_constant": ("motor", "name it in a robot file, at the joint: `motor: {path}`"),
}
"""Keys that identify a motion or motor file given as a robot file, with the fix."""


def _refuse_other_files(source: Source) -> None:
    """Raise InputError if a file given as a robot file is a motion file or a motor file."""
    data, marks = source.declared.data, source.declared.marks
    if data.keys() & {"buses", "joints", "controllers", KEY}:
        return
    for key, (called, fix) in _OTHER_FILES.items():
        if key in data:
            problem = f"this is a {called} file, not a robot file"
            raise refusal(marks.key(key), problem, fix.format(path=source.path))


def _refuse_misplaced_sections(grown: PlainDocument) -> None:
    """Raise InputError for sections that are misnamed or indented too far, before the rest is checked."""
    problems: dict[str, Problem] = {}
    for path, fix in misplaced_sections(robot_form(), grown.data):
        what = f"{path_text(path[:-1])} has an unknown key {path[-1]!r}"
        problems.setdefault(fix, Problem(grown.marks.key(*path), what, fix))
    if problems:
        raise InputError(_in_order([*grown.problems, *problems.values()]))


def _with(grown: PlainDocument, replacement: Replacement) -> PlainDocument:
    """Return a document in which a value is replaced or added at a path.

    A place that the file does not have gets the mark of its nearest parent.
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
    """Return a copy of nested values with a new value at a path; missing mappings are created."""
    if not path:
        return value
    if isinstance(at, list):
        return [_put(item, path[1:], value) if index == path[0] else item for index, item in enumerate(at)]
    below = at if isinstance(at, dict) else {}
    return {**below, path[0]: _put(below.get(path[0]), path[1:], value)}


def _in_order(problems: Iterable[Problem]) -> list[Problem]:
    """Sort problems: those of the command line first, then by place in the file."""
    return sorted(problems, key=lambda problem: (problem.mark != COMMAND_LINE, problem.mark))
