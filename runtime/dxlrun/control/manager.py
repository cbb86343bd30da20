"""Manager: brings the plan's controllers to life, updates them in turn, ends one that breaks its contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from dxlrun.clock import Clock
from dxlrun.commands import CommandSink, NoCommands, TakenCommand
from dxlrun.control.claims import conflicts
from dxlrun.control.controller import Context, Controller, JointLimits
from dxlrun.control.loop_plan import ControllerPlan, LoopPlan, ScheduledCommand
from dxlrun.control.managed import Managed
from dxlrun.control.plugins import PlugIns
from dxlrun.cycle import CycleRecord
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.events import EventCode, EventSink, Severity
from dxlrun.interfaces import Commands, States


class Manager:
    """The controllers of a robot; `record` holds the arrays that all of them share.

    `fault` is None, or the sentence of the first controller that broke its contract.
    """

    def __init__(
        self,
        plan: LoopPlan,
        plugins: PlugIns,
        record: CycleRecord,
        events: EventSink,
        clock: Clock,
        *,
        commands: CommandSink | None = None,
    ) -> None:
        self.fault: str | None = None
        self._plan = plan
        self._plugins = plugins
        self._record = record
        self._events = events
        self._clock = clock
        self._taken = commands or NoCommands()
        self._rows = {joint.name: row for row, joint in enumerate(plan.joints)}
        self._managed: tuple[Managed, ...] = ()
        self._commands: tuple[tuple[ScheduledCommand, NDArray[np.float64]], ...] = ()
        self._next = 0

    def configure(self) -> None:
        """Build and configure every controller, decode every command; allocates, before real time.

        Raises PlugInError (a type is not to be had, parameters do not fit it) and ControllerFault (one raised
        in on_configure, or two that start active want one joint).
        """
        clash = conflicts(controller for controller in self._plan.controllers if controller.active)
        if clash:
            raise ControllerFault("; ".join(str(conflict) for conflict in clash))
        self._managed = tuple(
            self._configured(index, controller) for index, controller in enumerate(self._plan.controllers)
        )
        self._commands = tuple(
            (command, np.frombuffer(command.data, dtype="<f8")) for command in self._plan.commands
        )

    def activate(self, time_ns: int) -> None:
        """Activate what the plan wants active; states and goals must be fresh. A fault is in `fault`."""
        for index, managed in enumerate(self._managed):
            if managed.plan.active and not managed.active:
                try:
                    managed.activate(time_ns)
                except ControllerFault as fault:
                    self._end(managed, fault)
                else:
                    self._record.active |= 1 << index
                    self._tell(EventCode.CONTROLLER_ACTIVATED, managed, "active")

    def update(self, time_ns: int) -> str | None:
        """Hand over the commands that are due and update every active controller whose turn it is.

        `time_ns` is the time of this cycle since the loop's first deadline. A controller that breaks its
        contract is ended, its joints are held by the gate, the others go on; returns `fault`.
        """
        record, now_ns = self._record, self._clock.now_ns
        record.published = 0
        record.clamped.fill(0)
        record.controller_ns.fill(0)
        record.command_count = self._hand_over(time_ns)
        number = time_ns // self._plan.period_ns
        for index, managed in enumerate(self._managed):
            if managed.active and managed.due(number):
                begin_ns = now_ns()
                try:
                    managed.update(number, time_ns)
                except ControllerFault as fault:
                    self._end(managed, fault)
                record.controller_ns[index] = now_ns() - begin_ns
        return self.fault

    def deactivate(self, time_ns: int) -> None:
        """Deactivate whoever is active, the last one first; raises nothing, a fault is in `fault`."""
        for index, managed in reversed(tuple(enumerate(self._managed))):
            if managed.active:
                try:
                    managed.deactivate(time_ns)
                except ControllerFault as fault:
                    self._end(managed, fault)
                else:
                    self._record.active &= ~(1 << index)
                    self._tell(EventCode.CONTROLLER_DEACTIVATED, managed, "inactive")

    def _hand_over(self, time_ns: int) -> int:
        """Give each command whose time has come to its controller; return how many were taken."""
        taken = 0
        while self._next < len(self._commands) and self._commands[self._next][0].at_ns <= time_ns:
            command, data = self._commands[self._next]
            self._tell_taken(self._next, command)
            self._next += 1
            taken += self._hand(command, data, time_ns)
        return taken

    def _tell_taken(self, planned: int, command: ScheduledCommand) -> None:
        record = self._record
        self._taken.take(
            TakenCommand(
                record.woken_ns, record.cycle, planned, command.controller, command.kind, command.origin, b""
            )
        )

    def _hand(self, command: ScheduledCommand, data: NDArray[np.float64], time_ns: int) -> bool:
        what = f"{command.kind} from {command.origin}"
        managed = next((one for one in self._managed if one.plan.name == command.controller), None)
        if managed is None or not managed.active:
            why = "there is no such controller" if managed is None else "the controller is not active"
            self._events.emit(
                EventCode.COMMAND_REFUSED, Severity.WARNING, command.controller, f"{what} refused: {why}"
            )
            return False
        try:
            managed.command(command.kind, data, time_ns)
        except ControllerFault as fault:
            self._end(managed, fault)
            return False
        self._tell(EventCode.COMMAND, managed, what)
        return True

    def _end(self, managed: Managed, fault: ControllerFault) -> None:
        """Take a controller that broke its contract out of the robot, and say so."""
        managed.release()
        self._record.active &= ~(1 << self._managed.index(managed))
        self.fault = self.fault or str(fault)
        text = "\n".join([str(fault), *getattr(fault, "__notes__", ())])
        self._events.emit(EventCode.CONTROLLER_FAULT, Severity.ERROR, managed.plan.name, text)

    def _tell(self, code: EventCode, managed: Managed, text: str) -> None:
        self._events.emit(code, Severity.INFO, managed.plan.name, text)

    def _configured(self, index: int, plan: ControllerPlan) -> Managed:
        controller = self._built(plan)
        context = self._context(index, plan)
        try:
            controller.on_configure(context)
        except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
            raise ControllerFault(
                f"controller {plan.name} raised in on_configure: {type(error).__name__}: {error}"
            ) from error
        rows = np.array([self._rows[joint] for joint in plan.joints], dtype=np.intp)
        return Managed(plan, controller, context, rows, self._record)

    def _built(self, plan: ControllerPlan) -> Controller[Any]:
        offer = self._plugins.controllers.get(plan.type)
        if offer is None:
            why = "; ".join(self._plugins.broken.values())
            raise PlugInError(
                f"no plug-in offers the type {plan.type} of controller {plan.name}"
                + (f" ({why})" if why else "")
            )
        try:
            parameters = offer.controller.Parameters.model_validate_json(plan.parameters)
        except ValidationError as error:
            raise PlugInError(f"parameters of controller {plan.name}: {error}") from error
        return offer.controller(parameters)

    def _context(self, index: int, plan: ControllerPlan) -> Context:
        joints = [self._plan.joints[self._rows[joint]] for joint in plan.joints]
        count = len(joints)
        return Context(
            name=plan.name,
            joints=plan.joints,
            period_ns=plan.every * self._plan.period_ns,
            limits=JointLimits(
                lower=np.array([joint.lower for joint in joints], dtype=np.float64),
                upper=np.array([joint.upper for joint in joints], dtype=np.float64),
                velocity=np.array(
                    [np.nan if joint.velocity is None else joint.velocity for joint in joints],
                    dtype=np.float64,
                ),
            ),
            states=States.empty(count),
            goals=Commands.empty(count),
            commands=Commands.empty(count),
            say=self._sayer(plan.name),
            publish=self._publisher(1 << index),
        )

    def _sayer(self, name: str) -> Callable[[str], None]:
        def say(text: str) -> None:
            self._events.emit(EventCode.CONTROLLER_SAYS, Severity.INFO, name, text)

        return say

    def _publisher(self, bit: int) -> Callable[[], None]:
        def publish() -> None:
            self._record.published |= bit

        return publish
