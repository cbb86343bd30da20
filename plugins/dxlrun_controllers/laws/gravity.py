"""Gravity: the torques that hold the bodies of a URDF at rest.

g(q) of the equations of motion M(q) a + C(q, v) v + g(q) = torque, by MuJoCo's recursive Newton-Euler
algorithm at rest (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 5.3). Only the origins and
axes of the URDF's joints and the masses and centres of mass of its links matter. MuJoCo is preferred to
pinocchio, which gives the same torques: the extra `physics` already installs it, it takes half the memory in
the loop's process, and the mass of a payload can change in a run. Neither starts a thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import msgspec
import numpy as np

from dxlrun import LINEAR, ROTARY, Floats, JointUnit
from dxlrun_controllers.joint_parameters import finite_or

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

GRAVITY = 9.80665
"""Standard gravity, m/s^2."""
TYPES: Mapping[JointUnit, tuple[str, ...]] = {ROTARY: ("revolute", "continuous"), LINEAR: ("prismatic",)}
"""Unit of a joint's positions -> URDF joint types that have it."""
MOVABLE = (*TYPES[ROTARY], *TYPES[LINEAR])
_PAYLOAD = "payload of gravity_compensation"
_LEAST_MASS = 1e-12
"""Mass of a link without one, kg: MuJoCo rejects a moving body without mass; the weight is 1e-11 N."""

GravityLaw: TypeAlias = Callable[[Floats, Floats, float, Floats], None]
"""Function that writes the gravity torques of joints. Its arguments are the positions of all joints (rad),
the unit vector that points up in the axes of the URDF's first link, the mass of the payload (kg), and the
output array of torques (Nm). It allocates no memory that stays."""


class Bodies(msgspec.Struct, frozen=True):
    """Kinematic tree of a URDF with the masses of its links."""

    joints: Mapping[str, Element]
    masses: Mapping[str, float | None]
    """Mass of each link, kg; None for a link without `inertial`."""
    children: Mapping[str, tuple[str, ...]] = msgspec.field(default_factory=dict)
    """Link -> joints whose parent it is."""
    shaped: frozenset[str] = frozenset()
    """Links that have a visual or a collision shape."""

    def moved(self, joint: str) -> list[str]:
        """Return all links that a joint moves. Links below joints that mimic the joint are not included."""
        links: list[str] = []
        left = [joint]
        while left:
            link = _end(self.joints[left.pop()], "child")
            if link not in links:
                links.append(link)
                left += self.children.get(link, ())
        return links

    def mass(self, joint: str) -> float:
        """Return the total mass of the links that a joint moves, kg."""
        return sum(self.masses.get(link) or 0.0 for link in self.moved(joint))


def bodies_of(urdf: str) -> Bodies:
    """Parse the joints and masses of a URDF. Raises ValueError for an invalid mass."""
    root = _root(urdf)
    joints = {_name(each): each for each in root.findall("joint")}
    masses = {_name(each): _mass(each) for each in root.findall("link")}
    children: dict[str, tuple[str, ...]] = {}
    for name, joint in joints.items():
        parent = _end(joint, "parent")
        children[parent] = (*children.get(parent, ()), name)
    shaped = {
        _name(each) for each in root.findall("link") if {"visual", "collision"} & {part.tag for part in each}
    }
    return Bodies(joints, masses, children, frozenset(shaped))


def gravity_law(
    urdf: str, names: Sequence[str], count: int, payload: tuple[str, Sequence[float]] | None = None
) -> GravityLaw:
    """Build the gravity law of a URDF. Imports MuJoCo.

    Joints of the URDF that are not in `names` stay at 0. A joint that mimics a named one moves with that
    joint, and its torque is added to that joint's. Names that the URDF lacks have the torque 0.

    Args:
        urdf: Text of the URDF.
        names: Joints in the order of the positions that the law gets.
        count: Number of joints, from the first on, whose torques the law writes.
        payload: Link that carries the payload, and the centre of mass of the payload in its axes, m.

    Raises:
        ValueError: MuJoCo cannot compile the URDF.
    """
    import mujoco

    root = _root(urdf)
    turned = _turned(root, names)
    _strip(root, turned)
    if payload is not None:
        _hang(root, *payload)
    from xml.etree import ElementTree

    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compiler.boundmass, spec.compiler.boundinertia = _LEAST_MASS, _LEAST_MASS
    spec.compiler.fusestatic = False  # the payload stays a body of its own
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model = spec.compile()
    data = mujoco.MjData(model)
    order = [model.joint(number).name for number in range(model.njnt)]
    source = np.array([turned[name][0] for name in order], dtype=np.intp)
    ratio = np.array([turned[name][1] for name in order])
    offset = np.array([turned[name][2] for name in order])
    share = np.zeros((count, len(order)))
    """Weight of each joint of the MuJoCo model (columns) in each requested torque (rows)."""
    for column, row in enumerate(source):
        if row < count:
            share[row, column] = ratio[column]
    bias = np.zeros(model.nv)
    carried = model.body(_PAYLOAD).id if payload is not None else -1
    masses, pull, turn = model.body_mass, model.opt.gravity, data.qpos
    kinematics, centres, newton = mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_rne

    def law(positions: Floats, up: Floats, mass: float, torque: Floats) -> None:
        np.add(finite_or(positions, 0.0)[source] * ratio, offset, out=turn)
        np.multiply(up, -GRAVITY, out=pull)
        if carried >= 0:
            masses[carried] = mass
        kinematics(model, data)
        centres(model, data)
        newton(model, data, 0, bias)
        np.dot(share, bias, out=torque)

    return law


