"""`dxlrun play`: play motions on a running robot one after the other, or list them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, cast

from cyclopts import Parameter

from dxlrun.cli.inputs import Flag, WaitFlag
from dxlrun.cli.steering.goals import MOST_JOINTS, begun_or_cancelled, show_goal_progress
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, connect_robot, report_done
from dxlrun.errors import DxlrunError, InputError, Mark, Problem, Refused, suggestion
from dxlrun.output.terminal import print_warning, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.description.joints.groups import Groups
    from dxlrun.remote.client import RemoteRobot

PLAY = "play"
"""Name of the command by which a controller such as keyframe_player plays one of its own motions."""
MOST_LOOPS = 10_000
_FOLDER = "motions"
"""Name of the folder next to the robot file in which motion files are searched."""


class MotionSource(NamedTuple):
    """A motion named on the command line, and where it was found."""

    motion: str
    path: Path
    player: str = ""
    """Controller that has the motion; empty: `path` is the motion file."""


class Playable(NamedTuple):
    """A motion that can be played by name, as `play --list` shows it."""

    motion: str
    controllers: Sequence[str]
    joints: Sequence[str]
    seconds: float | None
    """Duration at speed 1, from the first pose on, s; None for a motion that is played until it is cancelled,
    and for a motion file that cannot be read.
    """
    file: str = ""
    """Path of the motion file; empty when a controller has the motion."""


def play_motions(
    *motions: Annotated[str, Parameter(name="motion")],
    speed: float = 1.0,
    loop: int = 1,
    listed: Annotated[Flag, Parameter(name="--list")] = False,
    wait: WaitFlag = True,
    chosen: RobotChoice = ONLY_ONE,
) -> int:
    """Play motions on a running robot: `dxlrun play wave bow`.

    All controllers of a motion start in the same cycle. After a motion that does not reach its end, no other
    motion is played. Ctrl-C cancels the motion, and the command returns when the joints are at rest.

    Parameters
    ----------
    motions
        Motion files, or names of motions. A name stands for a file next to the robot file or in its folder
        motions, or for a motion of a keyframe_player. The controllers of a motion must be active.
    speed
        Speed factor: at 0.5 a motion takes twice as long.
    loop
        Number of times that all motions are played.
    listed
        List the motions that can be played by name, with their joints and durations.
    wait
        Wait until all motions have ended. With --no-wait, return when the motion has started.
    """
    _check(motions, loop, listed=listed, wait=wait)
    with connect_robot(chosen.robot, "play") as robot:
        if listed:
            _list(robot, chosen)
            return 0
        found = [_found(robot, motion) for motion in motions]
        files = [each.path for each in found if not each.player]
        if len(found) > 1 or _omitted(robot.info()):
            _check_forms(robot, files)
        for _ in range(loop):
            for each in found:
                if code := _play(robot, each, speed, chosen, wait=wait):
                    return code
    return 0


def _check(motions: Sequence[str], loop: int, *, listed: bool, wait: bool) -> None:
    if listed and motions:
        raise InputError(f"--list takes no motions; omit {' '.join(motions)}")
    if not (listed or motions):
        raise InputError("name a motion; `dxlrun play --list` shows those of the robot")
    if not 1 <= loop <= MOST_LOOPS:
        raise InputError(f"--loop {loop} is not a number of repetitions; give 1 to {MOST_LOOPS}")
    if not wait and loop * len(motions) > 1:
        raise InputError("--no-wait can start only one motion; omit --no-wait")
    for motion in motions:
        path = Path(motion)
        if not path.is_file() and (path.suffix or path.name != motion):
            raise InputError(f"motion file {motion} not found; check the path")


def _play(robot: RemoteRobot, found: MotionSource, speed: float, chosen: RobotChoice, *, wait: bool) -> int:
    """Play one motion; return the exit code after its end, or at once without `wait`."""
    motion, path, player = found
    try:
        with begun_or_cancelled(robot, "play", waited=wait):
            if player:
                done = robot.send(player, PLAY, {"motion": motion, "speed": speed})
            else:
                done = robot.play(path, speed)
    except Refused as refused:
        raise _located(refused, path) from None
    numbers = [goal.number for goal in done.goals]
    if not wait:
        shown = ", ".join(map(str, numbers))
        goals = f"goal{'s' if len(numbers) > 1 else ''} {shown}"
        return report_done(robot, chosen, done, f"{robot.name}: plays {motion} as {goals}")
    return show_goal_progress(robot, chosen, done, numbers, motion)


# Lookup of motions


def _found(robot: RemoteRobot, name: str) -> MotionSource:
    """Return the motion file or the controller for a motion's name or path.

    Raises InputError for an unknown name, or one that several files or controllers have.
    """
    if (path := Path(name)).is_file():
        return MotionSource(name, path)
    info = robot.info()
    players = _players(info)
    files = _files(info)
    fitting = [file for file in files if file.stem == name]
    having = [player for player, motions in players.items() if name in motions]
    if len(fitting) + len(having) > 1:
        ways = [
            *(f"`dxlrun play {file}`" for file in fitting),
            *(f"`dxlrun send {player} {PLAY} motion={name}`" for player in having),
        ]
        raise InputError(f"{len(ways)} motions have the name {name}; choose one: {', '.join(ways)}")
    if fitting or having:
        return MotionSource(name, fitting[0]) if fitting else MotionSource(name, Path(name), having[0])
    known = [each.motion for each in _playable(info)]
    raise InputError(
        f"{robot.name} has no motion {name}, and no file has this name; {suggestion(name, known)}"
    )


def _players(info: Mapping[str, object]) -> dict[str, Mapping[str, float | None]]:
    """Return controller -> motion -> duration, s, for the motions that controllers have."""
    rows = cast("Sequence[Mapping[str, object]]", info["controllers"])
    return {str(row["name"]): cast("Mapping[str, float | None]", row["motions"]) for row in rows}


def _files(info: Mapping[str, object]) -> list[Path]:
    """Return the YAML files next to the robot file and in its folder of motions, which may be motion
    files.
    """
    robot = Path(str(info["file"]))
    folders = robot.parent, robot.parent / _FOLDER
    return [file for folder in folders for file in sorted(folder.glob("*.yaml")) if file != robot]


def _has_motions(file: Path) -> bool:
    """Return True when a YAML file has a line `motions:`, as motion files have; it may still be invalid."""
    from dxlrun.description.document import read_text

    try:
        return any(line.startswith("motions:") for line in read_text(file).splitlines())
    except InputError:
        return False


def _check_forms(robot: RemoteRobot, files: Sequence[Path]) -> None:
    """Parse all motion files before the first is played, and print which joints they are played without.

    Raises InputError with the mistakes of a file.
    """
    from dxlrun.description.motion import read_motion

    info = robot.info()
    for file in files:
        motion = read_motion(file, cast("Groups", info["groups"]), _omitted(info))
        if motion.without:
            print_warning(f"{robot.name}: {file} is played without {', '.join(motion.without)}")


def _omitted(info: Mapping[str, object]) -> Sequence[str]:
    """Return the joints and groups that a run omits; a robot of an earlier version does not report them."""
    return cast("Sequence[str]", info.get("omitted", ()))


def _list(robot: RemoteRobot, chosen: RobotChoice) -> None:
    from dxlrun.output.text_table import Column, Table

    rows = sorted(_playable(robot.info()))
    if chosen.as_json:
        show_json([row._asdict() for row in rows])
        return
    if not rows:
        show_parts(f"{robot.name} has no motions; record one by `dxlrun teach`")
        return
    columns = [Column(name, "name") for name in ("motion", "controllers", "joints")]
    columns += [Column("length", form="{:.2f} s"), Column("file", "name")]
    cells = [
        (row.motion, ", ".join(row.controllers), _few(row.joints), row.seconds, row.file) for row in rows
    ]
    show_parts(Table.from_rows("", columns, cells))


def _few(joints: Sequence[str]) -> str:
    return ", ".join(joints) if len(joints) <= MOST_JOINTS else f"{len(joints)} joints"


def _playable(info: Mapping[str, object]) -> Iterator[Playable]:
    """Yield the robot's motions that have a name: those of controllers, and files for its controllers and
    joints.

    A file that cannot be read is included, without controllers and duration.
    """
    from dxlrun.description.motion import read_motion

    rows = cast("Sequence[Mapping[str, object]]", info["controllers"])
    joints = {str(row["name"]): cast("Sequence[str]", row["joints"]) for row in rows}
    known = {joint for each in joints.values() for joint in each}
    for player, motions in _players(info).items():
        for name, seconds in motions.items():
            yield Playable(name, (player,), joints[player], seconds)
    for file in filter(_has_motions, _files(info)):
        try:
            motion = read_motion(file, cast("Groups", info["groups"]), _omitted(info)).motion
        except InputError:
            yield Playable(file.stem, (), (), None, str(file))
            continue
        if set(motion.controllers) <= joints.keys() and known.issuperset(motion.joints):
            yield Playable(file.stem, motion.controllers, motion.joints, motion.seconds, str(file))


def _located(refused: Refused, motion: Path) -> DxlrunError:
    """Return a refused motion's mistakes as an InputError with places in the file; other refusals are
    unchanged.
    """
    places, problems, fixes = (refused.fields.get(name) for name in ("places", "problems", "fixes"))
    if not (isinstance(places, list) and isinstance(problems, list) and isinstance(fixes, list)):
        return refused
    found = []
    for place, problem, fix in zip(places, problems, fixes, strict=True):
        line, column = map(int, place.split(":"))
        found.append(Problem(Mark(str(motion), line, column), problem, fix))
    return InputError(found)
