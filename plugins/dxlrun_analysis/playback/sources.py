"""Reader of recorded motions from logs of dxlrun, whole or in parts, foreign MCAP files and ROS 2 bags."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import InputError, LogError, open_log
from dxlrun_analysis.plan_excerpt import plan_of
from dxlrun_analysis.playback.foreign_recordings import foreign_series, is_foreign
from dxlrun_analysis.playback.recorded_motion import (
    WHOLE,
    Floats,
    RecordedMotion,
    Series,
    Stretch,
    What,
    chosen,
    motion_of,
)

_FIELDS = ("scheduled_ns", "goal_position", "command_velocity", "position", "valid")


def read_motion(
    path: Path,
    *,
    what: What | None = None,
    stretch: Stretch = WHOLE,
    only: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
    topic: str | None = None,
) -> RecordedMotion:
    """Read the motion of a log, a foreign MCAP file, or a ROS 2 bag.

    Args:
        path: The recording.
        what: Goals that were sent, or measured states. None selects, for a log of dxlrun, the goals of
            joints that were sent a path of positions, and the states of all others; for a foreign recording,
            states if it has any.
        stretch: Part of the recording.
        only: Recorded joints; empty for all.
        names: Joint by recorded name; an empty joint omits the recorded one.
        topic: Topic of a foreign recording with several.

    Raises:
        InputError: The options do not select a motion.
        LogError: The recording cannot be read.
    """
    stretch.validate_times()
    if not path.exists():
        raise InputError(f"log {path} not found; a run prints the path of its log when it ends")
    plan = None
    if is_foreign(path):
        series, remarks = foreign_series(path, what, topic)
    elif topic is not None:
        raise InputError(f"--topic {topic}: {path} is a log of dxlrun; choose its goals or states by --what")
    else:
        series, remarks, plan = _own_series(path, what, stretch)
    kept = chosen(path, series, only)
    return replace(motion_of(path, kept, stretch, names or {}), remarks=remarks, plan=plan)


def _own_series(
    path: Path, what: What | None, stretch: Stretch
) -> tuple[dict[str, Series], tuple[str, ...], bytes | None]:
    """Return the positions or goals of the joints in a log of dxlrun over time, sentences about damage,
    and its plan as JSON."""
    joints: tuple[str, ...] = ()
    columns: dict[str, list[NDArray[np.generic]]] = {field: [] for field in _FIELDS}
    reader = open_log(path)
    for piece in reader.slices():
        joints = piece.joints
        for field in _FIELDS:
            columns[field].append(piece.cycles[field].copy())
    cycles = {field: np.concatenate(rows) for field, rows in columns.items() if rows}
    if not cycles or not len(cycles["scheduled_ns"]):
        raise LogError(f"{path}: no motion: the log has no cycles")
    time_s = (cycles["scheduled_ns"] - cycles["scheduled_ns"][0]) * 1e-9
    begin, end = stretch.begin_s or 0.0, math.inf if stretch.end_s is None else stretch.end_s
    inside = (time_s >= begin) & (time_s <= end)
    goals: Floats = cycles["goal_position"]
    measured: Floats = np.where(cycles["valid"], cycles["position"], np.nan)
    # A position with a speed is a destination, not the position for that cycle.
    led = np.isfinite(goals) & ~np.isfinite(cycles["command_velocity"])
    plan = plan_of(reader.about)
    found: dict[str, Series] = {}
    for row, joint in enumerate(joints):
        known: What = what or ("goals" if np.all(led[inside, row]) else "states")
        values = (goals if known == "goals" else measured)[:, row]
        found[joint] = Series(time_s, values, known, unit=plan.joint(joint).unit)
    return found, reader.damage, reader.attachments.get("plan.json")
