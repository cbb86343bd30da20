"""Plant of simulated servos (`physics: mujoco`): MuJoCo moves the bodies of a URDF by the servos' torques.

Used from the URDF: the tree, masses and inertias (for a link without `inertial`: those of its collision
shapes at the density of water), `dynamics` and `mimic` of joints. Gravity is along -z of the first link,
which is fixed. Not used: meshes, contacts, limits of joints. A joint is fixed if no servo moves it, directly
or by `mimic`. Servos turn hinges; they move slides if the robot file has the travel per turn.

A servo that moves one joint is that joint's rotor: its inertia, damping and friction are added to the joint.
Where several servos share joints, each has its own rotor, and constraints keep the rotors at s = pinv(M) q.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import InputError
from dxlsim import (
    JAMMED_NM,
    CoupledJoints,
    Mechanism,
    MechanismServo,
    Motor,
    Part,
    Plant,
    PlantJoint,
    PlantMaker,
    UrdfBodies,
    combine_plants,
    coupled_motion,
    coupled_projection,
)

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from mujoco import MjModel, MjsJoint, MjSpec

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]

_LEAST_MASS = 1e-6
"""Mass of a link with neither `inertial` nor a shape, kg: MuJoCo rejects a moving body without mass."""
_LEAST_INERTIA = 1e-9  # kg m^2, for the same reason
_HELD_SOLREF = (0.004, 1.0)
"""Time constant (s) and damping ratio of the constraint between rotors and joints: two steps, the stiffest
that MuJoCo allows."""
_FRICTION_SOLREF = (0.004, 1.0)
_FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""MuJoCo's solref and solimp for stiff friction: with the defaults, a joint creeps although friction could
hold it."""


def mujoco_plant(bodies: UrdfBodies) -> PlantMaker:
    """Return a function that creates the plant of simulated servos with the bodies of a URDF.

    A mechanism (servos and their joints) moves without bodies if the URDF lacks one of these joints, or has
    an unsuitable type for one (hinges for rad, slides for m).

    Raises:
        ImportError: MuJoCo cannot be loaded.
        InputError: MuJoCo cannot load the URDF, or no servo moves one of its joints.
    """
    from xml.etree import ElementTree  # Only robots with a URDF need it

    try:
        # The text has no DTD: the robot file's compiler rejects one.
        root = ElementTree.fromstring(bodies.urdf)  # noqa: S314  it was checked when the robot was compiled
        kinds = {each.get("name", ""): each.get("type", "") for each in root.findall("joint")}
        here = [one for one in bodies.mechanisms if all(kinds.get(name) in one.types for name in one.joints)]
        moved = _MovedMechanisms(
            tuple(one for one in here if one.is_single), tuple(one for one in here if not one.is_single)
        )
        _make_movable(root, moved.joint_names)
        text = ElementTree.tostring(root, encoding="unicode")
        _compiled(text, _NOTHING_MOVED, ())
    except (ValueError, SyntaxError) as error:  # A ParseError of XML is a SyntaxError
        reason = " ".join(str(error).split())
        raise InputError(f"MuJoCo cannot load the URDF: {reason}; correct the URDF") from error
    if not moved.joint_names:
        raise InputError(
            "physics: mujoco moves nothing, because hinges of the URDF and joints of the robot file have "
            "different names; use the same names, or physics: independent"
        )

    def make_plant(joints: Sequence[PlantJoint]) -> Plant:
        here = moved.restricted_to(len(joints))
        others = [row for row in range(len(joints)) if row not in here.rows]
        parts: list[Part] = [(here.rows, MujocoBodies(text, here, joints))] if here.rows else []
        if others or not parts:
            shafts = [joints[row] for row in others]
            parts.append((others, CoupledJoints(bodies.mechanisms, shafts, others)))
        return combine_plants(joints, parts)

    return make_plant


class _MovedMechanisms(msgspec.Struct, frozen=True):
    """Mechanisms whose joints MuJoCo moves."""

    single: tuple[Mechanism, ...]  # One servo each, which is the rotor of its joint
    shared: tuple[Mechanism, ...]  # Several servos that share joints, each with its own rotor

    @property
    def joint_names(self) -> set[str]:
        """Names of the URDF's joints that servos move."""
        return {name for one in (*self.single, *self.shared) for name in one.joints}

    @property
    def servos(self) -> list[MechanismServo]:
        """Servos of all mechanisms, first those of single ones."""
        return [servo for one in (*self.single, *self.shared) for servo in one.servos]

    @property
    def rows(self) -> list[int]:
        """Index of each of `servos` among all servos of the simulation."""
        return [servo.index for servo in self.servos]

    def restricted_to(self, count: int) -> _MovedMechanisms:
        """Return the mechanisms whose servos are all among the first `count` servos of the simulation."""
        parts = (
            tuple(one for one in part if all(servo.index < count for servo in one.servos))
            for part in (self.single, self.shared)
        )
        return _MovedMechanisms(*parts)


