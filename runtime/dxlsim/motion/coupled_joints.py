"""Joints that several servos move together: two on one axis, differentials, any transmission.

Each servo has a coordinate s of its own, and the joints are at q = M s. With the rotors' inertias J_s, the
loads' J_q, and torques t, all in these coordinates:

    (J_s + M' J_q M) s'' = t_s - M' t_q(q) - N' K N s,    N = 1 - pinv(M) M

N s is the disagreement between servos, if more servos than joints are coupled; K is the stiffness of horns
and brackets. Friction holds at most its torque, at each servo and each joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlsim.motion.compiled_mechanics import library
from dxlsim.motion.plant import (
    JAMMED_NM,
    Floats,
    IndependentJoints,
    Part,
    Plant,
    PlantJoint,
    combine_plants,
    stribecks,
)
from dxlsim.simulation_plan import Mechanism

GIVE_RAD = 0.05  # rad of deflection of one servo's horn and bracket at its stall torque [i]

_ROUNDED = 1e-9  # A smaller entry of a pseudoinverse is a rounding error

_MOST_ROUNDS = 30
_SETTLED = 1e-10  # rad/s or m/s; the iteration ends when a round of friction changes less


class CoupledJoints:
    """Plant of one mechanism in which several servos move joints together.

    Damping and the elasticity of brackets are implicit (backward Euler), so a step is stable at any
    stiffness. As in `IndependentJoints`, half a step of the motors' damping is subtracted from their
    inertia, and friction is that of `Motor` and of `Load`. The holding frictions are found by iteration
    (projected Gauss-Seidel)."""

    def __init__(self, mechanism: Mechanism, joints: Sequence[PlantJoint]) -> None:
        self.angle: Floats = np.array([joint.angle for joint in joints], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(joints))
        motors, loads = [joint.motor for joint in joints], mechanism.loads
        self._reference = np.array([each.reference for each in mechanism.servos])
        self._reference += [joint.recounted for joint in joints]
        self._per_rad = scale = np.array([each.per_rad for each in mechanism.servos])
        self._size = size = np.abs(scale)
        self._matrix: Floats = np.array(mechanism.matrix, dtype=np.float64)
        self._together = coupled_projection(self._matrix)
        apart = np.eye(len(joints)) - self._together
        stiffness = np.array([motor.stall_torque / GIVE_RAD for motor in motors]) / scale**2
        self._stiffness: Floats = apart.T @ (stiffness[:, None] * apart)
        self._rotors = np.array([motor.inertia for motor in motors]) / scale**2
        self._viscous = np.array([motor.viscous_friction for motor in motors]) / scale**2
        self._own_damping = np.array([motor.damping for motor in motors]) / scale**2 + self._viscous
        inertia = np.array([load.inertia for load in loads])
        self._loads: Floats = self._matrix.T @ (inertia[:, None] * self._matrix)
        self._gravity = np.array([load.gravity for load in loads])
        self._down = np.array([load.gravity_angle for load in loads])
        self._steady = np.array([load.steady for load in loads])
        self._own_friction = np.array([motor.friction for motor in motors]) / size
        self._jammed = np.zeros(len(joints))
        self._load_friction = np.array([motor.load_friction for motor in motors])
        self._stribeck = stribecks(joints) if any(motor.stribeck for motor in motors) else None
        self._joint_friction = [load.friction for load in loads]
        # Directions of friction: each servo's own, and each joint's.
        self._rows: Floats = np.vstack([np.eye(len(joints)), self._matrix])
        self._take_braking(np.zeros(len(joints)), 0.0)

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""
        scale = self._per_rad
        place, speed = scale * (self.angle - self._reference), scale * self.velocity
        torque, braking = drive / scale, damping / scale**2
        pull = self._matrix.T @ (self._gravity * np.sin(self._matrix @ place - self._down) + self._steady) + (
            self._stiffness @ place
        )
        if dt_s != self._dt_s or not np.array_equal(braking, self._braking):
            self._take_braking(braking, dt_s)
        most: Floats = self._own_friction + self._load_friction * np.abs(torque - braking * speed + pull)
        if self._stribeck is not None:
            rubs = np.empty(len(most))
            arrays = (each.ctypes.data for each in (self._stribeck, self.velocity, rubs))
            library().motion_stribeck(*arrays, len(most))
            most = most + rubs / self._size
        most = most + self._jammed
        free = self._inverse @ (self._mass @ speed + dt_s * (torque - pull))
        speed = self._rubbed(free, [*most.tolist(), *self._joint_friction], dt_s)
        self.velocity[:] = speed / scale
        self.angle += self.velocity * dt_s

    def jam(self, index: int, on: bool) -> None:
        """Block a servo's shaft at its present angle, or release it."""
        self._jammed[index] = JAMMED_NM if on else 0.0

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, together with the shafts on the same axis."""
        moved = coupled_motion(self._together, index)
        by = self._per_rad[index] * (angle - self.angle[index])
        self.angle += moved * by / self._per_rad
        self.velocity[moved != 0.0] = 0.0

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, which does not move."""
        self.angle[index] += by
        self._reference[index] += by

    def _take_braking(self, braking: Floats, dt_s: float) -> None:
        self._braking, self._dt_s = braking, dt_s
        # As in `IndependentJoints`: subtract half a step of damping, but keep at least half of the inertia.
        rotors = np.maximum(self._rotors - self._own_damping * dt_s / 2, self._rotors / 2)
        self._mass = self._loads + np.diag(rotors)
        slowing = np.diag((braking + self._viscous) * dt_s)
        stepped = self._mass + slowing + self._stiffness * dt_s**2
        inverse: Floats = np.asarray(np.linalg.inv(stepped), dtype=np.float64)
        self._inverse: Floats = inverse
        self._answers: Floats = inverse @ self._rows.T
        compliance = self._rows @ self._answers
        self._gains: list[list[float]] = compliance.tolist()

    def _rubbed(self, free: Floats, most: Sequence[float], dt_s: float) -> Floats:
        """Return the servos' speeds after friction.

        Args:
            free: Speeds without friction.
            most: Friction limit along each row, Nm or N.
            dt_s: Step, s.
        """
        speeds, gains = (self._rows @ free).tolist(), self._gains
        held = [0.0] * len(most)
        rubbing = [row for row, torque in enumerate(most) if torque > 0.0]
        for _ in range(_MOST_ROUNDS):
            change = 0.0
            for row in rubbing:
                bound = most[row] * dt_s
                impulse = min(bound, max(-bound, held[row] - speeds[row] / gains[row][row]))
                by = impulse - held[row]
                if by:
                    held[row] = impulse
                    speeds = [speed + gain * by for speed, gain in zip(speeds, gains[row], strict=True)]
                    change = max(change, abs(by) * gains[row][row])
            if change < _SETTLED:
                break
        found: Floats = free + self._answers @ np.array(held)
        return found


