"""Frame tree: which joint or IMU moves each link of a URDF, and the link's pose at given positions.

Frames have the names of the URDF's links, after ROS REP 105: `base_link` is the robot's own frame, `odom` is
fixed. Joints and their origins come from the URDF alone; no library is needed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Literal

import msgspec

from dxlrun.errors import InputError, Mark, Problem, suggestion
from dxlsim.geometry.transform import (
    NO_TURN,
    Quaternion,
    Transform,
    conjugate,
    from_rpy,
    product,
    rotation_about,
    unit,
)
from dxlsim.geometry.urdf import SLIDING, Urdf, UrdfJoint, leader, read_urdf

ODOM = "odom"  # fixed frame in which an IMU measures its orientation (ROS REP 105)
_ABOVE_ODOM = ("world", "map", ODOM)
ORIENTATION = ("orientation.x", "orientation.y", "orientation.z", "orientation.w")
"""States (quaternion) that a device, sensor or controller must have to rotate the robot's body."""
IMU_LINKS = ("{}", "{}_link", "{}_frame")  # possible names of an IMU's link, from the IMU's name

MovedBy = Literal["root", "fixed", "servo", "mimic", "imu", "nothing"]
_UNKNOWN: Quaternion = (math.nan, math.nan, math.nan, math.nan)
_NOTHING_KNOWN: Mapping[str, float] = MappingProxyType({})


class FramesPlan(msgspec.Struct, frozen=True):
    """Settings for writing the robot's frames (/tf) into the log."""

    rate: float
    """Messages of /tf per second, at most one per cycle; 0: none."""
    moved: tuple[str, ...] = ()  # joints of the robot that move joints of the URDF
    imu: str = ""  # source whose orientation rotates the body; empty: the root is fixed
    imu_link: str = ""  # link of the URDF with that orientation


class Frame(msgspec.Struct, frozen=True):
    """One frame, usually a link of the URDF: its parent and what moves it."""

    name: str
    parent: str  # empty: none
    joint: UrdfJoint | None  # joint of the URDF; None: the root, or a body that the IMU rotates in `odom`
    moved_by: MovedBy  # `nothing`: a movable joint without a servo, which is at rest

    @property
    def moves(self) -> bool:
        """True if the frame's pose in its parent can change during a run."""
        return self.moved_by in ("servo", "mimic", "imu")