_NOTHING_MOVED = _MovedMechanisms((), ())


class MujocoBodies:
    """MuJoCo simulation of the bodies, as the plant of the servos that move them.

    `angle` (rad) and `velocity` (rad/s) have an item for each servo's shaft, in the order of
    `_MovedMechanisms.servos`.
    """

    def __init__(self, urdf: str, moved: _MovedMechanisms, servos: Sequence[PlantJoint]) -> None:
        import mujoco

        mine = [servos[row] for row in moved.rows]
        both = moved.servos
        self.angle: Floats = np.array([each.angle for each in mine], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(mine))
        self._reference = np.array([each.reference for each in both]) + [each.recounted for each in mine]
        self._per_rad = np.array([float(each.per_rad) for each in both])
        model = _compiled(urdf, moved, servos)
        data = mujoco.MjData(model)
        self._model, self._data, self._step = model, data, mujoco.mj_step
        # Persistent views. All joints are hinges or slides, so the indices of coordinate and speed equal that
        # of the joint.
        self._damping, self._force = model.dof_damping, data.qfrc_applied
        self._turn, self._speed = data.qpos, data.qvel
        names = [name for one in moved.single for name in one.joints]
        names += [_rotor(servo) for one in moved.shared for servo in one.servos]
        self._numbers = np.array([model.joint(name).id for name in names], dtype=np.intp)
        self._own_damping = model.dof_damping[self._numbers]
        self._friction, self._bias = model.dof_frictionloss, data.qfrc_bias
        self._own_friction = model.dof_frictionloss[self._numbers]
        self._free_friction = self._own_friction.copy()
        self._load_friction = np.array([each.motor.load_friction for each in mine])
        self._armature = model.dof_armature[self._numbers]
        own = [each.motor.damping + each.motor.viscous_friction for each in mine]
        self._motor_damping = np.array(own) / self._per_rad**2
        self._shared = [
            _SharedBodies(one, moved.rows, np.array([model.joint(name).id for name in one.joints]))
            for one in moved.shared
        ]
        # MuJoCo imports `mimic` as equality constraints between joints.
        following = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
        self._mimics = list(
            zip(model.eq_obj1id[following], model.eq_obj2id[following], model.eq_data[following], strict=True)
        )
        self._put_bodies()
        self._dt_s = 0.0

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""
        numbers, scale = self._numbers, self._per_rad
        if dt_s != self._dt_s:
            self._set_step(dt_s)
        # MuJoCo's integrator treats damping implicitly, like `IndependentJoints`.
        self._damping[numbers] = self._own_damping + damping / scale**2
        torque = (drive - damping * self.velocity) / scale
        # The bodies' pull on the joint is that of the previous step.
        pull = self._bias[numbers]
        for one in self._shared:
            pull[one.rows] = one.matrix.T @ self._bias[one.numbers]
        self._friction[numbers] = self._own_friction + self._load_friction * np.abs(torque + pull)
        self._turn[numbers] = scale * (self.angle - self._reference)
        self._speed[numbers] = scale * self.velocity
        self._force[numbers] = drive / scale
        self._step(self._model, self._data)
        self.angle[:] = self._reference + self._turn[numbers] / scale
        self.velocity[:] = self._speed[numbers] / scale

    def place_shaft(self, index: int, angle: float) -> None:
        """Put a servo's shaft at an angle, rad, at rest, together with the joints that it moves."""
        by = self._per_rad[index] * (angle - self.angle[index])
        self.angle[index] = angle
        self.velocity[index] = 0.0
        for one in self._shared:
            if index in one.rows:
                moved = coupled_motion(one.together, one.rows.tolist().index(index))
                self.angle[one.rows] += (moved * by - (one.rows == index) * by) / self._per_rad[one.rows]
                self.velocity[one.rows[moved != 0.0]] = 0.0
        self._put_bodies()

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the counted angle of a servo's shaft. The shaft and the bodies do not move."""
        self.angle[index] += by
        self._reference[index] += by

    def jam(self, index: int, on: bool) -> None:
        """Block a servo's shaft at its angle by friction (`on`), or release it."""
        self._own_friction[index] = JAMMED_NM if on else self._free_friction[index]

    def _put_bodies(self) -> None:
        """Put all bodies where the shafts' angles require; shared and mimic joints come to rest."""
        turned = self._per_rad * (self.angle - self._reference)
        self._turn[self._numbers] = turned
        for one in self._shared:
            self._turn[one.numbers] = one.matrix @ turned[one.rows]
            self._speed[one.numbers] = 0.0
        for _ in self._mimics:  # A mimic joint may follow another one, so repeat until the chain is resolved
            for follower, leader, (offset, multiplier, *_) in self._mimics:
                self._turn[follower] = offset + multiplier * self._turn[leader]
                self._speed[follower] = 0.0

    def _set_step(self, dt_s: float) -> None:
        self._dt_s = self._model.opt.timestep = dt_s
        # As in `IndependentJoints`: subtract half a step of damping, but keep at least half of the inertia.
        armature = np.maximum(self._armature - self._motor_damping * dt_s / 2, self._armature / 2)
        self._model.dof_armature[self._numbers] = armature


