"""Manager: configure, activate and update the controllers of a robot; end one that breaks its contract."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.clock import Clock
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.claims import conflicts
from dxlrun.control.controllers.controller import Outcome
from dxlrun.control.controllers.goals import Goals, RunningGoal
from dxlrun.control.controllers.graph import update_order
from dxlrun.control.controllers.live_parameters import LiveValues
from dxlrun.control.controllers.managed import Managed, rate_divider, rate_fits
from dxlrun.control.controllers.mode_switch import ModeSwitch, SetModes
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.loop_plan import ControllerPlan, LoopPlan, ScheduledCommand
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.run.channels.answers import Code, CommandOutcome, Field, Refusal, Waiting
from dxlrun.run.channels.commands import CommandSink, NoCommands, TakenCommand
from dxlrun.run.channels.cycle import LIMP, MOST_CONTROLLERS, CycleRecord
from dxlrun.run.channels.events import EventCode, EventSink, Severity


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
        topics: TopicLog | None = None,
    ) -> None:
        """`set_modes` requests other modes of joints from the hardware; without it they stay as they are.

        `activity` shows which controller's code runs, `topics` takes what they publish.
        """
        self.fault: str | None = None
        self._plan = plan
        self._plugins = plugins
        self._record = record
        self._events = events
        self._clock = clock
        self._taken = commands or NoCommands()
        self._activity = activity or Activity()
        self._topics = topics or TopicLog(record)
        self._period_ns = plan.period_ns
        self._managed: tuple[Managed, ...] = ()
        """By their places; those that were unloaded keep theirs until another one gets it."""
        self._order: tuple[tuple[int, Managed], ...] = ()
        """Places and controllers in the order of updates: those above in a chain before those below."""
        self._named: dict[str, Managed] = {}
        """Those that are loaded."""
        self._commands: tuple[tuple[ScheduledCommand, NDArray[np.float64]], ...] = ()
        self._next = 0
        self._lost: Collection[int] = ()
        self._goals = Goals(record, events)
        self._modes = ModeSwitch(plan.joints, record.states.mode, set_modes)
        self.released: set[int] = set()
        """Rows of joints whose torque clients switched off; the states show it a cycle later."""
        self.ended_switches: list[tuple[int, Refusal | None]] = []
        """Switches that waited and have ended: the command's number, and why not; for the loop to answer."""

    def configure(self) -> None:
        """Build and configure every controller, decode every command; allocates, before real time.

        Raises PlugInError (a type is not available, parameters do not fit it) and ControllerFault (one raised
        in on_configure, or two that start active claim one joint).
        """
        clash = conflicts(controller for controller in self._plan.controllers if controller.active)
        if clash:
            raise ControllerFault("; ".join(str(conflict) for conflict in clash))
        self._managed = tuple(
            self._configured(place, controller) for place, controller in enumerate(self._plan.controllers)
        )
        self._named = {managed.plan.name: managed for managed in self._managed}
        self._sort()
        self._commands = tuple(
            (command, np.frombuffer(command.data, dtype="<f8")) for command in self._plan.commands
        )

    def activate(self, time_ns: int) -> None:
        """Activate the controllers that start active; states and goals are fresh. A fault is in `fault`."""
        self._enter([one for one in self._managed if one.plan.active and not one.active], time_ns, None, "")

    def begin(self) -> None:
        """Begin a cycle, before its states are read: request modes."""
        if not self._modes.requested:
            self._modes.request(self._managed)
        self._record.renew()

    def update(self, cycle: int, time_ns: int) -> str | None:
        """Hand over the commands that are due and update every active controller that is due.

        `cycle` counts the periods since the first deadline, `time_ns` is the controllers' time; pauses are in
        neither. A controller that breaks its contract is ended, its fallback takes over, or its joints are
        held by the gate; the others are updated all the same. Returns `fault`.
        """
        now_ns, took_ns = self._clock.now_ns, self._record.controller_ns
        if self._modes.groups:
            self._admit(time_ns)
        if self._next < len(self._commands):
            self._record.command_count += self._hand_over(time_ns)
        for place, managed in self._order:
            if managed.active and managed.due(cycle):
                begin_ns = now_ns()
                try:
                    managed.update(cycle, time_ns)
                except ControllerFault as fault:
                    self._end(managed, fault, time_ns)
                if place < len(took_ns):
                    took_ns[place] = now_ns() - begin_ns
        return self.fault

    def hand(  # noqa: PLR0917  a command's parts, as they come
        self,
        controller: str,
        kind: str,
        data: NDArray[np.float64],
        origin: str,
        time_ns: int,
        until_ns: int = 0,
    ) -> int | Refusal:
        """Hand a prepared command to a controller; return the number of the goal that it is, else 0.

        `until_ns` is when it runs out, ns of the clock, unless another one follows (see `stale`); 0: never.
        Of a stream, only the first one has an event.
        """
        managed = self._named.get(controller)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})
        if not managed.active:
            entering = managed in self._modes.entering
            code = Code.NOT_ACTIVE_YET if entering else Code.NOT_ACTIVE
            return Refusal(code, {"controller": controller})
        if managed.takes_goal(kind):
            if until_ns:
                return Refusal(Code.GOAL_STREAMED, {"controller": controller, "kind": kind})
            return self._begin_goal(managed, kind, data, origin, time_ns)
        streaming = until_ns and managed.until_ns
        try:
            managed.command(kind, data, time_ns, until_ns)
        except ControllerFault as fault:
            self._end(managed, fault, time_ns)
            return _refused_by(managed, str(fault))
        if not streaming:
            self._log(EventCode.COMMAND, managed, f"{kind} from {origin}")
        return 0

    def _begin_goal(
        self, managed: Managed, kind: str, data: NDArray[np.float64], origin: str, time_ns: int
    ) -> int | Refusal:
        if (before := managed.goal) is not None:
            before.end(Outcome.PREEMPTED, f"goal {self._goals.last + 1} took its place")
        goal = self._goals.accept(managed.plan.name, kind, origin)
        try:
            managed.begin_goal(goal, data, time_ns)
        except ControllerFault as fault:
            self._end(managed, fault, time_ns)
            return _refused_by(managed, str(fault))
        return goal.number

    def cancel(self, number: int, controller: str, time_ns: int) -> Refusal | None:
        """Let a controller end a goal, by the goal's number, or the one that a controller has."""
        goal = self._goal_of(controller) if controller else self._goals.found(number)
        if isinstance(goal, Refusal):
            return goal
        if goal.cancelling:
            return Refusal(Code.CANCELLED_ALREADY, {"goal": goal.number, "controller": goal.controller})
        managed = self._named[goal.controller]
        try:
            managed.cancel(goal, time_ns)
        except ControllerFault as fault:
            self._end(managed, fault, time_ns)
            return _refused_by(managed, str(fault))
        return None

    def _goal_of(self, controller: str) -> RunningGoal | Refusal:
        managed = self._named.get(controller)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})
        return managed.goal or Refusal(Code.NO_GOAL, {"controller": controller})

    def change_parameters(self, controller: str, values: LiveValues, time_ns: int) -> Refusal | None:
        """Replace live parameters of a controller, active or not, all of them together."""
        managed = self._named.get(controller)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})
        try:
            managed.change_parameters(values, time_ns)
        except ValueError as error:
            return Refusal(Code.INVALID, {"problem": f"{controller}: {error}"})
        except ControllerFault as fault:
            if managed.active:
                self._end(managed, fault, time_ns)
            else:
                self._take_out(managed, fault)  # it has no joints that a fallback would take over
            return _refused_by(managed, str(fault))
        shown = ", ".join(f"{name} = {value:g}" for name, value in values.items())
        self._log(EventCode.PARAMETERS, managed, shown)
        return None

    def stale(self, now_ns: int) -> list[str]:
        """Return the controllers whose stream of commands has run out, each of them once."""
        stale: list[str] = []
        for managed in self._managed:
            if 0 < managed.until_ns < now_ns:
                managed.until_ns = 0
                stale.append(managed.plan.name)
        return stale

    def hold(self, controller: str) -> None:
        """Withdraw what a controller commands until it gets another command; it stays active."""
        managed = self._named.get(controller)
        if managed is not None and managed.active:
            managed.hold()

    def wait_for(self, lost: Collection[int]) -> tuple[int, ...]:
        """Hold every controller that claims a lost joint, of these rows, as long as it is lost.

        Returns the rows of those that are commanded again. One that is activated meanwhile waits too.
        """
        self._lost = lost
        resumed: list[int] = []
        for managed in self._managed:
            if not managed.wait_for(lost):
                continue
            text, severity = "resumes: all its joints answer again", Severity.INFO
            if managed.waiting:
                text, severity = "is held until all its joints answer again", Severity.WARNING
            else:
                resumed += managed.rows.tolist()
            self._events.emit(EventCode.POLICY, severity, managed.plan.name, text)
        return tuple(resumed)

    def switch(
        self, activate: Sequence[str], deactivate: Sequence[str], time_ns: int, number: int | None = None
    ) -> Refusal | Waiting | None:
        """Deactivate and activate controllers in one step, or refuse all of it; None: it is done.

        A controller in both lists begins anew. Claims are those of all that are active afterwards. Where
        joints must change their mode first, those that leave do so at once, and those that enter do together
        in the first cycle in which all joints have (see ModeSwitch). How that ends is in `ended_switches`,
        under `number`, the command's; None: no command asked for it.
        """
        if refusal := self._refuse(activate, deactivate) or self._refuse_limp(activate):
            return refusal
        for managed in (self._named[name] for name in deactivate):
            if managed.active:
                self._deactivate(managed, time_ns)
            else:
                refusal = Refusal(Code.SWITCHED_AGAIN, {"controller": managed.plan.name})
                self._end_switch(self._modes.drop(managed), refusal)
        return self._enter([self._named[name] for name in activate], time_ns, number, "")

    def commanding(self, joints: Collection[str]) -> tuple[str, ...]:
        """Return the controllers that command one of these joints, directly or through a chain.

        Active ones, and those that wait for modes; upper ends of chains first.
        """
        engaged = [one for one in self._managed if one.active or one in self._modes.entering]
        found = [
            one.plan.name
            for one in engaged
            if one.plan.command and not one.plan.into and not set(joints).isdisjoint(one.plan.joints)
        ]
        for lower in found:  # grows meanwhile
            found += [
                one.plan.name for one in engaged if lower in one.plan.into and one.plan.name not in found
            ]
        return tuple(reversed(found))

    def _refuse_limp(self, activate: Sequence[str]) -> Refusal | None:
        """Refuse controllers for joints without torque: they would command what cannot move."""
        torque = self._record.states.torque
        limp = tuple(
            dict.fromkeys(
                self._plan.joints[row].name
                for managed in (self._named[name] for name in activate)
                if managed.plan.command and not managed.plan.into
                for row in managed.rows.tolist()
                if row in self.released or torque[row] in LIMP
            )
        )
        if not limp:
            return None
        hint = f"`dxlrun torque on {' '.join(limp)}` gives it"
        return Refusal(Code.JOINT_LIMP, {"joint": limp, "hint": hint})

    def _end_switch(self, number: int | None, refusal: Refusal | None) -> None:
        if number is not None:
            self.ended_switches.append((number, refusal))

    def _refuse(self, activate: Sequence[str], deactivate: Sequence[str]) -> Refusal | None:
        active = [managed for managed in self._managed if managed.active]
        return self._modes.refuse(activate, deactivate, self._named, active)

    def _enter(
        self, entering: Sequence[Managed], time_ns: int, number: int | None, why: str
    ) -> Refusal | Waiting | None:
        """Activate controllers whose claims were checked together, at once or when their modes are there.

        `why`: the fault of the controller that these stand in for; empty: they were asked for.
        """
        self._modes.changed()
        if self._modes.ready(entering):
            return self._activate_all(entering, time_ns)
        self._modes.await_modes(entering, time_ns, number, why)
        for managed in entering:
            self._log(EventCode.MODE, managed, "waits until its joints are in their modes")
        return Waiting(tuple(managed.plan.name for managed in entering))

    def _admit(self, time_ns: int) -> None:
        """Activate controllers whose modes are there now; give up those that waited too long."""
        ready, late = self._modes.due(time_ns)
        for group in ready:
            self._end_switch(group.number, self._activate_all(group.entering, time_ns))
        for group in late:
            problem = self._modes.problem(group)
            refusal = Refusal(Code.MODE_NOT_ENTERED, {"controller": group.names, "problem": problem})
            self._end_switch(group.number, refusal)
            for managed in group.entering:
                name = managed.plan.name
                text = f"{name} is not activated: {problem}"
                self._report_refusal(name, text, CommandOutcome("switch", "", refusal))
            self.fault = self.fault or group.why or None

    def load(self, plan: ControllerPlan) -> int | Refusal:
        """Configure one more controller, inactive; return its place. Only while the loop is paused."""
        if plan.name in self._named:
            return Refusal(Code.NAME_TAKEN, {"controller": plan.name})
        if not rate_fits(plan.rate, self._period_ns):
            return _not_divided(plan, self._period_ns)
        place = self._free_place()
        if place >= MOST_CONTROLLERS:
            return Refusal(Code.TOO_MANY_CONTROLLERS, {"most": MOST_CONTROLLERS})
        known = {joint.name for joint in self._plan.joints}
        if unknown := tuple(joint for joint in plan.joints if joint not in known):
            return Refusal(Code.UNKNOWN_JOINT, {"joint": unknown})
        begin_ns = self._clock.now_ns()
        try:
            divider = rate_divider(plan.rate, self._period_ns)
            managed = self._configured(place, replace(plan, active=False, every=divider))
        except (ControllerFault, PlugInError) as error:
            return Refusal(Code.CONTROLLER_FAULT, {"controller": plan.name, "problem": str(error)})
        managed.wait_for(self._lost)
        self._managed = (*self._managed[:place], managed, *self._managed[place + 1 :])
        self._named[plan.name] = managed
        self._sort()
        self._log_loaded(managed, "loaded", begin_ns)
        return place

    def _sort(self) -> None:
        """Put the loaded controllers into the order of updates."""
        places = {
            managed.plan.name: place
            for place, managed in enumerate(self._managed)
            if self._named.get(managed.plan.name) is managed
        }
        order = update_order([self._managed[place].plan for place in places.values()])
        self._order = tuple((places[name], self._managed[places[name]]) for name in order)

    def _free_place(self) -> int:
        """Return a place for a controller; those of the plan keep theirs, also when they were unloaded.

        The log shows each controller by its place.
        """
        for place in range(len(self._plan.controllers), len(self._managed)):
            there = self._managed[place]
            if self._named.get(there.plan.name) is not there:  # the name may be another's by now
                return place
        return len(self._managed)

    def unload(self, name: str) -> Refusal | None:
        """Forget a controller that is not active. Only while the loop is paused."""
        managed = self._named.get(name)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": name})
        if managed.active or managed in self._modes.entering:
            return Refusal(Code.STILL_ACTIVE, {"controller": name})
        begin_ns = self._clock.now_ns()
        del self._named[name]
        self._sort()
        self._log_loaded(managed, "unloaded", begin_ns)
        return None

    def change_period(self, period_ns: int) -> Refusal | None:
        """Let every controller keep its own rate in another period of the loop."""
        for managed in self._named.values():
            if not rate_fits(managed.plan.rate, period_ns):
                return _not_divided(managed.plan, period_ns)
        self._period_ns = period_ns
        for managed in self._named.values():
            managed.change_period(period_ns)
        return None

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active controllers, in the order of their updates."""
        return tuple(managed.plan.name for _, managed in self._order if managed.active)

    @property
    def plans(self) -> tuple[ControllerPlan, ...]:
        """The plans of all controllers by their places, which are their bits in the record's masks."""
        return tuple(managed.plan for managed in self._managed)

    def deactivate(self, time_ns: int) -> None:
        """Deactivate all controllers, the last one first; raises nothing, a fault is in `fault`."""
        for managed in reversed(self._managed):
            if managed.active:
                self._deactivate(managed, time_ns, "the run ended")
        for number in self._modes.end():
            self._end_switch(number, Refusal(Code.RUN_ENDING))

    def _activate_all(self, entering: Sequence[Managed], time_ns: int) -> Refusal | None:
        """Activate controllers whose claims were checked together, then the fallbacks of those that failed:
        a fallback that came first could have a joint that belongs to one of the others.

        Returns the first fault; the other controllers are active all the same.
        """
        # no faults in it, which hold this frame: the collector is off, so such a circle would stay
        failed: list[tuple[Managed, str]] = []
        for managed in entering:
            try:
                managed.activate(time_ns)
            except ControllerFault as fault:
                self._take_out(managed, fault)
                failed.append((managed, str(fault)))
            else:
                self._log(EventCode.CONTROLLER_ACTIVATED, managed, "active")
        for managed, why in failed:
            self._fall_back(managed, why, time_ns)
        return _refused_by(*failed[0]) if failed else None

    def _deactivate(self, managed: Managed, time_ns: int, why: str = "") -> None:
        self._modes.changed()
        try:
            managed.deactivate(time_ns, why)
        except ControllerFault as fault:
            self._take_out(managed, fault)  # without a fallback: it was leaving anyway
            self.fault = self.fault or str(fault)
        else:
            self._log(EventCode.CONTROLLER_DEACTIVATED, managed, "inactive")

    def _hand_over(self, time_ns: int) -> int:
        """Give each command whose time has come to its controller; return how many were taken."""
        taken = 0
        while self._next < len(self._commands) and self._commands[self._next][0].at_ns <= time_ns:
            command, data = self._commands[self._next]
            self._log_taken(self._next, command)
            self._next += 1
            answer = self.hand(command.controller, command.kind, data, command.origin, time_ns)
            if isinstance(answer, Refusal):
                text = f"{command.kind} from {command.origin} refused: {answer.text}"
                outcome = CommandOutcome(command.kind, command.origin, answer)
                self._report_refusal(command.controller, text, outcome)
            else:
                taken += 1
        return taken

    def _report_refusal(self, controller: str, text: str, outcome: CommandOutcome) -> None:
        data = msgspec.json.encode(outcome)
        self._events.emit(EventCode.COMMAND_REFUSED, Severity.WARNING, controller, text, data)

    def _log_taken(self, planned: int, command: ScheduledCommand) -> None:
        record = self._record
        self._taken.take(
            TakenCommand(
                record.woken_ns, record.cycle, planned, command.controller, command.kind, command.origin, b""
            )
        )

    def _end(self, managed: Managed, fault: ControllerFault, time_ns: int) -> None:
        """Take a controller that broke its contract out of the robot, and let its fallback take over."""
        self._take_out(managed, fault)
        self._fall_back(managed, str(fault), time_ns)

    def _take_out(self, managed: Managed, fault: ControllerFault) -> None:
        managed.release(str(fault))
        self._modes.changed()
        text = "\n".join([str(fault), *getattr(fault, "__notes__", ())])
        self._events.emit(EventCode.CONTROLLER_FAULT, Severity.ERROR, managed.plan.name, text)
        managed.failed = True

    def _fall_back(self, managed: Managed, why: str, time_ns: int) -> None:
        """Let a fallback take over, but for one that broke its own contract before: two that fall back on
        each other would do so for ever."""
        fallback = self._named.get(managed.plan.fallback)
        if fallback is None or fallback.failed or self._refuse((fallback.plan.name,), ()):
            self.fault = self.fault or why
        else:
            self._enter([fallback], time_ns, None, why)

    def _log_loaded(self, managed: Managed, what: str, begin_ns: int) -> None:
        text = f"{what} in {(self._clock.now_ns() - begin_ns) / 1e6:.1f} ms, while the loop stood still"
        self._log(EventCode.CONTROLLER_LOADED, managed, text)

    def _log(self, code: EventCode, managed: Managed, text: str) -> None:
        self._events.emit(code, Severity.INFO, managed.plan.name, text)

    def _configured(self, place: int, plan: ControllerPlan) -> Managed:
        managed = Managed(
            plan,
            place,
            joints=self._plan.joints,
            record=self._record,
            events=self._events,
            activity=self._activity,
            period_ns=self._period_ns,
            topics=self._topics,
        )
        managed.configure(self._plugins)
        if managed.has_goals:
            self._goals.open(self._topics)
        return managed


def _refused_by(managed: Managed, problem: str) -> Refusal:
    return Refusal(Code.CONTROLLER_FAULT, {"controller": managed.plan.name, "problem": problem})


def _not_divided(plan: ControllerPlan, period_ns: int) -> Refusal:
    fields: dict[str, Field] = {"controller": plan.name, "controller_rate": plan.rate or 0.0}
    return Refusal(Code.RATE_NOT_DIVIDED, fields | {"rate": 1e9 / period_ns})
