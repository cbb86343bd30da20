"""Plant: motion of the joints that simulated servos move, with inertia, friction and gravity, all in one
step.

Each servo provides its torque at standstill and the reduction of this torque per rad/s; a plant converts
that into motion. `IndependentJoints` is the plant of joints without coupling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

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
        """Angle of each shaft, rad from the servo's raw 0; always the same array."""

    @property
    def velocity(self) -> Floats:
        """Speed of each shaft, rad/s, counter-clockwise positive; always the same array."""

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
    """Plant of shafts that do not affect each other.

    The velocity is updated first, with implicit damping: stable at any damping and any step. That alone
    would brake less than the motor does, as if dt / 2 of its damping were inertia (7 % for an MX-64).
    Subtracting this from the inertia turns the step into Crank-Nicolson's. Friction is that of `Motor` and
    of `Load`."""

    def __init__(self, joints: Sequence[PlantJoint]) -> None:
        self.angle: Floats = np.array([joint.angle for joint in joints], dtype=np.float64)
        self.velocity: Floats = np.zeros(len(joints))
        self._inertia = np.array([each.motor.inertia + each.load.inertia for each in joints])
        self._own_damping = np.array([each.motor.damping + each.motor.viscous_friction for each in joints])
        self._friction = np.array([each.motor.friction + each.load.friction for each in joints])
        self._load_friction = np.array([each.motor.load_friction for each in joints])
        self._viscous_friction = np.array([each.motor.viscous_friction for each in joints])
        self._gravity = np.array([each.load.gravity for each in joints])
        self._down = np.array([each.load.gravity_angle + each.recounted for each in joints])
        self._turns = np.array([each.load.turns for each in joints])
        self._steady = np.array([each.load.steady for each in joints])
        self._stribeck = Stribecks(joints) if any(each.motor.stribeck for each in joints) else None
        self._free_friction = self._friction.copy()
        self._dt_s = 0.0

    def step_shafts(self, drive: Floats, damping: Floats, dt_s: float) -> None:
        """Advance by `dt_s` with servo torque `drive - damping * velocity` (Nm, Nm s/rad)."""
        if dt_s != self._dt_s:
            self._set_step(dt_s)
        velocity, per_torque = self.velocity, self._per_torque
        pull = np.sin((self.angle - self._down) * self._turns) * self._gravity + self._steady
        # The torque between motor and load, which load friction depends on.
        most = np.abs(drive - damping * velocity + pull) * (self._load_friction * per_torque)
        most += self._friction * per_torque
        if self._stribeck is not None:
            most += self._stribeck.friction(velocity) * per_torque
        free = velocity + (drive - pull) * per_torque  # Velocity without friction and damping
        # Friction removes at most the whole velocity: a joint that it stops stays at rest.
        rubbed = free - np.maximum(np.minimum(free, most), -most)
        velocity[:] = rubbed / (per_torque * damping + self._undamped)
        self.angle += velocity * dt_s

    def jam(self, index: int, on: bool) -> None:
        """Block a shaft at its present angle, or release it."""
        self._friction[index] = JAMMED_NM if on else self._free_friction[index]

    def place_shaft(self, index: int, angle: float) -> None:
        """Move a resting shaft to an angle, rad, at once."""
        self.angle[index] = angle
        self.velocity[index] = 0.0

    def shift_angle(self, index: int, by: float) -> None:
        """Add `by`, rad, to the angle count of a resting shaft, which does not move."""
        self.angle[index] += by
        self._down[index] += by

    def _set_step(self, dt_s: float) -> None:
        self._dt_s = dt_s
        # At least half: the correction does not improve a step as long as the motor's time constant.
        inertia = np.maximum(self._inertia - self._own_damping * dt_s / 2, self._inertia / 2)
        self._per_torque: Floats = dt_s / inertia
        self._undamped: Floats = 1.0 + self._viscous_friction * self._per_torque


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


class Stribecks:
    """Additional friction near standstill (Stribeck effect) of several joints at once."""

    def __init__(self, joints: Sequence[PlantJoint]) -> None:
        parts = [joint.motor.stribeck or Stribeck(0.0, 1.0) for joint in joints]
        self._most = np.array([part.friction for part in parts])
        self._speed = np.array([part.velocity for part in parts])
        self._exponent = np.array([part.exponent for part in parts])

    def friction(self, velocity: Floats) -> Floats:
        """Return the additional friction of each joint, Nm, at its velocity, rad/s."""
        friction: Floats = self._most * np.exp(-((np.abs(velocity) / self._speed) ** self._exponent))
        return friction
