"""Managed: one controller of a running robot: its state, its arrays, its calls.

                 await                    enter
    INACTIVE ------------> ENTERING ---------------> ACTIVE
        |    enter                                     ^
        '----------------------------------------------'
    leave, fault: from every state back to INACTIVE

Which controllers are updated, and which have their claims, follows from the state, and is changed nowhere
else; what drives it is `switching.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, unique
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun.channels.events import EventCode, Severity
from dxlrun.channels.heartbeat import ControllerMethod
from dxlrun.contract.controller import Context, Controller, JointLimits, Outcome
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.goals import Commanded, RunningGoal
from dxlrun.control.controllers.graph import Plans, rate_divider
from dxlrun.control.controllers.keeping import Keeping
from dxlrun.control.controllers.live_parameters import LiveValues, with_values
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.controllers.wiring import Inputs, Outputs, Provided
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan

PERIOD_CAP = 5
"""A controller never gets a period longer than this many nominal ones: a law that integrates would jump.
The guardian ends a loop that stops for as long."""


@unique
class State(Enum):
    """What a controller is doing."""

    INACTIVE = "inactive"
    ENTERING = "entering"
    """It has its claims, and is active as soon as its joints are in the modes that it needs."""
    ACTIVE = "active"


@unique
class Event(Enum):
    """What happens to a controller."""

    AWAIT = "a wait for modes"  # It is to be active; joints must change their modes first
    ENTER = "an entry"  # It took its joints over
    COMMAND = "a command"  # It was given a command, or one above it commands it now
    LEAVE = "leave"  # It is deactivated, or need not wait any more
    FAULT = "fault"  # It broke its contract


_OUT = {Event.LEAVE: State.INACTIVE, Event.FAULT: State.INACTIVE}
TRANSITIONS: Mapping[State, Mapping[Event, State]] = MappingProxyType(
    {
        State.INACTIVE: {Event.AWAIT: State.ENTERING, Event.ENTER: State.ACTIVE, **_OUT},
        State.ENTERING: {Event.AWAIT: State.ENTERING, Event.ENTER: State.ACTIVE, **_OUT},
        State.ACTIVE: {Event.AWAIT: State.ACTIVE, Event.COMMAND: State.ACTIVE, **_OUT},
    }
)
"""Every legal transition. Another one is a mistake of this program, which ends the controller: only what is
called where a ControllerFault ends it, `activate` and commands, has events that a state lacks."""


class Request(NamedTuple):
    """What a controller requests of the run in an update; executed behind all updates of the cycle."""

    requester: str
    takes_over: tuple[str, ...]
    """The controllers that are to take over; empty: the run is to end."""
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllersContext:
    """What the controllers of one run share, those that are loaded later too."""

    run: ControlContext
    plugins: PlugIns
    activity: Activity
    """Shows which controller's code runs."""
    topics: TopicLog
    """Takes what they publish."""
    keeping: Keeping
    requests: list[Request]
    """What they request of the run in this cycle."""


