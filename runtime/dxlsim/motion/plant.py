"""Plant: motion of the joints that simulated servos move, with inertia, friction and gravity, all in one
step.

Each servo provides its torque at standstill and the reduction of this torque per rad/s; a plant converts
that into motion. `IndependentJoints` is the plant of joints without coupling."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlsim.motion.compiled_mechanics import JOINT, STRUCTS, library
from dxlsim.motion.motor import Motor
from dxlsim.motor_model import Stribeck
from dxlsim.simulation_plan import Load

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]


JAMMED_NM = 1e6  # Friction of a blocked joint: more than the torque of any motor


class PlantJoint(msgspec.Struct, frozen=True):
    """Shaft of one servo with its motor and load, as the input of a plant."""

    motor: Motor  # The plant applies its inertia and friction
    load: Load
    angle: float  # rad from the servo's raw 0, at the start
    recounted: float = 0.0  # Shift of its count since it was mounted, rad


class Plant(Protocol):
    """Mechanics of all shafts of a simulation, in the order in which the servos were added."""

    @property
    def angle(self) -> Floats:
        """Angle of each shaft, rad from the servo's raw 0; always the same contiguous array."""

    @property
    def velocity(self) -> Floats:
        """Speed of each shaft, rad/s, counter-clockwise positive; always the same contiguous array."""

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once."""

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, as after a power cycle; the shaft does not
        move."""

    def jam(self, index: int, on: bool) -> None:
        """Block a shaft at its present angle, or release it."""


Part = tuple[Sequence[int], Plant]  # Indices of some servos, and their plant

PlantMaker = Callable[[Sequence[PlantJoint]], Plant]
"""Makes the plant of some shafts. It is called again with all shafts, at their present angles, when a
servo is added later."""


class IndependentJoints:
    """Plant of shafts that do not affect each other, with the friction of `Motor` and of `Load`.

    `mechanics.c` has the step."""

    def __init__(self, joints: Sequence[PlantJoint]) -> None:
        self.angle: Floats = np.array([joint.angle for joint in joints], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(joints))
        self.joints = np.zeros(len(joints), dtype=JOINT)
        """Struct `Joint` of mechanics.c for each shaft."""
        for row, joint in zip(self.joints, joints, strict=True):
            motor, load = joint.motor, joint.load
            row["inertia"] = motor.inertia + load.inertia
            row["damping"] = motor.damping + motor.viscous_friction
            row["friction"] = motor.friction + load.friction
            row["load_friction"], row["viscous_friction"] = motor.load_friction, motor.viscous_friction
            row["gravity"], row["steady"], row["turns"] = load.gravity, load.steady, load.turns
            row["down"] = load.gravity_angle + joint.recounted
        self.joints["stribeck"] = stribecks(joints)
        self.couplings = (STRUCTS["Coupling"] * 0)()
        """Struct `Coupling` of mechanics.c for each mechanism whose servos move joints together."""
        self._free_friction = self.joints["friction"].copy()
        self._step = library().motion_step_joints

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""
        drive, damping = np.ascontiguousarray(drive), np.ascontiguousarray(damping)
        shafts = (each.ctypes.data for each in (self.angle, self.velocity, drive, damping))
        coupled = ctypes.addressof(self.couplings), len(self.couplings)
        self._step(self.joints.ctypes.data, *coupled, *shafts, len(self.joints), dt_s)

    def jam(self, index: int, on: bool) -> None:
        """Block a shaft at its present angle, or release it."""
        self.joints["friction"][index] = JAMMED_NM if on else self._free_friction[index]

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once."""
        self.angle[index] = angle
        self.velocity[index] = 0.0

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, which does not move."""
        self.angle[index] += by
        self.joints["down"][index] += by


class SeveralPlants:
    """Plant composed of plants that do not affect each other, each with some of the servos."""

    def __init__(self, joints: Sequence[PlantJoint], parts: Sequence[Part]) -> None:
        self.angle: Floats = np.array([joint.angle for joint in joints], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(joints))
        self._parts = [(np.array(rows, dtype=np.intp), plant) for rows, plant in parts]
        self._place_of = {
            row: (rows, plant, place)
            for rows, plant in self._parts
            for place, row in enumerate(rows.tolist())
        }

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""
        for rows, plant in self._parts:
            self._hand(rows, plant)
            plant.step_shafts(drive[rows], damping[rows], dt_s)
            self._copy_states(rows, plant)

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once."""
        rows, plant, place = self._place_of[index]
        self._hand(rows, plant)
        plant.place_shaft(place, angle)
        self._copy_states(rows, plant)

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, which does not move."""
        rows, plant, place = self._place_of[index]
        self._hand(rows, plant)
        plant.shift_angle(place, by)
        self._copy_states(rows, plant)

    def jam(self, index: int, on: bool) -> None:
        """Block a shaft at its present angle, or release it."""
        _, plant, place = self._place_of[index]
        plant.jam(place, on)

    def _hand(self, rows: Rows, plant: Plant) -> None:
        """Copy the shafts' state to a plant before its step, because the common arrays may have been
        changed."""
        plant.angle[:] = self.angle[rows]
        plant.velocity[:] = self.velocity[rows]

    def _copy_states(self, rows: Rows, plant: Plant) -> None:
        self.angle[rows] = plant.angle
        self.velocity[rows] = plant.velocity


def combine_plants(joints: Sequence[PlantJoint], parts: Sequence[Part]) -> Plant:
    """Return one plant that consists of these parts, with the shafts in the order of the joints."""
    rows, plant = parts[0]
    return plant if [*rows] == [*range(len(joints))] else SeveralPlants(joints, parts)


def stribecks(joints: Sequence[PlantJoint]) -> Floats:
    """Return the Stribeck friction of each joint, as rows of Nm, rad/s and exponent; 0 Nm: none."""
    parts = [joint.motor.stribeck or Stribeck(0.0, 1.0) for joint in joints]
    rows = [(part.friction, part.velocity, part.exponent) for part in parts]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)
