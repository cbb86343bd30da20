"""`dxlrun examples` and `dxlrun schema`: example robots, and JSON Schemas for editors."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dxlrun.cli.inputs import DebugFlag, JsonFlag, examples_directory
from dxlrun.errors import InputError
from dxlrun.output.target import make_folder_of, write_target
from dxlrun.output.terminal import show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.description.motion import MotionDescription
    from dxlrun.description.robot import Robot

_HERE = Path("robots")
_SCHEMAS = ("robot.schema.json", "motions/motion.schema.json", "motors/motor.schema.json")
"""Schemas to which the first lines of the example files refer, for editors."""


@dataclass(frozen=True, slots=True)
class Example:
    """An example robot that comes with dxlrun, with the files it needs."""

    name: str
    """Name of the robot file without suffix."""
    servos: int
    motions: tuple[str, ...]
    """Names of the motion files that fit the robot; those that can be played at once come first."""
    playable: int
    """Number of motions that can be played at once; the others need a controller that is inactive at the
    start."""
    about: str
    files: tuple[str, ...]
    """Paths of all files to copy, the robot file first, relative to the directory of the examples."""


def examples(
    name: str | None = None,
    directory: Path = _HERE,
    /,
    *,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """List the robots that come with dxlrun, or copy one with its motions.

    Parameters
    ----------
    name
        Robot to copy. Default: list all robots.
    directory
        Directory for the copy. Existing files are not overwritten.
    """
    source = examples_directory()
    known = {path.stem: path for path in sorted(source.glob("*.yaml"))}
    if name is None:
        _list([_example(path) for path in known.values()], as_json=as_json)
        return 0
    stem = Path(name).name.removesuffix(".yaml")
    if stem not in known:
        from dxlrun.errors import suggestion

        raise InputError(f"there is no example {name}; {suggestion(stem, tuple(known))}")
    example = _example(known[stem])
    _copy(source, directory, example.files)
    copied = [str(directory / file) for file in example.files]
    if as_json:
        show_json({"robot": copied[0], "files": copied})
        return 0
    motion = f" --play {directory / 'motions' / example.motions[0]}.yaml" if example.playable else ""
    show_parts(*copied, f"next: dxlrun {copied[0]}{motion}")
    return 0


def _list(found: Sequence[Example], *, as_json: bool) -> None:
    if as_json:
        show_json(found)
        return
    from dxlrun.output.text_table import Column, Table

    columns = [
        Column("example", "name"),
        Column("servos"),
        Column("motions", "text", detail=True),
        Column("about", "text"),
    ]
    rows = [(one.name, one.servos, ", ".join(one.motions), one.about) for one in found]
    show_parts(
        Table.from_rows("", columns, rows),
        f"copy an example with its motions: `dxlrun examples NAME [DIR]` (default of DIR: {_HERE})",
    )


def _example(path: Path) -> Example:
    from dxlrun.control.controllers.single_files import file_of
    from dxlrun.description.motion import read_motion
    from dxlrun.description.reading import read_robot

    description = read_robot(path, {})
    robot, source = description.robot, path.parent
    active = {name for name, entry in robot.controllers.items() if entry.active}
    found = map(read_motion, sorted(source.glob("motions/*.yaml")))
    motions = [motion for motion in found if _fits(motion, robot)]
    at_once = [motion for motion in motions if {part.controller for part in motion.motion.motions} <= active]
    motions = [*at_once, *(motion for motion in motions if motion not in at_once)]
    needed = [*map(Path, description.included), *(motion.path for motion in motions)]
    needed += [source / robot.model.urdf] if robot.model else []
    named = {(getattr(joint, "motor", None), joint.simulation.motor) for joint in robot.joints.values()}
    motors = sorted({each for both in named for each in both if each})
    code = sorted({file_of(entry.type) or "" for entry in robot.controllers.values()} - {""})
    needed += [source / file for file in (*motors, *code)]
    files = [path.name, *(str(each.relative_to(source)) for each in needed)]
    folders = {Path(name).parent for name in files}
    schemas = (name for name in _SCHEMAS if Path(name).parent in folders)
    return Example(
        name=path.stem,
        servos=len(robot.joints),
        motions=tuple(motion.path.stem for motion in motions),
        playable=len(at_once),
        about=_about(description.text),
        files=(*files, *schemas),
    )


def _fits(motion: MotionDescription, robot: Robot) -> bool:
    """Return True when a robot has all controllers and joints that a motion names, and they can play it."""
    from dxlrun.compile.motions import command_kind
    from dxlrun.control.controllers.plugin_loading import load_plugins
    from dxlrun.description.motion import FormulaPart

    joints: set[str] = set()
    for part in motion.motion.motions:
        if isinstance(part, FormulaPart):
            joints.update(part.joints)
        else:
            joints.update(*(point.joints for point in part.points))
    controllers = {part.controller for part in motion.motion.motions}
    if not (controllers <= set(robot.controllers) and joints <= set(robot.joints)):
        return False
    offers = (load_plugins().controllers.get(robot.controllers[name].type) for name in controllers)
    return all(offer is None or command_kind(offer.controller) for offer in offers)


def _about(text: str) -> str:
    """Return the first sentence of the comment at the top of a robot file, after the line for editors."""
    comment: list[str] = []
    # The first line is for editors.
    for line in text.splitlines()[1:]:
        if not line.startswith("# ") or line.startswith("#  "):
            break
        comment.append(line.removeprefix("# "))
    return re.split(r"(?<=\.)\s", " ".join(comment), maxsplit=1)[0]


def _copy(source: Path, directory: Path, files: Sequence[str]) -> None:
    """Copy files from `source` to `directory`; identical files are skipped.

    Raises InputError, before any is written, when another file has one of the names.
    """
    texts = {directory / file: (source / file).read_bytes() for file in files}
    missing = {path: text for path, text in texts.items() if not _holds(path, text)}
    taken = [path for path in missing if os.path.lexists(path)]
    if taken:
        raise InputError(
            "\n".join(
                f"{path} already exists with other contents; choose another directory" for path in taken
            )
        )
    for path, text in missing.items():
        make_folder_of(path)
        write_target(path, text)


def _holds(path: Path, text: bytes) -> bool:
    return path.is_file() and path.read_bytes() == text


_SCHEMA_MARK = '"$schema": "https://json-schema.org/'
"""Text that is in each JSON Schema of dxlrun; an existing file without it is not overwritten."""


def schema(
    kind: Literal["robot", "motion", "motor", "fragment"] = "robot",
    /,
    *,
    output: Path | None = None,
    debug: DebugFlag = False,
) -> int:
    """Print the JSON Schema of robot files.

    It includes the parameters of all installed controllers. Editors with a YAML language server use the
    schema if the first line of a robot file is `# yaml-language-server: $schema=robot.schema.json`.

    Parameters
    ----------
    kind
        Kind of file. A fragment is a file that a robot file includes.
    output
        Output file. Default: standard output.
    """
    text = schema_text(kind)
    if output is None:
        sys.stdout.write(text)
        return 0
    write_target(output, text, _SCHEMA_MARK)
    return 0


def schema_text(kind: Literal["robot", "motion", "motor", "fragment"], *, only: str = "") -> str:
    """Return the JSON Schema of a kind of file, with the parameters of installed plug-ins, as JSON text.

    `only`: restrict the plug-ins to distributions whose names begin with it.
    """
    from dxlrun.description.json_schema import fragment_schema, motion_schema, motor_schema, robot_schema

    if kind == "motion":
        made = motion_schema()
    elif kind == "motor":
        made = motor_schema()
    else:
        from dxlrun.control.controllers.offers import OfferStage
        from dxlrun.control.controllers.plugin_loading import load_plugins
        from dxlrun.features import FEATURES, stages

        # A controller whose class cannot be imported has no parameters to show.
        found = load_plugins()
        controllers = {
            name: offer.controller.Parameters
            for name in found.controllers
            if (offer := found.controllers.get(name)) and offer.distribution.startswith(only)
        }
        entries = {
            stage.form: (stage.kind, found.parameters_of_drivers(feature.name, only))
            for feature, stage in stages(OfferStage, FEATURES)
        }
        of_kind = robot_schema if kind == "robot" else fragment_schema
        made = of_kind(controllers, entries)
    return json.dumps(made, indent=2, ensure_ascii=False) + "\n"
