"""Managed: one controller of a running robot: its arrays, its calls, and the rules for its commands."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, ParamSpec

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.cycle import Clamp, Commands, CycleRecord, Floats
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.channels.heartbeat import ControllerMethod
from dxlrun.contract.controller import Context, Controller, JointLimits, Outcome
from dxlrun.control.controllers.activity import Activity, is_interrupt
from dxlrun.control.controllers.claims import Plans
from dxlrun.control.controllers.goals import RunningGoal
from dxlrun.control.controllers.keeping import Keeping
from dxlrun.control.controllers.live_parameters import LiveValues, with_values
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.controllers.wiring import Claim, Inputs, Provided, claims, device_claim
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan

PERIOD_CAP = 5
"""A controller never gets a period longer than this many nominal ones: a law that integrates would jump.
The guardian ends a loop that stops for as long."""

_TRACEBACK = 6000
P = ParamSpec("P")


def rate_fits(rate: float | None, period_ns: int) -> bool:
    """Return whether a controller's own rate can be kept: the loop's is a multiple of it."""
    if rate is None:
        return True
    divider = 1e9 / period_ns / rate if rate > 0 else 0.0
    return math.isfinite(divider) and round(divider) >= 1 and abs(divider - round(divider)) < 1e-6 * divider


def rate_divider(rate: float | None, period_ns: int) -> int:
    """Return every how many cycles a controller is updated; its rate fits."""
    return 1 if rate is None else max(1, round(1e9 / period_ns / rate))


class Requests(msgspec.Struct):
    """What controllers request of the run in a cycle; the manager takes it behind their updates."""

    takeovers: list[tuple[ControllerPlan, tuple[str, ...], str]] = msgspec.field(default_factory=list)
    """The controller that requests, those that are to take over, and why."""
    endings: list[tuple[ControllerPlan, str]] = msgspec.field(default_factory=list)
    """The controller that requests the end of the run, and why."""

    def take_over(self, plan: ControllerPlan, controllers: Sequence[str], why: str) -> None:
        """Note a takeover. Raises ControllerFault for a controller that is not among `takeovers`."""
        if other := [name for name in controllers if name not in plan.takeovers]:
            raise ControllerFault(f"requested that {other[0]} takes over, which is none of its takeovers")
        self.takeovers.append((plan, tuple(controllers), why))

    def end_run(self, plan: ControllerPlan, why: str) -> None:
        """Note that the run is to end."""
        self.endings.append((plan, why))


class Managed:
    """A controller with its rows of the robot's arrays: gathered before an update, checked and merged after.

    `place` is that of the controller: its bit in the record's masks.
    """

    def __init__(
        self,
        plan: ControllerPlan,
        place: int,
        *,
        joints: Sequence[JointPlan],
        record: CycleRecord,
        events: EventSink,
        activity: Activity,
        period_ns: int,
        topics: TopicLog,
        requests: Requests,
        urdf: str | None = None,
    ) -> None:
        """`joints` are all joints of the robot; `period_ns` is the loop's.

        Raises ControllerFault for a reference, or something that it reads, which is not there.
        """
        self.plan = plan
        self.bit = 1 << place
        self.active = False
        self.failed = False
        """True when it broke its contract."""
        self.until_ns = 0
        """When its stream of commands runs out, ns of the clock; 0: there is none."""
        self.waiting = False
        """True while one of the joints that it claims is lost."""
        self._goal: RunningGoal | None = None
        rows = {joint.name: row for row, joint in enumerate(joints)}
        self.rows: NDArray[np.intp] = np.array([rows[joint] for joint in plan.joints], dtype=np.intp)
        """Rows of its joints in the robot's arrays."""
        self._place = place
        self._record = record
        self._activity = activity
        self._controller: Controller[Any]
        self._inputs = Inputs(plan, record, self.rows)
        self.provided = Provided(plan, record) if plan.provides else None
        """The states that it provides; None: it provides none."""
        self._topics = topics.of_controller(plan.name, self.bit)
        self._divider = plan.every
        self._nominal_ns = plan.every * period_ns
        self._requests = requests
        self._context = self._new_context([joints[row] for row in self.rows], events, urdf)
        self._held = False
        self._last_ns = -1
        self._due_cycle = 0
        self._claimed = (
            *claims(plan, self._context.commands, record, self.rows),
            *device_claim(plan, self._context.device_commands, record),
        )

    def _new_context(self, joints: Sequence[JointPlan], events: EventSink, urdf: str | None) -> Context:
        return Context(
            name=self.plan.name,
            joints=self.plan.joints,
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
            commands=Commands.empty(len(joints)),
            # none of them knows this object: a circle would stay when the controller is unloaded
            say=partial(events.emit, EventCode.CONTROLLER_SAYS, Severity.INFO, self.plan.name),
            warn=partial(events.emit, EventCode.CONTROLLER_SAYS, Severity.WARNING, self.plan.name),
            publish=self._topics.publish,
            references=self._inputs.references,
            reads=self._inputs.reads,
            read_names=self.plan.reads,
            into=self.plan.into,
            motors=tuple(joint.motor for joint in joints),
            servos=tuple(joint.servo_model for joint in joints),
            urdf=urdf,
            provided=np.zeros(0) if self.provided is None else self.provided.own,
            device_commands=np.full(len(self.plan.device_commands), np.nan),
            take_over=partial(self._requests.take_over, self.plan),
            end_run=partial(self._requests.end_run, self.plan),
        )

    # Life

    def configure(self, plugins: PlugIns, keeping: Keeping, plans: Plans) -> None:
        """Build and configure the controller; allocates. Raises PlugInError and ControllerFault.

        `plans` has those below it.
        """
        name = self.plan.name
        self._activity.name_controller(self._place, name)
        with self._shown(ControllerMethod.INIT):
            self._controller = plugins.built(self.plan)
        self._topics.open(
            self._controller.topics(self._controller.parameters), self.plan.distribution, self.plan.joints
        )
        if type(self._controller).keeps:
            kept, keep = keeping.open(self.plan, plans)
            self._context = replace(self._context, kept=kept, keep=keep)
        with self._shown(ControllerMethod.ON_CONFIGURE):
            try:
                self._controller.on_configure(self._context)
            except BaseException as error:  # foreign code: one sentence instead of its traceback
                if is_interrupt(error):
                    raise
                raise ControllerFault(
                    f"controller {name} raised in on_configure: {type(error).__name__}: {error}"
                ) from error
        plugins.after_each(f"of controller {name}")

    @contextmanager
    def _shown(self, method: ControllerMethod) -> Iterator[None]:
        self._activity.begin(self._place, method)
        try:
            yield
        finally:
            self._activity.end()

    def activate(self, time_ns: int) -> None:
        """Let the controller take over its joints. Raises ControllerFault."""
        for claim in self._claimed:
            claim.forget()
        self._inputs.gather()
        self._call(ControllerMethod.ON_ACTIVATE, "", self._controller.on_activate, time_ns)
        self._last_ns = -1
        self._due_cycle = 0
        self._held = False
        self.until_ns = 0
        self.active = True
        self._record.active |= self.bit

    def deactivate(self, time_ns: int, why: str = "") -> None:
        """Let the controller leave its joints. Raises ControllerFault; they are released all the same.

        `why` its goal is aborted; empty: because it is deactivated.
        """
        self.release(why or f"{self.plan.name} was deactivated")
        self._call(ControllerMethod.ON_DEACTIVATE, "", self._controller.on_deactivate, time_ns)

    def release(self, why: str) -> None:
        """Take its commands out of the robot's: the gate holds what it last let through.

        Its goal is aborted for this reason.
        """
        if (goal := self.goal) is not None:
            goal.end(Outcome.ABORTED, why)
        if self.active:  # else the arrays that it claims may be another's
            self._withdraw()
        self.active = False
        self._record.active &= ~self.bit
        self.until_ns = 0

    def _withdraw(self) -> None:
        for claim in self._claimed:
            claim.withdraw()

    # In a cycle

    def command(self, kind: str, data: NDArray[np.float64], time_ns: int, until_ns: int = 0) -> None:
        """Hand over a prepared command, which runs out at `until_ns` unless that is 0. Raises
        ControllerFault."""
        self._held = False
        self.until_ns = until_ns
        self._inputs.gather()
        self._call(
            ControllerMethod.ON_COMMAND, f" ({kind})", self._controller.on_command, kind, data, time_ns
        )

    @property
    def controller(self) -> Controller[Any]:
        """The controller itself."""
        return self._controller

    @property
    def goal(self) -> RunningGoal | None:
        """The goal that it works on."""
        if self._goal is not None and self._goal.outcome is not None:
            self._goal = None
        return self._goal

    @property
    def has_goals(self) -> bool:
        """True when some of its commands are goals."""
        return bool(self._controller.Goals)

    def takes_goal(self, kind: str) -> bool:
        """Return whether a command of this name is a goal."""
        return kind in self._controller.Goals

    def adopt(self, goal: RunningGoal) -> None:
        """Have a goal that the runtime leads for it, by plain commands."""
        self._goal = goal

    def begin_goal(self, goal: RunningGoal, data: NDArray[np.float64], time_ns: int) -> None:
        """Hand over a prepared command that is a goal; the one before has ended. Raises ControllerFault."""
        self._held = False
        self.until_ns = 0
        self._goal = goal
        self._inputs.gather()
        on_goal = self._controller.on_goal
        self._call(ControllerMethod.ON_GOAL, f" ({goal.kind})", on_goal, goal, data, time_ns)

    def cancel(self, goal: RunningGoal, time_ns: int) -> None:
        """Let the controller bring its goal to an end. Raises ControllerFault.

        One that the runtime leads ends at once: the controller keeps what it was given last.
        """
        if not self.takes_goal(goal.kind):
            goal.end(Outcome.CANCELLED)
            return
        goal.cancelling = True
        self._inputs.gather()
        self._call(ControllerMethod.ON_CANCEL, "", self._controller.on_cancel, goal, time_ns)

    def change_parameters(self, values: LiveValues, time_ns: int) -> None:
        """Replace live parameters, all of them together. Raises ControllerFault, and ValueError for a name
        that is none of a live one: then nothing is changed."""
        self._controller.parameters = with_values(self._controller.parameters, values)
        self._call(ControllerMethod.ON_PARAMETERS, "", self._controller.on_parameters, time_ns)

    def hold(self) -> None:
        """Take its commands out of the robot's, and update it no more, until the next command.

        A goal that it has still would never end: it is aborted.
        """
        if (goal := self.goal) is not None:
            goal.end(Outcome.ABORTED, "the stream of commands ended")
        self._held = True
        self._withdraw()

    def follow(self, time_ns: int) -> None:
        """End what clients had it do: one above commands its references now. Raises ControllerFault."""
        self._held = False
        self.until_ns = 0
        if (goal := self.goal) is not None and not goal.cancelling:
            self.cancel(goal, time_ns)

    def wait_for(self, lost: Collection[int], below: bool = False) -> bool:
        """Hold its joints as long as one that it claims is lost, of these rows, or one below it waits.

        Returns whether that changed anything for the robot.
        """
        waiting = bool(self._claimed) and (below or any(row in lost for row in self.rows.tolist()))
        changed = waiting != self.waiting
        self.waiting = waiting
        if waiting and self.active:
            self._withdraw()
        return changed and self.active

    def change_period(self, period_ns: int) -> None:
        """Keep its own rate in another period of the loop."""
        self._divider = rate_divider(self.plan.rate, period_ns)
        self._nominal_ns = self._divider * period_ns
        self._due_cycle = 0  # counted anew

    def due(self, cycle: int) -> bool:
        """Return whether the controller is updated in this cycle; a skipped one is made up for next."""
        return cycle >= self._due_cycle and not (self._held or self.waiting)

    def update(self, cycle: int, time_ns: int) -> None:
        """Update and merge its commands into the robot's. Raises ControllerFault."""
        period_ns = self._nominal_ns if self._last_ns < 0 else time_ns - self._last_ns
        self._last_ns = time_ns
        self._due_cycle = (cycle // self._divider + 1) * self._divider
        if self._inputs.gathered:
            self._inputs.gather()
        capped_ns = min(period_ns, PERIOD_CAP * self._nominal_ns)
        self._call(ControllerMethod.UPDATE, "", self._controller.update, time_ns, capped_ns)
        changed: list[Claim] = []
        for claim in self._claimed:
            own, shown = claim.own.tobytes(), claim.shown
            if own == claim.taken and shown is not None and shown.tobytes() == own:
                continue  # checked and merged before, and still there
            changed.append(claim)
            np.isfinite(claim.own, claim.finite)
            if np.count_nonzero(claim.finite) < claim.finite.size:  # a tenth of the time of all()
                self._check(claim)
            elif not claim.all_seen:
                claim.seen.fill(True)
                claim.all_seen = True
        for claim in changed:
            claim.merge()
        if self.provided is not None:
            self.provided.take()

    def _check(self, claim: Claim) -> None:
        """Accept NaN where nothing was commanded yet. Raises ControllerFault for everything else."""
        wrong = ~claim.finite & (claim.seen | np.isinf(claim.own))
        if wrong.any():
            if claim.rows is not None:
                self._record.clamped[claim.rows[wrong]] |= np.uint8(Clamp.NOT_FINITE)
            first = int(np.flatnonzero(wrong)[0])
            after = " after a finite value" if claim.seen[first] else ""
            raise ControllerFault(
                f"controller {self.plan.name} commanded {claim.names[first]} = {claim.own[first]}{after}"
            )
        claim.seen |= claim.finite

    def _call(
        self,
        method: ControllerMethod,
        what: str,
        call: Callable[P, object],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> None:
        """Call a method of the controller. Raises ControllerFault for what it raises and what it starts."""
        self._activity.begin(self._place, method)
        raised: BaseException | None = None
        try:
            call(*arguments, **named)
        except BaseException as error:  # foreign code: it must not take the loop along
            if is_interrupt(error):
                raise
            raised = error
        finally:
            breach = self._activity.end()
        if breach:
            raise self._fault(
                f"{breach} in {method}{what}: while the robot runs that would stop the loop; "
                "start a process in on_configure instead",
                raised,
            ) from raised
        if isinstance(raised, ControllerFault):  # the context refused something, in a sentence of its own
            raise self._fault(str(raised), raised) from raised
        if raised is not None:
            shown = " ".join(f"{type(raised).__name__}: {raised}".split())
            raise self._fault(f"raised in {method}{what}: {shown}", raised) from raised

    def _fault(self, what: str, raised: BaseException | None) -> ControllerFault:
        fault = ControllerFault(f"controller {self.plan.name} {what}")
        if raised is not None:
            fault.add_note("".join(traceback.format_exception(raised))[-_TRACEBACK:])
        return fault


def _row(values: Sequence[float | None]) -> Floats:
    """Return the values of the joints; NaN where there is none."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
