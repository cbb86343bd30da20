"""A stage for controllers of whole machines, whose joints, references and reads are their own to name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import pytest

from dxlrun import Commands, Context, Controller, JointLimits, Outcome, States


@dataclass
class GoalDouble:
    """A goal that notes what is reported of it."""

    number: int
    kind: str
    progress: list[float] = field(default_factory=list)
    outcome: Outcome | None = None
    text: str = ""
    joint: str = ""
    error: float = np.nan
    joints: Sequence[str] | None = None

    def feedback(self, progress: float, error: float = float("nan")) -> None:
        assert self.outcome is None
        self.progress.append(progress)

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = float("nan"),
        joints: Sequence[str] | None = None,
    ) -> None:
        assert self.outcome is None, "a goal has one result"
        self.outcome, self.text, self.joint, self.error = outcome, text, joint, error
        self.joints = joints


@dataclass
class Mounted:
    """A controller whose manager is played: `step` updates it, and sends what it commands.

    Joints, references and reads are those that the controller asks for.
    """

    type: type[Controller[Any]]
    written: dict[str, object]
    period_s: float = 0.02
    limits: dict[str, float] = field(default_factory=dict)
    into: tuple[str, ...] = ()
    said: list[str] = field(default_factory=list)
    messages: list[tuple[str, Any]] = field(default_factory=list)
    goals: list[GoalDouble] = field(default_factory=list)
    takeovers: list[tuple[tuple[str, ...], str]] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.model = self.type.Parameters.model_validate(self.written)
        self.controller = self.type(self.model)
        self.interfaces = self.type.interfaces(self.model, ())
        count = len(self.interfaces.joints)
        names = [each.name for each in fields(JointLimits)]
        self.context = Context(
            name="tested",
            joints=self.interfaces.joints,
            period_ns=round(self.period_s * 1e9),
            limits=JointLimits(**{name: np.full(count, self.limits.get(name, np.nan)) for name in names}),
            states=States.empty(count),
            goals=Commands.empty(count),
            commands=Commands.empty(count),
            say=self.said.append,
            warn=self.said.append,
            publish=lambda topic="", message=None: self.messages.append((topic, message)),
            references=Commands.empty(count),
            reads=np.full(len(self.interfaces.reads), np.nan),
            into=self.into,
            provided=np.full(len(self.interfaces.provides), np.nan),
            take_over=lambda names, why: self.takeovers.append((tuple(names), why)),
            end_run=self.endings.append,
        )
        self.states, self.commands, self.sent = (
            self.context.states,
            self.context.commands,
            self.context.goals,
        )
        self.states.motion[:] = 0.0
        self.states.valid[:] = True
        self.time_ns = 0
        self.controller.on_configure(self.context)

    def activate(self) -> None:
        self.controller.on_activate(self.time_ns)

    def prepare(self, kind: str, **command: object) -> Any:
        model = self.type.Commands[kind].model_validate(command)
        return self.type.prepare(kind, model, self.model)

    def send(self, kind: str, **command: object) -> None:
        self.controller.on_command(kind, self.prepare(kind, **command), self.time_ns)

    def ask(self, kind: str, **command: object) -> GoalDouble:
        """Send a goal; the one before ends as preempted, as the runtime does it."""
        data = self.prepare(kind, **command)
        if self.goals and self.goals[-1].outcome is None:
            self.goals[-1].end(Outcome.PREEMPTED)
        goal = GoalDouble(len(self.goals) + 1, kind)
        self.goals.append(goal)
        self.controller.on_goal(goal, data, self.time_ns)
        return goal

    def cancel(self) -> None:
        self.controller.on_cancel(self.goals[-1], self.time_ns)

    def step(self, periods: float = 1.0) -> None:
        """Update `periods` after the last time; then what was commanded is sent."""
        period_ns = round(periods * self.period_s * 1e9)
        self.time_ns += period_ns
        self.controller.update(self.time_ns, min(period_ns, 5 * self.context.period_ns))
        np.copyto(self.sent.values, self.commands.values)


@pytest.fixture(scope="session")
def mounted() -> type[Mounted]:
    return Mounted