def coupled_projection(matrix: Floats) -> Floats:
    """Return the projection of servo coordinates onto motions in which the servos do not work against each
    other: pinv(M) M."""
    found = np.linalg.pinv(matrix) @ matrix
    return np.where(np.abs(found) < _ROUNDED, 0.0, found)


def coupled_motion(projection: Floats, index: int) -> Floats:
    """Return how far each servo of a mechanism moves per unit of movement of the servo at `index`."""
    moved: Floats = projection[:, index] / projection[index, index]
    return moved


def joints_without_bodies(mechanisms: Sequence[Mechanism], joints: Sequence[PlantJoint]) -> Plant:
    """Return the plant of all servos of a simulation without bodies, grouped by their mechanisms."""
    return combine_plants(joints, parts_without_bodies(mechanisms, joints, range(len(joints))))


def parts_without_bodies(
    mechanisms: Sequence[Mechanism], joints: Sequence[PlantJoint], rows: Sequence[int]
) -> list[Part]:
    """Return the plants of the servos in `rows`: one per coupled mechanism, and one for all independent
    servos.

    A mechanism is omitted until all its servos have been added."""
    whole = [
        one for one in mechanisms if not one.is_single and all(servo.index in rows for servo in one.servos)
    ]
    coupled = [[servo.index for servo in one.servos] for one in whole]
    alone = sorted(set(rows).difference(*coupled))
    parts: list[Part] = [
        (mine, CoupledJoints(one, [joints[row] for row in mine]))
        for mine, one in zip(coupled, whole, strict=True)
    ]
    if alone or not parts:
        parts.append((alone, IndependentJoints([joints[row] for row in alone])))
    return parts
