"""Drives: compiles the range, speed, effort and modes of each joint from its coupling."""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.compile.joints.compiled_servos import CompiledServo
from dxlrun.compile.joints.joint_drives import DriveStage, JointDrive
from dxlrun.compile.joints.limits import Interval
from dxlrun.compile.problems import RobotFile
from dxlrun.features.mechanics.couplings import (
    Coupling,
    allowed_limits,
    check_together,
    compile_couplings,
    joint_reaches,
    top_efforts,
    top_speeds,
)
from dxlwire.modes import Mode


class CoupledDrive(JointDrive, frozen=True, kw_only=True):
    """Drive of a joint, together with the coupling from which it was computed."""

    coupling: Coupling


def compile_drives(file: RobotFile, servos: Mapping[str, CompiledServo]) -> dict[str, JointDrive]:
    """Return the drive of each joint by name; joints whose servos or limits have mistakes may be missing."""
    drives: dict[str, JointDrive] = {}
    for coupling in compile_couplings(file, servos):
        reaches, limits = joint_reaches(coupling), allowed_limits(file, coupling)
        speeds, efforts = top_speeds(coupling), top_efforts(coupling)
        for column, joint in enumerate(coupling.joints):
            drives[joint] = CoupledDrive(
                servos=coupling.servos,
                together=coupling.joints,
                levers=tuple(row[column] for row in coupling.inverse),
                reach=_wider(reaches[column], limits[column]),
                allowed=limits[column],
                modes=coupling.modes,
                top_speed=speeds[column][0],
                shared_speed=speeds[column][1],
                top_effort=efforts[column],
                excluded=_excluded(coupling),
                coupling=coupling,
            )
        if not coupling.direct and None not in limits and all(one.known_bus for one in coupling.servos):
            check_together(file, coupling)
    return drives


def _wider(reach: Interval, allowed: Interval | None) -> Interval:
    """Return the reach of a joint, which is that of its limits if its servos count turns to reach these."""
    return reach if allowed is None or reach.contains(allowed) else allowed


def _excluded(coupling: Coupling) -> dict[Mode, str]:
    reason = f"transmission {coupling.name} cannot move its servos together in this mode"
    return {Mode.PWM: reason} if coupling.transmission else {}


STAGE = DriveStage(compile_drives)
