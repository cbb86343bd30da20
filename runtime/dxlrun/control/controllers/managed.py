"""Managed controller: state, arrays and method calls of one controller in a run.

                 await                    enter
    INACTIVE ------------> ENTERING ---------------> ACTIVE
        |    enter                                     ^
        '----------------------------------------------'
    leave, fault: from every state back to INACTIVE

The state alone decides whether a controller is updated and whether it holds its claims. `switching.py`
causes the transitions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum, unique
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun.channels.event_records import EventSink, EventText
from dxlrun.channels.heartbeat import ControllerMethod
from dxlrun.contract.controller import Context, Controller, Goal, JointLimits, Outcome
from dxlrun.control import texts
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.changed_registers import ChangedRegisters
from dxlrun.control.controllers.goal_registry import CurrentCommands, RunningGoal
from dxlrun.control.controllers.keeping import StateKeeper
from dxlrun.control.controllers.live_parameters import LiveValues, with_values
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.control.controllers.update_order import Plans, rate_divider
from dxlrun.control.controllers.wiring import Inputs, Outputs, ProvidedStates
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan

PERIOD_CAP = 5
"""Longest period that a controller gets, in nominal periods: a law that integrates would jump otherwise.
The guardian ends a loop that stalls for as long."""


@unique
class State(Enum):
    """State of a controller."""

    INACTIVE = "inactive"
    ENTERING = "entering"
    """The controller holds its claims, and becomes active as soon as its joints are in the required modes."""
    ACTIVE = "active"


@unique
class ControllerEvent(Enum):
    """Event that changes the state of a controller."""

    AWAIT = "a wait for modes"  # Activation requested; its joints must change their modes first
    ENTER = "an entry"  # It took over its joints
    COMMAND = "a command"  # It got a command, or a controller above commands it now
    LEAVE = "leave"  # It was deactivated, or its wait was cancelled
    FAULT = "fault"  # It broke its contract


_OUT = {ControllerEvent.LEAVE: State.INACTIVE, ControllerEvent.FAULT: State.INACTIVE}
TRANSITIONS: Mapping[State, Mapping[ControllerEvent, State]] = MappingProxyType(
    {
        State.INACTIVE: {ControllerEvent.AWAIT: State.ENTERING, ControllerEvent.ENTER: State.ACTIVE, **_OUT},
        State.ENTERING: {ControllerEvent.AWAIT: State.ENTERING, ControllerEvent.ENTER: State.ACTIVE, **_OUT},
        State.ACTIVE: {ControllerEvent.AWAIT: State.ACTIVE, ControllerEvent.COMMAND: State.ACTIVE, **_OUT},
    }
)
"""Next state of a controller by its state and the event. A missing entry is a bug of dxlrun, which ends the
controller with a ControllerFault. Only `activate` and commands can cause one, and their callers handle the
fault."""


class ControllerRequest(NamedTuple):
    """Request of a controller: another one takes over, or the run ends.

    Executed after all updates of the cycle.
    """

    requester: str
    takes_over: tuple[str, ...]
    """Names of the controllers to activate; empty: the run shall end."""
    why: str


class ControllersContext(msgspec.Struct, frozen=True, kw_only=True):
    """Objects that the controllers of one run share, including controllers that are loaded later."""

    run: ControlContext
    plugins: PlugIns
    activity: Activity
    """Publishes which controller's code runs, and refuses threads that it starts."""
    topics: TopicLog
    """Destination of the controllers' messages."""
    keeping: StateKeeper
    registers: ChangedRegisters
    begin_goal: Callable[[str, str], Goal]
    """Begins a goal of the named controller, of a kind, which no client requested."""
    requests: list[ControllerRequest]
    """Takeovers and ends of the run that controllers requested in this cycle; not executed yet."""


