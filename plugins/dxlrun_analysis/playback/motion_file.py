"""Conversion of a recorded motion to a motion file, with points for the controllers that move its joints."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import InputError, JointUnit, LogError
from dxlrun.tooling.plans import ControllerPlan, LoopPlan, from_json
from dxlrun.tooling.robots import TRAJECTORY, command_kind, load_plugins, parse_motion
from dxlrun_analysis.playback.recorded_motion import Floats, RecordedMotion
from dxlrun_analysis.playback.spline_path import TURN_SIZES, SplinePath, fit
from dxlrun_controllers.laws.tracking_law import CLOSING_SPEED

LEAD_S = 1.0  # Before the first point, during which controllers move their joints there, as in the thesis
_STEP_S = 0.02  # Between points of a controller that accepts single positions


class MotionFile(msgspec.Struct, frozen=True):
    """Text of a motion file, and the number of points in it for each controller."""

    text: str
    points: Mapping[str, int]  # By controller


class _ControllerShare(msgspec.Struct, frozen=True):
    """Joints of a recorded motion that one controller plays, and the form of points that it accepts."""

    controller: str
    joints: tuple[str, ...]
    trajectory: bool  # The controller accepts points with velocities; else single positions
    speeds: bool = False  # The controller accepts a speed with each single position


def motion_file(
    motion: RecordedMotion,
    allowed: Floats,
    target: Path,
    controller: str | None,
    origin: str,
    *,
    plans: Sequence[ControllerPlan] | None = None,
    speeds: Mapping[str, float] | None = None,
) -> MotionFile:
    """Convert a recorded motion to the text of a motion file.

    It has points for the controllers that moved the joints in the log, for `controller`, or for the active
    ones of `plans`.

    Args:
        motion: The recorded motion.
        allowed: Tolerance of each joint, rad or m; shape (joints,).
        target: Path of the file, which determines the name of the motion.
        controller: Controller for all joints; it must accept trajectories.
        origin: Comment at the beginning of the file.
        plans: Controllers of the robot; without them, those in the log.
        speeds: Top speed by joint, rad/s or m/s; without them, those of the log's robot.

    Raises:
        InputError: A joint has no suitable controller.
    """
    if speeds is None:
        robot = () if motion.plan is None else _logged_loop(motion).joints
        speeds = {joint.name: joint.highest_speed for joint in robot}
    parts = [_ControllerShare(controller, motion.joints, True)] if controller else _parts(motion, plans)
    name = re.sub(r"\W", "_", target.stem, flags=re.ASCII).strip("_") or "motion"
    name = name if name[0].isalpha() else f"motion_{name}"
    lines = [f"# {line}" for line in origin.split("\n")]
    lines += [f"name: {name}", "", "motions:"]
    points: dict[str, int] = {}
    for part in parts:
        units = [motion.units[motion.joints.index(joint)] for joint in part.joints]
        closing = [
            _closing_speed(joint, unit, speeds) for joint, unit in zip(part.joints, units, strict=True)
        ]
        rows = list(_points(part, _path_of(part, motion, allowed), units, closing))
        points[part.controller] = len(rows)
        lines += [f"  - controller: {part.controller}", "    points:", *rows]
    text = "\n".join(lines) + "\n"
    parse_motion(text, target)  # Validate the text like any motion file
    return MotionFile(text, points)


def _path_of(part: _ControllerShare, motion: RecordedMotion, allowed: Floats) -> SplinePath:
    columns = [motion.joints.index(joint) for joint in part.joints]
    return fit(replace(motion, joints=part.joints, position=motion.position[:, columns]), allowed[columns])


def _closing_speed(joint: str, unit: JointUnit, speeds: Mapping[str, float]) -> float:
    """Return the least speed to send to a joint with a position, rad/s or m/s. A slower servo would not
    arrive within the step."""
    speed = CLOSING_SPEED * TURN_SIZES[unit]
    return min(speed, speeds.get(joint, speed))


def _points(
    part: _ControllerShare, path: SplinePath, units: Sequence[JointUnit], closing: Sequence[float]
) -> Iterator[str]:
    times, positions, velocities = path.time_s, path.position, path.velocity
    if not part.trajectory:
        times = np.linspace(0.0, path.duration_s, max(2, round(path.duration_s / _STEP_S) + 1))
        positions = path.positions_at(times)
        way = np.abs(np.diff(positions, axis=0, prepend=positions[:1]))
        velocities = np.maximum(way / (times[1] - times[0]), closing)
        moved: NDArray[np.bool_] = way.max(axis=1) > 0
        moved[[0, -1]] = True
        times, positions, velocities = times[moved], positions[moved], velocities[moved]
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        given = velocity if part.trajectory or part.speeds else None
        at = f"{LEAD_S + time:.9f}".rstrip("0").rstrip(".")
        yield f"      - {{time: {at} s, joints: {{{_targets(part.joints, position, given, units)}}}}}"


def _targets(
    joints: Sequence[str], position: Floats, velocity: Floats | None, units: Sequence[JointUnit]
) -> str:
    if velocity is None:
        return ", ".join(
            f"{joint}: {{position: {value:.6f} {unit.si}}}"
            for joint, value, unit in zip(joints, position, units, strict=True)
        )
    return ", ".join(
        f"{joint}: {{position: {value:.6f} {unit.si}, velocity: {speed:.6f} {unit.speed}}}"
        for joint, value, speed, unit in zip(joints, position, velocity, units, strict=True)
    )


def player_of(joint: str, plans: Sequence[ControllerPlan]) -> str | None:
    """Return the name of an active controller that can play motions of a joint, preferably one that
    accepts trajectories; None if there is none."""
    part = _part_of(joint, plans)
    return None if part is None else part.controller


def _plans_of(motion: RecordedMotion) -> Sequence[ControllerPlan]:
    if motion.plan is None:
        raise InputError(
            f"{motion.path}: a foreign recording does not name its controllers; name a trajectory "
            "controller by --controller"
        )
    return _logged_loop(motion).controllers


def _logged_loop(motion: RecordedMotion) -> LoopPlan:
    """Return the loop's plan from the log that a motion was read from.

    Raises:
        LogError: The plan cannot be read.
    """
    try:
        return from_json(motion.plan or b"").loop
    except ValueError as error:
        raise LogError(f"{motion.path}: its plan cannot be read: {error}") from error


def _parts(motion: RecordedMotion, plans: Sequence[ControllerPlan] | None) -> list[_ControllerShare]:
    """Assign each joint of the motion to an active controller of `plans`, by default of the log; return a
    part for each controller."""
    plans = _plans_of(motion) if plans is None else plans
    parts: dict[str, _ControllerShare] = {}
    missing = []
    for joint in motion.joints:
        part = _part_of(joint, plans)
        if part is None:
            missing.append(joint)
        else:
            before = parts.get(part.controller)
            parts[part.controller] = (
                part
                if before is None
                else _ControllerShare(part.controller, (*before.joints, joint), part.trajectory, part.speeds)
            )
    if missing:
        raise InputError(
            f"{motion.path}: no controller active at the start plays motions of "
            f"{', '.join(missing)}; name one by --controller, or choose other joints by --joint"
        )
    wanting = [
        f"{motion.path}: a motion file needs all joints of {plan.name}; convert {', '.join(others)} too, "
        "or name another controller by --controller"
        for plan in plans
        if plan.name in parts
        and (others := [joint for joint in plan.joints if joint not in parts[plan.name].joints])
    ]
    if wanting:
        raise InputError("\n".join(wanting))
    return list(parts.values())


def _part_of(joint: str, plans: Sequence[ControllerPlan]) -> _ControllerShare | None:
    """Return a part with one joint and a controller that can play it, preferably one that accepts
    trajectories; None if there is none."""
    offers = load_plugins().controllers
    found = None
    for plan in plans:
        if not (plan.active and plan.command and joint in plan.joints and plan.type in offers):
            continue
        controller = offers[plan.type].controller
        kind = command_kind(controller)
        if kind == TRAJECTORY:
            return _ControllerShare(plan.name, (joint,), True)
        if kind is not None and "positions" in controller.Commands[kind].model_fields:
            speeds = "velocities" in controller.Commands[kind].model_fields
            found = found or _ControllerShare(plan.name, (joint,), False, speeds)
    return found
