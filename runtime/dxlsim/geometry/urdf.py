"""URDF of a robot: reads links, joints, origins, axes, limits and mimic joints; each error has its position.

Source: the pages "urdf/XML" of ROS (robot, link, joint) for elements, defaults and units: rad, and m for
prismatic joints. `rpy` rotates about the parent's fixed x, then y, then z axis. Shapes and masses are not
read here."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Literal, TypeAlias, cast, get_args
from xml.parsers import expat

import msgspec

from dxlwire.exceptions import InputError, Mark, Problem, suggestion

Vector: TypeAlias = "tuple[float, float, float]"
JointType = Literal["revolute", "continuous", "prismatic", "fixed"]
_TYPES: tuple[str, ...] = get_args(JointType)
_FREE = ("floating", "planar")  # Joint types that a single servo cannot move
TURNING = ("revolute", "continuous")
SLIDING = "prismatic"
_NOWHERE: Vector = (0.0, 0.0, 0.0)


class UrdfLimits(msgspec.Struct, frozen=True):
    """Limits of a joint in the URDF: rad, rad/s and Nm; for a prismatic joint m, m/s and N. None: not
    given."""

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None


class Mimic(msgspec.Struct, frozen=True):
    """`mimic` of a joint: it follows the joint `joint` with q = multiplier * q_of_that + offset."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


class UrdfJoint(msgspec.Struct, frozen=True):
    """Joint of a URDF, with the pose of its child link in its parent link."""

    name: str
    type: JointType
    parent: str
    child: str
    xyz: Vector = _NOWHERE  # m, in the parent's frame
    rpy: Vector = _NOWHERE  # rad, roll, pitch and yaw about the parent's axes
    axis: Vector = (1.0, 0.0, 0.0)  # Unit vector in the joint's own frame
    limits: UrdfLimits = UrdfLimits()
    mimic: Mimic | None = None
    mark: Mark = Mark("")

    @property
    def moves(self) -> bool:
        """True unless the joint's type is `fixed`."""
        return self.type != "fixed"


class Urdf(msgspec.Struct, frozen=True):
    """Links and joints of a URDF, which form one tree."""

    name: str
    root: str  # Link without a parent
    links: tuple[str, ...]
    """Links from the root downwards, each after its parent; otherwise in the order of the file."""
    joints: tuple[UrdfJoint, ...]  # In the order of `links`: the joint above each link except the root

    def joint(self, name: str) -> UrdfJoint | None:
        """Return the joint with this name, or None."""
        return next((joint for joint in self.joints if joint.name == name), None)


def leader(
    joints: Mapping[str, UrdfJoint], joint: UrdfJoint, known: Container[str]
) -> tuple[UrdfJoint, float, float]:
    """Return the joint that `joint` follows through its `mimic` chain, with scale and offset: q = scale *
    q_of_that + offset.

    The search ends at the first joint that is in `known` or mimics no joint, possibly the joint itself."""
    scale, offset = 1.0, 0.0
    while joint.name not in known and joint.mimic is not None:
        offset += scale * joint.mimic.offset
        scale *= joint.mimic.multiplier
        joint = joints[joint.mimic.joint]
    return joint, scale, offset


def read_urdf(text: str, file: str = "the URDF") -> Urdf:
    """Parse the text of a URDF and return its links and joints; `file` is its name in error messages.

    DTDs are rejected: entities can refer to files of this machine or expand without limit, and a URDF
    needs none.

    Raises:
        InputError: The URDF is invalid; `problems` has all errors that can be detected at once.
    """
    return _UrdfReader(_parsed(text, file)).result()


class _Element(msgspec.Struct):
    tag: str
    attributes: Mapping[str, str]
    mark: Mark
    children: list[_Element] = []

    def all(self, tag: str) -> Iterator[_Element]:
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> _Element | None:
        return next(self.all(tag), None)


