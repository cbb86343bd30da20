"""A stage for one controller: its context, without loop and manager."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import pytest

from dxlrun import Commands, Context, Controller, JointLimits, MotorModel, Outcome, ServoModel, States


@dataclass
class StagedGoal:
    """A goal as the runtime hands it over; keeps what its controller reports."""

    number: int
    kind: str
    progress: list[tuple[float, float]] = field(default_factory=list)
    ended: list[tuple[Outcome, str, str, float]] = field(default_factory=list)

    def feedback(self, progress: float, error: float = float("nan")) -> None:
        assert not self.ended, "feedback after the end"
        self.progress.append((progress, error))

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = float("nan"),
        joints: Sequence[str] | None = None,
    ) -> None:
        assert not self.ended, f"ended twice: {self.ended} {outcome} {text}"
        self.ended.append((outcome, text, joint, error))


@dataclass
class Stage:
    """Plays the manager; `follow` makes the servos be where they were last commanded.

    `limits`: values by the names of JointLimits, one for all joints or one a joint; NaN where left out.
    """

    type: type[Controller[Any]]
    parameters: dict[str, object]
    present: tuple[float, ...] = (0.3, -0.2)
    speed: float = np.nan
    limits: dict[str, Any] = field(default_factory=dict)
    into: tuple[str, ...] = ()
    motors: tuple[MotorModel | None, ...] = ()
    kept: bytes = b""
    keeps: list[bytes] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)
    servos: tuple[ServoModel | None, ...] = ()
    urdf: str | None = None
    others: tuple[str, ...] = ()
    published: int = 0
    messages: list[tuple[str, object]] = field(default_factory=list)
    goals: list[StagedGoal] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.model = self.type.Parameters.model_validate(self.parameters)
        self.controller = self.type(self.model)
        joints = tuple(self.parameters.get("joints", ("a", "b")))
        count = len(joints)
        limits = {"velocity": self.speed} | self.limits
        rows = {each.name: np.full(count, limits.get(each.name, np.nan)) for each in fields(JointLimits)}
        interfaces = self.type.interfaces(self.model, (*joints, *self.others))
        self.context = Context(
            name="tested",
            joints=joints,
            period_ns=20_000_000,
            limits=JointLimits(**rows),
            states=States.empty(count),
            goals=Commands.empty(count),
            commands=Commands.empty(count),
            say=self.said.append,
            warn=self.warned.append,
            publish=self._publish,
            references=Commands.empty(count),
            reads=np.full(len(interfaces.reads), np.nan),
            read_names=interfaces.reads,
            into=self.into,
            motors=self.motors,
            servos=self.servos,
            urdf=self.urdf,
            provided=np.full(len(interfaces.provides), np.nan),
            kept=self.kept,
            keep=self.keeps.append,
        )
        self.context.states.position[:] = self.present[:count]
        self.context.states.valid[:] = True
        self.context.goals.position[:] = self.present[:count]
        self.controller.on_configure(self.context)

    def _publish(self, topic: str = "", message: object = None) -> None:
        self.published += 1
        if topic:
            assert isinstance(message, self.type.Topics[topic])
            self.messages.append((topic, message))

    @property
    def goal(self) -> StagedGoal:
        """The newest goal."""
        return self.goals[-1]

    def prepare(self, kind: str, **command: object) -> np.ndarray:
        model = self.type.Commands[kind].model_validate(command)
        return self.type.prepare(kind, model, self.model)

    def send(self, at_s: float, kind: str, **command: object) -> None:
        data, time_ns = self.prepare(kind, **command), round(at_s * 1e9)
        if kind not in self.type.Goals:
            self.controller.on_command(kind, data, time_ns)
            return
        if self.goals and not self.goal.ended:
            self.goal.end(Outcome.PREEMPTED)
        self.goals.append(StagedGoal(len(self.goals) + 1, kind))
        self.controller.on_goal(self.goal, data, time_ns)

    def cancel(self, at_s: float) -> None:
        self.controller.on_cancel(self.goal, round(at_s * 1e9))

    def change(self, at_s: float, **values: object) -> None:
        """Change live parameters: the whole value of each name."""
        written = {**self.parameters, **values}
        self.controller.parameters = self.type.Parameters.model_validate(written)
        self.controller.on_parameters(round(at_s * 1e9))

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
