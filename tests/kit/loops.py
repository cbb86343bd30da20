"""A robot's loop on virtual time: its controllers are scripts, its servos are where they were sent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import msgspec
import numpy as np
from tests.kit.kept_events import Events

from dxlrun.channels.answers import Refusal
from dxlrun.channels.commands import LOOP, CommandMessage, QueueInbox
from dxlrun.channels.cycle import Clamp, Commands, CycleRecord, Floats
from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.contract.controller import Controller, Interfaces, ParametersModel
from dxlrun.control.context import ControlContext, StopFlag
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugin_loading import Offer, OverrunHook, PlugIns
from dxlrun.control.gate import Gate
from dxlrun.control.loop import ControlLoop
from dxlrun.plan.loop_plan import (
    ControllerPlan,
    JointPlan,
    LoopPlan,
    ScheduledCommand,
    SchedulerPlan,
    ServoLimit,
)
from dxlrun.plan.policy_plan import SLOW_START_NS
from dxlwire.clock import VirtualClock
from dxlwire.modes import Mode

PERIOD_NS = 20_000_000
SCHEDULER = SchedulerPlan("other", 31, False)

Act = Callable[["Scripted", str, int, Any], None]
"""What a controller does: itself, the step ("activate", "update", "command", "deactivate"), time, value."""


def plan_of(name: str, **options: Any) -> ControllerPlan:
    """Return the plan of a controller of j0 and j1 that commands positions."""
    usual = {
        "type": name,
        "distribution": "tests 1",
        "parameters": "{}",
        "joints": ("j0", "j1"),
        "command": ("position",),
        "publishes": (),
        "active": True,
        "every": 1,
    }
    return ControllerPlan(name=name, **usual | options)


def loop_plan(
    joints: Sequence[JointPlan], controllers: Sequence[ControllerPlan] = (), **more: Any
) -> LoopPlan:
    """Return a plan at 50 Hz without an end."""
    usual = {"period_ns": PERIOD_NS, "scheduler": SCHEDULER, "commands": (), "end_ns": None}
    return LoopPlan(joints=tuple(joints), controllers=tuple(controllers), **usual | more)


class Scripted(Controller[ParametersModel]):
    """Does in each step what the test wants."""

    Parameters = ParametersModel
    act: Act

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


def idle(*_: object) -> None:
    """Do nothing."""


def on_update(act: Callable[[Any, int, Any], None]) -> Act:
    """Return what does this in updates: with the context, the time and the period."""
    return lambda self, step, time_ns, value: act(self.context, time_ns, value) if step == "update" else None


def commanding(**values: Any) -> Act:
    """Return what commands these values in each update: `position=0.3`."""

    def act(context: Any, *_: object) -> None:
        for interface, value in values.items():
            getattr(context.commands, interface)[:] = value

    return on_update(act)


@on_update
def following(context: Any, *_: object) -> None:
    """Command the references, and where the joints are where there is none."""
    given = context.references.position
    np.copyto(context.commands.position, np.where(np.isnan(given), context.states.position, given))


@dataclass
class Hardware:
    """Servos that are always where they were sent, and come into other modes."""

    record: CycleRecord
    clock: VirtualClock
    work_ns: Callable[[], int] = lambda: 0
    """How long a read takes"""
    written: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Positions and velocities that were sent"""
    asked: list[list[int]] = field(default_factory=list)
    """Modes that were requested"""
    mode_cycles: Callable[[], int] = lambda: 0
    """How many cycles a joint takes to come into another mode"""
    servo_limits: dict[int, tuple[ServoLimit, ...]] = field(default_factory=dict)
    """Registers that limit the servos, by row of the joint"""
    _coming: dict[int, tuple[int, int]] = field(default_factory=dict)
    _reads: int = 0

    def start(self) -> None:
        states = self.record.states
        states.position[:] = 0.25
        states.valid[:] = True
        states.mode[:] = Mode.POSITION
        self.record.goals.position[:] = states.position

    def read_states(self) -> None:
        for row, (at, mode) in list(self._coming.items()):
            if self._reads >= at:
                self.record.states.mode[row] = mode
                del self._coming[row]
        self._reads += 1
        goal = self.record.goals.position
        np.copyto(self.record.states.position, goal, where=np.isfinite(goal))
        self.clock.wait_until(self.clock.now_ns() + self.work_ns())

    def write_goals(self) -> None:
        goals = self.record.goals
        self.written.append((goals.position.copy(), goals.velocity.copy()))

    def idle(self, until_ns: int, time_ns: int) -> None:
        pass

    def follow_goals(self, rows: Sequence[int]) -> None:
        pass

    def set_modes(self, modes: np.ndarray) -> None:
        self.asked.append(modes.tolist())
        self._coming = {}
        for row in np.flatnonzero(modes).tolist():
            cycles = self.mode_cycles()
            mode = int(modes[row])
            self.record.states.mode[row] = Mode.UNKNOWN if cycles else mode
            if cycles:
                self._coming[row] = (self._reads + cycles, mode)

    def stop(self) -> tuple[str, ...]:
        return ()


