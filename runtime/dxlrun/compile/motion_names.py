"""Names of motions: the motion file, or the controller's own motion, that a word stands for.

The same names are for `dxlrun ROBOT.yaml --play`, `dxlrun play`, `RemoteRobot.play` and the page.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, cast

from dxlrun.errors import InputError, suggestion

PLAY = "play"
"""Name of the command by which a controller such as keyframe_player plays one of its own motions."""
_FOLDER = "motions"
"""Name of the folder next to the robot file in which motion files are searched."""


class FoundMotion(NamedTuple):
    """A motion that a word stands for, and where it was found."""

    name: str
    path: Path
    player: str = ""
    """Controller that has the motion; empty: `path` is the motion file."""


def is_name(word: str) -> bool:
    """Return True if a word is the name of a motion, not the path of a motion file."""
    path = Path(word)
    return not path.is_file() and not path.suffix


def motion_files(robot: Path) -> list[Path]:
    """Return the YAML files next to a robot file and in its folder of motions, which may be motion files."""
    folders = robot.parent, robot.parent / _FOLDER
    return [file for folder in folders for file in sorted(folder.glob("*.yaml")) if file != robot]


def has_motions(file: Path) -> bool:
    """Return True when a YAML file has a line `motions:`, as motion files have; it may still be invalid."""
    from dxlrun.description.document import read_text

    try:
        return any(line.startswith("motions:") for line in read_text(file).splitlines())
    except InputError:
        return False


def find_motion(word: str, name: str, robot: Path, players: Mapping[str, Collection[str]]) -> FoundMotion:
    """Return the motion that a word stands for: a path, a file's name, or `MOTION` or `CONTROLLER/MOTION`.

    Args:
        word: Path or name.
        name: Name of the robot, for messages.
        robot: Robot file, next to which motion files are.
        players: Names of the motions of each controller, by controller.

    Raises:
        InputError: The word stands for nothing, or for several motions.
    """
    if not is_name(word):
        return FoundMotion(word, Path(word))
    files = motion_files(robot)
    found = [FoundMotion(word, file) for file in files if file.stem == word]
    for player, motions in players.items():
        for motion in motions:
            if word in (motion, f"{player}/{motion}"):
                found.append(FoundMotion(motion, Path(word), player))
    if len(found) > 1:
        found = [one for one in found if one.player or has_motions(one.path)]
    if len(found) > 1:
        choices = ", ".join(f"{one.player}/{one.name}" if one.player else str(one.path) for one in found)
        raise InputError(f"{len(found)} motions have the name {word}; choose one: {choices}")
    if not found:
        known = [motion for motions in players.values() for motion in motions]
        known += [file.stem for file in files if has_motions(file)]
        raise InputError(f"{name} has no motion {word}, and no file has this name; {suggestion(word, known)}")
    return found[0]


def motions_of_players(info: Mapping[str, object]) -> dict[str, Mapping[str, float | None]]:
    """Return controller -> motion -> duration, s, of the controllers of a running robot, from its `info`."""
    rows = cast("Sequence[Mapping[str, object]]", info["controllers"])
    return {str(row["name"]): cast("Mapping[str, float | None]", row["motions"]) for row in rows}


def find_live_motion(word: str, name: str, info: Mapping[str, object]) -> FoundMotion:
    """Return the motion of a running robot that a word stands for, as `find_motion`; `info` is that of the
    robot.
    """
    return find_motion(word, name, Path(str(info["file"])), motions_of_players(info))