class _SharedBodies:
    """Indices and coupling matrix of a mechanism whose servos share joints."""

    def __init__(self, mechanism: Mechanism, indices: Sequence[int], numbers: Rows) -> None:
        self.rows: Rows = np.array([indices.index(servo.index) for servo in mechanism.servos], dtype=np.intp)
        """Index of each servo of the mechanism in `MujocoBodies.angle`."""
        self.numbers = numbers  # Indices of its joints in MuJoCo
        self.matrix: Floats = np.array(mechanism.matrix, dtype=np.float64)
        self.together = coupled_projection(self.matrix)


def _make_movable(root: Element, moved: Set[str]) -> None:
    """Fix the joints of a URDF that servos move neither directly nor by `mimic`, and remove meshes."""
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    followed = {
        name: mimic.get("joint", "")
        for name, joint in joints.items()
        if name not in moved and (mimic := joint.find("mimic")) is not None
    }
    free = set(moved)
    while more := {name for name, leader in followed.items() if leader in free} - free:
        free |= more
    for name, joint in joints.items():
        if name not in free:
            joint.set("type", "fixed")
        if name in moved or name not in free:
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)


def _compiled(urdf: str, moved: _MovedMechanisms, servos: Sequence[PlantJoint]) -> MjModel:
    """Compile the URDF to a MuJoCo model, with the rotors and frictions of servos.

    Joint limits and contacts are disabled.

    Raises:
        ValueError: MuJoCo cannot load the URDF.
    """
    import mujoco

    spec: MjSpec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.boundmass = _LEAST_MASS
    spec.compiler.boundinertia = _LEAST_INERTIA
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    spec.option.disableflags |= int(disabled)
    joints = {joint.name: joint for joint in spec.joints}
    for one in moved.single:
        (name,), (servo,) = one.joints, one.servos
        # The load's friction already belongs to the shaft, as for a servo that moves no body.
        _drive(joints[name], servos[servo.index].motor, servo.per_rad, servos[servo.index].load.friction)
    for one in moved.shared:
        for name, load in zip(one.joints, one.loads, strict=True):
            _rub(joints[name], load.friction)
        shares = np.linalg.pinv(np.array(one.matrix))
        for servo, share in zip(one.servos, shares, strict=True):
            body = spec.worldbody.add_body(name=_rotor(servo))
            rotor = body.add_joint(name=_rotor(servo), type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
            _drive(rotor, servos[servo.index].motor, servo.per_rad, 0.0)
            tendon = spec.add_tendon(name=_rotor(servo))
            tendon.wrap_joint(rotor.name, 1.0)
            for name, part in zip(one.joints, share.tolist(), strict=True):
                tendon.wrap_joint(name, -part)
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_TENDON, name1=tendon.name, solref=_HELD_SOLREF, data=[0.0] * 12
            )
    return spec.compile()


def _drive(joint: MjsJoint, motor: Motor, per_rad: float, friction: float) -> None:
    """Add inertia, damping and friction of a servo's motor to a joint of the MuJoCo model. `friction` is
    additional friction of the load at the servo's shaft, Nm."""
    joint.armature = motor.inertia / per_rad**2
    joint.damping[0] += motor.viscous_friction / per_rad**2
    _rub(joint, (motor.friction + friction) / abs(per_rad))


def _rub(joint: MjsJoint, friction: float) -> None:
    joint.frictionloss += friction
    joint.solref_friction = _FRICTION_SOLREF
    joint.solimp_friction = _FRICTION_SOLIMP


def _rotor(servo: MechanismServo) -> str:
    return f"rotor of servo {servo.index}"
