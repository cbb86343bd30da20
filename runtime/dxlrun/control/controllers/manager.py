"""Manager: configure and update a robot's controllers; give them their commands, goals and motions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, ParamSpec

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.answers import Code, CommandOutcome, Field, Refusal
from dxlrun.channels.commands import Command, TakenCommand
from dxlrun.channels.cycle import MOST_CONTROLLERS
from dxlrun.channels.events import EventCode, Severity
from dxlrun.channels.kept import KeptStates
from dxlrun.contract.controller import Controller, Outcome
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.claims import conflicts
from dxlrun.control.controllers.goals import Commanded, Goals, PlayedMotion, PlayedPart, RunningGoal
from dxlrun.control.controllers.graph import Plans, commander, rate_divider, rate_fits, update_order
from dxlrun.control.controllers.keeping import Keeping
from dxlrun.control.controllers.live_parameters import LiveValues
from dxlrun.control.controllers.managed import ControllersContext, Managed, Request, State
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.switching import Switching, fault_of
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.controllers.wiring import Provided
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.plan.loop_plan import ControllerPlan, ScheduledCommand

P = ParamSpec("P")


class Manager:
    """The controllers of a robot; the cycle's record holds the arrays that all of them share."""

    def __init__(
        self,
        context: ControlContext,
        plugins: PlugIns,
        *,
        activity: Activity | None = None,
        topics: TopicLog | None = None,
        kept: KeptStates | None = None,
    ) -> None:
        """Build the manager of a run; `configure` then builds the controllers.

        Args:
            context: The run.
            plugins: Types of controllers.
            activity: Shows which controller's code runs.
            topics: Takes what controllers publish.
            kept: What controllers kept in earlier runs.
        """
        self.switching = Switching(context)
        """Which of them are active."""
        self._plan = context.plan
        self._record = context.record
        self._events = context.events
        self._clock = context.clock
        self._command_log = context.command_log
        self._topics = topics or TopicLog(context.record)
        self._keeping = Keeping(kept or KeptStates(), self._topics, context.events)
        self._requests: list[Request] = []
        """What controllers request of the run in this cycle."""
        self._shared = ControllersContext(
            run=context,
            plugins=plugins,
            activity=activity or Activity(),
            topics=self._topics,
            keeping=self._keeping,
            requests=self._requests,
        )
        self._schedule = context.schedule
        self._managed: tuple[Managed, ...] = ()
        """By their places; those that were unloaded keep theirs until another one gets it."""
        self._named = self.switching.named
        self._order: tuple[Managed, ...] = ()
        """In the order of updates: those above in a chain before those below."""
        self.streams: dict[int, Managed] = {}
        """By place: those whose commands run out; one whose stream has ended leaves with the next look."""
        self.providers: tuple[Provided, ...] = ()
        """What controllers provide; all of it is older in each cycle."""
        self._next = 0  # of the plan's commands
        self._lost: list[int] = []  # rows of the joints that are lost
        self._goals = Goals(context.record, context.events, context.plan.joints, self._commanded)
        self._motions: dict[str, PlayedMotion] = {}
        """What is played by commands, by controller."""
        self._pursued: dict[str, RunningGoal] = {}
        """Goals that the runtime pursues with commands of the plan, by controller; they may have ended."""

    def configure(self) -> None:
        """Build and configure every controller; allocates, before real time.

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

    # In a cycle

    def update(self, cycle: int) -> None:
        """Hand over the commands that are due and update every active controller that is due.

        `cycle` counts the periods since the first deadline, without pauses. A controller that breaks its
        contract is ended, its fallback takes over, or its joints are held by the gate; the others are updated
        all the same.
        """
        self._goals.time_ns = self._schedule.time_ns
        self._dispatch_due()
        now_ns, took_ns = self._clock.now_ns, self._record.controller_ns
        for left in range(len(self._order), -1, -1):  # one that entered by a request may have one of its own
            for managed in self._order:
                if managed.state is State.ACTIVE and cycle >= managed.due_cycle:
                    begin_ns = now_ns()
                    try:
                        managed.update(cycle)
                    except ControllerFault as fault:
                        self.switching.end_controller(managed, fault)
                    if managed.place < len(took_ns):
                        took_ns[managed.place] = now_ns() - begin_ns
            if not (left and self._requests):
                break
            self._execute_requests()
        if self._lost:
            self._record.commands.values[:, self._lost] = np.nan
        if self._keeping.controllers:
            self._keeping.step()

    def _dispatch_due(self) -> None:
        """Activate what waited for modes, hand over what is due, and judge goals, before the updates."""
        if self.switching.groups:
            self.switching.admit_groups()
        if self._next < len(self._plan.commands):
            self._hand_over()
        if self._goals.running:
            self._goals.judge_running()
        if self._motions:
            self._play_on()

    def _execute_requests(self) -> None:
        """Let controllers take over as others have requested it; endings of the run behind that."""
        requests = sorted(self._requests, key=lambda request: not request.takes_over)
        self._requests.clear()
        for request in requests:
            requester = self._named.get(request.requester)
            if requester is not None and requester.active:
                self.switching.execute_request(request)

    def deactivate(self) -> None:
        """Deactivate all controllers, the last one first; raises nothing, a fault is in `switching.fault`.

        Goals that are neither reached nor missed by now end as aborted, because the run ended.
        """
        self._goals.time_ns = self._schedule.time_ns
        self._goals.judge_running()
        self.switching.deactivate_all()
        self._keeping.finish()

    # Commands

    @property
    def settles(self) -> bool:
        """True while the motion of a goal has ended and its joints may still settle."""
        return self._goals.are_settling

    def dispatch_command(self, command: Command, pursued: RunningGoal | None = None) -> int | Refusal:
        """Hand a prepared command to its controller; return the number of the goal that it is, else 0.

        `pursued`: the goal that the runtime pursues with this command; another one is preempted.

        With a lease it runs out unless another one follows (see `stale`). Of a stream, only the first one has
        an event.
        """
        self._goals.time_ns = self._schedule.time_ns
        if len(command.data) % 8:
            problem = f"{len(command.data)} bytes are no array of numbers"
            return Refusal(Code.INVALID, {"problem": problem})
        managed = self._commandable(command.controller)
        if isinstance(managed, Refusal):
            return managed
        kind, data = command.kind, np.frombuffer(command.data, dtype="<f8")
        if kind in managed.controller.Goals:
            if command.lease_ns:
                return Refusal(Code.GOAL_STREAMED, {"controller": managed.plan.name, "kind": kind})
            return self._begin_goal(managed, kind, data, command.origin)
        goal = managed.goal
        led = goal is not None and (goal.is_judged or managed.plan.name in self._motions)
        if goal is not None and led and goal is not pursued:
            goal.end(Outcome.PREEMPTED, "another command took its place")
        streaming = command.lease_ns and managed.until_ns
        try:
            managed.give_command(kind, data)
        except ControllerFault as fault:
            return self._end(managed, fault)
        if command.lease_ns:
            managed.until_ns = self._record.woken_ns + command.lease_ns
            self.streams[managed.place] = managed
        if not streaming:
            self._events.emit(
                EventCode.COMMAND, Severity.INFO, managed.plan.name, f"{kind} from {command.origin}"
            )
        return 0

    def _end(self, managed: Managed, fault: ControllerFault) -> Refusal:
        self.switching.end_controller(managed, fault)
        return fault_of(managed, str(fault))

    def _attempt(
        self,
        managed: Managed,
        call: Callable[P, None],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> Refusal | None:
        """Call something of a controller; where it breaks its contract it is ended, and that is returned."""
        try:
            call(*arguments, **named)
        except ControllerFault as fault:
            return self._end(managed, fault)
        return None

    def _known(self, controller: str) -> Managed | Refusal:
        managed = self._named.get(controller)
        return managed or Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})

    def _commandable(self, controller: str) -> Managed | Refusal:
        managed = self._named.get(controller)
        if managed is None:
            return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})
        if not managed.active:
            code = Code.NOT_ACTIVE_YET if managed.state is State.ENTERING else Code.NOT_ACTIVE
            return Refusal(code, {"controller": controller})
        for upper in managed.uppers:
            if upper.active:
                hint = f"command {upper.plan.name}, or deactivate it"
                return _commanded_by(controller, upper.plan.name, hint)
        return managed

    def _hand_over(self) -> None:
        """Give each command of the plan whose time has come to its controller, and count those taken."""
        commands, record = self._plan.commands, self._record
        while self._next < len(commands) and commands[self._next].at_ns <= self._schedule.time_ns:
            place, command = self._next, commands[self._next]
            name, kind, origin = command.controller, command.kind, command.origin
            taken = TakenCommand(record.woken_ns, record.cycle, place, name, kind, origin, b"")
            self._command_log.take(taken)
            self._next += 1
            pursued = self._pursue(command)
            answer = self.dispatch_command(Command(place, name, kind, command.data, origin), pursued)
            if isinstance(answer, Refusal):
                text = f"{kind} from {origin} refused: {answer.text}"
                self.switching.report_refusal(name, text, CommandOutcome(kind, origin, answer))
            else:
                record.command_count += 1

    def _pursue(self, command: ScheduledCommand) -> RunningGoal | None:
        """Return the goal that the runtime pursues with a command of the plan, which may begin with it."""
        name, planned = command.controller, command.goal
        managed = self._commandable(name) if planned is not None else None
        if planned and isinstance(managed, Managed) and command.kind not in managed.controller.Goals:
            goal = self._pursued[name] = self._accept(managed, command.kind, command.origin)
            managed.adopt(goal)
            part = PlayedPart(name, command.kind, (), (), planned.end_ns, planned.positions)
            self._motions[name] = PlayedMotion(goal, part, (), 0)
        return self._pursued.get(name)

    def change_parameters(self, controller: str, values: LiveValues) -> Refusal | None:
        """Replace live parameters of a controller, active or not, all of them together."""
        managed = self._known(controller)
        if isinstance(managed, Refusal):
            return managed
        try:
            refusal = self._attempt(managed, managed.change_parameters, values)
        except ValueError as error:
            return Refusal(Code.INVALID, {"problem": f"{controller}: {error}"})
        if refusal is None:
            shown = ", ".join(f"{name} = {value:g}" for name, value in values.items())
            self._log(EventCode.PARAMETERS, managed, shown)
        return refusal

    def stale(self, now_ns: int) -> list[str]:
        """Return the controllers whose stream of commands has run out, each of them once."""
        over = [managed for managed in self.streams.values() if managed.until_ns < now_ns]
        stale = [managed for managed in over if managed.until_ns]  # others have no stream any more
        for managed in over:
            managed.until_ns = 0
            del self.streams[managed.place]
        return [managed.plan.name for managed in sorted(stale, key=lambda one: one.place)]

    def hold_controller(self, controller: str) -> None:
        """Let a controller hold its joints until it gets another command; it stays active."""
        if (managed := self._named.get(controller)) is not None:
            self._attempt(managed, managed.hold_joints)

    def hold_lost(self, lost: Collection[int], until: str = "all its joints answer again") -> tuple[int, ...]:
        """Hold the controllers that command a lost joint, of these rows, and those above them.

        They are updated, and their other joints stay where they are. So does one that is activated while a
        joint is lost. Nothing is commanded to the lost joints themselves. A policy may hold others, `until`.

        Returns:
            The rows of the controllers that are not held any more.
        """
        self._lost = sorted(lost)
        resumed: list[int] = []
        for managed in reversed(self._order):  # those below first
            if not managed.hold_lost(self._lost, below=self._holds_below(managed)):
                continue
            text, severity = f"resumes: {until}", Severity.INFO
            if managed.held:
                text, severity = f"is held until {until}", Severity.WARNING
            else:
                resumed += managed.rows.tolist()
            self._events.emit(EventCode.POLICY, severity, managed.plan.name, text)
        return tuple(resumed)

    def _holds_below(self, managed: Managed) -> bool:
        return any(self._named[lower].held for lower in managed.plan.into)

    # Goals and motions

    def _accept(self, managed: Managed, kind: str, origin: str) -> RunningGoal:
        if (before := managed.goal) is not None:
            before.end(Outcome.PREEMPTED, f"goal {self._goals.last + 1} took its place")
        return self._goals.accept(managed.plan.name, kind, origin)

    def _begin_goal(
        self, managed: Managed, kind: str, data: NDArray[np.float64], origin: str
    ) -> int | Refusal:
        goal = self._accept(managed, kind, origin)
        return self._attempt(managed, managed.begin_goal, goal, data) or goal.number

    def cancel_goal(self, number: int, controller: str) -> Refusal | None:
        """Let a controller end a goal, by the goal's number, or the one that a controller has."""
        if controller:
            managed = self._known(controller)
            if isinstance(managed, Refusal):
                return managed
            goal = managed.goal or Refusal(Code.NO_GOAL, {"controller": controller})
        else:
            goal = self._goals.found(number)
        if isinstance(goal, Refusal):
            return goal
        if goal.cancelling:
            return Refusal(Code.CANCELLED_ALREADY, {"goal": goal.number, "controller": goal.controller})
        managed = self._named[goal.controller]
        return self._attempt(managed, managed.cancel_goal, goal)

    def play_motion(
        self, parts: Sequence[PlayedPart], numbers: bytes, origin: str
    ) -> tuple[int, ...] | Refusal:
        """Begin the parts of a motion in this cycle, or none; return the numbers of their goals.

        `numbers` has the commands of all parts in a row, little-endian float64.
        """
        self._goals.time_ns = self._schedule.time_ns
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
            if not part.sizes or (part.kind in managed.controller.Goals and part.at_ns != (0,)):
                return Refusal(Code.INVALID, {"problem": f"the part of {part.controller} has no single goal"})
        commands = np.split(np.frombuffer(numbers, dtype="<f8"), np.cumsum(sizes)[:-1])
        begun: list[int] = []
        for part in parts:
            own, commands = commands[: len(part.sizes)], commands[len(part.sizes) :]
            found = self._begin_part(part, tuple(own), origin)
            if isinstance(found, Refusal):
                for number in begun:
                    self.cancel_goal(number, "")
                return found
            begun.append(found)
        return tuple(begun)

    def _begin_part(
        self, part: PlayedPart, commands: tuple[NDArray[np.float64], ...], origin: str
    ) -> int | Refusal:
        managed = self._commandable(part.controller)
        if isinstance(managed, Refusal):  # a fault of another one took it out
            return managed
        if part.kind in managed.controller.Goals:
            return self._begin_goal(managed, part.kind, commands[0], origin)
        goal = self._accept(managed, part.kind, origin)
        managed.adopt(goal)
        self._motions[part.controller] = PlayedMotion(goal, part, commands, self._schedule.time_ns)
        return goal.number

    def _play_on(self) -> None:
        """Hand over what is due of each motion, and forget those that have ended."""
        time_ns = self._schedule.time_ns
        for name, motion in tuple(self._motions.items()):
            managed, kind = self._named[name], motion.part.kind  # active: else its goal has ended
            while motion.goal.outcome is None and (data := motion.due(time_ns)) is not None:
                self._attempt(managed, managed.give_command, kind, data)
            if motion.goal.outcome is None:
                motion.report(time_ns)
            if motion.goal.outcome is not None:
                del self._motions[name]

    def _commanded(self, controller: str) -> Commanded:
        """Return the joints that a controller commands, directly or through others, with its commands."""
        return self._named[controller].commanded

    # Loading

    def load(self, plan: ControllerPlan) -> int | Refusal:
        """Configure one more controller, inactive; return its place. Only while the loop is paused."""
        place = self._free_place()
        if refusal := next(self._refusals(plan, place), None):
            return refusal
        plan = replace(plan, active=False, every=rate_divider(plan.rate, self._schedule.period_ns))
        begin_ns = self._clock.now_ns()
        try:
            managed = self._configured(place, plan)
        except (ControllerFault, PlugInError) as error:
            return Refusal(Code.CONTROLLER_FAULT, {"controller": plan.name, "problem": str(error)})
        managed.hold_lost(self._lost, below=self._holds_below(managed))
        self._managed = (*self._managed[:place], managed, *self._managed[place + 1 :])
        self._named[plan.name] = managed
        self._sort()
        self._log_loaded(managed, "loaded", begin_ns)
        return place

    def _refusals(self, plan: ControllerPlan, place: int) -> Iterator[Refusal]:
        """Yield why a controller cannot be loaded into a place; the first reason counts."""
        known, layout = self.switching.standing.known, self._record.layout
        if plan.name in known:
            yield Refusal(Code.NAME_TAKEN, {"controller": plan.name})
        if not rate_fits(plan.rate, self._schedule.period_ns):
            yield from _refused_rates({plan.name: plan}, self._schedule.period_ns)
        if place >= MOST_CONTROLLERS:
            yield Refusal(Code.TOO_MANY_CONTROLLERS, {"most": MOST_CONTROLLERS})
        if unknown := tuple(joint for joint in plan.joints if joint not in layout.joints):
            yield Refusal(Code.UNKNOWN_JOINT, {"joint": unknown})
        if (parted := plan.split_group(self._plan.joints)) is not None:
            joint, others = parted[0], " and ".join(parted[1])
            problem = f"it commands another mode of {joint} without {others}, which the same servos move"
            yield Refusal(Code.CONTROLLER_FAULT, {"controller": plan.name, "problem": problem})
        if unknown := tuple(lower for lower in plan.into if lower not in known):
            yield Refusal(Code.UNKNOWN_CONTROLLER, {"controller": unknown})
        provided = {f"{plan.name}/{state}" for state in plan.provides}
        if not (set(plan.references) <= set(layout.references) and provided <= set(layout.source_states)):
            yield Refusal(Code.NO_NEW_REFERENCES, {"controller": plan.name})
        try:
            update_order([*known.values(), plan])
        except ValueError as error:
            yield Refusal(Code.INVALID, {"problem": str(error)})
        yield from _refused_rates({**known, plan.name: plan}, self._schedule.period_ns)

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
        managed = self._known(name)
        if isinstance(managed, Refusal):
            return managed
        if managed.state is not State.INACTIVE:
            return Refusal(Code.STILL_ACTIVE, {"controller": name})
        if upper := commander(name, self.switching.standing.known.values()):
            return _commanded_by(name, upper, f"unload {upper} first")
        begin_ns = self._clock.now_ns()
        del self._named[name]
        self._sort()
        self._log_loaded(managed, "unloaded", begin_ns)
        return None

    def change_period(self, period_ns: int) -> Refusal | None:
        """Let every controller keep its own rate in another period of the loop."""
        if refusal := next(_refused_rates(self.switching.standing.known, period_ns), None):
            return refusal
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
        return tuple(managed.plan.name for managed in self._order if managed.active)

    @property
    def plans(self) -> tuple[ControllerPlan, ...]:
        """The plans of all controllers by their places, which are their bits in the record's masks."""
        return tuple(managed.plan for managed in self._managed)

    def _sort(self) -> None:
        self.providers = tuple(one.provided for one in self._managed if one.provided is not None)
        loaded = [one for one in self._managed if self._named.get(one.plan.name) is one]
        for one in loaded:
            one.uppers = tuple(upper for upper in self._named.values() if one.plan.name in upper.plan.into)
        self._order = tuple(self._named[name] for name in update_order([one.plan for one in loaded]))

    def _log_loaded(self, managed: Managed, what: str, begin_ns: int) -> None:
        text = f"{what} in {(self._clock.now_ns() - begin_ns) / 1e6:.1f} ms, while the loop stood still"
        self._log(EventCode.CONTROLLER_LOADED, managed, text)

    def _log(self, code: EventCode, managed: Managed, text: str) -> None:
        self._events.emit(code, Severity.INFO, managed.plan.name, text)

    def _configured(self, place: int, plan: ControllerPlan) -> Managed:
        managed = Managed(plan, place, self._shared)
        plans = {one.name: one for one in self._plan.controllers} | dict(self.switching.standing.known)
        managed.configure(plans)
        if managed.controller.Goals:
            self._goals.open(self._topics)
        return managed


def _commanded_by(controller: str, upper: str, hint: str) -> Refusal:
    return Refusal(Code.COMMANDED, {"controller": controller, "upper": upper, "hint": hint})


def _refused_rates(plans: Plans, period_ns: int) -> Iterator[Refusal]:
    """Yield why a period does not do: a controller cannot keep its rate in it, or is not updated whenever one
    above it is."""
    rate = 1e9 / period_ns
    for plan in plans.values():
        if not rate_fits(plan.rate, period_ns):
            fields: dict[str, Field] = {"controller": plan.name, "controller_rate": plan.rate or 0.0}
            yield Refusal(Code.RATE_NOT_DIVIDED, fields | {"rate": rate})
    for upper in plans.values():
        for lower in (plans[name] for name in upper.into):
            if rate_divider(upper.rate, period_ns) % rate_divider(lower.rate, period_ns):
                fields = {"controller": lower.name, "upper": upper.name, "rate": rate}
                yield Refusal(Code.RATE_BELOW_UPPER, fields)
