"""Joints that several servos move together: two on one axis, differentials, any transmission.

Each servo has a coordinate s of its own, and the joints are at q = M s. With the rotors' inertias J_s, the
loads' J_q, and torques t, all in these coordinates:

    (J_s + M' J_q M) s'' = t_s - M' t_q(q) - N' K N s,    N = 1 - pinv(M) M

N s is the disagreement between servos, if more servos than joints are coupled; K is the stiffness of horns
and brackets. Friction holds at most its torque, at each servo and each joint. `mechanics.c` has the step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlsim.motion.compiled_mechanics import STRUCTS
from dxlsim.motion.plant import JAMMED_NM, Floats, IndependentJoints, PlantJoint, stribecks
from dxlsim.simulation_plan import Mechanism

GIVE_RAD = 0.05  # rad of deflection of one servo's horn and bracket at its stall torque [i]

_ROUNDED = 1e-9  # A smaller entry of a pseudoinverse is a rounding error


class CoupledJoints(IndependentJoints):
    """Plant of joints of which some are moved by several servos together, with the friction of `Motor` and
    of `Load`.

    As for independent joints, half a step of the motors' damping is subtracted from their inertia."""

    def __init__(
        self,
        mechanisms: Sequence[Mechanism],
        joints: Sequence[PlantJoint],
        rows: Sequence[int] | None = None,
    ) -> None:
        """Create the plant.

        Args:
            mechanisms: All mechanisms. One is omitted until all its servos have been added.
            joints: Shafts of this plant.
            rows: Index of each shaft's servo in the mechanisms; None: 0, 1, ...
        """
        super().__init__(joints)
        place_of = {row: place for place, row in enumerate(rows if rows is not None else range(len(joints)))}
        self._couplings = [
            _Coupling(one, [place_of[servo.index] for servo in one.servos], joints)
            for one in mechanisms
            if not one.is_single and all(servo.index in place_of for servo in one.servos)
        ]
        self._coupled = {
            place: (coupling, number)
            for coupling in self._couplings
            for number, place in enumerate(coupling.places)
        }
        self.joints["coupled"][list(self._coupled)] = 1
        self.couplings = (STRUCTS["Coupling"] * len(self._couplings))(*(one.state for one in self._couplings))

    def jam(self, index: int, on: bool) -> None:
        """Block a servo's shaft at its present angle, or release it."""
        if (found := self._coupled.get(index)) is None:
            super().jam(index, on)
            return
        coupling, number = found
        coupling.arrays["jammed"][number] = JAMMED_NM if on else 0.0

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, together with the shafts on the same axis."""
        if (found := self._coupled.get(index)) is None:
            super().place_shaft(index, angle)
            return
        coupling, number = found
        moved, per_rad = coupled_motion(coupling.together, number), coupling.arrays["per_rad"]
        by = per_rad[number] * (angle - self.angle[index])
        self.angle[coupling.places] += moved * by / per_rad
        self.velocity[np.array(coupling.places)[moved != 0.0]] = 0.0

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, which does not move."""
        super().shift_angle(index, by)
        if (found := self._coupled.get(index)) is not None:
            coupling, number = found
            coupling.arrays["reference"][number] += by


class _Coupling:
    """One mechanism as struct `Coupling` of mechanics.c."""

    def __init__(self, mechanism: Mechanism, places: list[int], every: Sequence[PlantJoint]) -> None:
        self.places = places
        joints, loads = [every[place] for place in places], mechanism.loads
        motors, size = [joint.motor for joint in joints], len(joints)
        scale = np.array([each.per_rad for each in mechanism.servos])
        matrix: Floats = np.array(mechanism.matrix, dtype=np.float64)
        self.together = coupled_projection(matrix)
        apart = np.eye(size) - self.together
        stiffness = np.array([motor.stall_torque / GIVE_RAD for motor in motors]) / scale**2
        viscous = np.array([motor.viscous_friction for motor in motors]) / scale**2
        references = [each.reference for each in mechanism.servos]
        lines = size + len(loads)
        self.index = np.array(places, dtype=np.int64)
        arrays = {
            "reference": np.array(references) + [joint.recounted for joint in joints],
            "per_rad": scale,
            "rows": np.vstack([np.eye(size), matrix]),
            "stiffness": apart.T @ (stiffness[:, None] * apart),
            "loads": matrix.T @ (np.array([load.inertia for load in loads])[:, None] * matrix),
            "rotors": np.array([motor.inertia for motor in motors]) / scale**2,
            "own_damping": np.array([motor.damping for motor in motors]) / scale**2 + viscous,
            "viscous": viscous,
            "friction": np.array([motor.friction for motor in motors]) / np.abs(scale),
            "load_friction": np.array([motor.load_friction for motor in motors]),
            "stribeck": stribecks(joints),
            "jammed": np.zeros(size),
            "gravity": np.array([load.gravity for load in loads]),
            "down": np.array([load.gravity_angle for load in loads]),
            "steady": np.array([load.steady for load in loads]),
            "joint_friction": np.array([load.friction for load in loads]),
            "braking": np.zeros(size),
            "mass": np.zeros((size, size)),
            "inverse": np.zeros((size, size)),
            "answers": np.zeros((size, lines)),
            "gains": np.zeros((lines, lines)),
            "work": np.zeros(5 * size + 4 * lines),
        }
        self.arrays = {
            name: np.ascontiguousarray(values, dtype=np.float64) for name, values in arrays.items()
        }
        addresses = {name: values.ctypes.data for name, values in self.arrays.items()}
        self.state = STRUCTS["Coupling"](size, len(loads), self.index.ctypes.data, **addresses)


def coupled_projection(matrix: Floats) -> Floats:
    """Return the projection of servo coordinates onto motions in which the servos do not work against each
    other: pinv(M) M."""
    found = np.linalg.pinv(matrix) @ matrix
    return np.where(np.abs(found) < _ROUNDED, 0.0, found)


def coupled_motion(projection: Floats, index: int) -> Floats:
    """Return how far each servo of a mechanism moves per unit of movement of the servo at `index`."""
    moved: Floats = projection[:, index] / projection[index, index]
    return moved
