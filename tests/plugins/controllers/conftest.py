"""A stage for one controller: its context, without loop and manager."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from dxlrun import Commands, Context, Controller, JointLimits, States


@dataclass
class Stage:
    """Plays the manager; `follow` makes the servos be where they were last commanded."""

    type: type[Controller[Any]]
    parameters: dict[str, object]
    present: tuple[float, ...] = (0.3, -0.2)
    speed: float = np.nan
    said: list[str] = field(default_factory=list)
    published: int = 0

    def __post_init__(self) -> None:
        self.model = self.type.Parameters.model_validate(self.parameters)
        self.controller = self.type(self.model)
        joints = tuple(self.parameters.get("joints", ("a", "b")))
        count = len(joints)
        free = np.full(count, np.nan)
        self.context = Context(
            name="tested",
            joints=joints,
            period_ns=20_000_000,
            limits=JointLimits(free, free, np.full(count, self.speed), free),
            states=States.empty(count),
            goals=Commands.empty(count),
            commands=Commands.empty(count),
            say=self.said.append,
            publish=self._publish,
        )
        self.context.states.position[:] = self.present[:count]
        self.context.states.valid[:] = True
        self.context.goals.position[:] = self.present[:count]
        self.controller.on_configure(self.context)

    def _publish(self) -> None:
        self.published += 1

    def prepare(self, kind: str, **command: object) -> np.ndarray:
        model = self.type.Commands[kind].model_validate(command)
        return self.type.prepare(kind, model, self.model)

    def send(self, at_s: float, kind: str, **command: object) -> None:
        self.controller.on_command(kind, self.prepare(kind, **command), round(at_s * 1e9))

    def update(self, at_s: float, *, follow: bool = True) -> np.ndarray:
        self.controller.update(round(at_s * 1e9), 20_000_000)
        commands = self.context.commands
        if follow:
            self.context.states.position[:] = commands.position
        self.context.goals.position[:] = commands.position
        self.context.goals.velocity[:] = commands.velocity
        return commands.position.copy()


@pytest.fixture(scope="session")
def stage() -> type[Stage]:
    return Stage