class ManagedController:
    """A controller in a run, with its state, its rows of the robot's arrays and its calls.

    Inputs are gathered before an update; commands are checked and merged after it.

    Args:
        plan: The controller's plan.
        place: Index of the controller, which is its bit in the record's masks.
        context: Objects that the controllers share.

    Raises:
        ControllerFault: A reference or an interface in `reads` does not exist.
    """

    def __init__(self, plan: ControllerPlan, place: int, context: ControllersContext) -> None:
        record, joints = context.run.record, context.run.plan.joints
        self.plan = plan
        self.place = place
        self.state = State.INACTIVE
        self.failed = False
        """True after the controller broke its contract."""
        self.held = False
        """True while its joints are held because one that it commands, directly or through others, is lost.
        Updates continue."""
        self.withheld = False
        """True while its commands are not merged, because its command stream ended and it has no `on_hold`.
        Updates continue."""
        self.uppers: tuple[ManagedController, ...] = ()
        """Controllers that can command its references: they do so while active."""
        self.due_cycle = 0
        """Number of the cycle of the next update. If that cycle is skipped, the update happens in the
        following one."""
        self.until_ns = 0
        """Time at which its command stream ends without another command, ns of the run's clock; 0: no stream.
        """
        self.controller: Controller[Any]
        """The controller instance of the plug-in."""
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
        self.provided = ProvidedStates(plan, record) if plan.provides else None
        """States that the controller provides to others; None: it provides none."""
        self._topics = context.topics.of_controller(plan.name, self._bit)
        self._divider = plan.every
        self._nominal_ns = plan.every * context.run.schedule.period_ns
        self._last_ns = -1
        self._set_registers = context.registers.open_setter(plan)
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
            # None of these refers to this object: a reference cycle would never be freed after an unload,
            # because the garbage collector is off.
            say=partial(_emit, run.events, plan.name, texts.controller_says),
            warn=partial(_emit, run.events, plan.name, texts.controller_warns),
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
            begin_goal=partial(self._shared.begin_goal, plan.name),
            set_registers=self._set_registers,
            take_over=partial(_take_over, requests, plan),
            end_run=partial(_end_run, requests, plan),
        )

    # Life

    def configure(self, plans: Plans) -> None:
        """Build and configure the controller. Allocates.

        Args:
            plans: Plans by name, including the controllers below this one.

        Raises:
            PlugInError: The type is not available or its parameters are not valid.
            ControllerFault: The controller raised.
        """
        name, plugins, activity = self.plan.name, self._shared.plugins, self._shared.activity
        activity.name_controller(self.place, name)
        activity.publish_method(self.place, ControllerMethod.INIT)
        try:
            self.controller = plugins.built(self.plan)
        finally:
            activity.publish_method(0, ControllerMethod.NONE)
        topics = self.controller.topics(self.controller.parameters)
        self._topics.open_topics(topics, self.plan.distribution, self.plan.joints)
        if type(self.controller).keeps:
            kept, keep = self._shared.keeping.open_state(self.plan, plans)
            self._context = replace(self._context, kept=kept, keep=keep)
        self._call(ControllerMethod.ON_CONFIGURE, "", self.controller.on_configure, self._context)
        plugins.after_each(f"of controller {name}")

    def on(self, event: ControllerEvent) -> None:
        """Change the controller's state as TRANSITIONS has it for an event.

        An end of activity withdraws its commands. Raises ControllerFault if the state has no transition.
        """
        before, after = self.active, TRANSITIONS[self.state].get(event)
        if after is None:
            text = f"is {self.state.value}; {event.value} is invalid in this state"
            raise ControllerFault(f"controller {self.plan.name} {text}")
        self.state = after
        self.failed |= event is ControllerEvent.FAULT
        if before and self.state is not State.ACTIVE:  # another controller may own the arrays otherwise
            self._outputs.withdraw()
            if self.plan.registers:
                self._set_registers({})
        if self.active:
            self._record.active |= self._bit
        else:
            self.until_ns = 0
            self._record.active &= ~self._bit

    @property
    def active(self) -> bool:
        """True if the controller is updated in cycles: state ACTIVE, not ENTERING."""
        return self.state is State.ACTIVE

    def activate(self, *, restarts: bool = False) -> None:
        """Activate the controller, by on_restart if `restarts`, else by on_activate.

        Raises ControllerFault.
        """
        if restarts:
            self._call_without_commands(ControllerMethod.ON_RESTART, self.controller.on_restart)
        else:
            self._call_without_commands(ControllerMethod.ON_ACTIVATE, self.controller.on_activate)
        self._last_ns = -1
        self.due_cycle = self.until_ns = 0
        self.on(ControllerEvent.ENTER)

    def _call_without_commands(self, method: ControllerMethod, call: Callable[[int], None]) -> None:
        """Clear the controller's commands, gather current states, and call one of its methods.

        Raises ControllerFault.
        """
        self.withheld = False
        self._outputs.reset_commands()
        self._inputs.gather()
        self._call(method, "", call, self._schedule.time_ns)

    def deactivate(self, why: str = "") -> None:
        """Withdraw the controller's commands, abort its goal, and call its on_deactivate.

        Args:
            why: Reason for which its goal is aborted; empty: the deactivation itself.

        Raises:
            ControllerFault: The controller raised. Its joints are released anyway.
        """
        self.release_commands(ControllerEvent.LEAVE, why or f"{self.plan.name} was deactivated")
        on_deactivate, time_ns = self.controller.on_deactivate, self._schedule.time_ns
        self._call(ControllerMethod.ON_DEACTIVATE, "", on_deactivate, time_ns)

    def release_commands(self, event: ControllerEvent, why: str) -> None:
        """Abort the controller's goal, and make it inactive by an event, LEAVE or FAULT.

        Its commands are withdrawn. The gate then holds the last goals of the joints.
        """
        if (goal := self.goal) is not None:
            goal.has_begun = True  # The controller did not refuse the goal.
            goal.end(Outcome.ABORTED, why)
        self.on(event)

    # In a cycle

    def give_command(self, kind: str, data: NDArray[np.float64]) -> None:
        """Pass a command without a lease to the controller's on_command. Raises ControllerFault."""
        self._begin_command()
        if self._inputs.gathered:
            self._inputs.gather()
        on_command, time_ns = self.controller.on_command, self._schedule.time_ns
        self._call(ControllerMethod.ON_COMMAND, kind, on_command, kind, data, time_ns)

    def _begin_command(self) -> None:
        """End the previous command stream; a controller with withheld commands is activated again.

        Withheld commands are outdated: the joints may have moved since. Raises ControllerFault.
        """
        self.on(ControllerEvent.COMMAND)
        self.until_ns = 0
        if self.withheld:
            self._call_without_commands(ControllerMethod.ON_ACTIVATE, self.controller.on_activate)

    @property
    def goal(self) -> RunningGoal | None:
        """Goal of the controller that has not ended; None without one."""
        if self._goal is not None and self._goal.outcome is not None:
            self._goal = None
        return self._goal

    @property
    def commanded(self) -> CurrentCommands:
        """Joints and current commands of the controller, before any limit."""
        return CurrentCommands.by_interfaces(self.plan.joints, self.plan.command, self._outputs.commands)

    def adopt_goal(self, goal: RunningGoal) -> None:
        """Assign a goal that the runtime, not the controller, pursues with plain commands."""
        self._goal = goal

    def begin_goal(self, goal: RunningGoal, data: NDArray[np.float64]) -> None:
        """Pass a new goal to the controller's on_goal.

        The previous goal must have ended. Raises ControllerFault.
        """
        self._goal = goal
        self._begin_command()
        self._inputs.gather()
        on_goal, time_ns = self.controller.on_goal, self._schedule.time_ns
        self._call(ControllerMethod.ON_GOAL, goal.kind, on_goal, goal, data, time_ns)

    def cancel_goal(self, goal: RunningGoal) -> None:
        """Ask the controller, by on_cancel, to end its goal. Raises ControllerFault.

        A goal that the runtime pursues ends at once, and the controller keeps its last command.
        """
        if goal.kind not in self.controller.Goals:
            goal.end(Outcome.CANCELLED)
            return
        goal.cancelling, judged = True, goal.is_judged
        self._inputs.gather()
        on_cancel, time_ns = self.controller.on_cancel, self._schedule.time_ns
        self._call(ControllerMethod.ON_CANCEL, "", on_cancel, goal, time_ns)
        if judged:  # the controller has requested a judgement and does not end it
            goal.end(Outcome.CANCELLED, "stopped at the end of the motion")

    def change_parameters(self, values: LiveValues) -> None:
        """Replace live parameters of the controller in one step, and call its on_parameters.

        Raises:
            ControllerFault: The controller raised.
            ValueError: A name is not that of a live parameter. Nothing is changed.
        """
        self.controller.parameters = with_values(self.controller.parameters, values)
        on_parameters, time_ns = self.controller.on_parameters, self._schedule.time_ns
        self._call(ControllerMethod.ON_PARAMETERS, "", on_parameters, time_ns)

    def hold_joints(self) -> None:
        """Hold the joints after the end of the command stream, and abort the goal. Raises ControllerFault.

        A controller without `on_hold` might keep executing the last command. Its commands are withheld until
        the next one, and the gate holds the joints. Updates continue in both cases.
        """
        if (goal := self.goal) is not None:
            goal.end(Outcome.ABORTED, "the stream of commands ended")
        if type(self.controller).on_hold is Controller.on_hold:
            self.withheld = True
            self._outputs.withdraw()
        else:
            self._call_without_commands(ControllerMethod.ON_HOLD, self.controller.on_hold)

    def follow_upper(self) -> None:
        """End command streams and goals of clients, because a controller above sends the commands now.

        Raises ControllerFault.
        """
        self._begin_command()
        if (goal := self.goal) is not None and not goal.cancelling:
            self.cancel_goal(goal)

    def hold_lost(self, lost: Collection[int], *, below: bool) -> bool:
        """Hold or resume the joints, as a joint of the controller is lost or a controller below it is held.

        Args:
            lost: Rows of the lost joints.
            below: Whether a controller below this one is held.

        Returns:
            True if an active controller was held or resumed.
        """
        commands = not self._outputs.is_empty
        held = commands and (below or any(row in lost for row in self.rows.tolist()))
        changed = held != self.held
        self.held = held
        if held and self.active:  # the next update may be several cycles away
            self._merge()
        return changed and self.active

    def _merge(self) -> None:
        """Write the controller's commands into the robot's arrays, or hold its joints while one is lost.

        A controller with an active commander follows held references, so its own commands continue: a PID law
        keeps the joints in place.
        """
        if self.withheld:
            return
        if self.held and not any(upper.active for upper in self.uppers):
            self._outputs.hold_joints()
        else:
            self._outputs.merge_commands()

    def change_period(self, period_ns: int) -> None:
        """Keep the controller's own rate by updating it every so many cycles of a new period, ns."""
        self._divider = rate_divider(self.plan.rate, period_ns)
        self._nominal_ns = self._divider * period_ns
        self.due_cycle = 0  # the new divider applies from the next cycle

    def update(self, cycle: int) -> None:
        """Call the controller's update for a cycle, then check and merge its commands.

        Raises ControllerFault.
        """
        time_ns = self._schedule.time_ns
        period_ns = self._nominal_ns if self._last_ns < 0 else time_ns - self._last_ns
        self._last_ns = time_ns
        self.due_cycle = (cycle // self._divider + 1) * self._divider
        if self._inputs.gathered:
            self._inputs.gather()
        capped_ns = min(period_ns, PERIOD_CAP * self._nominal_ns)
        self._call(ControllerMethod.UPDATE, "", self.controller.update, time_ns, capped_ns)
        outputs = self._outputs
        # Unchanged commands were checked before. Comparing bytes is cheaper than the check.
        if outputs.own.tobytes() != outputs.taken:
            outputs.check_commands()
        self._merge()
        if self.provided is not None:
            self.provided.publish_states()


def _take_over(
    requests: list[ControllerRequest], plan: ControllerPlan, controllers: Sequence[str], why: str
) -> None:
    """Record a controller's request that others take over.

    Raises ControllerFault for one not in its `takeovers`.
    """
    if other := [name for name in controllers if name not in plan.takeovers]:
        raise ControllerFault(f"requested a takeover by {other[0]}; add {other[0]} to its takeovers")
    if controllers:
        requests.append(ControllerRequest(plan.name, tuple(controllers), why))


def _end_run(requests: list[ControllerRequest], plan: ControllerPlan, why: str) -> None:
    requests.append(ControllerRequest(plan.name, (), why))


def _emit(events: EventSink, controller: str, row: EventText[[str]], text: str) -> None:
    events.emit_event(controller, row(text))


def _row(values: Sequence[float | None]) -> Floats:
    """Return the values as an array, with NaN for None."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
