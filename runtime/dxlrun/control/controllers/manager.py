"""Manager: brings the plan's controllers to life, updates them in turn, ends one that breaks its contract."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dxlrun.clock import Clock
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.claims import conflicts
from dxlrun.control.controllers.context import new_context
from dxlrun.control.controllers.gathering import Gathering
from dxlrun.control.controllers.managed import Managed
from dxlrun.control.controllers.mode_switch import ModeSwitch, SetModes
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.turns import every, fits
from dxlrun.control.loop_plan import ControllerPlan, LoopPlan, ScheduledCommand
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.run.channels.commands import CommandSink, NoCommands, TakenCommand
from dxlrun.run.channels.cycle import MOST_CONTROLLERS, CycleRecord
from dxlrun.run.channels.events import EventCode, EventSink, Severity
from dxlrun.run.channels.heartbeat import Step


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
        set_modes: SetModes | None = None,
        activity: Activity | None = None,
    ) -> None:
        """`set_modes` asks the hardware for other modes of joints; without it they stay as they are.

        `activity` is where the controller is shown whose code runs.
        """
        self.fault: str | None = None
        self._plan = plan
        self._plugins = plugins
        self._record = record
        self._events = events
        self._clock = clock
        self._taken = commands or NoCommands()
        self._activity = activity or Activity()
        self._rows = {joint.name: row for row, joint in enumerate(plan.joints)}
        self._period_ns = plan.period_ns
        self._managed: tuple[Managed, ...] = ()
        self._named: dict[str, Managed] = {}
        self._commands: tuple[tuple[ScheduledCommand, NDArray[np.float64]], ...] = ()
        self._next = 0
        self._streaming = False  # nobody can have a stream of commands
        self._lost: Collection[int] = ()
        self._modes = ModeSwitch(plan.joints, record.states.mode, set_modes)
        self._failed: set[str] = set()

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
        self._named = {managed.plan.name: managed for managed in self._managed}
        self._commands = tuple(
            (command, np.frombuffer(command.data, dtype="<f8")) for command in self._plan.commands
        )

    def activate(self, time_ns: int) -> None:
        """Activate what the plan wants active; states and goals must be fresh. A fault is in `fault`."""
        self._enter([one for one in self._managed if one.plan.active and not one.active], time_ns, "")

    def begin(self) -> None:
        """Begin a cycle, before its states are read: ask for modes; nobody was updated in it yet."""
        self._modes.ask(self._managed)
        self._record.renew()

    def update(self, turn: int, time_ns: int) -> str | None:
        """Hand over the commands that are due and update every active controller whose turn it is.

        `turn` counts the periods since the first deadline, `time_ns` is the controllers' time; pauses are in
        neither. A controller that breaks its contract is ended, its fallback takes over, or its joints are
        held by the gate; the others go on. Returns `fault`.
        """
        now_ns, took_ns = self._clock.now_ns, self._record.controller_ns
        if self._modes.awaited:
            self._admit(time_ns)
        if self._next < len(self._commands):
            self._record.command_count += self._hand_over(time_ns)
        for index, managed in enumerate(self._managed):
            if managed.active and managed.due(turn):
                begin_ns = now_ns()
                try:
                    managed.update(turn, time_ns)
                except ControllerFault as fault:
                    self._end(managed, fault, time_ns)
                if index < len(took_ns):
                    took_ns[index] = now_ns() - begin_ns
        return self.fault

    def hand(  # noqa: PLR0917  a command's parts, as they come
        self,
        controller: str,
        kind: str,
        data: NDArray[np.float64],
        origin: str,
        time_ns: int,
        until_ns: int = 0,
    ) -> str:
        """Hand a prepared command to a controller; return why it was refused, empty when it was taken.

        `until_ns` is when it runs out, ns of the clock, unless another one follows (see `stale`); 0: never.
        The next one of a stream is told by no event.
        """
        managed = self._named.get(controller)
        if managed is None:
            return f"there is no such controller as {controller}"
        if not managed.active:
            waits = managed in self._modes.entering
            return f"{controller} is not active{' yet' if waits else '; switch to it first'}"
        streaming = until_ns and managed.until_ns
        self._streaming = self._streaming or until_ns > 0
        try:
            managed.command(kind, data, time_ns, until_ns)
        except ControllerFault as fault:
            self._end(managed, fault, time_ns)
            return str(fault)
        if not streaming:
            self._tell(EventCode.COMMAND, managed, f"{kind} from {origin}")
        return ""

    def stale(self, now_ns: int) -> list[str]:
        """Return the controllers whose stream of commands has run out, each of them once."""
        if not self._streaming:
            return []
        stale = [managed for managed in self._managed if 0 < managed.until_ns < now_ns]
        for managed in stale:
            managed.until_ns = 0
        self._streaming = any(managed.until_ns for managed in self._managed)
        return [managed.plan.name for managed in stale]

    def hold(self, controller: str) -> None:
        """Withdraw what a controller commands until it gets another command; it stays active."""
        managed = self._named.get(controller)
        if managed is not None and managed.active:
            managed.hold()

    def wait_for(self, lost: Collection[int]) -> tuple[int, ...]:
        """Hold every controller that claims a lost joint, of these rows, as long as it is lost.

        Returns the rows of those that go on again. A controller that is activated meanwhile waits too.
        """
        self._lost = lost
        going: list[int] = []
        for managed in self._managed:
            if not managed.wait_for(lost):
                continue
            text, severity = "goes on: all its joints answer again", Severity.INFO
            if managed.waiting:
                text, severity = "is held until all its joints answer again", Severity.WARNING
            else:
                going += managed.rows.tolist()
            self._events.emit(EventCode.POLICY, severity, managed.plan.name, text)
        return tuple(going)

    def switch(self, activate: Sequence[str], deactivate: Sequence[str], time_ns: int) -> str:
        """Deactivate and activate controllers in one step; return why nothing was done, empty when it was.

        A controller in both lists begins anew. Claims are those of everybody who is active afterwards. Where
        joints must change their mode first, those that leave do so at once, and those that enter do together
        in the first cycle in which all of theirs have (see ModeSwitch); an event tells when they never do.
        """
        return self._switch(activate, deactivate, time_ns, "")

    def _switch(self, activate: Sequence[str], deactivate: Sequence[str], time_ns: int, why: str) -> str:
        active = [one for one in self._managed if one.active]
        if refusal := self._modes.refuse(activate, deactivate, self._named, active):
            return refusal
        for managed in (self._named[name] for name in deactivate):
            leave = self._deactivate if managed.active else self._modes.drop
            leave(managed, time_ns)
        self._enter([self._named[name] for name in activate], time_ns, why)
        return ""

    def _enter(self, wanted: Sequence[Managed], time_ns: int, why: str) -> None:
        """Activate controllers whose claims were checked together, at once or when their modes are there."""
        self._modes.changed()
        if self._modes.ready(wanted):
            self._activate_all(wanted, time_ns)
            return
        self._modes.await_modes(wanted, time_ns, why)
        for managed in wanted:
            self._tell(EventCode.MODE, managed, "waits until its joints are in their modes")

    def _admit(self, time_ns: int) -> None:
        """Activate who waited for modes that are there now; give up who waited too long."""
        ready, late = self._modes.due(time_ns)
        for group in ready:
            self._activate_all(group.entering, time_ns)
        for group in late:
            excuse = self._modes.excuse(group)
            for managed in group.entering:
                name = managed.plan.name
                self._events.emit(
                    EventCode.COMMAND_REFUSED, Severity.WARNING, name, f"{name} is not activated: {excuse}"
                )
            self.fault = self.fault or group.why or None

    def load(self, plan: ControllerPlan) -> str:
        """Configure one more controller, inactive; return why not. Only while the loop is paused."""
        if plan.name in self._named:
            return f"there is a controller {plan.name} already"
        if not fits(plan, self._period_ns):
            return f"its rate {plan.rate:g} Hz does not divide the loop's {1e9 / self._period_ns:g} Hz"
        index = self._free_index()
        if index >= MOST_CONTROLLERS:
            return f"there are {MOST_CONTROLLERS} controllers, which is the most"
        if unknown := [joint for joint in plan.joints if joint not in self._rows]:
            return f"the robot has no joint {', '.join(unknown)}"
        begin_ns = self._clock.now_ns()
        try:
            turns = every(plan, self._period_ns)
            managed = self._configured(index, replace(plan, active=False, every=turns))
        except (ControllerFault, PlugInError) as error:
            return str(error)
        self._failed.discard(plan.name)  # that was another one
        managed.pace(self._period_ns, turns)
        managed.wait_for(self._lost)
        self._managed = (*self._managed[:index], managed, *self._managed[index + 1 :])
        self._named[plan.name] = managed
        self._tell_loaded(managed, "loaded", begin_ns)
        return ""

    def _free_index(self) -> int:
        """Return a place for a controller; those of the plan keep theirs, also when they were unloaded.

        The log shows each controller by its place.
        """
        for index in range(len(self._plan.controllers), len(self._managed)):
            there = self._managed[index]
            if self._named.get(there.plan.name) is not there:  # the name may live on in another place
                return index
        return len(self._managed)

    def unload(self, name: str) -> str:
        """Forget a controller that is not active; return why not. Only while the loop is paused."""
        managed = self._named.get(name)
        if managed is None:
            return f"there is no controller {name}"
        if managed.active or managed in self._modes.entering:
            return f"{name} is active; deactivate it first"
        begin_ns = self._clock.now_ns()
        del self._named[name]
        self._tell_loaded(managed, "unloaded", begin_ns)
        return ""

    def change_period(self, period_ns: int) -> str:
        """Let every controller keep its own rate in another period of the loop; return why that cannot be."""
        for managed in self._named.values():
            if not fits(managed.plan, period_ns):
                return (
                    f"controller {managed.plan.name} runs at {managed.plan.rate:g} Hz, of which "
                    f"{1e9 / period_ns:g} Hz is no multiple"
                )
        self._period_ns = period_ns
        for managed in self._named.values():
            managed.pace(period_ns, every(managed.plan, period_ns))
        return ""

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active controllers, in the order of their updates."""
        return tuple(managed.plan.name for managed in self._managed if managed.active)

    @property
    def plans(self) -> tuple[ControllerPlan, ...]:
        """The plans of all controllers by their places, which are their bits in the record's masks."""
        return tuple(managed.plan for managed in self._managed)

    def deactivate(self, time_ns: int) -> None:
        """Deactivate whoever is active, the last one first; raises nothing, a fault is in `fault`."""
        for managed in reversed(self._managed):
            if managed.active:
                self._deactivate(managed, time_ns)
        self._modes.end()

    def _activate_all(self, wanted: Sequence[Managed], time_ns: int) -> None:
        """Activate controllers whose claims were checked together, then the fallbacks of those that failed:
        a fallback that came first could have a joint that belongs to one of the others."""
        failed: list[tuple[Managed, str]] = []  # no faults, which hold this frame: nobody collects circles
        for managed in wanted:
            try:
                managed.activate(time_ns)
            except ControllerFault as fault:
                self._take_out(managed, fault)
                failed.append((managed, str(fault)))
            else:
                self._record.active |= managed.bit
                self._tell(EventCode.CONTROLLER_ACTIVATED, managed, "active")
        for managed, why in failed:
            self._fall_back(managed, why, time_ns)

    def _deactivate(self, managed: Managed, time_ns: int) -> None:
        self._record.active &= ~managed.bit
        self._modes.changed()
        try:
            managed.deactivate(time_ns)
        except ControllerFault as fault:
            self._take_out(managed, fault)  # nobody takes over from one that was leaving anyway
            self.fault = self.fault or str(fault)
        else:
            self._tell(EventCode.CONTROLLER_DEACTIVATED, managed, "inactive")

    def _hand_over(self, time_ns: int) -> int:
        """Give each command whose time has come to its controller; return how many were taken."""
        taken = 0
        while self._next < len(self._commands) and self._commands[self._next][0].at_ns <= time_ns:
            command, data = self._commands[self._next]
            self._tell_taken(self._next, command)
            self._next += 1
            refusal = self.hand(command.controller, command.kind, data, command.origin, time_ns)
            taken += not refusal
            if refusal:
                text = f"{command.kind} from {command.origin} refused: {refusal}"
                self._events.emit(EventCode.COMMAND_REFUSED, Severity.WARNING, command.controller, text)
        return taken

    def _tell_taken(self, planned: int, command: ScheduledCommand) -> None:
        record = self._record
        self._taken.take(
            TakenCommand(
                record.woken_ns, record.cycle, planned, command.controller, command.kind, command.origin, b""
            )
        )

    def _end(self, managed: Managed, fault: ControllerFault, time_ns: int) -> None:
        """Take a controller that broke its contract out of the robot, say so, let its fallback take over."""
        self._take_out(managed, fault)
        self._fall_back(managed, str(fault), time_ns)

    def _take_out(self, managed: Managed, fault: ControllerFault) -> None:
        managed.release()
        self._record.active &= ~managed.bit
        self._modes.changed()
        text = "\n".join([str(fault), *getattr(fault, "__notes__", ())])
        self._events.emit(EventCode.CONTROLLER_FAULT, Severity.ERROR, managed.plan.name, text)
        self._failed.add(managed.plan.name)

    def _fall_back(self, managed: Managed, why: str, time_ns: int) -> None:
        """Let a fallback take over, but for one that broke its own contract before: two that fall back on
        each other would do so for ever."""
        name = managed.plan.fallback
        if not name or name in self._failed or self._switch((name,), (), time_ns, why):
            self.fault = self.fault or why

    def _tell_loaded(self, managed: Managed, what: str, begin_ns: int) -> None:
        text = f"{what} in {(self._clock.now_ns() - begin_ns) / 1e6:.1f} ms, while the loop stood still"
        self._tell(EventCode.CONTROLLER_LOADED, managed, text)

    def _tell(self, code: EventCode, managed: Managed, text: str) -> None:
        self._events.emit(code, Severity.INFO, managed.plan.name, text)

    def _configured(self, index: int, plan: ControllerPlan) -> Managed:
        self._activity.name_controller(index, plan.name)
        self._activity.begin(index, Step.INIT)
        try:
            controller = self._plugins.built(plan)
        finally:
            self._activity.end()
        rows = np.array([self._rows[joint] for joint in plan.joints], dtype=np.intp)
        joints = [self._plan.joints[row] for row in rows]
        gathering = Gathering(self._record, rows)
        say, publish = self._sayer(plan.name), self._publisher(1 << index)
        context = new_context(plan, joints, gathering, period_ns=self._period_ns, say=say, publish=publish)
        self._activity.begin(index, Step.ON_CONFIGURE)
        try:
            controller.on_configure(context)
        except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
            raise ControllerFault(
                f"controller {plan.name} raised in on_configure: {type(error).__name__}: {error}"
            ) from error
        finally:
            self._activity.end()
        self._plugins.after_each(f"of controller {plan.name}")
        return Managed(
            plan,
            controller,
            context,
            rows,
            self._record,
            gather=gathering.gather,
            place=index,
            activity=self._activity,
        )

    def _sayer(self, name: str) -> Callable[[str], None]:
        def say(text: str) -> None:
            self._events.emit(EventCode.CONTROLLER_SAYS, Severity.INFO, name, text)

        return say

    def _publisher(self, bit: int) -> Callable[[], None]:
        def publish() -> None:
            self._record.published |= bit

        return publish