@dataclass
class Sink:
    cycles: list[dict[str, Any]] = field(default_factory=list)

    def wake(self, cycle: int) -> None:
        pass

    def append_activation(self, record: CycleRecord) -> None:
        pass

    def append_cycle(self, record: CycleRecord) -> None:
        numbers = "cycle scheduled_ns woken_ns period_ns skipped active published command_count"
        cycle = {name: getattr(record, name) for name in numbers.split()}
        arrays = {name: getattr(record.commands, name) for name in ("position", "velocity", "effort")}
        arrays |= {name: getattr(record, name) for name in ("clamped", "reference", "controller_ns")}
        self.cycles.append(cycle | {name: array.copy() for name, array in arrays.items()})


class Call(NamedTuple):
    """A call of a scripted controller."""

    cycle: int
    name: str
    step: str
    time_ns: int
    value: Any


class Robot:
    """Plan, manager, gate and loop of a robot; controllers are added before `build` or `run`."""

    def __init__(self, joints: int = 2, velocity: float | None = None) -> None:
        self.joints = tuple(JointPlan(f"j{row}", -1.0, 1.0, velocity) for row in range(joints))
        self.names = tuple(joint.name for joint in self.joints)
        self.events, self.clock, self.sink, self.stop = Events(), VirtualClock(5_000), Sink(), StopFlag()
        self.beats = 0
        self.inbox = QueueInbox()
        self.taken: list[Any] = []
        self.patience: list[int] = []
        """How long the guardian is told to let a cycle take, ns"""
        self.periods: list[int] = []
        """Other periods than the plan's, which the clock gets, ns"""
        self.commands: list[ScheduledCommand] = []
        self.calls: list[Call] = []
        self.raises: dict[tuple[str, str], Exception] = {}
        """What a controller raises at its next step of a name: `("arm", "update")`"""
        self.after_each: Callable[[str], None] = idle
        """What is called after foreign code was imported or configured"""
        self.loop: Any = None
        self._asked = 0
        self._controllers: list[ControllerPlan] = []
        self._offers: dict[str, Offer] = {}

    def add(self, name: str, controller: type[Controller[Any]], **options: Any) -> Robot:
        """Add a controller of all joints, or those of `options`."""
        self._controllers.append(plan_of(name, **{"joints": self.names} | options))
        self._offers[name] = Offer(name, controller, "tests 1")
        return self

    def script(self, name: str, act: Act = idle, **options: Any) -> Robot:
        """Add a controller that does this in each step; `calls` has its steps."""

        def recorded(controller: Any, step: str, time_ns: int, value: Any) -> None:
            own = controller.context.name
            self.calls.append(Call(self.record.cycle, own, step, time_ns, value))
            if error := self.raises.pop((own, step), None):
                raise error
            act(controller, step, time_ns, value)

        options.setdefault("command", ("position", "velocity"))
        return self.add(name, type("OneScript", (Scripted,), {"act": recorded}), **options)

    # Requests, now or before a cycle of `run`

    def send(self, at_ns: int, controller: str, kind: str, *values: float) -> None:
        """Plan a command, as a motion file does."""
        data = np.array(values, dtype="<f8").tobytes()
        self.commands.append(ScheduledCommand(at_ns, controller, kind, data, "motion.yaml:7:5"))

    def post(self, controller: str, kind: str, data: bytes | Sequence[float] = b"", lease_ns: int = 0) -> int:
        """Put a command into the inbox; return its number."""
        self._asked += 1
        raw = data if isinstance(data, bytes) else np.array(data, dtype="<f8").tobytes()
        self.inbox.waiting.append(CommandMessage(self._asked, controller, kind, raw, "anna", lease_ns))
        return self._asked

    def ask(self, kind: str, **data: Any) -> int:
        """Ask the loop itself for something; return the number."""
        return self.post(LOOP, kind, msgspec.json.encode(data) if data else b"")

    def asks(self, kind: str, **data: Any) -> Callable[[], int]:
        """Return what asks the loop for something."""
        return partial(self.ask, kind, **data)

    def posts(self, *words: Any) -> Callable[[], int]:
        """Return what puts a command into the inbox."""
        return partial(self.post, *words)

    def switches(self, activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> Callable[[], int]:
        """Return what asks for a switch."""
        return self.asks("switch", activate=list(activate), deactivate=list(deactivate))

    def loads(self, name: str, **options: Any) -> Callable[[], int]:
        """Return what asks to load a controller."""
        return self.asks("load", **msgspec.to_builtins(plan_of(name, **options)))

    def breaks(self, name: str, step: str = "update") -> Callable[[], None]:
        """Return what lets a controller raise at its next step of this name."""
        return lambda: self.raises.update({(name, step): RuntimeError("broken")})

    # Runs

    def build(
        self,
        end_ns: int | None = None,
        overrun_hooks: tuple[OverrunHook, ...] = (),
        **plan: Any,
    ) -> Robot:
        """Configure the controllers, start the hardware."""
        self.plan = loop_plan(
            self.joints, self._controllers, **{"commands": tuple(self.commands), "end_ns": end_ns} | plan
        )
        self.record = CycleRecord(self.plan.layout)
        self.hardware = Hardware(self.record, self.clock)
        context = ControlContext(
            plan=self.plan,
            record=self.record,
            clock=self.clock,
            hardware=self.hardware,
            events=self.events,
            command_log=self,
            inbox=self.inbox,
            supervision=self,
        )
        missing = {"broken_one": "plug-in broken_one of x 1 cannot be imported"}
        plugins = PlugIns(self._offers, missing, after_each=self._after_each)
        self.manager = Manager(context, plugins)
        self.loop = ControlLoop(context, self.manager, self.sink, overrun_hooks=overrun_hooks)
        self.manager.configure()
        self.hardware.start()
        return self

    def run(
        self,
        cycles: int = 0,
        at: Mapping[int, Any] = {},
        work: Mapping[int, float] = {},
        **plan: Any,
    ) -> Any:
        """Run so many cycles, or until the plan's end; return how the loop ended.

        `at`: what is called before a cycle, one thing or a list, by the place of the cycle; `work`: how many
        periods a cycle takes.
        """
        if self.loop is None:
            self.build(**plan)
        place = 0

        def before(*_: int) -> None:
            nonlocal place
            acts = at.get(place, ())
            for act in acts if isinstance(acts, list | tuple) else [acts]:
                act()
            if work:
                periods = work.get(place, 0)
                self.hardware.work_ns = lambda: int(periods * PERIOD_NS)
            place += 1
            if place == cycles:
                self.stop.request()

        self.hardware.idle = before  # type: ignore[method-assign]
        self.result = self.loop.run()
        return self.result

    def wake_late(self, late_ns: Iterable[int]) -> None:
        """Let each wake-up be late by the next of these times, then by none; also one that had to wait for
        nothing."""
        clock, late = self.clock, iter(late_ns)

        class LateClock:
            now_ns = clock.now_ns

            def wait_until(self, deadline_ns: int) -> int:
                return int(clock.wait_until(max(deadline_ns, clock.now_ns()) + next(late, 0)))

        self.loop.clock = LateClock()

    def keep_nothing(self) -> None:
        """Record nothing more: memory is what the test measures."""
        nothing: Any = type("Nothing", (), {"append": idle})()
        self.calls = self.hardware.written = self.taken = nothing
        self.sink.append_cycle = self.events.emit_event = self.inbox.answer_command = idle  # type: ignore[method-assign]

    def record_command(self, command: Any) -> None:
        """Keep what the log gets."""
        self.taken.append(command)

    def beat(self) -> None:
        """Count a cycle that the guardian saw."""
        self.beats += 1

    def limit_cycle(self, limit_ns: int) -> None:
        """Keep what the guardian gets."""
        self.patience.append(limit_ns)

    def set_period(self, period_ns: int) -> None:
        """Keep what the clock gets."""
        self.periods.append(period_ns)

    def _after_each(self, name: str) -> None:
        self.after_each(name)

    # What came of it

    @property
    def refusals(self) -> dict[int, str]:
        """Why commands were refused, by their numbers; empty: they were not."""
        answers = self.inbox.answers.items()
        return {number: one.text if isinstance(one, Refusal) else "" for number, one in answers}

    def answer(self, number: int = 1) -> Any:
        """Return the answer to a command; of a refusal its code and its fields."""
        answer = self.inbox.answers[number]
        return (answer.code, answer.fields) if isinstance(answer, Refusal) else answer

    def active(self, cycle: int) -> list[str]:
        """Return the controllers that were active in the cycle at a place."""
        mask = self.sink.cycles[cycle]["active"]
        return [plan.name for bit, plan in enumerate(self.manager.plans) if mask >> bit & 1]

    def column(self, name: str, row: int | None = None) -> list[Any]:
        """Return something of each cycle's record, of an array one row: `("position", 0)`."""
        values = [cycle[name] for cycle in self.sink.cycles]
        return values if row is None else [float(value[row]) for value in values]

    def steps(self, name: str, step: str = "update") -> list[int]:
        """Return the cycles in which a controller had a step."""
        return [call.cycle for call in self.calls if (call.name, call.step) == (name, step)]

    def times(self, name: str) -> list[int]:
        """Return the times of a controller's updates, ns."""
        return [call.time_ns for call in self.calls if (call.name, call.step) == (name, "update")]

    def order(self, step: str) -> list[str]:
        """Return the controllers in the order in which they had a step."""
        return [call.name for call in self.calls if call.step == step]


class Sent(NamedTuple):
    """What the gate made of the commands for the first joint."""

    position: float
    velocity: float
    effort: float
    pwm: float
    moved: float
    """rad/s, of the goal's step"""
    clamped: Clamp


class GateRig:
    """The gate of joints of -1..1 rad, fed cycle by cycle; controller b is active.

    Events are in `texts`, each with its severity in `severities`.
    """

    def __init__(
        self,
        mode: Mode = Mode.POSITION,
        *,
        start: float = 0.0,
        joints: int = 1,
        eased: bool = True,
        dt_ns: int = PERIOD_NS,
        more: Sequence[JointPlan] = (),
        sources: Sequence[Any] = (),
        accepts: Sequence[EventCode] = (EventCode.GATE,),
        **joint: Any,
    ) -> None:
        """`eased`: the slow second after the start is over; `joint`: keys of JointPlan."""
        limits: dict[str, Any] = {"lower": -1.0, "upper": 1.0, "velocity": None} | joint
        plans = [*(JointPlan(f"j{row}", **limits) for row in range(joints)), *more]
        names = tuple(one.name for one in plans)
        controllers = [plan_of(name, joints=names) for name in "ab"]
        self.dt_ns, self._accepts = dt_ns, accepts
        self.texts: list[str] = []
        self.severities: list[Severity] = []
        self.plan = loop_plan(plans, controllers, period_ns=dt_ns, sources=tuple(sources))
        self.record = CycleRecord(self.plan.layout)
        self.record.active = 0b10
        self.states, self.goals = self.record.states, self.record.goals
        self.states.mode[:] = mode
        self.states.position[:] = start
        if mode in {Mode.POSITION, Mode.EFFORT_POSITION}:
            self.goals.position[:] = start
        self.gate = Gate(self.plan, self.record, self)
        self.gate.initialize_goals()
        if eased:
            self.apply(SLOW_START_NS)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        assert event.code in self._accepts
        self.texts.append(event.text)
        self.severities.append(event.severity)

    def apply(self, dt_ns: int = 0, **commands: Any) -> Sent:
        """Command these values for a cycle; what is not named is not commanded."""
        wanted = Commands.empty(len(self.plan.joints))
        for name, value in commands.items():
            getattr(wanted, name)[:] = value
        before, dt_ns = float(self.goals.position[0]), dt_ns or self.dt_ns
        self.cycle(dt_ns, wanted.values)
        sent = [float(one) for one in self.goals.values[:, 0]]
        moved = (sent[0] - before) / (dt_ns * 1e-9)
        return Sent(*sent, moved, Clamp(int(self.record.clamped[0])))

    def cycle(self, dt_ns: int, commands: Floats) -> None:
        """Command these values, shape (4, joints), for a cycle."""
        self.record.commands.values[:] = commands
        if self.states.mode.tobytes() != self.gate.modes:
            self.gate.enter_modes()
        self.gate.move_goals(dt_ns)
