"""Pendulums for the plants of simulated servos: a weight at the end of each arm, as a URDF and as a load."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dxlsim.motion.motor import Motor
from dxlsim.motion.plant import Plant
from dxlsim.simulation_plan import HINGES, Mechanism, MechanismServo, UrdfBodies

STEP_S = 0.002
MASS, ARM = 0.5, 0.2
"""kg and m of each: a weight at the end of an arm."""
PULL = MASS * 9.81 * ARM
"""Nm of one where it sticks out"""
ROTOR = Motor(stall_torque=1.0, damping=0.0, torque_per_ampere=1.0, voltage=12.0, inertia=0.01)


def link(name: str) -> str:
    # the mass in one point, so that its inertia about the joint is MASS * ARM**2
    return (
        f'<link name="{name}"><inertial><origin xyz="{ARM} 0 0"/><mass value="{MASS}"/>'
        '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(
    name: str, parent: str, child: str, *, axis: str = "0 -1 0", kind: str = "revolute", more: str = ""
) -> str:
    # about -y: a link along x at 0 rises with its angle
    origin = 0 if parent == "base" else ARM
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin} 0 0"/><axis xyz="{axis}"/>'
        f'<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>{more}</joint>'
    )


def urdf(*parts: str) -> str:
    return f'<robot name="pendulums"><link name="base"/>{"".join(parts)}</robot>'


def run(plant: Plant, seconds: float, drive: float | Sequence[float] = 0.0, damping: float = 0.0) -> None:
    count = len(plant.angle)
    for _ in range(round(seconds / STEP_S)):
        plant.step_shafts(np.broadcast_to(np.asarray(drive, float), count), np.full(count, damping), STEP_S)


class Turned(NamedTuple):
    """A joint of a URDF that one servo moves: q = per_rad * (theta - reference)."""

    name: str
    reference: float
    per_rad: float
    types: tuple[str, ...] = HINGES


def bodies_of(urdf: str, joints: Sequence[Turned | None], shared: Sequence[Mechanism] = ()) -> UrdfBodies:
    """Return bodies with the joints of the first servos; None: a shared mechanism has the servo."""
    single = (
        Mechanism((MechanismServo(index, one.reference, one.per_rad),), (one.name,), types=one.types)
        for index, one in enumerate(joints)
        if one is not None
    )
    return UrdfBodies(urdf, (*single, *shared))
