"""Manager: configure, activate and update the controllers of a robot; end one that breaks its contract."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.answers import MOST_NAMED, Code, CommandOutcome, Field, Refusal, Waiting
from dxlrun.channels.commands import CommandSink, NoCommands, TakenCommand
from dxlrun.channels.cycle import LIMP, MOST_CONTROLLERS, CycleRecord
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.channels.kept import KeptStates
from dxlrun.clock import Clock
from dxlrun.contract.controller import Controller, Outcome
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.claims import Plans, conflicts, parted_couplings
from dxlrun.control.controllers.goals import Goals, PlayedMotion, PlayedPart, RunningGoal
from dxlrun.control.controllers.graph import commander, update_order
from dxlrun.control.controllers.keeping import Keeping
from dxlrun.control.controllers.live_parameters import LiveValues
from dxlrun.control.controllers.managed import Managed, Requests, rate_divider, rate_fits
from dxlrun.control.controllers.mode_switch import ModeSwitch, SetModes
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.switching import Switching, refused_by
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.plan.loop_plan import ControllerPlan, LoopPlan, ScheduledCommand


class Manager:
    """The controllers of a robot; `record` holds the arrays that all of them share."""

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
        kept: KeptStates | None = None,
    ) -> None:
        """`set_modes` requests other modes of joints from the hardware; without it they stay as they are.

        `activity` shows which controller's code runs, `topics` takes what they publish, `kept` is what they
        kept in earlier runs.
        """
        self._plan = plan
        self._plugins = plugins
        self._record = record
        self._events = events
        self._clock = clock
        self._taken = commands or NoCommands()
        self._activity = activity or Activity()
        self._topics = topics or TopicLog(record)
        self._keeping = Keeping(kept or KeptStates(), self._topics, events)
        self._period_ns = plan.period_ns
        self._managed: tuple[Managed, ...] = ()
        """By their places; those that were unloaded keep theirs until another one gets it."""
        self._order: tuple[tuple[int, Managed], ...] = ()
        """Places and controllers in the order of updates: those above in a chain before those below."""
        self._commands: tuple[tuple[ScheduledCommand, NDArray[np.float64]], ...] = ()
        self._requests = Requests()
        self._next = 0
        self._lost: Collection[int] = ()
        self._goals = Goals(record, events, [joint.name for joint in plan.joints], self._commanded)
        self._motions: dict[str, PlayedMotion] = {}
        """What is played by commands, by controller."""
        self._modes = ModeSwitch(plan.joints, record.states.mode, set_modes)
        self.released: set[int] = set()
        """Rows of joints whose torque clients switched off; the states show it a cycle later."""
        self._switching = Switching(self._modes, events, self._refuse_limp)
        self._named = self._switching.named
        self.ended_switches = self._switching.ended
        """Switches that waited and have ended: the command's number, and why not; for the loop to answer."""

    @property
    def fault(self) -> str | None:
        """The sentence of the first controller that broke its contract without a fallback; None: none did."""
        return self._switching.fault

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
        self._named.update((managed.plan.name, managed) for managed in self._managed)
        self._sort()
        self._commands = tuple(
            (command, np.frombuffer(command.data, dtype="<f8")) for command in self._plan.commands
        )

    def activate(self, time_ns: int) -> None:
        """Activate the controllers that start active; states and goals are fresh. A fault is in `fault`."""
        self._switching.start(time_ns)

    def begin(self) -> None:
        """Begin a cycle, before its states are read: request modes."""
        if not self._modes.requested:
            self._modes.request(self._managed)
        self._record.renew()
        for managed in self._managed:
            if managed.provided is not None:
                managed.provided.grow_old(self._record.period_ns)

    def update(self, cycle: int, time_ns: int) -> str | None:
        """Hand over the commands that are due and update every active controller that is due.

        `cycle` counts the periods since the first deadline, `time_ns` is the controllers' time; pauses are in
        neither. A controller that breaks its contract is ended, its fallback takes over, or its joints are
        held by the gate; the others are updated all the same. Returns `fault`.
        """
        if self._modes.groups:
            self._switching.admit(time_ns)
        if self._next < len(self._commands):
            self._record.command_count += self._hand_over(time_ns)
        if self._goals.running:
            self._goals.settle()
        if self._motions:
            self._play_on(time_ns)
        self._update_due(cycle, time_ns)
        requests = self._requests
        for _ in self._order:  # one that entered by a request may have one of its own
            if not (requests.takeovers or requests.endings):
                break
            self._execute_requests(time_ns)
            self._update_due(cycle, time_ns)
        if self._keeping.controllers:
            self._keeping.step()
        return self._switching.fault

    def _update_due(self, cycle: int, time_ns: int) -> None:
        now_ns, took_ns = self._clock.now_ns, self._record.controller_ns
        for place, managed in self._order:
            if managed.active and managed.due(cycle):
                begin_ns = now_ns()
                try:
                    managed.update(cycle, time_ns)
                except ControllerFault as fault:
                    self._switching.end(managed, fault, time_ns)
                if place < len(took_ns):
                    took_ns[place] = now_ns() - begin_ns

    def _execute_requests(self, time_ns: int) -> None:
        """Execute what controllers have requested; not of those that are not active any more."""
        takeovers, endings = tuple(self._requests.takeovers), tuple(self._requests.endings)
        self._requests.takeovers.clear()
        self._requests.endings.clear()
        for plan, names, why in takeovers:
            if plan.name in self._switching.active:
                self._switching.take_over(plan.name, names, why, time_ns)
        for plan, why in endings:
            if plan.name in self._switching.active:
                self._switching.end_run(plan.name, why)

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
        managed = self._commandable(controller)
        if isinstance(managed, Refusal):
            return managed
        if managed.takes_goal(kind):
            if until_ns:
                return Refusal(Code.GOAL_STREAMED, {"controller": controller, "kind": kind})
            return self._begin_goal(managed, kind, data, origin, time_ns)
        if (motion := self._motions.get(controller)) is not None:
            motion.goal.end(Outcome.PREEMPTED, "another command took its place")
        streaming = until_ns and managed.until_ns
        try:
            managed.command(kind, data, time_ns, until_ns)
        except ControllerFault as fault:
            self._switching.end(managed, fault, time_ns)
            return refused_by(managed, str(fault))
        if not streaming:
            self._log(EventCode.COMMAND, managed, f"{kind} from {origin}")
        return 0

    def _commandable(self, controller: str) -> Managed | Refusal:
        managed = self._named.get(controller)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})
        if not managed.active:
            entering = managed in self._modes.entering
            code = Code.NOT_ACTIVE_YET if entering else Code.NOT_ACTIVE
            return Refusal(code, {"controller": controller})
        if upper := commander(controller, self._switching.active.values()):
            hint = f"command {upper}, or deactivate it"
            return Refusal(Code.COMMANDED, {"controller": controller, "upper": upper, "hint": hint})
        return managed

    def play(
        self, parts: Sequence[PlayedPart], numbers: bytes, origin: str, time_ns: int
    ) -> tuple[int, ...] | Refusal:
        """Begin the parts of a motion in this cycle, or none; return the numbers of their goals.

        `numbers` has the commands of all parts in a row, little-endian float64.
        """
        sizes = [size for part in parts for size in part.sizes]
        fits = all(size >= 0 for size in sizes) and 8 * sum(sizes) == len(numbers)
        if not fits or any(len(part.at_ns) != len(part.sizes) for part in parts):
            return Refusal(
                Code.INVALID, {"problem": "the motion's array does not have the sizes of its parts"}
            )
        for part in parts:
            managed = self._commandable(part.controller)
            if isinstance(managed, Refusal):
                return managed
            if not part.sizes or (managed.takes_goal(part.kind) and part.at_ns != (0,)):
                return Refusal(Code.INVALID, {"problem": f"the part of {part.controller} has no single goal"})
        values = np.frombuffer(numbers, dtype="<f8")
        commands = np.split(values, np.cumsum(sizes)[:-1])
        begun: list[int] = []
        for part in parts:
            own, commands = commands[: len(part.sizes)], commands[len(part.sizes) :]
            found = self._begin_part(part, tuple(own), origin, time_ns)
            if isinstance(found, Refusal):
                for number in begun:
                    self.cancel(number, "", time_ns)
                return found
            begun.append(found)
        return tuple(begun)

    def _begin_part(
        self, part: PlayedPart, commands: tuple[NDArray[np.float64], ...], origin: str, time_ns: int
    ) -> int | Refusal:
        managed = self._commandable(part.controller)
        if isinstance(managed, Refusal):  # a fault of another one took it out
            return managed
        if managed.takes_goal(part.kind):
            return self._begin_goal(managed, part.kind, commands[0], origin, time_ns)
        goal = self._accept(managed, part.kind, origin)
        managed.adopt(goal)
        self._motions[part.controller] = PlayedMotion(goal, part, commands, time_ns)
        return goal.number

    def _play_on(self, time_ns: int) -> None:
        """Hand over what is due of each motion, and forget those that have ended."""
        for name, motion in tuple(self._motions.items()):
            while motion.goal.outcome is None and (data := motion.due(time_ns)) is not None:
                managed = self._named[name]  # active: else its goal has ended
                try:
                    managed.command(motion.part.kind, data, time_ns)
                except ControllerFault as fault:
                    self._switching.end(managed, fault, time_ns)
            if motion.goal.outcome is None:
                motion.report(time_ns)
            if motion.goal.outcome is not None:
                del self._motions[name]

    def _accept(self, managed: Managed, kind: str, origin: str) -> RunningGoal:
        if (before := managed.goal) is not None:
            before.end(Outcome.PREEMPTED, f"goal {self._goals.last + 1} took its place")
        return self._goals.accept(managed.plan.name, kind, origin)

    def _begin_goal(
        self, managed: Managed, kind: str, data: NDArray[np.float64], origin: str, time_ns: int
    ) -> int | Refusal:
        goal = self._accept(managed, kind, origin)
        try:
            managed.begin_goal(goal, data, time_ns)
        except ControllerFault as fault:
            self._switching.end(managed, fault, time_ns)
            return refused_by(managed, str(fault))
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
            self._switching.end(managed, fault, time_ns)
            return refused_by(managed, str(fault))
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
            if managed.active or managed in self._modes.entering:
                self._switching.end(managed, fault, time_ns)
            else:
                self._switching.take_out(managed, fault)  # it has no joints that a fallback would take over
            return refused_by(managed, str(fault))
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
        """Hold every controller that claims a lost joint, of these rows, as long as it is lost, and those
        above it.

        Returns the rows of those that are commanded again. One that is activated meanwhile waits too.
        """
        self._lost = lost
        resumed: list[int] = []
        for managed in (managed for _, managed in reversed(self._order)):  # those below first
            if not managed.wait_for(lost, self._waits_below(managed)):
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
        step = self._switching.planned(activate, deactivate)
        if isinstance(step, Refusal):
            return step
        return self._refuse_limp(step.enter) or self._switching.take(step, time_ns, number)

    def _commanded(self, controller: str) -> tuple[str, ...]:
        """Return the joints that a controller commands, directly or through others."""
        plan = self._named[controller].plan
        return plan.joints if plan.command else ()

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

    def stopped_by(self, joints: Mapping[str, int]) -> tuple[str, ...]:
        """Return the controllers that command one of these joints and do not go on without their torque."""
        return tuple(
            name
            for name in self.commanding(joints)
            if not self._named[name].plan.partial
            or all(row in joints.values() for row in self._torqued(self._named[name]))
        )

    def _torqued(self, managed: Managed) -> list[int]:
        """Return the rows of a controller's joints that have torque, or are to have it."""
        torque = self._record.states.torque
        return [row for row in managed.rows.tolist() if row not in self.released and torque[row] not in LIMP]

    def _refuse_limp(self, entering: Sequence[str]) -> Refusal | None:
        """Refuse controllers for joints without torque: they would command what cannot move."""
        limp: dict[str, str] = {}
        names: list[str] = []
        for managed in (self._named[name] for name in entering):
            torqued = self._torqued(managed)
            if managed.plan.commands_servos and not (managed.plan.partial and torqued):
                rows = [row for row in managed.rows.tolist() if row not in torqued]
                limp.update((self._plan.joints[row].name, self._plan.joints[row].label) for row in rows)
                names += [managed.plan.name] if rows else []
        if not limp:
            return None
        named = list(limp) if len(limp) <= MOST_NAMED else names  # a controller stands for its joints
        hint = f"`dxlrun torque on {' '.join(named)}` gives it"
        return Refusal(Code.JOINT_LIMP, {"joint": tuple(limp), "servo": tuple(limp.values()), "hint": hint})

    def load(  # noqa: PLR0911  one return a reason
        self, plan: ControllerPlan
    ) -> int | Refusal:
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
        if (parted := parted_couplings(plan, self._plan.joints)) is not None:
            joint, others = parted[0], " and ".join(parted[1])
            problem = f"it commands another mode of {joint} without {others}, which the same servos move"
            return Refusal(Code.CONTROLLER_FAULT, {"controller": plan.name, "problem": problem})
        divider = rate_divider(plan.rate, self._period_ns)
        plan = replace(plan, active=False, every=divider)
        if refusal := self._refuse_graph(plan):
            return refusal
        begin_ns = self._clock.now_ns()
        try:
            managed = self._configured(place, plan)
        except (ControllerFault, PlugInError) as error:
            return Refusal(Code.CONTROLLER_FAULT, {"controller": plan.name, "problem": str(error)})
        managed.wait_for(self._lost, self._waits_below(managed))
        self._managed = (*self._managed[:place], managed, *self._managed[place + 1 :])
        self._named[plan.name] = managed
        self._sort()
        self._log_loaded(managed, "loaded", begin_ns)
        return place

    def _waits_below(self, managed: Managed) -> bool:
        return any(self._named[lower].waiting for lower in managed.plan.into)

    def _sort(self) -> None:
        places = {
            managed.plan.name: place
            for place, managed in enumerate(self._managed)
            if self._named.get(managed.plan.name) is managed
        }
        order = update_order([self._managed[place].plan for place in places.values()])
        self._order = tuple((places[name], self._managed[places[name]]) for name in order)

    def _refuse_graph(self, plan: ControllerPlan) -> Refusal | None:
        """Refuse a controller that is not to be had in the graph of those that are loaded."""
        known = self._switching.known
        if unknown := tuple(lower for lower in plan.into if lower not in known):
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": unknown})
        layout, provided = self._record.layout, {f"{plan.name}/{state}" for state in plan.provides}
        if not (set(plan.references) <= set(layout.references) and provided <= set(layout.source_states)):
            return Refusal(Code.NO_NEW_REFERENCES, {"controller": plan.name})
        try:
            update_order([*known.values(), plan])
        except ValueError as error:
            return Refusal(Code.INVALID, {"problem": str(error)})
        return _refuse_rates({**known, plan.name: plan}, self._period_ns)

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
        if upper := commander(name, self._switching.known.values()):
            hint = f"unload {upper} first"
            return Refusal(Code.COMMANDED, {"controller": name, "upper": upper, "hint": hint})
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
        if refusal := _refuse_rates(self._switching.known, period_ns):
            return refusal
        self._period_ns = period_ns
        for managed in self._named.values():
            managed.change_period(period_ns)
        return None

    def controller(self, name: str) -> Controller[Any] | None:
        """Return a controller that is loaded, for what is done with it outside of the loop."""
        managed = self._named.get(name)
        return None if managed is None else managed.controller

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
        self._switching.deactivate_all(time_ns)
        self._keeping.finish()

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
                self._switching.report_refusal(command.controller, text, outcome)
            else:
                taken += 1
        return taken

    def _log_taken(self, planned: int, command: ScheduledCommand) -> None:
        record = self._record
        self._taken.take(
            TakenCommand(
                record.woken_ns, record.cycle, planned, command.controller, command.kind, command.origin, b""
            )
        )

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
            requests=self._requests,
            urdf=self._plan.urdf,
        )
        plans = {one.name: one for one in self._plan.controllers} | self._switching.known
        managed.configure(self._plugins, self._keeping, plans)
        if managed.has_goals:
            self._goals.open(self._topics)
        return managed


def _refuse_rates(plans: Plans, period_ns: int) -> Refusal | None:
    """Refuse a period in which a controller is not updated whenever one above it is."""
    for upper in plans.values():
        for lower in (plans[name] for name in upper.into):
            if rate_divider(upper.rate, period_ns) % rate_divider(lower.rate, period_ns):
                fields: dict[str, Field] = {"controller": lower.name, "upper": upper.name}
                return Refusal(Code.RATE_BELOW_UPPER, fields | {"rate": 1e9 / period_ns})
    return None


def _not_divided(plan: ControllerPlan, period_ns: int) -> Refusal:
    fields: dict[str, Field] = {"controller": plan.name, "controller_rate": plan.rate or 0.0}
    return Refusal(Code.RATE_NOT_DIVIDED, fields | {"rate": 1e9 / period_ns})
