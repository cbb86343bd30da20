"""A robot of a few joints without servos, whose controllers are written in the tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import pytest

from dxlrun.channels.answers import Refusal
from dxlrun.channels.commands import LOOP, Command, QueueInbox
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventCode, Severity
from dxlrun.clock import VirtualClock
from dxlrun.contract.controller import Controller, Interfaces, ParametersModel
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import Offer, PlugIns
from dxlrun.control.gate import Gate
from dxlrun.control.loop import Loop, StopFlag
from dxlrun.description.modes import Mode
from dxlrun.plan.loop_plan import (
    ControllerPlan,
    JointPlan,
    LoopPlan,
    ScheduledCommand,
    SchedulerPlan,
)

PERIOD_NS = 20_000_000


@dataclass
class Events:
    seen: list[tuple[EventCode, Severity, str, str]] = field(default_factory=list)

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        self.seen.append((code, severity, source, text))

    def of(self, code: EventCode) -> list[tuple[str, str]]:
        return [(source, text) for seen, _, source, text in self.seen if seen == code]


class Scripted(Controller[ParametersModel]):
    """Does in each step what the test wants."""

    Parameters = ParametersModel
    act: Callable[[Scripted, str, int, Any], None]

    @classmethod
    def interfaces(cls, parameters: ParametersModel, joints: tuple[str, ...]) -> Interfaces:
        return Interfaces(joints, ("position", "velocity"))

    def on_activate(self, time_ns: int) -> None:
        self.act("activate", time_ns, None)

    def on_command(self, kind: str, data: Any, time_ns: int) -> None:
        self.act("command", time_ns, data)

    def on_deactivate(self, time_ns: int) -> None:
        self.act("deactivate", time_ns, None)

    def update(self, time_ns: int, period_ns: int) -> None:
        self.act("update", time_ns, period_ns)


@dataclass
class Hardware:
    """Servos that are always where they were sent; `work_ns` is how long each read takes."""

    record: CycleRecord
    clock: VirtualClock
    work_ns: Callable[[], int] = lambda: 0
    written: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    keep: bool = True
    asked: list[list[int]] = field(default_factory=list)

    def start(self) -> None:
        self.record.states.position[:] = 0.25
        self.record.states.valid[:] = True
        self.record.states.mode[:] = Mode.POSITION
        self.record.goals.position[:] = self.record.states.position

    def read(self) -> None:
        goal = self.record.goals.position
        np.copyto(self.record.states.position, goal, where=np.isfinite(goal))
        self.clock.wait_until(self.clock.now_ns() + self.work_ns())

    def write(self) -> None:
        if self.keep:
            goals = self.record.goals
            self.written.append((goals.position.copy(), goals.velocity.copy()))

    def idle(self, until_ns: int) -> None:
        pass

    def set_modes(self, modes: np.ndarray) -> None:
        self.asked.append(modes.tolist())
        np.copyto(self.record.states.mode, modes, where=modes != Mode.UNKNOWN)

    def stop(self) -> tuple[str, ...]:
        return ()


@dataclass
class Sink:
    cycles: list[dict[str, Any]] = field(default_factory=list)
    keep: bool = True
    begun: list[int] = field(default_factory=list)

    def wake(self, cycle: int) -> None:
        pass

    def begin(self, record: CycleRecord) -> None:
        self.begun.append(record.cycle)

    def append(self, record: CycleRecord) -> None:
        if self.keep:
            names = ("cycle", "scheduled_ns", "woken_ns", "period_ns", "skipped", "active", "published")
            cycle = {name: getattr(record, name) for name in (*names, "command_count")}
            arrays = {
                "position": record.commands.position,
                "velocity": record.commands.velocity,
                "effort": record.commands.effort,
                "clamped": record.clamped,
                "reference": record.reference,
                "controller_ns": record.controller_ns,
            }
            self.cycles.append(cycle | {name: array.copy() for name, array in arrays.items()})


class Robot:
    """Plan, manager, gate and loop of a robot; controllers are added before `build`."""

    def __init__(self, joints: int = 2, velocity: float | None = None) -> None:
        self.joints = tuple(JointPlan(f"j{row}", -1.0, 1.0, velocity) for row in range(joints))
        self.names = tuple(joint.name for joint in self.joints)
        self.events = Events()
        self.clock = VirtualClock(5_000)
        self.sink = Sink()
        self.stop = StopFlag()
        self.beats = 0
        self.inbox = QueueInbox()
        self.taken: list[Any] = []
        self.patience: list[int] = []
        self._asked = 0
        self._controllers: list[ControllerPlan] = []
        self._offers: dict[str, Offer] = {}
        self.commands: list[ScheduledCommand] = []

    def add(
        self,
        name: str,
        controller: type[Controller[Any]],
        *,
        joints: tuple[str, ...] | None = None,
        command: tuple[str, ...] = ("position", "velocity"),
        active: bool = True,
        every: int = 1,
        rate: float | None = None,
        fallback: str = "",
        parameters: str = "{}",
        into: tuple[str, ...] = (),
        reference: tuple[str, ...] = (),
        reads: tuple[str, ...] = (),
        takeovers: tuple[str, ...] = (),
        provides: tuple[str, ...] = (),
    ) -> None:
        plan = ControllerPlan(
            name=name,
            type=name,
            distribution="tests 1",
            parameters=parameters,
            joints=self.names if joints is None else joints,
            command=command,
            publishes=(),
            active=active,
            every=every,
            rate=rate,
            fallback=fallback,
            into=into,
            reference=reference,
            reads=reads,
            takeovers=takeovers,
            provides=provides,
        )
        self._controllers.append(plan)
        self._offers[name] = Offer(name, controller, "tests 1")

    def script(self, name: str, act: Callable[[Scripted, str, int, Any], None], **options: Any) -> None:
        """Add a controller that calls `act(controller, step, time_ns, period or data)`."""
        self.add(name, type("OneScript", (Scripted,), {"act": act}), **options)

    def send(self, at_ns: int, controller: str, kind: str, *values: float) -> None:
        data = np.array(values, dtype="<f8").tobytes()
        self.commands.append(ScheduledCommand(at_ns, controller, kind, data, "motion.yaml:7:5"))

    def post(self, controller: str, kind: str, data: bytes = b"", lease_ns: int = 0) -> int:
        """Put a command into the inbox; return its number."""
        self._asked += 1
        self.inbox.waiting.append(Command(self._asked, controller, kind, data, "anna", lease_ns))
        return self._asked

    def ask(self, kind: str, **data: Any) -> int:
        """Ask the loop itself for something; return the number."""
        return self.post(LOOP, kind, msgspec.json.encode(data) if data else b"")

    @property
    def refusals(self) -> dict[int, str]:
        """Why commands were refused, by their numbers; empty: they were not."""
        return {
            number: answer.text if isinstance(answer, Refusal) else ""
            for number, answer in self.inbox.answers.items()
        }

    def answer(self, number: int) -> Any:
        """Return the answer to a command; of a refusal its code and its fields."""
        answer = self.inbox.answers[number]
        return (answer.code, answer.fields) if isinstance(answer, Refusal) else answer

    def take(self, command: Any) -> None:
        """Keep what the log gets."""
        self.taken.append(command)

    def build(self, end_ns: int | None = None, activity: Activity | None = None, **plan: Any) -> None:
        self.plan = LoopPlan(
            period_ns=PERIOD_NS,
            scheduler=SchedulerPlan("other", 31, False),
            joints=self.joints,
            controllers=tuple(self._controllers),
            commands=tuple(self.commands),
            end_ns=end_ns,
            **plan,
        )
        self.record = CycleRecord(self.plan.layout)
        self.hardware = Hardware(self.record, self.clock)
        plugins = PlugIns(self._offers, {"broken_one": "plug-in broken_one of x 1 cannot be imported"})
        self.manager = Manager(
            self.plan,
            plugins,
            self.record,
            self.events,
            self.clock,
            set_modes=self.hardware.set_modes,
            activity=activity,
        )
        self.gate = Gate(self.plan, self.record, self.events)
        self.loop = Loop(
            clock=self.clock,
            hardware=self.hardware,
            manager=self.manager,
            gate=self.gate,
            record=self.record,
            sink=self.sink,
            events=self.events,
            plan=self.plan,
            beat=self._beat,
            stop=self.stop,
            inbox=self.inbox,
            commands=self,
            cycle_limit=self.patience.append,
        )
        self.manager.configure()
        self.hardware.start()

    @staticmethod
    def scripted() -> type[Scripted]:
        return Scripted

    def _beat(self) -> None:
        self.beats += 1


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def make_robot() -> type[Robot]:
    return Robot
