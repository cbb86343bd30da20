"""Recorded motions on the command line: selection of a part of a recording, and playback on a robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import print_warning, show_json, show_parts
from dxlrun.tooling.verbs import Flag, Seconds, compiled
from dxlrun_lab.commands.on_robot import Course, ExperimentOptions, RobotFileArguments, perform_on

if TYPE_CHECKING:
    from dxlrun.tooling.output import Part
    from dxlrun_analysis.playback.recorded_motion import RecordedMotion
    from dxlrun_lab.commands.on_robot import ExperimentRun
    from dxlrun_lab.playback import PlaybackResult

_MOST_DEG = 10.0


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class RecordedPart:
    """Part of a recording: quantity, time, joints.

    Parameters
    ----------
    what
        Recorded quantity: goals that were sent, or states that were measured. Default: goals for joints that
        were sent a path of positions, states for all other joints.
    from_
        Start of the part, s from the start of the recording.
    to
        End of the part, s from the start of the recording.
    joint
        Joint of the recording to use. Can be given several times. Default: all joints.
    map
        New joint for a recorded joint: RECORDED=JOINT. RECORDED= omits the recorded joint. Can be given
        several times.
    topic
        Topic of a foreign recording. Required if the recording has several.
    tolerance
        Largest deviation of the smoothed motion from the recording. Default: 0.1 deg from goals, 0.5 deg from
        states.
    """

    what: Literal["goals", "states"] | None = None
    from_: Annotated[Seconds | None, Parameter(name="--from")] = None
    to: Seconds | None = None
    joint: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = ()
    map: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = ()
    topic: str | None = None
    tolerance: str | None = None

    @property
    def tolerance_rad(self) -> float | None:
        """Value of --tolerance, rad, or None if it was not given. Raises InputError if it is invalid."""
        if self.tolerance is None:
            return None
        from dxlrun.tooling.verbs import angle

        try:
            allowed = angle(self.tolerance)
        except ValueError as error:
            raise InputError(f"--tolerance {self.tolerance}: {error}") from None
        if not 0 < allowed <= math.radians(_MOST_DEG):
            raise InputError(
                f"--tolerance {self.tolerance}: give an angle above 0 and up to {_MOST_DEG:g} deg"
            )
        return allowed

    def read_motion(self, log: Path) -> RecordedMotion:
        """Read this part of a recording as a motion, and print warnings about it. Raises InputError.

        `log` is a log of dxlrun, a foreign MCAP file or a ROS 2 bag.
        """
        from dxlrun_analysis.playback.recorded_motion import Stretch, parse_names
        from dxlrun_analysis.playback.sources import read_motion

        motion = read_motion(
            log,
            what=self.what,
            stretch=Stretch(self.from_, self.to),
            only=self.joint,
            names=parse_names(self.map),
            topic=self.topic,
        )
        for remark in motion.remarks:
            print_warning(f"{log}: {remark}")
        return motion


ALL_OF_IT = RecordedPart()


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PlaybackOptions:
    """Robot on which a recorded motion is played.

    Parameters
    ----------
    on
        Robot file of a robot that plays the recorded motion. The controllers of the log are not run again
        then.
    speed
        Speed factor: at 0.5 a motion takes twice as long.
    virtual
        Run on virtual time, with simulated servos.
    yes
        Do not ask for confirmation before a real joint moves. The countdown remains.
    """

    on: Path | None = None
    speed: float = 1.0
    virtual: Flag = False
    yes: Flag = False


NOWHERE = PlaybackOptions()


def play_recorded(
    log: Path, chosen: RobotFileArguments, played_on: PlaybackOptions, part: RecordedPart, *, as_json: bool
) -> int:
    """Play a part of a recording on a robot, and show how well it was followed. Return the exit code.

    Args:
        log: Recording.
        chosen: Robot file with its arguments. Its joints are those of the motion.
        played_on: Speed, and other options of the command.
        part: Part of the recording.
        as_json: Print the result as JSON.
    """
    from dxlrun_analysis.playback.rows import rows_of
    from dxlrun_lab.playback import Playback

    tolerance = part.tolerance_rad
    motion = part.read_motion(log)
    plan = compiled(chosen.file or Path(), chosen.assignments, (), None).plan
    rows = rows_of(
        motion,
        {joint.name: joint for joint in plan.loop.joints},
        speed=played_on.speed,
        tolerance=tolerance,
        period_s=plan.loop.period_ns * 1e-9,
    )
    playback = Playback(rows)
    chosen = chosen._replace(joints=rows.joints)
    options = ExperimentOptions(virtual=played_on.virtual, yes=played_on.yes)
    course = Course("the motion", ranges=None, back=False, expected=playback.expected)
    ran = perform_on(playback, chosen, plan, options, course)
    if as_json:
        show_json(_content(ran), code=ran.exit_code, errors=ran.failures)
    elif ran.result is not None:
        show_parts(*_parts(ran, ran.result, log))
    return ran.exit_code


def _content(ran: ExperimentRun[PlaybackResult]) -> dict[str, object]:
    result = (
        msgspec.to_builtins(ran.result)
        if ran.result is not None
        else {"seconds": 0.0, "whole": False, "joints": []}
    )
    return {
        "robot": ran.robot,
        **result,
        "why": ran.why,
        "problems": list(ran.problems),
        "log": str(ran.log) if ran.log else None,
    }


def _parts(ran: ExperimentRun[PlaybackResult], result: PlaybackResult, log: Path) -> tuple[Part, ...]:
    from dxlrun.tooling.output import Column, Table, numbers

    end = "played" if result.whole else "partly played"
    rows = [
        (one.name, round(math.degrees(one.rms), 2), round(math.degrees(one.worst), 2))
        for one in result.joints
    ]
    columns = [Column("distance from the sent goals", "name"), *numbers("rms, deg", "largest, deg")]
    left = (f"log: {ran.log}",) if ran.log is not None else ()
    return f"{ran.robot}: {end}, {result.seconds:.1f} s of {log}", Table.from_rows("", columns, rows), *left
