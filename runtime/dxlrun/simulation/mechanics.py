"""All servos of one simulation as mechanics: stepped together on one grid of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dxlrun.simulation.plant import NO_LOAD, Floats, IndependentJoints, Joint, Load, Plant, PlantMaker

__all__ = ["NO_LOAD", "STEP_NS", "Load", "Mechanics", "Motor", "Plant", "PlantMaker"]

STEP_NS = 2_000_000
"""Step of the grid. The fastest thing in a servo here is its motor's time constant of 10 ms."""


@dataclass(frozen=True, slots=True)
class Motor:
    """A servo's motor with its gear, as felt at the shaft, at its nominal voltage."""

    max_speed: float
    """No-load speed, rad/s"""
    stall_torque: float
    """Nm"""
    inertia: float
    """kg m^2 of rotor and gear"""


class Mechanics:
    """Servos that are stepped together; time comes from the callers, and going back is ignored."""

    def __init__(self, start_ns: int, plant: PlantMaker | None = None) -> None:
        self._make_plant: PlantMaker = plant or IndependentJoints
        self._grid_ns = start_ns
        self._joints: list[Joint] = []
        self._drive: Floats = np.zeros(0)
        self._damping: Floats = np.zeros(0)
        self.plant: Plant = self._make_plant(())

    def add(self, motor: Motor, load: Load, angle: float) -> int:
        """Add a servo with its shaft at an angle, rad from its raw 0, at rest; return its index."""
        self._joints = [
            Joint(joint.rotor_inertia, joint.load, float(self.plant.angle[index]))
            for index, joint in enumerate(self._joints)
        ]
        self._joints.append(Joint(motor.inertia, load, angle))
        velocity = self.plant.velocity
        self.plant = self._make_plant(self._joints)
        self.plant.velocity[:-1] = velocity
        self._drive, self._damping = np.zeros(len(self._joints)), np.zeros(len(self._joints))
        return len(self._joints) - 1

    def advance(self, now_ns: int) -> None:
        """Step up to the last point of the grid before a time."""
        while self._grid_ns + STEP_NS <= now_ns:
            self.plant.step(self._drive, self._damping, STEP_NS * 1e-9)
            self._grid_ns += STEP_NS