def _root(urdf: str) -> Element:
    from xml.etree import ElementTree  # only robots with a URDF need it

    # The compiler of the robot file rejects a URDF with a DTD, so no entity can expand here.
    return ElementTree.fromstring(urdf)  # noqa: S314  as above


def _turned(root: Element, names: Sequence[str]) -> dict[str, tuple[int, float, float]]:
    """Return, by URDF joint that moves, the index of the position in `names` that it follows, ratio and
    offset.
    """
    known = {_name(each): each for each in root.findall("joint") if each.get("type") in MOVABLE}
    own = {name: (row, 1.0, 0.0) for row, name in enumerate(names) if name in known}
    turned = dict(own)
    for name in known:
        ratio, offset, leader, seen = 1.0, 0.0, name, {name}
        while leader not in own and (mimic := known[leader].find("mimic")) is not None:
            leader = mimic.get("joint", "")
            offset += ratio * float(mimic.get("offset", "0"))
            ratio *= float(mimic.get("multiplier", "1"))
            if leader not in known or leader in seen:
                break
            seen.add(leader)
        if name not in own and leader in own:
            turned[name] = (own[leader][0], ratio, offset)
    return turned


def _strip(root: Element, turned: Mapping[str, object]) -> None:
    """Reduce a URDF to its moving joints, without `mimic`, and the masses of its links."""
    for joint in root.findall("joint"):
        if _name(joint) not in turned:
            joint.set("type", "fixed")
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)  # MuJoCo would derive a mass from the shapes of a link without `inertial`
        inertia = link.find("inertial/inertia")
        # The inertia has no effect at rest, but MuJoCo rejects one that is physically impossible.
        if inertia is not None:
            for name in inertia.keys():  # noqa: SIM118  an element has no other iteration over its attributes
                inertia.set(name, "1e-6" if name in {"ixx", "iyy", "izz"} else "0")


def _hang(root: Element, link: str, at: Sequence[float]) -> None:
    from xml.etree.ElementTree import SubElement

    body = SubElement(root, "link", name=_PAYLOAD)
    inertial = SubElement(body, "inertial")
    SubElement(inertial, "mass", value="1")
    SubElement(inertial, "inertia", ixx="1e-6", iyy="1e-6", izz="1e-6", ixy="0", ixz="0", iyz="0")
    joint = SubElement(root, "joint", name=_PAYLOAD, type="fixed")
    SubElement(joint, "parent", link=link)
    SubElement(joint, "child", link=_PAYLOAD)
    SubElement(joint, "origin", xyz=" ".join(repr(float(each)) for each in at))


def up_of(quaternion: Floats, up: Floats) -> None:
    """Write the unit vector that points up, in the axes of a base with this orientation, into `up`.

    It is the third row of the rotation matrix. An orientation that is zero or not finite leaves `up`
    unchanged.

    Args:
        quaternion: Orientation of the base x, y, z, w; of any length above 0.
        up: Output, shape (3,).
    """
    x, y, z, w = quaternion
    norm = x * x + y * y + z * z + w * w
    if not (math.isfinite(norm) and norm > 0.0):
        return
    up[0] = 2.0 * (x * z - w * y) / norm
    up[1] = 2.0 * (y * z + w * x) / norm
    up[2] = 1.0 - 2.0 * (x * x + y * y) / norm


def _name(element: Element) -> str:
    return element.get("name", "")


def _end(joint: Element, which: str) -> str:
    end = joint.find(which)
    return "" if end is None else end.get("link", "")


def _mass(link: Element) -> float | None:
    mass = link.find("inertial/mass")
    if mass is None:
        return None
    text = mass.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"the mass of link {_name(link)} is {text or 'empty'}, not a number of at least 0")
    return value
