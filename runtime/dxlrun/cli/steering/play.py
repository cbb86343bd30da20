"""`dxlrun play`: play motions on a running robot one after the other, or list them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, cast

from cyclopts import Parameter

from dxlrun.cli.inputs import Flag, WaitFlag
from dxlrun.cli.steering.goals import MOST_JOINTS, begun_or_cancelled, show_goal_progress
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, connect_robot, report_done
from dxlrun.compile.motion_names import (
    PLAY,
    FoundMotion,
    find_live_motion,
    has_motions,
    is_name,
    motion_files,
    motions_of_players,
)
from dxlrun.errors import DxlrunError, InputError, Mark, Problem, Refused
from dxlrun.output.terminal import print_warning, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.description.joints.groups import Groups
    from dxlrun.remote.client import RemoteRobot

MOST_LOOPS = 10_000


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
        motions, or for a motion of a controller such as a keyframe_player, also as CONTROLLER/MOTION. The
        controllers of a motion must be active.
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
        found = [find_live_motion(motion, robot.name, robot.info()) for motion in motions]
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
        if not is_name(motion) and not Path(motion).is_file():
            raise InputError(f"motion file {motion} not found; check the path")


def _play(robot: RemoteRobot, found: FoundMotion, speed: float, chosen: RobotChoice, *, wait: bool) -> int:
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
    for player, motions in motions_of_players(info).items():
        for name, seconds in motions.items():
            yield Playable(name, (player,), joints[player], seconds)
    for file in filter(has_motions, motion_files(Path(str(info["file"])))):
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
