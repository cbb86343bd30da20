"""Body: computes the motion of a URDF's links from the shafts of simulated servos, for simulated sensors.

Pose, velocity and acceleration are propagated from link to link along the tree (R. Featherstone, "Rigid
Body Dynamics Algorithms", 2008, chapter 5: the outward half of the recursive Newton-Euler algorithm). The
input is only the shafts' motion, so the result is the same with independent joints and with MuJoCo; a test
compares it with MuJoCo's own sensors. The URDF's first link is fixed at the world's origin, z up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import msgspec
import numpy as np

from dxlsim.geometry import urdf as frames
from dxlsim.geometry.transform import (
    NO_TURN,
    Quaternion,
    Vector,
    conjugate,
    from_rpy,
    near,
    product,
    rotated,
    rotation_about,
)
from dxlsim.geometry.urdf import read_urdf
from dxlsim.motion.link_motion import Floats, LinkMotion, Shafts
from dxlsim.motion.mechanics import Mechanics
from dxlsim.simulation_plan import UrdfBodies


class _Step(msgspec.Struct, frozen=True):
    offset: Vector  # m, position of the joint in the previous link
    rotation: Quaternion  # Orientation of the joint's frame in the previous link, at q = 0
    axis: Vector  # Unit vector in the joint's frame
    slides: bool
    joint: int  # Index of the joint that shafts move, directly or by `mimic`; -1: fixed
    scale: float  # Coordinate = scale * that joint's + at
    at: float


class SimulatedBody:
    """Links of a URDF, moved by simulated shafts; `motion` shows them at the last `set_shafts`.

    Raises:
        InputError: The URDF is invalid.
    """

    def __init__(self, bodies: UrdfBodies) -> None:
        urdf = read_urdf(bodies.urdf)
        self.links = urdf.links
        self._joints = {joint.name: joint for joint in urdf.joints}
        self._above = {joint.child: joint for joint in urdf.joints}
        self._names, self._matrix, self._offset = _moved(bodies)
        self._chains: dict[str, tuple[_Step, ...]] = {}
        self._place = self._speed = self._gain = np.zeros(len(self._names))
        self.set_shafts(Shafts(0, *(np.zeros(bodies.servos) for _ in range(3))))

    def set_shafts(self, shafts: Shafts) -> None:
        """Set angles, velocities and accelerations of all shafts, in the order in which the servos were
        added."""
        self._place = self._matrix @ shafts.angle + self._offset
        self._speed = self._matrix @ shafts.velocity
        self._gain = self._matrix @ shafts.acceleration

    def motion(self, link: str) -> LinkMotion:
        """Return pose, velocity and acceleration of a link at the last `set_shafts`.

        Raises:
            KeyError: The URDF does not have the link.
        """
        facing, position = NO_TURN, np.zeros(3)
        speed, rate, gain, spin = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
        for step in self._chain(link):
            # Acceleration of a point on a rotating link: Euler term (spin x arm) and centripetal term.
            arm = np.array(rotated(facing, step.offset))
            position = position + arm
            gain = gain + _cross(spin, arm) + _cross(rate, _cross(rate, arm))
            speed = speed + _cross(rate, arm)
            facing = product(facing, step.rotation)
            if step.joint < 0 and not step.at:
                continue
            q, dq, ddq = step.at, 0.0, 0.0
            if step.joint >= 0:
                q += step.scale * self._place.item(step.joint)
                dq = step.scale * self._speed.item(step.joint)
                ddq = step.scale * self._gain.item(step.joint)
            axis = np.array(rotated(facing, step.axis))
            if step.slides:
                way = axis * q
                position = position + way
                gain = gain + _cross(spin, way) + _cross(rate, _cross(rate, way))
                # Coriolis acceleration, and the slide's own.
                gain = gain + 2 * dq * _cross(rate, axis) + ddq * axis
                speed = speed + _cross(rate, way) + dq * axis
            else:
                facing = product(facing, rotation_about(step.axis, q))
                spin = spin + ddq * axis + dq * _cross(rate, axis)
                rate = rate + dq * axis
        facing = near(facing, NO_TURN)
        back = conjugate(facing)
        return LinkMotion(position, np.array(facing), speed, _turned(back, rate), _turned(back, gain))

    def _chain(self, link: str) -> tuple[_Step, ...]:
        if (known := self._chains.get(link)) is not None:
            return known
        if link not in self.links:
            raise KeyError(link)
        steps: list[_Step] = []
        at = link
        while (joint := self._above.get(at)) is not None:
            steps.append(self._step(joint))
            at = joint.parent
        self._chains[link] = chain = tuple(reversed(steps))
        return chain

    def _step(self, joint: frames.UrdfJoint) -> _Step:
        moved, scale, at = frames.leader(self._joints, joint, self._names)
        return _Step(
            offset=joint.xyz,
            rotation=from_rpy(joint.rpy),
            axis=joint.axis,
            slides=joint.type == frames.SLIDING,
            joint=self._names.index(moved.name) if moved.name in self._names else -1,
            scale=scale,
            at=at,
        )


def _moved(bodies: UrdfBodies) -> tuple[tuple[str, ...], Floats, Floats]:
    """Return the joints that shafts move, and matrix and offset for their coordinates: q = matrix @ shafts
    + offset."""
    names: list[str] = []
    rows: list[Floats] = []
    offsets: list[float] = []
    for mechanism in bodies.mechanisms:
        for name, weights in zip(mechanism.joints, mechanism.matrix, strict=True):
            row, offset = np.zeros(bodies.servos), 0.0
            for servo, weight in zip(mechanism.servos, weights, strict=True):
                row[servo.index] += weight * servo.per_rad
                offset -= weight * servo.per_rad * servo.reference
            names.append(name)
            rows.append(row)
            offsets.append(offset)
    return tuple(names), np.array(rows).reshape(-1, bodies.servos), np.array(offsets)


class ShaftSink(Protocol):
    """Receiver of the newest angles, velocities and accelerations of all shafts."""

    values: int
    """Length of the array that `write_sample` receives: angle, velocity and acceleration of each shaft."""

    def write_sample(self, t_ns: int, values: Floats) -> None:
        """Write an array with the angles, rad, then the velocities, rad/s, then the accelerations,
        rad/s^2; never waits."""


class ShaftPublisher:
    """Publishes the motion of all shafts after each step of the mechanics, for sensors in other processes."""

    def __init__(self, mechanics: Mechanics, sink: ShaftSink) -> None:
        self._mechanics, self._sink = mechanics, sink
        self._values = np.zeros(sink.values).reshape(3, -1)
        self._shown_ns = -1

    def write_shafts(self) -> None:
        """Write the shafts' motion to the sink if the mechanics have advanced since the last call."""
        mechanics, values = self._mechanics, self._values
        if mechanics.grid_ns == self._shown_ns:
            return
        self._shown_ns, count = mechanics.grid_ns, values.shape[1]
        values[0] = mechanics.plant.angle[:count]
        values[1] = mechanics.plant.velocity[:count]
        values[2] = mechanics.acceleration[:count]
        self._sink.write_sample(mechanics.grid_ns, values.ravel())


class SensedBody:
    """Source of link motions for sensors in the process of the simulation; each query moves the body to
    the present time."""

    def __init__(self, bodies: UrdfBodies, mechanics: Mechanics, now_ns: Callable[[], int]) -> None:
        """Read the URDF of `bodies`. Raises InputError for an invalid one."""
        self._body, self._mechanics, self._now_ns = SimulatedBody(bodies), mechanics, now_ns
        self._count = bodies.servos

    def motion(self, link: str) -> LinkMotion:
        """Return the motion of a link at the present time of the simulation.

        Raises:
            KeyError: The URDF does not have the link.
        """
        self._body.set_shafts(self._mechanics.shafts(self._now_ns(), self._count))
        return self._body.motion(link)


def _cross(a: Floats, b: Floats) -> Floats:
    # numpy's cross product takes 20 us for three numbers
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def _turned(rotation: Quaternion, vector: Floats) -> Floats:
    x, y, z = vector.tolist()
    return np.array(rotated(rotation, (x, y, z)))