def _parsed(text: str, file: str) -> _Element:
    """Parse the XML and return the top element, `robot`. Raises InputError."""
    top = _Element("", {}, Mark(file))
    inside = [top]
    parser = expat.ParserCreate()

    def here() -> Mark:
        return Mark(file, parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = _Element(tag, attributes, here())
        inside[-1].children.append(element)
        inside.append(element)

    def close_element(tag: str) -> None:
        inside.pop()

    def doctype(*_: object) -> None:
        before = text.encode()[: parser.CurrentByteIndex].rpartition(b"<!DOCTYPE")[0].decode()
        mark = Mark(file, before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1)
        raise InputError([Problem(mark, "DOCTYPE is not allowed", "remove it")])

    parser.StartElementHandler, parser.EndElementHandler = start, close_element
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        what = f"this is not XML ({expat.ErrorString(error.code)})"
        mark = Mark(file, error.lineno, error.offset + 1)
        raise InputError([Problem(mark, what, "correct it")]) from error
    (robot,) = top.children
    if robot.tag != "robot":
        what = f"the top element is {robot.tag}, not robot"
        raise InputError([Problem(Mark(file), what, "name a URDF file")])
    return robot


class _UrdfReader:
    """Reads the elements of a URDF and collects all errors in them."""

    def __init__(self, robot: _Element) -> None:
        self._robot = robot
        self._problems: list[Problem] = []
        self._links: dict[str, Mark] = {}
        self._joints: dict[str, UrdfJoint] = {}

    def result(self) -> Urdf:
        """Return the tree of links. Raises InputError with all errors."""
        for element in self._robot.all("link"):
            self._link(element)
        if not self._links:
            self._add(self._robot.mark, "the URDF has no links", "add at least one link")
        for element in self._robot.all("joint"):
            joint = self._joint(element)
            if joint is not None:
                self._joints[joint.name] = joint
        self._check_mimics()
        root = ""
        if not self._problems:  # After an error links might seem to have no parents
            root = self._root()
        if self._problems:
            raise InputError(sorted(self._problems, key=lambda problem: problem.mark))
        joints = _downwards(root, tuple(self._joints.values()))
        name = self._robot.attributes.get("name", "")
        return Urdf(name, root, (root, *(joint.child for joint in joints)), joints)

    def _add(self, mark: Mark, what: str, fix: str) -> None:
        self._problems.append(Problem(mark, what, fix))

    def _link(self, element: _Element) -> None:
        name = element.attributes.get("name", "")
        if not name:
            self._add(element.mark, "a link has no name", 'write <link name="...">')
        elif name in self._links:
            self._add(element.mark, f"link {name} is defined twice", "rename one of the links")
        else:
            self._links[name] = element.mark

    def _joint(self, element: _Element) -> UrdfJoint | None:
        name = element.attributes.get("name", "")
        if not name:
            self._add(element.mark, "a joint has no name", 'write <joint name="..." type="...">')
            return None
        if name in self._joints:
            self._add(element.mark, f"joint {name} is defined twice", "rename one of the joints")
            return None
        kind = self._type(element, name)
        parent, child = self._find_link(element, name, "parent"), self._find_link(element, name, "child")
        xyz, rpy = (self._vector(element, name, "origin", key, _NOWHERE) for key in ("xyz", "rpy"))
        axis = self._axis(element, name) if kind != "fixed" else (1.0, 0.0, 0.0)
        limits, mimic = self._limits(element, name), self._mimic(element, name)
        return UrdfJoint(name, kind, parent, child, xyz, rpy, axis, limits, mimic, element.mark)

    def _type(self, element: _Element, name: str) -> JointType:
        kind = element.attributes.get("type", "")
        if kind in _TYPES:
            return cast("JointType", kind)
        if kind in _FREE:
            what = f"joint {name} is {kind}, with several degrees of freedom; a servo has one"
            self._add(element.mark, what, "make it fixed, or split it into revolute and prismatic joints")
        else:
            what = f"joint {name} has the unknown type {kind}" if kind else f"joint {name} has no type"
            self._add(element.mark, what, f"write one of {', '.join(_TYPES)}")
        return "fixed"

    def _find_link(self, element: _Element, name: str, tag: str) -> str:
        """Return the name of a joint's parent or child link; report it if it is missing or unknown."""
        found = element.first(tag)
        link = "" if found is None else found.attributes.get("link", "")
        mark = element.mark if found is None else found.mark
        if not link:
            self._add(mark, f"joint {name} has no {tag}", f'add <{tag} link="..."/>')
        elif link not in self._links:
            what = f"link {link}, the {tag} of joint {name}, is not defined"
            self._add(mark, what, suggestion(link, tuple(self._links)))
        return link

    def _vector(self, element: _Element, name: str, tag: str, key: str, default: Vector) -> Vector:
        found = element.first(tag)
        text = None if found is None else found.attributes.get(key)
        if found is None or text is None:
            return default
        numbers = [_number(word) for word in text.split()]
        if len(numbers) == 3 and None not in numbers:
            return cast("Vector", tuple(numbers))
        what = f"{key} of the {tag} of joint {name} is {text!r}, not three numbers"
        self._add(found.mark, what, f'write three numbers such as {key}="0 0 1"')
        return default

    def _axis(self, element: _Element, name: str) -> Vector:
        """Return a joint's axis as a unit vector."""
        x, y, z = self._vector(element, name, "axis", "xyz", (1.0, 0.0, 0.0))
        length = math.hypot(x, y, z)
        if not length:
            found = element.first("axis")
            mark = element.mark if found is None else found.mark
            self._add(
                mark, f"the axis of joint {name} has zero length", 'write an axis such as <axis xyz="0 0 1"/>'
            )
            return 1.0, 0.0, 0.0
        return x / length, y / length, z / length

    def _scalar(self, element: _Element, joint: str, key: str) -> float | None:
        text = element.attributes.get(key)
        value = None if text is None else _number(text)
        if text is not None and value is None:
            what = f"{key} of the {element.tag} of joint {joint} is {text!r}, not a number"
            self._add(element.mark, what, "write a number")
        return value

    def _limits(self, element: _Element, name: str) -> UrdfLimits:
        found = element.first("limit")
        if found is None:
            return UrdfLimits()
        lower, upper, velocity, effort = (
            self._scalar(found, name, key) for key in ("lower", "upper", "velocity", "effort")
        )
        if lower is not None and upper is not None and lower > upper:
            what = f"the lower limit of joint {name}, {lower:g}, is above the upper limit, {upper:g}"
            self._add(found.mark, what, "exchange the limits")
        return UrdfLimits(lower, upper, velocity, effort)

    def _mimic(self, element: _Element, name: str) -> Mimic | None:
        found = element.first("mimic")
        if found is None:
            return None
        joint = found.attributes.get("joint", "")
        if not joint:
            self._add(found.mark, f"the mimic of joint {name} names no joint", 'write <mimic joint="..."/>')
            return None
        multiplier, offset = self._scalar(found, name, "multiplier"), self._scalar(found, name, "offset")
        return Mimic(joint, 1.0 if multiplier is None else multiplier, offset or 0.0)

    def _check_mimics(self) -> None:
        for joint in self._joints.values():
            if joint.mimic is None:
                continue
            name, mark = joint.mimic.joint, joint.mark
            followed = self._joints.get(name)
            if followed is None:
                what = f"joint {joint.name} mimics the unknown joint {name}"
                self._add(mark, what, suggestion(name, [each for each in self._joints if each != joint.name]))
            elif not followed.moves:
                self._add(mark, f"joint {joint.name} mimics the fixed joint {name}", "name a moving joint")
        self._check_circles_of_mimics()

    def _check_circles_of_mimics(self) -> None:
        seen: set[str] = set()
        for joint in self._joints.values():
            way: dict[str, None] = {}
            following: UrdfJoint | None = joint
            while following is not None and following.name not in seen:
                seen.add(following.name)
                way[following.name] = None
                following = None if following.mimic is None else self._joints.get(following.mimic.joint)
            if following is not None and following.name in way:  # Otherwise this circle was already reported
                circle = [*way][[*way].index(following.name) :]
                what = f"joint {circle[0]} mimics itself: {' -> '.join((*circle, circle[0]))}"
                self._add(following.mark, what, "remove one mimic of this circle")

    def _root(self) -> str:
        """Return the link without a parent; report an error unless the links form one tree."""
        above: dict[str, UrdfJoint] = {}
        for joint in self._joints.values():
            other = above.setdefault(joint.child, joint)
            if other is not joint:
                what = f"link {joint.child} is the child of two joints, {other.name} and {joint.name}"
                self._add(joint.mark, what, "change one child")
        if self._problems:
            return ""
        roots = [link for link in self._links if link not in above]
        if len(roots) > 1:
            self._add(
                self._links[roots[1]],
                f"{len(roots)} links have no parent: {', '.join(roots)}",
                "connect all links to one tree, for example by fixed joints",
            )
        reached = {joint.child for root in roots for joint in _downwards(root, tuple(self._joints.values()))}
        lost = [link for link in self._links if link not in reached and link in above]
        if lost:
            way = [lost[0]]
            while way.count(way[-1]) == 1:
                way.append(above[way[-1]].parent)
            circle = way[way.index(way[-1]) :][::-1]
            what = f"links form a circle: {' -> '.join(circle)}"
            self._add(above[circle[-1]].mark, what, "remove one joint of this circle")
        return roots[0] if roots else ""


def _downwards(root: str, joints: Sequence[UrdfJoint]) -> tuple[UrdfJoint, ...]:
    """Return all joints below the link `root`, each after the joint above it."""
    below: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    found: list[UrdfJoint] = []
    left = below.get(root, [])[::-1]
    while left:
        found.append(left.pop())
        left += below.get(found[-1].child, [])[::-1]
    return tuple(found)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
