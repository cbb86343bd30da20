"""What a JointController takes in a cycle beside the same law of a Controller with `out=` in every step.

    python bench/short_law.py [--updates 20000]

Prints the best of seven rounds, us of update() alone, of a sine of positions and of a spring of efforts.
"""

from __future__ import annotations

import argparse
import math
import sys
import timeit
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.stages import Stage

from dxlrun import Context, Controller, Floats, Interfaces, JointController, ParametersModel
from dxlwire.modes import CommandName


class Joints(ParametersModel):
    """The joints, and the figures of both laws."""

    joints: tuple[str, ...]
    amplitude: float = 0.3
    frequency: float = 0.5
    stiffness: float = 1.5
    damping: float = 0.05


class Sine(Controller[Joints]):
    """A sine, without an array of its own."""

    Parameters = Joints
    command: CommandName = "position"

    @classmethod
    def interfaces(cls, parameters: Joints, joints: tuple[str, ...]) -> Interfaces:
        """Claim its interface."""
        return Interfaces(parameters.joints, (cls.command,))

    def on_configure(self, context: Context) -> None:
        """Make its arrays."""
        super().on_configure(context)
        self.pull, self.brake = np.zeros((2, len(context.joints)))

    def on_activate(self, time_ns: int) -> None:
        """Begin where the joints are."""
        self.begin_ns, self.start = time_ns, self.context.goals.position.copy()

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the sine."""
        keys = self.parameters
        swing = keys.amplitude * math.sin(2 * math.pi * keys.frequency * (time_ns - self.begin_ns) * 1e-9)
        np.add(self.start, swing, out=self.context.commands.position)


class Spring(Sine):
    """A spring with a damper, each step into an array that is there."""

    command = "effort"

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the effort."""
        states, keys = self.context.states, self.parameters
        np.subtract(self.start, states.position, out=self.pull)
        np.multiply(self.pull, keys.stiffness, out=self.pull)
        np.multiply(states.velocity, keys.damping, out=self.brake)
        np.subtract(self.pull, self.brake, out=self.context.commands.effort)


class ShortSine(JointController):
    """The same sine."""

    amplitude: float = 0.3
    frequency: float = 0.5

    def positions(self, time: float, dt: float) -> Floats:
        """Return the sine."""
        return self.start + self.amplitude * np.sin(2 * np.pi * self.frequency * time)


class ShortSpring(JointController):
    """The same spring."""

    stiffness: float = 1.5
    damping: float = 0.05

    def efforts(self, time: float, dt: float) -> Floats:
        """Return the effort."""
        return self.stiffness * (self.start - self.position) - self.damping * self.velocity


def update_us(kind: type[Controller[Joints]] | type[JointController], joints: int, updates: int) -> float:
    """Return how long an update of a controller takes, us."""
    stage = Stage(kind, {"joints": [f"j{number}" for number in range(joints)]}).activate()
    update = stage.controller.update
    for cycle in range(2):
        update(cycle * 10_000_000, 10_000_000)
    rounds = timeit.repeat(lambda: update(20_000_000, 10_000_000), number=updates, repeat=7)
    return min(rounds) / updates * 1e6


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=20_000)
    updates = parser.parse_args().updates
    for joints in (2, 6, 20):
        for plain, short in ((Sine, ShortSine), (Spring, ShortSpring)):
            figures = [update_us(kind, joints, updates) for kind in (plain, short)]
            of = f"{joints:2} joints {plain.__name__:6}"
            print(f"{of} {figures[0]:5.2f} us, JointController {figures[1]:5.2f} us")


if __name__ == "__main__":
    main()
