"""Compiles the couplings of a robot (several servos for one or more joints) into the plan."""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.compile.contribution import Compilation, CompileStage, Contribution
from dxlrun.compile.joints.compiled_joints import CompiledJoint, moving_servos
from dxlrun.features.mechanics.drives import CoupledDrive
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan


def compile_mechanics(joints: Mapping[str, CompiledJoint]) -> MechanicsPlan:
    """Return which servos move which joints, with matrices; empty if each joint has a servo of its own."""
    drives = {name: joint.drive for name, joint in joints.items() if isinstance(joint.drive, CoupledDrive)}
    couplings = dict.fromkeys(drive.coupling for drive in drives.values() if not drive.coupling.direct)
    if not couplings:
        return MechanicsPlan()
    rows = {name: row for row, name in enumerate(joints)}
    names = [servo.described.name for servo in moving_servos(joints.values())]
    return MechanicsPlan(
        couplings=tuple(
            CouplingPlan(
                name=coupling.name,
                joints=tuple(rows[joint] for joint in coupling.joints),
                servos=tuple(names.index(servo.described.name) for servo in coupling.servos),
                matrix=coupling.matrix,
                inverse=coupling.inverse,
                tolerance=coupling.tolerance,
            )
            for coupling in couplings
        ),
        direct=tuple(
            (rows[name], names.index(drive.servos[0].described.name))
            for name, drive in drives.items()
            if drive.coupling.direct
        ),
        servos=tuple(names),
    )


def _contribute(compilation: Compilation) -> Contribution:
    return Contribution(mechanics=compile_mechanics(compilation.joints))


STAGE = CompileStage(_contribute)
