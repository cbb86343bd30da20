"""`dxlrun convert`: writes the motion that a log recorded to a motion file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import check_target, counted, show_json, show_parts, write_target
from dxlrun.tooling.verbs import DebugFlag, JsonFlag
from dxlrun_lab.commands.recorded_motions import ALL_OF_IT, RecordedPart

if TYPE_CHECKING:
    from dxlrun_analysis.playback.recorded_motion import RecordedMotion


def convert(
    log: Path,
    motion: Annotated[Path, Parameter(name="motion")],
    /,
    *,
    controller: str | None = None,
    part: RecordedPart = ALL_OF_IT,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Write a recorded motion to a new motion file.

    The recording is a log, a foreign MCAP file or a ROS 2 bag. `dxlrun ROBOT.yaml --play MOTION.yaml` and
    `dxlrun play MOTION.yaml` play the motion file.

    Parameters
    ----------
    log
        Log of dxlrun, foreign .mcap file, or directory of a ROS 2 bag.
    motion
        New motion file, whose name ends in .yaml.
    controller
        Controller that plays the motion, such as a joint_trajectory_controller. Default: the controllers that
        moved the joints in the log.
    """
    if motion.suffix not in (".yaml", ".yml"):
        raise InputError(f"{motion} does not end in .yaml; give the name of a YAML file")
    tolerance = part.tolerance_rad
    from dxlrun_analysis.playback.motion_file import motion_file
    from dxlrun_analysis.playback.spline_path import tolerances

    check_target(motion)
    recorded = part.read_motion(log)
    allowed = tolerances(recorded, tolerance)
    nearest = f"with a deviation of at most {math.degrees(float(allowed.max())):.4g} deg"
    origin = f"Motion of {_where(recorded)}, {nearest}.\nWritten by `dxlrun convert`."
    written = motion_file(recorded, allowed, motion, controller, origin)
    write_target(motion, written.text)
    if as_json:
        show_json(
            {
                "motion": str(motion),
                "seconds": recorded.duration_s,
                "joints": list(recorded.joints),
                "points": dict(written.points),
                "tolerance": float(allowed.max()),
            }
        )
    else:
        points = ", ".join(
            f"{counted(n, 'point', 'points')} for {name}" for name, n in written.points.items()
        )
        show_parts(f"{motion}: {recorded.duration_s:.1f} s of {log}, {nearest}: {points}")
    return 0


def _where(motion: RecordedMotion) -> str:
    """Describe the source of a motion on one line: file, time, and joints by goals or states. Unprintable
    characters of the file name are replaced."""
    name = "".join(letter if letter.isprintable() else "?" for letter in str(motion.path))
    end_s = motion.begin_s + motion.duration_s
    goals = [joint for joint, what in zip(motion.joints, motion.what, strict=True) if what == "goals"]
    states = [joint for joint in motion.joints if joint not in goals]
    kinds = [f"goals of {', '.join(goals)}"] * bool(goals) + [f"states of {', '.join(states)}"] * bool(states)
    return f"{name}, {motion.begin_s:.3f} s to {end_s:.3f} s: {'; '.join(kinds)}"
