"""Bodies of a URDF that servos move together: each of its joints is turned by a servo's torque, in MuJoCo.

What is taken of the URDF: its tree, masses and inertias (of a link without `inertial`: those of its collision
shapes at the density of water), `dynamics` of its joints, gravity along -z of its first link, which does not
move. What is not: meshes, contacts, limits of joints; and joints that no servo turns do not move. Only hinges
are turned: how far the turn of a servo would move a slide is not defined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING

import numpy as np

from dxlrun.errors import InputError
from dxlrun.simulation.configuration import UrdfBodies, UrdfJoint
from dxlrun.simulation.motion.plant import Floats, IndependentJoints, PlantJoint, PlantMaker

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from mujoco import MjModel, MjSpec

NEEDS_MUJOCO = "physics: mujoco needs MuJoCo, which is not installed"
INSTALL_MUJOCO = "`pip install 'dxlrun[physics]'` installs it; or take physics: independent"

_HINGES = ("revolute", "continuous")
_LEAST_MASS = 1e-6
"""kg. A link with neither `inertial` nor a shape: MuJoCo refuses a moving body without mass."""
_LEAST_INERTIA = 1e-9
"""kg m^2, as above"""
_FRICTION_SOLREF = (0.004, 1.0)
_FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Friction that holds: with MuJoCo's own values a joint creeps although its friction could hold it."""


def mujoco_plant(bodies: UrdfBodies) -> PlantMaker:
    """Return what makes the plant of these bodies.

    Joints that the URDF lacks, or does not draw as hinges, move by themselves. Raises InputError when MuJoCo
    is not installed, cannot take the URDF, or would turn nothing.
    """
    try:
        import mujoco  # noqa: F401 (it may be there and yet not load)
    except ImportError as error:
        raise InputError(f"{NEEDS_MUJOCO}; {INSTALL_MUJOCO}") from error
    from xml.etree import ElementTree  # only robots with a URDF need it

    try:
        # no DTD can be in it: the robot file's compiler refuses one
        root = ElementTree.fromstring(bodies.urdf)  # noqa: S314  it was checked when the robot was compiled
        hinges = {each.get("name") for each in root.findall("joint") if each.get("type") in _HINGES}
        turned = {row: joint for row, joint in enumerate(bodies.joints) if joint.name in hinges}
        _make_movable(root, {joint.name for joint in turned.values()})
        text = ElementTree.tostring(root, encoding="unicode")
        _compiled(text, {})
    except (ValueError, SyntaxError) as error:  # a ParseError of XML is a SyntaxError
        reason = " ".join(str(error).split())
        raise InputError(f"MuJoCo cannot take the URDF: {reason}; correct it") from error
    if not turned:
        raise InputError(
            "physics: mujoco turns no joint: no hinge of the URDF has the name of a joint of the robot file; "
            "give them the same names, or take physics: independent"
        )
    return lambda joints: MujocoPlant(text, turned, joints)


class MujocoPlant:
    """Joints that feel one another through their bodies; those without a body move by themselves."""

    def __init__(self, urdf: str, turned: Mapping[int, UrdfJoint], joints: Sequence[PlantJoint]) -> None:
        import mujoco

        self.angle: Floats = np.array([joint.angle for joint in joints], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(joints))
        rows = [row for row in range(len(joints)) if row in turned]
        self._alone = np.array([row for row in range(len(joints)) if row not in turned], dtype=np.intp)
        self._independent = IndependentJoints([joints[row] for row in self._alone])
        self._rows = np.array(rows, dtype=np.intp)
        self._reference = np.array([turned[row].reference for row in rows])
        self._direction = np.array([float(turned[row].direction) for row in rows])
        model = _compiled(urdf, {turned[row].name: joints[row] for row in rows})
        data = mujoco.MjData(model)
        self._model, self._data, self._step = model, data, mujoco.mj_step
        # views that stay; all joints are hinges, so that coordinate and speed have a joint's own number
        self._damping, self._force = model.dof_damping, data.qfrc_applied
        self._turn, self._speed = data.qpos, data.qvel
        self._numbers = np.array([model.joint(turned[row].name).id for row in rows], dtype=np.intp)
        self._own_damping = model.dof_damping[self._numbers]
        self._friction, self._bias = model.dof_frictionloss, data.qfrc_bias
        self._own_friction = model.dof_frictionloss[self._numbers]
        self._load_friction = np.array([joints[row].motor.load_friction for row in rows])
        self._armature = model.dof_armature[self._numbers]
        own = [joints[row].motor.damping + joints[row].motor.viscous_friction for row in rows]
        self._motor_damping = np.array(own)
        self._dt_s = 0.0

    def step(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Let a time pass in which each servo drives with `drive - damping * velocity`; Nm and Nm s/rad."""
        if len(self._rows):
            self._step_bodies(drive, damping, dt_s)
        if len(self._alone):
            alone, independent = self._alone, self._independent
            independent.angle[:] = self.angle[alone]
            independent.velocity[:] = self.velocity[alone]
            independent.step(drive[alone], damping[alone], dt_s)
            self.angle[alone] = independent.angle
            self.velocity[alone] = independent.velocity

    def place(self, index: int, angle: float) -> None:
        """Put a joint somewhere, rad, at rest."""
        self.angle[index] = angle
        self.velocity[index] = 0.0

    def _step_bodies(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        rows, numbers, direction = self._rows, self._numbers, self._direction
        if dt_s != self._dt_s:
            self._set_step(dt_s)
        # MuJoCo's own integrator takes damping at the end of the step, as independent joints do
        self._damping[numbers] = self._own_damping + damping[rows]
        torque = direction * (drive[rows] - damping[rows] * self.velocity[rows])
        # what pulls at the joint is the bodies' as it was a step ago
        rubbing = self._load_friction * np.abs(torque + self._bias[numbers])
        self._friction[numbers] = self._own_friction + rubbing
        self._turn[numbers] = direction * (self.angle[rows] - self._reference)
        self._speed[numbers] = direction * self.velocity[rows]
        self._force[numbers] = direction * drive[rows]
        self._step(self._model, self._data)
        self.angle[rows] = self._reference + direction * self._turn[numbers]
        self.velocity[rows] = direction * self._speed[numbers]

    def _set_step(self, dt_s: float) -> None:
        """Take the inertia by which a step brakes as the motor does; see `IndependentJoints`."""
        self._dt_s = self._model.opt.timestep = dt_s
        armature = np.maximum(self._armature - self._motor_damping * dt_s / 2, self._armature / 2)
        self._model.dof_armature[self._numbers] = armature


def _make_movable(root: Element, turned: Set[str]) -> None:
    """Leave of a URDF what servos move: joints that none of them turns are fixed, meshes are not there."""
    for joint in root.findall("joint"):
        if joint.get("name") not in turned:
            joint.set("type", "fixed")
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)


def _compiled(urdf: str, turned: Mapping[str, PlantJoint]) -> MjModel:
    """Return the model with the rotors and frictions of servos at the joints of these names.

    Raises ValueError when MuJoCo cannot take the URDF.
    """
    import mujoco

    spec: MjSpec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.boundmass = _LEAST_MASS
    spec.compiler.boundinertia = _LEAST_INERTIA
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    spec.option.disableflags |= int(disabled)
    for joint in spec.joints:
        if (servo := turned.get(joint.name)) is not None:
            joint.armature = servo.motor.inertia
            joint.damping[0] += servo.motor.viscous_friction
            joint.frictionloss += servo.motor.friction + servo.load.friction
            joint.solref_friction = _FRICTION_SOLREF
            joint.solimp_friction = _FRICTION_SOLIMP
    return spec.compile()