class Managed:
    """A controller with its rows of the robot's arrays: gathered before an update, checked and merged after.

    `place` is that of the controller: its bit in the record's masks.
    """

    def __init__(self, plan: ControllerPlan, place: int, context: ControllersContext) -> None:
        """Raises ControllerFault for a reference, or something that it reads, which is not there."""
        record, joints = context.run.record, context.run.plan.joints
        self.plan = plan
        self.place = place
        self.state = State.INACTIVE
        self.failed = False
        """True when it broke its contract."""
        self.held = False
        """True while a joint is lost that it commands, directly or through others. It is updated all the
        same."""
        self.withheld = False
        """True while its commands are kept from the robot: its stream of commands ended, and it has no
        `on_hold`. It is updated all the same."""
        self.uppers: tuple[Managed, ...] = ()
        """Those that command its references while they are active."""
        self.due_cycle = 0
        """The first cycle in which it is updated again; a skipped one is made up for next."""
        self.until_ns = 0
        """When its stream of commands runs out, ns of the clock; 0: there is none."""
        self.controller: Controller[Any]
        """The controller itself."""
        self._bit = 1 << place
        self._goal: RunningGoal | None = None
        rows = {joint.name: row for row, joint in enumerate(joints)}
        self.rows: NDArray[np.intp] = np.array([rows[joint] for joint in plan.joints], dtype=np.intp)
        """Rows of its joints in the robot's arrays."""
        self._record = record
        self._shared = context
        self._schedule = context.run.schedule
        self._call: Callable[..., None] = partial(context.activity.call, place)
        self._inputs = Inputs(plan, record, self.rows)
        self._outputs = Outputs(plan, record, self.rows)
        self.provided = Provided(plan, record) if plan.provides else None
        """The states that it provides; None: it provides none."""
        self._topics = context.topics.of_controller(plan.name, self._bit)
        self._divider = plan.every
        self._nominal_ns = plan.every * context.run.schedule.period_ns
        self._last_ns = -1
        self._context = self._new_context([joints[row] for row in self.rows])

    def _new_context(self, joints: Sequence[JointPlan]) -> Context:
        plan, run, requests = self.plan, self._shared.run, self._shared.requests
        return Context(
            name=plan.name,
            joints=plan.joints,
            period_ns=self._nominal_ns,
            limits=JointLimits(
                lower=_row([joint.lower if joint.bounded else -np.inf for joint in joints]),
                upper=_row([joint.upper if joint.bounded else np.inf for joint in joints]),
                velocity=_row([joint.velocity for joint in joints]),
                effort=_row([joint.effort for joint in joints]),
                acceleration=_row([joint.acceleration for joint in joints]),
            ),
            states=self._inputs.states,
            goals=self._inputs.goals,
            commands=self._outputs.commands,
            # none of them knows this object: a circle would stay when the controller is unloaded
            say=partial(run.events.emit, EventCode.CONTROLLER_SAYS, Severity.INFO, plan.name),
            warn=partial(run.events.emit, EventCode.CONTROLLER_SAYS, Severity.WARNING, plan.name),
            publish=self._topics.publish,
            references=self._inputs.references,
            reads=self._inputs.reads,
            read_names=plan.reads,
            into=plan.into,
            motors=tuple(joint.motor for joint in joints),
            servos=tuple(joint.servo_model for joint in joints),
            wrap=tuple(joint.wrap for joint in joints),
            units=tuple(joint.unit for joint in joints),
            urdf=run.plan.urdf,
            provided=np.zeros(0) if self.provided is None else self.provided.own,
            source_commands=self._outputs.source_commands,
            take_over=partial(_take_over, requests, plan),
            end_run=partial(_end_run, requests, plan),
        )

    # Life

    def configure(self, plans: Plans) -> None:
        """Build and configure the controller; allocates. Raises PlugInError and ControllerFault.

        `plans` has those below it.
        """
        name, plugins, activity = self.plan.name, self._shared.plugins, self._shared.activity
        activity.name_controller(self.place, name)
        activity.show(self.place, ControllerMethod.INIT)
        try:
            self.controller = plugins.built(self.plan)
        finally:
            activity.show(0, ControllerMethod.NONE)
        topics = self.controller.topics(self.controller.parameters)
        self._topics.open(topics, self.plan.distribution, self.plan.joints)
        if type(self.controller).keeps:
            kept, keep = self._shared.keeping.open(self.plan, plans)
            self._context = replace(self._context, kept=kept, keep=keep)
        self._call(ControllerMethod.ON_CONFIGURE, "", self.controller.on_configure, self._context)
        plugins.after_each(f"of controller {name}")

    def on(self, event: Event) -> None:
        """Change the state by an event. Raises ControllerFault for one that the state does not have."""
        before, after = self.active, TRANSITIONS[self.state].get(event)
        if after is None:
            text = f"is {self.state.value}, where {event.value} cannot happen"
            raise ControllerFault(f"controller {self.plan.name} {text}")
        self.state = after
        self.failed |= event is Event.FAULT
        if before and self.state is not State.ACTIVE:  # else the arrays that it claims may be another's
            self._outputs.withdraw()
        if self.active:
            self._record.active |= self._bit
        else:
            self.until_ns = 0
            self._record.active &= ~self._bit

    @property
    def active(self) -> bool:
        """True when it is active."""
        return self.state is State.ACTIVE

    def activate(self, *, restarts: bool = False) -> None:
        """Let the controller take over its joints, or begin again with them. Raises ControllerFault."""
        if restarts:
            self._call_without_commands(ControllerMethod.ON_RESTART, self.controller.on_restart)
        else:
            self._call_without_commands(ControllerMethod.ON_ACTIVATE, self.controller.on_activate)
        self._last_ns = -1
        self.due_cycle = self.until_ns = 0
        self.on(Event.ENTER)

    def _call_without_commands(self, method: ControllerMethod, call: Callable[[int], None]) -> None:
        """Call a method with the current states and no commands. Raises ControllerFault."""
        self.withheld = False
        self._outputs.forget()
        self._inputs.gather()
        self._call(method, "", call, self._schedule.time_ns)

    def deactivate(self, why: str = "") -> None:
        """Let the controller leave its joints. Raises ControllerFault; they are released all the same.

        `why` its goal is aborted; empty: because it is deactivated.
        """
        self.release(Event.LEAVE, why or f"{self.plan.name} was deactivated")
        on_deactivate, time_ns = self.controller.on_deactivate, self._schedule.time_ns
        self._call(ControllerMethod.ON_DEACTIVATE, "", on_deactivate, time_ns)

    def release(self, event: Event, why: str) -> None:
        """Take its commands out of the robot's, by an event after which it has none: the gate holds what it
        last let through. Its goal is aborted for this reason."""
        if (goal := self.goal) is not None:
            goal.end(Outcome.ABORTED, why)
        self.on(event)

    # In a cycle

    def give_command(self, kind: str, data: NDArray[np.float64]) -> None:
        """Hand over a prepared command, which never runs out. Raises ControllerFault."""
        self._begin_command()
        if self._inputs.gathered:
            self._inputs.gather()
        on_command, time_ns = self.controller.on_command, self._schedule.time_ns
        self._call(ControllerMethod.ON_COMMAND, kind, on_command, kind, data, time_ns)

    def _begin_command(self) -> None:
        """End the stream of before; activate the controller again if its commands were withheld, as they are
        of another time. Raises ControllerFault."""
        self.on(Event.COMMAND)
        self.until_ns = 0
        if self.withheld:
            self._call_without_commands(ControllerMethod.ON_ACTIVATE, self.controller.on_activate)

    @property
    def goal(self) -> RunningGoal | None:
        """The goal that it works on."""
        if self._goal is not None and self._goal.outcome is not None:
            self._goal = None
        return self._goal

    @property
    def commanded(self) -> Commanded:
        """The joints that it commands, and what it commands now, before any limit."""
        return Commanded.by_interfaces(self.plan.joints, self.plan.command, self._outputs.commands)

    def adopt(self, goal: RunningGoal) -> None:
        """Have a goal that the runtime leads for it, by plain commands."""
        self._goal = goal

    def begin_goal(self, goal: RunningGoal, data: NDArray[np.float64]) -> None:
        """Hand over a prepared command that is a goal; the one before has ended. Raises ControllerFault."""
        self._goal = goal
        self._begin_command()
        self._inputs.gather()
        on_goal, time_ns = self.controller.on_goal, self._schedule.time_ns
        self._call(ControllerMethod.ON_GOAL, goal.kind, on_goal, goal, data, time_ns)

    def cancel_goal(self, goal: RunningGoal) -> None:
        """Let the controller bring its goal to an end. Raises ControllerFault.

        One that the runtime leads ends at once: the controller keeps what it was given last.
        """
        if goal.kind not in self.controller.Goals:
            goal.end(Outcome.CANCELLED)
            return
        goal.cancelling, judged = True, goal.is_judged
        self._inputs.gather()
        on_cancel, time_ns = self.controller.on_cancel, self._schedule.time_ns
        self._call(ControllerMethod.ON_CANCEL, "", on_cancel, goal, time_ns)
        if judged:  # its controller has handed it over, and does not end it
            goal.end(Outcome.CANCELLED, "stopped at its end")

    def change_parameters(self, values: LiveValues) -> None:
        """Replace live parameters, all of them together. Raises ControllerFault, and ValueError for a name
        that is none of a live one: then nothing is changed."""
        self.controller.parameters = with_values(self.controller.parameters, values)
        on_parameters, time_ns = self.controller.on_parameters, self._schedule.time_ns
        self._call(ControllerMethod.ON_PARAMETERS, "", on_parameters, time_ns)

    def hold_joints(self) -> None:
        """Hold its joints: the stream of commands ended. It is updated all the same. Raises ControllerFault.

        A controller without an `on_hold` of its own may go on with the last command, so its commands are
        withheld until the next one, and the gate holds the joints. A goal would never end: it is aborted.
        """
        if (goal := self.goal) is not None:
            goal.end(Outcome.ABORTED, "the stream of commands ended")
        if type(self.controller).on_hold is Controller.on_hold:
            self.withheld = True
            self._outputs.withdraw()
        else:
            self._call_without_commands(ControllerMethod.ON_HOLD, self.controller.on_hold)

    def follow_upper(self) -> None:
        """End what clients had it do: one above commands its references now. Raises ControllerFault."""
        self._begin_command()
        if (goal := self.goal) is not None and not goal.cancelling:
            self.cancel_goal(goal)

    def hold_lost(self, lost: Collection[int], *, below: bool) -> bool:
        """Hold its joints while it commands a lost one, of these rows, or a controller below it is held.

        Returns whether that changed anything for the robot.
        """
        commands = not self._outputs.is_empty
        held = commands and (below or any(row in lost for row in self.rows.tolist()))
        changed = held != self.held
        self.held = held
        if held and self.active:  # its own rate may be low
            self._merge()
        return changed and self.active

    def _merge(self) -> None:
        """Write its commands into the robot's, or what holds the joints while one of them is lost.

        A controller that is commanded by another one follows references that are held, so its own commands go
        on: a PID law keeps the joints where they are.
        """
        if self.withheld:
            return
        if self.held and not any(upper.active for upper in self.uppers):
            self._outputs.hold()
        else:
            self._outputs.merge()

    def change_period(self, period_ns: int) -> None:
        """Keep its own rate in another period of the loop."""
        self._divider = rate_divider(self.plan.rate, period_ns)
        self._nominal_ns = self._divider * period_ns
        self.due_cycle = 0  # counted anew

    def update(self, cycle: int) -> None:
        """Update and merge its commands into the robot's. Raises ControllerFault."""
        time_ns = self._schedule.time_ns
        period_ns = self._nominal_ns if self._last_ns < 0 else time_ns - self._last_ns
        self._last_ns = time_ns
        self.due_cycle = (cycle // self._divider + 1) * self._divider
        if self._inputs.gathered:
            self._inputs.gather()
        capped_ns = min(period_ns, PERIOD_CAP * self._nominal_ns)
        self._call(ControllerMethod.UPDATE, "", self.controller.update, time_ns, capped_ns)
        outputs = self._outputs
        if outputs.own.tobytes() != outputs.taken:
            outputs.check()
        self._merge()
        if self.provided is not None:
            self.provided.take()


def _take_over(requests: list[Request], plan: ControllerPlan, controllers: Sequence[str], why: str) -> None:
    """Note a takeover. Raises ControllerFault for a controller that is not among `takeovers`."""
    if other := [name for name in controllers if name not in plan.takeovers]:
        raise ControllerFault(f"requested that {other[0]} takes over, which is none of its takeovers")
    if controllers:
        requests.append(Request(plan.name, tuple(controllers), why))


def _end_run(requests: list[Request], plan: ControllerPlan, why: str) -> None:
    requests.append(Request(plan.name, (), why))


def _row(values: Sequence[float | None]) -> Floats:
    """Return the values of the joints; NaN where there is none."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