class FrameTree:
    """All frames of a robot with their parents; computes poses from joint positions and the IMU.

    With an IMU, `odom` is the frame in which the IMU measures its orientation. There are two cases. If the
    IMU's link is a child of `odom`, the link rotates together with everything below it. If the link is
    anywhere in the body, an `odom` is added above the root and the whole body rotates in it.

    Args:
        urdf: The robot's URDF.
        moved: Joints with servos.
        imu: Source with the IMU's orientation; empty: none.
        imu_link: Link of the IMU; empty: a link with its name.

    Raises:
        InputError: The URDF fits neither case.
    """

    def __init__(self, urdf: Urdf, moved: Collection[str], imu: str = "", imu_link: str = "") -> None:
        self._joints = {joint.name: joint for joint in urdf.joints}
        self.moved = frozenset(name for name in moved if name in self._joints)
        self._bases = {joint.name: Transform(joint.xyz, from_rpy(joint.rpy)) for joint in urdf.joints}
        self.imu = imu
        self.imu_link = _imu_link(urdf, imu, imu_link) if imu else ""
        self._turned = ""
        """Name of the frame that the IMU's orientation rotates; empty without an IMU."""
        frames = [Frame(urdf.root, "", None, "root")]
        frames += [Frame(joint.child, joint.parent, joint, self._mover(joint)) for joint in urdf.joints]
        if self.imu_link:
            frames = self._with_imu(urdf, frames)
        self.frames: tuple[Frame, ...] = tuple(frames)
        """All frames, each after its parent, beginning with the root."""
        self._frames = {frame.name: frame for frame in frames}

    @classmethod
    def from_urdf(cls, urdf: str, plan: FramesPlan) -> FrameTree:
        """Build the tree from the text of a URDF and a plan; raise InputError as the constructor does."""
        return cls(read_urdf(urdf), plan.moved, plan.imu, plan.imu_link)

    def _mover(self, joint: UrdfJoint) -> MovedBy:
        if not joint.moves:
            return "fixed"
        if joint.name in self.moved:
            return "servo"
        return "mimic" if leader(self._joints, joint, self.moved)[0].name in self.moved else "nothing"

    def _with_imu(self, urdf: Urdf, frames: list[Frame]) -> list[Frame]:
        """Return the frames with `odom` and the frame that the IMU rotates in it."""
        for number, frame in enumerate(frames):
            if (frame.name, frame.parent, frame.moved_by) == (self.imu_link, ODOM, "fixed"):
                self._turned = frame.name
                return [*frames[:number], Frame(frame.name, ODOM, frame.joint, "imu"), *frames[number + 1 :]]
        fixed = next((frame.name for frame in frames if frame.name in _ABOVE_ODOM), None)
        if fixed is not None:
            raise _refused(
                f"the URDF has the frame {fixed}, so it needs a fixed joint from {ODOM} to "
                f"{self.imu_link}, the link of the IMU",
                f"add the joint, or remove {fixed}",
            )
        self._turned = urdf.root
        return [Frame(ODOM, "", None, "root"), Frame(urdf.root, ODOM, None, "imu"), *frames[1:]]

    def position(self, name: str, positions: Mapping[str, float]) -> float:
        """Return the position of a URDF joint, rad or m: as given, from the joint it mimics, or at rest.

        The rest position is 0, or the middle of the limits if they exclude 0.
        """
        joint, scale, offset = leader(self._joints, self._joints[name], positions)
        known = positions.get(joint.name)
        return scale * (rest_position(joint) if known is None else known) + offset

    def local(
        self, frame: Frame, positions: Mapping[str, float], orientation: Quaternion = NO_TURN
    ) -> Transform | None:
        """Return the pose of a frame in its parent; None if a position or orientation is NaN."""
        if frame.moved_by == "root":
            return Transform()
        if frame.moved_by == "imu":
            return self._turned_by_imu(frame, positions, orientation)
        if frame.joint is None:
            raise ValueError(f"frame {frame.name} has no joint")
        base = self._bases[frame.joint.name]
        if not frame.joint.moves:
            return base
        position = self.position(frame.joint.name, positions)
        if not math.isfinite(position):
            return None
        x, y, z = frame.joint.axis
        if frame.joint.type == SLIDING:
            return base @ Transform((x * position, y * position, z * position))
        return Transform(base.translation, product(base.rotation, rotation_about(frame.joint.axis, position)))

    def orientation(self, states: Mapping[str, float | None]) -> Quaternion:
        """Return the IMU's orientation from states such as `imu/orientation.x`; NaN if one is missing.

        Without an IMU the orientation is the identity.
        """
        if not self.imu:
            return NO_TURN
        values = [states.get(f"{self.imu}/{name}") for name in ORIENTATION]
        x, y, z, w = (math.nan if value is None else value for value in values)
        return unit((x, y, z, w)) or _UNKNOWN

    def _turned_by_imu(
        self, frame: Frame, positions: Mapping[str, float], orientation: Quaternion
    ) -> Transform | None:
        if not all(map(math.isfinite, orientation)):
            return None
        if frame.joint is not None:
            return Transform(frame.joint.xyz, orientation)
        # The IMU measures its link's orientation, so remove the rotation of the link in the body.
        inside = self._below(self.imu_link, frame.name, positions)
        return inside and Transform(rotation=product(orientation, conjugate(inside.rotation)))

    def _shared(self, one: str, other: str) -> str:
        """Return the nearest frame that is above both frames, or one of the two."""
        above = {one}
        while parent := self._frames[one].parent:
            above.add(one := parent)
        while other not in above:
            other = self._frames[other].parent
        return other

    def _below(
        self, name: str, above: str, positions: Mapping[str, float], orientation: Quaternion = NO_TURN
    ) -> Transform | None:
        """Return the pose of a frame in a frame above it; None if a position or orientation is NaN."""
        found = Transform()
        frame = self._frames[name]
        while frame.name != above:
            local = self.local(frame, positions, orientation)
            if local is None:
                return None
            found = local @ found
            frame = self._frames[frame.parent]
        return found

    def _ends(self, of: str, relative_to: str) -> tuple[str, str]:
        known = [each.name for each in self.frames]
        for name in filter(None, (of, relative_to)):
            if name not in self._frames:
                raise LookupError(f"frame {name} not found; {suggestion(name, known)}")
        return of, relative_to or known[0]

    def movers(self, of: str, relative_to: str = "") -> tuple[str, ...]:
        """Return the joints that move the frame `of` in another frame; empty: the root.

        A joint that mimics another one is not among them, but that one is.

        Raises:
            LookupError: A frame does not exist.
            ValueError: A joint that moves the frame has no servo in this run.
        """
        ends = self._ends(of, relative_to)
        shared, found = self._shared(*ends), dict[str, None]()
        for end in ends:
            frame = self._frames[end]
            while frame.name != shared:
                if frame.joint is not None and frame.joint.moves:
                    found[leader(self._joints, frame.joint, self.moved)[0].name] = None
                frame = self._frames[frame.parent]
        if lacking := next((joint for joint in found if joint not in self.moved), ""):
            raise ValueError(f"frame {of} moves with joint {lacking}, which is omitted or has no servo")
        return tuple(found)

    def pose(
        self,
        of: str,
        relative_to: str = "",
        positions: Mapping[str, float] = _NOTHING_KNOWN,
        orientation: Quaternion = NO_TURN,
    ) -> Transform:
        """Return the pose of the frame `of` in another frame, at given joint positions.

        Args:
            of: The frame.
            relative_to: The other frame; empty: the root of the tree.
            positions: Joint positions, rad or m; other joints are at rest.
            orientation: Orientation of the IMU in `odom`.

        Raises:
            LookupError: A frame or joint does not exist.
            ValueError: A position is not finite.
        """
        ends = self._ends(of, relative_to)
        for name in positions:
            joint = self._joints.get(name)
            if joint is None or not joint.moves:
                moving = [each.name for each in self._joints.values() if each.moves]
                raise LookupError(f"movable joint {name} not found; {suggestion(name, moving)}")
        shared = self._shared(*ends)  # The frames above the common ancestor do not matter.
        found, base = (self._below(name, shared, positions, orientation) for name in ends)
        if found is None or base is None:
            raise ValueError("a position is missing; give a number for each joint")
        return base.inverse @ found


def rest_position(joint: UrdfJoint) -> float:
    """Return the position at which a joint without a servo is shown: 0, or the middle of its limits."""
    lower, upper = joint.limits.lower, joint.limits.upper
    if lower is None or upper is None or joint.type == "continuous" or lower <= 0.0 <= upper:
        return 0.0
    return (lower + upper) / 2


def _imu_link(urdf: Urdf, imu: str, link: str) -> str:
    """Return the link of an IMU: the given one, or one named like the IMU; raise InputError if none."""
    if link and link not in urdf.links:
        raise _refused(f"the URDF has no link {link} for the IMU {imu}", suggestion(link, urdf.links))
    names = [link] if link else [form.format(imu) for form in IMU_LINKS]
    found = next((name for name in names if name in urdf.links), None)
    if found is None:
        what = f"the URDF has no link for the IMU {imu}: {', '.join(names[:-1])} or {names[-1]}"
        raise _refused(what, "write the link of the IMU as `imu_link`")
    return found


def _refused(what: str, fix: str) -> InputError:
    return InputError([Problem(Mark(""), what, fix)])
