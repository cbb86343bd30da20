"""A stage for one controller: its context, without loop and manager; the test plays the servos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dxlrun import (
    ROTARY,
    Commands,
    Context,
    Controller,
    JointLimits,
    JointUnit,
    MotorModel,
    Outcome,
    ServoModel,
    States,
)
from dxlrun.channels.cycle import Torque
from dxlrun.control.controllers.goal_registry import CurrentCommands, GoalRegistry, RunningGoal
from dxlrun.plan.loop_plan import JointPlan


class Goal(RunningGoal):
    """A goal as the runtime hands it over, and as its judge ends it; keeps what its controller reports."""

    def __init__(self, goals: GoalRegistry, number: int, kind: str) -> None:
        super().__init__(goals, number, "tested", kind, "test")
        self.progresses: list[tuple[float, float]] = []
        """Progress and error"""
        self.judged: Sequence[str] | None = None
        """Joints by which it is judged"""

    def feedback(self, progress: float, error: float = float("nan")) -> None:
        assert (self.outcome, self.is_judged) == (None, False), "feedback after the end"
        self.progresses.append((progress, error))
        super().feedback(progress, error)

    def judge(self, positions: Any = None, *, joints: Sequence[str] | None = None, **more: Any) -> None:
        assert (self.outcome, self.is_judged) == (None, False), "handed over twice"
        self.judged = joints
        super().judge(positions, joints=joints, **more)

    def end(self, outcome: Outcome, text: str = "", *more: Any, **named: Any) -> None:
        assert self.outcome is None, f"ended twice: {self.outcome}, {outcome} {text}"
        super().end(outcome, text, *more, **named)

    @property
    def ended(self) -> list[tuple[Outcome, str, str, float]]:
        """How it ended, once; nothing while it runs."""
        return [] if self.outcome is None else [(self.outcome, self.text, self.joint, self.error)]

    @property
    def steps(self) -> list[float]:
        """The progress that was reported."""
        return [progress for progress, _ in self.progresses]


class _Record:
    """What the judge of goals reads of a cycle."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.states, self.period_ns = stage.context.states, stage.context.period_ns

    @property
    def woken_ns(self) -> int:
        return self._stage.time_ns


