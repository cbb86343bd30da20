"""Gravity: the torques that hold the bodies of a URDF at rest.

g(q) of the equations of motion M(q) a + C(q, v) v + g(q) = torque, by MuJoCo's recursive Newton-Euler
algorithm at rest (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 5.3). Of the URDF only
joints and masses count: their origins, axes, and centres of mass. MuJoCo and not pinocchio, which gives
the same: it is the extra `physics` already, takes half the memory in the loop's process, and a payload's mass
can change in a run. Neither starts a thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import msgspec
import numpy as np

from dxlrun import LINEAR, ROTARY, Floats, JointUnit
from dxlrun_controllers.joints import finite_or

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

GRAVITY = 9.80665
"""m/s^2, standard"""
TYPES: Mapping[JointUnit, tuple[str, ...]] = {ROTARY: ("revolute", "continuous"), LINEAR: ("prismatic",)}
"""Types of joints of a URDF whose positions have this unit."""
MOVABLE = (*TYPES[ROTARY], *TYPES[LINEAR])
_PAYLOAD = "payload of gravity_compensation"
_LEAST_MASS = 1e-12
"""kg of a link without mass: MuJoCo refuses a moving body without. Its weight is 1e-11 N."""

GravityLaw: TypeAlias = Callable[[Floats, Floats, float, Floats], None]
"""Write the torques of some joints, Nm: positions of all joints, rad; up in the axes of the URDF's first
link, a unit vector; mass of the payload, kg; the torques, to be written. No allocation that grows."""


class Bodies(msgspec.Struct, frozen=True):
    """Joints and masses of a URDF."""

    joints: Mapping[str, Element]
    masses: Mapping[str, float | None]
    """kg, by link; None: it has no `inertial`"""
    children: Mapping[str, tuple[str, ...]] = msgspec.field(default_factory=dict)
    """Joints by the link that they begin at"""
    shaped: frozenset[str] = frozenset()
    """Links with a shape"""

    def moved(self, joint: str) -> list[str]:
        """Return the links that a joint moves, those of mimic joints not among them."""
        links: list[str] = []
        left = [joint]
        while left:
            link = _end(self.joints[left.pop()], "child")
            if link not in links:
                links.append(link)
                left += self.children.get(link, ())
        return links

    def mass(self, joint: str) -> float:
        """Return the mass that a joint moves, kg."""
        return sum(self.masses.get(link) or 0.0 for link in self.moved(joint))


def bodies_of(urdf: str) -> Bodies:
    """Return joints and masses of a URDF. Raises ValueError for one that cannot be used."""
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
    """Return the law for the first `count` of the joints of these names; imports MuJoCo.

    Joints of the URDF that are none of them are at 0, those that mimic one of them move with it and count
    for it; names that the URDF lacks have the torque 0. `payload`: the link that carries it, and where its
    centre of mass is in the axes of that link, m. Raises ValueError for what MuJoCo cannot take.
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
    """What each joint of the model counts for those whose torques are asked for"""
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

    # no DTD can be in it: the robot file's compiler refuses one
    return ElementTree.fromstring(urdf)  # noqa: S314  as above


def _turned(root: Element, names: Sequence[str]) -> dict[str, tuple[int, float, float]]:
    """Return, by joint, which position it follows, by how much, and from where."""
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
    """Leave of a URDF the joints that move, and the masses of its links."""
    for joint in root.findall("joint"):
        if _name(joint) not in turned:
            joint.set("type", "fixed")
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)  # of a link without `inertial` MuJoCo would weigh the shapes
        inertia = link.find("inertial/inertia")
        if inertia is not None:  # which does not count at rest, and MuJoCo refuses ones that cannot be
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
    """Write the direction up in the axes of a base with an orientation x, y, z, w; not finite: as it was.

    The third row of its rotation matrix.
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
        raise ValueError(f"link {_name(link)} has the mass {text or 'of no value'}")
    return value
