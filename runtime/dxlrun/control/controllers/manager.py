"""Manager: configure and update a robot's controllers, and dispatch commands, goals and motions to them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, ParamSpec

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.answers import Code, CommandOutcome, Field, Refusal
from dxlrun.channels.commands import CommandMessage, TakenCommand
from dxlrun.channels.cycle import MOST_CONTROLLERS
from dxlrun.channels.kept import KeptStates
from dxlrun.contract.controller import Controller, Outcome
from dxlrun.control import texts
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.changed_registers import ChangedRegisters
from dxlrun.control.controllers.claims import conflicts
from dxlrun.control.controllers.goal_registry import (
    CurrentCommands,
    GoalRegistry,
    PlayedMotion,
    PlayedPart,
    RunningGoal,
)
from dxlrun.control.controllers.keeping import StateKeeper
from dxlrun.control.controllers.live_parameters import LiveValues
from dxlrun.control.controllers.managed import ControllerRequest, ControllersContext, ManagedController, State
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.control.controllers.switching import Switching, fault_of
from dxlrun.control.controllers.update_order import Plans, commander, rate_divider, rate_fits, update_order
from dxlrun.control.controllers.wiring import ProvidedStates
from dxlrun.errors import ControllerFault, PlugInError
from dxlrun.plan.loop_plan import ControllerPlan, ScheduledCommand

P = ParamSpec("P")


class Manager:
    """All controllers of a robot in a run: configures, updates and commands them once a cycle."""

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
            plugins: Controller types.
            activity: Publishes which controller's code runs.
            topics: Destination of the controllers' messages.
            kept: States that controllers kept in earlier runs.
        """
        self.switching = Switching(context)
        """States of the controllers, and activations and deactivations."""
        self._plan = context.plan
        self._record = context.record
        self._events = context.events
        self._clock = context.clock
        self._command_log = context.command_log
        self._topics = topics or TopicLog(context.record)
        self._keeping = StateKeeper(kept or KeptStates(), self._topics, context.events)
        self.registers = ChangedRegisters(context)
        """Registers of the servos that controllers change."""
        self._requests: list[ControllerRequest] = []
        """Takeovers and ends of the run that controllers requested in this cycle; not executed yet."""
        self._shared = ControllersContext(
            run=context,
            plugins=plugins,
            activity=activity or Activity(),
            topics=self._topics,
            keeping=self._keeping,
            registers=self.registers,
            begin_goal=self._begin_own_goal,
            requests=self._requests,
        )
        self._schedule = context.schedule
        self._managed: tuple[ManagedController, ...] = ()
        """All controllers by index (their bit in the record's masks). An unloaded one keeps its index until a
        new controller gets that."""
        self._named = self.switching.named
        self._order: tuple[ManagedController, ...] = ()
        """Loaded controllers in update order: upper controllers of a chain before lower ones."""
        self.streams: dict[int, ManagedController] = {}
        """Controllers that receive a stream of commands with a lease, by index. `stale` removes those whose
        stream has ended."""
        self.providers: tuple[ProvidedStates, ...] = ()
        """States that controllers provide; their age increases in each cycle."""
        self._next = 0  # index into the plan's commands
        self._lost: list[int] = []  # rows of lost joints
        self._goals = GoalRegistry(context.record, context.events, context.plan.joints, self._commanded)
        self._motions: dict[str, PlayedMotion] = {}
        """Motions that the runtime plays with plain commands, by name of the controller."""
        self._pursued: dict[str, RunningGoal] = {}
        """Goals that the runtime pursues with commands of the plan, by controller name. They may have
        ended."""

    def configure(self) -> None:
        """Build and configure every controller. Allocates, so it runs before real time.

        Raises:
            PlugInError: A type is not available, or its parameters are not valid.
            ControllerFault: A controller raised in on_configure, or two initially active controllers claim
                the same joint.
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
        """Dispatch due commands, then update every active controller that is due.

        A controller that breaks its contract is deactivated. Its fallback takes over, or the gate holds its
        joints. The update of other controllers continues.

        Args:
            cycle: Number of the cycle: periods since the first deadline, without pauses.
        """
        self._goals.time_ns = self._schedule.time_ns
        if self.registers.waiting:
            self.registers.retry()
        self._dispatch_due()
        now_ns, took_ns = self._clock.now_ns, self._record.controller_ns
        # A controller that entered by a request is updated in this cycle too, and may request one itself.
        for left in range(len(self._order), -1, -1):
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
            self._keeping.publish_next()

    def _dispatch_due(self) -> None:
        """Activate waiting controllers, dispatch due commands of plan and motions, and judge goals."""
        if self.switching.groups:
            self.switching.admit_groups()
        if self._next < len(self._plan.commands):
            self._dispatch_due_commands()
        if self._goals.running:
            self._goals.judge_running()
        if self._motions:
            self._play_on()

    def _execute_requests(self) -> None:
        """Execute the controllers' requests of this cycle: takeovers first, then ends of the run."""
        requests = sorted(self._requests, key=lambda request: not request.takes_over)
        self._requests.clear()
        for request in requests:
            requester = self._named.get(request.requester)
            if requester is not None and requester.active:
                self.switching.execute_request(request)

    def deactivate(self) -> None:
        """Deactivate all controllers at the end of a run. Never raises, but sets `switching.fault`.

        Goals that are neither reached nor missed are aborted because the run ends.
        """
        self._goals.time_ns = self._schedule.time_ns
        self._goals.judge_running()
        self.switching.deactivate_all()
        self._keeping.publish_remaining()

    # Commands

    @property
    def has_played(self) -> bool:
        """True if all commands of the plan were sent, and no goal is running."""
        return self._next >= len(self._plan.commands) and not self._goals.running

    @property
    def settles(self) -> bool:
        """True while the motion of any goal has ended but its outcome is still open."""
        return self._goals.are_settling

    def dispatch_command(
        self, command: CommandMessage, pursued: RunningGoal | None = None
    ) -> RunningGoal | Refusal | None:
        """Pass a client's or the plan's command to its controller, which must be active.

        A command with a lease starts or continues a stream, which ends unless another command follows in time
        (see `stale`). Only the first command of a stream is reported as an event.

        Args:
            command: The command.
            pursued: Goal that the runtime pursues with this command. Another goal of the controller that the
                runtime pursues or judges is preempted.

        Returns:
            The new goal if the command is a goal; or the refusal.
        """
        self._goals.time_ns = self._schedule.time_ns
        if len(command.data) % 8:
            problem = f"{len(command.data)} bytes are not an array of numbers"
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
            goal.end(Outcome.PREEMPTED, "replaced by another command")
        streaming = command.lease_ns and managed.until_ns
        try:
            managed.give_command(kind, data)
        except ControllerFault as fault:
            return self._end_controller(managed, fault)
        if command.lease_ns:
            managed.until_ns = self._record.woken_ns + command.lease_ns
            self.streams[managed.place] = managed
        if not streaming:
            self._events.emit_event(managed.plan.name, texts.command_accepted(kind, command.origin))
        return None

    def _end_controller(self, managed: ManagedController, fault: ControllerFault) -> Refusal:
        self.switching.end_controller(managed, fault)
        return fault_of(managed, str(fault))

    def _attempt(
        self,
        managed: ManagedController,
        call: Callable[P, None],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> Refusal | None:
        """Call a method of a controller. On a fault, deactivate the controller and return the refusal."""
        try:
            call(*arguments, **named)
        except ControllerFault as fault:
            return self._end_controller(managed, fault)
        return None

    def _known(self, controller: str) -> ManagedController | Refusal:
        managed = self._named.get(controller)
        return managed or Refusal(Code.UNKNOWN_CONTROLLER, {"controller": controller})

    def _commandable(self, controller: str) -> ManagedController | Refusal:
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

    def _dispatch_due_commands(self) -> None:
        """Dispatch the commands of the plan that are due, and count the accepted ones in the record."""
        commands, record = self._plan.commands, self._record
        while self._next < len(commands) and commands[self._next].at_ns <= self._schedule.time_ns:
            place, command = self._next, commands[self._next]
            name, kind, origin = command.controller, command.kind, command.origin
            taken = TakenCommand(record.woken_ns, record.cycle, place, name, kind, origin, b"")
            self._command_log.record_command(taken)
            self._next += 1
            pursued = self._pursue(command)
            if pursued is not None and pursued.outcome is not None:
                continue  # cancelled, or another command has taken over
            answer = self.dispatch_command(CommandMessage(place, name, kind, command.data, origin), pursued)
            if isinstance(answer, Refusal):
                event = texts.command_refused(kind, origin, answer.text)
                self.switching.report_refusal(name, event, CommandOutcome(kind, origin, answer))
            else:
                record.command_count += 1

    def _pursue(self, command: ScheduledCommand) -> RunningGoal | None:
        """Return the goal that the runtime pursues with a command of the plan; None without one.

        The goal is created if the command is the first for it.
        """
        name, planned = command.controller, command.goal
        managed = self._commandable(name) if planned is not None else None
        if (
            planned
            and isinstance(managed, ManagedController)
            and command.kind not in managed.controller.Goals
        ):
            goal = self._pursued[name] = self._accept(managed, command.kind, command.origin)
            managed.adopt_goal(goal)
            part = PlayedPart(name, command.kind, (), (), planned.end_ns or 0, planned.positions)
            self._motions[name] = PlayedMotion(goal, part, (), 0)
        return self._pursued.get(name)

    def change_parameters(self, controller: str, values: LiveValues) -> Refusal | None:
        """Replace live parameters of a controller, active or not, in one step.

        Returns the refusal, None on success.
        """
        managed = self._known(controller)
        if isinstance(managed, Refusal):
            return managed
        try:
            refusal = self._attempt(managed, managed.change_parameters, values)
        except ValueError as error:
            return Refusal(Code.INVALID, {"problem": f"{controller}: {error}"})
        if refusal is None:
            shown = ", ".join(f"{name} = {value:g}" for name, value in values.items())
            self._events.emit_event(managed.plan.name, texts.parameters_changed(shown))
        return refusal

    def stale(self, now_ns: int) -> list[str]:
        """Remove the command streams whose lease expired, and return the names of their controllers.

        Args:
            now_ns: Time of the run's clock.
        """
        over = [managed for managed in self.streams.values() if managed.until_ns < now_ns]
        stale = [managed for managed in over if managed.until_ns]  # 0: the stream ended before its lease
        for managed in over:
            managed.until_ns = 0
            del self.streams[managed.place]
        return [managed.plan.name for managed in sorted(stale, key=lambda one: one.place)]

    def hold_controller(self, controller: str) -> None:
        """Hold the joints of a controller, whose command stream ended, until its next command.

        It stays active.
        """
        if (managed := self._named.get(controller)) is not None:
            self._attempt(managed, managed.hold_joints)

    def hold_lost(self, lost: Collection[int], until: str) -> tuple[int, ...]:
        """Hold the controllers that command a lost joint, and the controllers above them.

        Resume the others.

        Held controllers are updated, but their joints stay where they are. This includes controllers that are
        activated while a joint is lost. Lost joints get no commands.

        Args:
            lost: Rows of the joints; a policy may also hold joints that are not lost.
            until: End of the hold for events, a clause: `all its joints answer again`.

        Returns:
            Rows of the joints whose controllers have resumed.
        """
        self._lost = sorted(lost)
        resumed: list[int] = []
        for managed in reversed(self._order):  # lower controllers first: the upper ones depend on them
            if not managed.hold_lost(self._lost, below=self._holds_below(managed)):
                continue
            if managed.held:
                event = texts.controller_held(until)
            else:
                event = texts.controller_resumes(until)
                resumed += managed.rows.tolist()
            self._events.emit_event(managed.plan.name, event)
        return tuple(resumed)

    def _holds_below(self, managed: ManagedController) -> bool:
        return any(self._named[lower].held for lower in managed.plan.into)

    # Goals and motions

    def _accept(self, managed: ManagedController, kind: str, origin: str) -> RunningGoal:
        if (before := managed.goal) is not None:
            before.end(Outcome.PREEMPTED, f"replaced by goal {self._goals.last + 1}")
        return self._goals.accept_goal(managed.plan.name, kind, origin)

    def _begin_goal(
        self, managed: ManagedController, kind: str, data: NDArray[np.float64], origin: str
    ) -> RunningGoal | Refusal:
        goal = self._accept(managed, kind, origin)
        refusal = self._attempt(managed, managed.begin_goal, goal, data)
        if goal.outcome is None and kind not in managed.controller.plans:
            goal.has_begun = True
        return refusal or goal

    def _begin_own_goal(self, controller: str, kind: str) -> RunningGoal:
        """Accept a goal that a controller begins itself. Raises ControllerFault for a kind without goals."""
        managed = self._named[controller]
        if kind not in managed.controller.Goals:
            raise ControllerFault(f"began a goal {kind}, which is not in its Goals")
        goal = self._accept(managed, kind, controller)
        managed.adopt_goal(goal)
        return goal

    def cancel_goal(self, number: int, controller: str) -> Refusal | None:
        """Cancel the running goal of a controller, or the goal `number` if `controller` is empty.

        Returns the refusal, None on success.
        """
        if controller:
            managed = self._known(controller)
            if isinstance(managed, Refusal):
                return managed
            goal = managed.goal or Refusal(Code.NO_GOAL, {"controller": controller})
        else:
            goal = self._goals.found(number)
        if isinstance(goal, Refusal):
            return goal
        managed = self._named[goal.controller]
        if goal.cancelling and not managed.controller.graceful:
            return Refusal(Code.CANCELLED_ALREADY, {"goal": goal.number, "controller": goal.controller})
        return self._attempt(managed, managed.cancel_goal, goal)

    def play_motion(
        self, parts: Sequence[PlayedPart], numbers: bytes, origin: str
    ) -> tuple[int, ...] | Refusal:
        """Start all parts of a client's motion in this cycle, or none of them.

        Args:
            parts: Parts of the motion.
            numbers: Concatenated commands of all parts, little-endian float64.
            origin: Client that sent the motion, for events.

        Returns:
            The numbers of the goals of the parts, or a refusal.
        """
        self._goals.time_ns = self._schedule.time_ns
        sizes = [size for part in parts for size in part.sizes]
        fits = all(size >= 0 for size in sizes) and 8 * sum(sizes) == len(numbers)
        if not fits or any(len(part.at_ns) != len(part.sizes) for part in parts):
            problem = "the motion's array does not match the sizes of its parts"
            return Refusal(Code.INVALID, {"problem": problem})
        for part in parts:
            managed = self._commandable(part.controller)
            if isinstance(managed, Refusal):
                return managed
            if not part.sizes or (part.kind in managed.controller.Goals and part.at_ns != (0,)):
                problem = f"the motion has other goals for {part.controller} than a single one at its start"
                return Refusal(Code.INVALID, {"problem": problem})
        commands = np.split(np.frombuffer(numbers, dtype="<f8"), np.cumsum(sizes)[:-1])
        begun: list[int] = []
        for part in parts:
            own, commands = commands[: len(part.sizes)], commands[len(part.sizes) :]
            found = self._begin_part(part, tuple(own), origin)
            if isinstance(found, RunningGoal):
                found = found.refusal or found
            if isinstance(found, Refusal):
                for number in begun:
                    self.cancel_goal(number, "")
                return found
            begun.append(found.number)
        return tuple(begun)

    def _begin_part(
        self, part: PlayedPart, commands: tuple[NDArray[np.float64], ...], origin: str
    ) -> RunningGoal | Refusal:
        managed = self._commandable(part.controller)
        if isinstance(managed, Refusal):  # deactivated because of a fault in an earlier part
            return managed
        if part.kind in managed.controller.Goals:
            return self._begin_goal(managed, part.kind, commands[0], origin)
        goal = self._accept(managed, part.kind, origin)
        managed.adopt_goal(goal)
        self._motions[part.controller] = PlayedMotion(goal, part, commands, self._schedule.time_ns)
        return goal

    def _play_on(self) -> None:
        """Dispatch the due commands of each motion being played, and remove motions that have ended."""
        time_ns = self._schedule.time_ns
        for name, motion in tuple(self._motions.items()):
            managed, kind = self._named[name], motion.part.kind  # it is active, otherwise its goal has ended
            while motion.goal.outcome is None and (data := motion.due(time_ns)) is not None:
                self._attempt(managed, managed.give_command, kind, data)
            if motion.goal.outcome is None:
                motion.report_progress(time_ns)
            if motion.goal.outcome is not None:
                del self._motions[name]

    def _commanded(self, controller: str) -> CurrentCommands:
        """Return the joints and current commands of a controller, before any limit."""
        return self._named[controller].commanded

    # Loading

    def load_controller(self, plan: ControllerPlan) -> int | Refusal:
        """Configure a new controller, inactive at first; return its index, or the refusal.

        Requires a paused loop.
        """
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
        self._events.emit_event(plan.name, texts.controller_loaded(self._clock.now_ns() - begin_ns))
        return place

    def _refusals(self, plan: ControllerPlan, place: int) -> Iterator[Refusal]:
        """Yield the reasons why a controller cannot be loaded at this index, the most important one first."""
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
            problem = f"it changes the mode of {joint}, but not of {others}; both share their servos"
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
        """Return the lowest index for a new controller. It is never one of the plan's controllers.

        The log identifies each controller by this index, even after an unload.
        """
        for place in range(len(self._plan.controllers), len(self._managed)):
            there = self._managed[place]
            if self._named.get(there.plan.name) is not there:  # another controller may have the name now
                return place
        return len(self._managed)

    def unload_controller(self, name: str) -> Refusal | None:
        """Remove an inactive controller from the run; return the refusal, None on success.

        Requires a paused loop.
        """
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
        self._events.emit_event(name, texts.controller_unloaded(self._clock.now_ns() - begin_ns))
        return None

    def change_period(self, period_ns: int) -> Refusal | None:
        """Adapt every controller to a new loop period, ns, so that each keeps its rate.

        Refuse if one cannot.
        """
        if refusal := next(_refused_rates(self.switching.standing.known, period_ns), None):
            return refusal
        for managed in self._named.values():
            managed.change_period(period_ns)
        return None

    def controller(self, name: str) -> Controller[Any] | None:
        """Return the loaded controller of this name, for use outside of the loop; None if there is none."""
        managed = self._named.get(name)
        return None if managed is None else managed.controller

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the active controllers in update order."""
        return tuple(managed.plan.name for managed in self._order if managed.active)

    @property
    def plans(self) -> tuple[ControllerPlan, ...]:
        """Plans of all controllers. The index is the controller's bit in the record's masks."""
        return tuple(managed.plan for managed in self._managed)

    def _sort(self) -> None:
        self.providers = tuple(one.provided for one in self._managed if one.provided is not None)
        loaded = [one for one in self._managed if self._named.get(one.plan.name) is one]
        for one in loaded:
            one.uppers = tuple(upper for upper in self._named.values() if one.plan.name in upper.plan.into)
        self._order = tuple(self._named[name] for name in update_order([one.plan for one in loaded]))

    def _configured(self, place: int, plan: ControllerPlan) -> ManagedController:
        managed = ManagedController(plan, place, self._shared)
        plans = {one.name: one for one in self._plan.controllers} | dict(self.switching.standing.known)
        managed.configure(plans)
        if managed.controller.Goals:
            self._goals.open_topic(self._topics)
        return managed


def _commanded_by(controller: str, upper: str, hint: str) -> Refusal:
    return Refusal(Code.COMMANDED, {"controller": controller, "upper": upper, "hint": hint})


def _refused_rates(plans: Plans, period_ns: int) -> Iterator[Refusal]:
    """Yield the reasons why controllers cannot run with a loop period, ns.

    A controller could not keep its own rate, or would not be updated in each cycle that updates a controller
    above it.
    """
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