@dataclass
class Stage:
    """Plays the manager of a controller whose joints, references and reads are those that it asks for.

    By time: `send`, `update`, `cancel` at so many seconds, where servos are where they were last commanded.
    By cycle: `ask`, `give`, `step`, where the test moves the servos.
    """

    type: type[Controller[Any]]
    parameters: dict[str, Any]
    present: Any = (0.3, -0.2)
    """Where the joints are, rad: one number, or one a joint"""
    limits: dict[str, Any] = field(default_factory=dict)
    """By the names of JointLimits, one for all joints or one a joint"""
    into: tuple[str, ...] = ()
    motors: tuple[MotorModel | None, ...] = ()
    servos: tuple[ServoModel | None, ...] = ()
    wrap: bool = False
    unit: JointUnit = ROTARY
    urdf: str | None = None
    kept: bytes = b""
    others: tuple[str, ...] = ()
    """Joints of the robot beside its own"""
    period_s: float = 0.02
    keeps: list[bytes] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)
    messages: list[tuple[str, Any]] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    takeovers: list[tuple[tuple[str, ...], str]] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)
    time_ns: int = 0

    def __post_init__(self) -> None:
        self.model = self.type.Parameters.model_validate(self.parameters)
        self.controller = self.type(self.model)
        named = tuple(self.parameters.get("joints", ()))
        self.interfaces = self.type.interfaces(self.model, (*(named or ("a", "b")), *self.others))
        joints = self.interfaces.joints
        count = len(joints)
        limits = {"lower": -np.inf, "upper": np.inf} | self.limits
        rows = {each: np.full(count, limits.get(each, np.nan)) for each in JointLimits.__struct_fields__}
        self.context = Context(
            name="tested",
            joints=joints,
            period_ns=round(self.period_s * 1e9),
            limits=JointLimits(**rows),
            states=States.empty(count),
            goals=Commands.empty(count),
            commands=Commands.empty(count),
            say=self.said.append,
            warn=self.warned.append,
            publish=self._publish,
            references=Commands.empty(count),
            reads=np.full(len(self.interfaces.reads), np.nan),
            read_names=self.interfaces.reads,
            into=self.into,
            motors=self.motors,
            servos=self.servos,
            wrap=(self.wrap,) * count,
            units=(self.unit,) * count,
            urdf=self.urdf,
            provided=np.full(len(self.interfaces.provides), np.nan),
            source_commands=np.full(len(self.interfaces.source_commands), np.nan),
            kept=self.kept,
            keep=self.keeps.append,
            take_over=lambda names, why: self.takeovers.append((tuple(names), why)),
            end_run=self.endings.append,
            begin_goal=self._begin_goal,
        )
        self.states, self.commands, self.sent = (
            self.context.states,
            self.context.commands,
            self.context.goals,
        )
        self.states.motion[:] = 0.0
        self.states.position[:] = self.sent.position[:] = np.resize(self.present, count)
        self.states.valid[:], self.states.torque[:] = True, Torque.ON
        events = type("Events", (), {"emit_event": lambda self, *_: None})()
        plans = [JointPlan(joint, -np.inf, np.inf, None, wrap=self.wrap) for joint in joints]
        commanded = CurrentCommands.by_interfaces(joints, self.interfaces.command, self.commands)
        self.judge = GoalRegistry(_Record(self), events, plans, lambda _: commanded)  # type: ignore[arg-type]  # of a record it reads states and times alone
        self.controller.on_configure(self.context)

    def _publish(self, topic: str = "", message: object = None) -> None:
        assert not topic or isinstance(message, self.type.topics(self.model)[topic])
        self.messages.append((topic, message))

    @property
    def goal(self) -> Goal:
        return self.goals[-1]

    def prepare(self, kind: str, **command: object) -> Any:
        return self.type.prepare(kind, self.type.Commands[kind].model_validate(command), self.model)

    def activate(self) -> Stage:
        self.controller.on_activate(self.time_ns)
        return self

    def change(self, at_s: float | None = None, **values: object) -> None:
        """Change live parameters: the whole value of each name."""
        self._at(at_s)
        written = {**self.parameters, **values}
        self.controller.parameters = self.type.Parameters.model_validate(written)
        self.controller.on_parameters(self.time_ns)

    def _at(self, at_s: float | None) -> None:
        self.time_ns = self.judge.time_ns = self.time_ns if at_s is None else round(at_s * 1e9)

    def _judge(self) -> None:
        self.judge.time_ns = self.time_ns
        self.judge.judge_running()

    # By time

    def send(self, at_s: float | None, kind: str, **command: object) -> None:
        """Send a command, or a goal: the one before ends as preempted, as the runtime does it."""
        self._at(at_s)
        data = self.prepare(kind, **command)
        if kind not in self.type.Goals:
            self.controller.on_command(kind, data, self.time_ns)
            return
        self.controller.on_goal(self._begin_goal(kind), data, self.time_ns)

    def _begin_goal(self, kind: str) -> Goal:
        if self.goals and self.goal.outcome is None:
            self.goal.end(Outcome.PREEMPTED)
        self.goals.append(Goal(self.judge, len(self.goals) + 1, kind))
        self.judge.running[self.goal.number] = self.goal
        return self.goal

    def cancel(self, at_s: float | None = None) -> None:
        self._at(at_s)
        judged = self.goal.is_judged
        self.controller.on_cancel(self.goal, self.time_ns)
        if judged:
            self.goal.end(Outcome.CANCELLED, "stopped at the end of the motion")

    def update(self, at_s: float, *, follow: bool = True) -> np.ndarray:
        """Update; return the positions that are commanded, where the servos are then if they follow."""
        self._at(at_s)
        self._judge()
        self.controller.update(self.time_ns, 20_000_000)
        if follow:
            self.states.position[:] = self.commands.position
            self._judge()
        self.sent.values[:2] = self.commands.values[:2]
        return self.commands.position.copy()

    # By cycle

    def ask(self, kind: str, **command: object) -> Goal:
        self.send(None, kind, **command)
        return self.goal

    def give(self, kind: str, **command: object) -> None:
        self.send(None, kind, **command)

    def step(self, periods: float = 1.0) -> None:
        """Update `periods` after the last time; then what was commanded is sent."""
        period_ns = round(periods * self.period_s * 1e9)
        self.time_ns += period_ns
        self._judge()
        self.controller.update(self.time_ns, min(period_ns, 5 * self.context.period_ns))
        np.copyto(self.sent.values, self.commands.values)

    def steps(self, count: int) -> None:
        """Update so many times, a period after another."""
        for _ in range(count):
            self.step()


def standing(controller: type[Controller[Any]], parameters: dict[str, Any], **options: Any) -> Stage:
    """Return a stage whose joints are all at 0, and were sent nothing yet."""
    stage = Stage(controller, parameters, present=0.0, **options)
    stage.sent.values[:] = np.nan
    return stage
