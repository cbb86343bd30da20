"""Steering: execute and answer a bounded number of client commands after each cycle's read.

Commands for the loop itself have a kind and data in the form that FORMS gives. This module executes them,
including changes of the loop's rate and pauses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from dxlrun.channels.answers import Acceptance, Answer, Code, CommandOutcome, Completion, Refusal
from dxlrun.channels.commands import LOOP, CommandMessage, TakenCommand
from dxlrun.channels.event_records import StreamEnd
from dxlrun.channels.loop_requests import (
    Cancel,
    NewCommander,
    ParametersRequest,
    Rate,
    RebootRequest,
    Register,
    RegisterReading,
    Switch,
    TorqueRequest,
    Unload,
)
from dxlrun.control import texts
from dxlrun.control.anchoring import Anchoring
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.goal_registry import PlayedPart, RunningGoal
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.gate import Gate
from dxlrun.control.halt import Halt
from dxlrun.control.joint_requests import JointRequests
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.policy_plan import HOLD

MOST_RATE = 100_000.0
"""Highest loop rate that clients can request, Hz; same limit as in the robot file."""
LEAST_RATE = 1.0
"""Lowest loop rate that clients can request, Hz. Commands, also `stop`, are executed once a cycle, and the
guardian's timeout follows the rate."""
PAUSE_LEASE_NS = 60_000_000_000
"""Time without a command for the loop after which a pause ends by the policy `on_stale_command`."""
PAUSED_CYCLE_NS = 200_000_000
"""Guardian's timeout of a cycle while the loop is paused. It is longer because a cycle may load a
controller."""
LONGEST_PLANNING_NS = 5_000_000_000
"""Longest wait for a controller that plans a goal; shorter than the gateway's timeout of a late answer."""
LONGEST_SHOWN = 120
"""Number of characters after which the text of a command is cut in its event."""


class Play(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of the command `play`: parts of a motion.

    An array with all their commands follows the JSON text.
    """

    parts: tuple[PlayedPart, ...]

    @property
    def words(self) -> str:
        """The data as text for an event: `motion of head, left_arm`."""
        return f"motion of {', '.join(dict.fromkeys(part.controller for part in self.parts))}"


FORMS: Mapping[str, type[msgspec.Struct] | None] = {
    "switch": Switch,
    "halt": None,
    "cancel": Cancel,
    "play": Play,
    "parameters": ParametersRequest,
    "rate": Rate,
    "pause": None,
    "resume": None,
    "load": ControllerPlan,
    "unload": Unload,
    "register": Register,
    "get": RegisterReading,
    "torque": TorqueRequest,
    "reboot": RebootRequest,
    "commander": NewCommander,
    "stop": None,
}
"""Commands for the loop by kind, with the type that their JSON data are decoded to; None: no data."""


class Steering:
    """Executes, logs and answers the commands of an inbox, and controls the loop's rate and pauses.

    Most commands are answered in the cycle that executes them. A switch that waits for modes is first
    answered with `Acceptance`, and again when its controllers are active or dropped. Torque requests,
    reboots, halts, and goals that are planned, are answered twice in the same way. A register is answered
    when the servo has responded.
    """

    def __init__(
        self,
        context: ControlContext,
        manager: Manager,
        gate: Gate,
        actions: PolicyActions,
    ) -> None:
        self.inbox = context.inbox
        self.joints = JointRequests(context, manager.switching, manager.registers, self._answer)
        self.halt = Halt(context, manager.switching, self._answer)
        self.anchoring = Anchoring(context, manager.switching, gate)
        self.paused_until_ns = 0
        """Time at which the pause ends without further commands, ns of the clock; 0: the loop is not paused.
        """
        self.stood = False
        """True in cycles of a pause and in the cycle that ends the pause. These cycles may be long."""
        self.planned: dict[int, RunningGoal] = {}
        """Goals whose controllers plan them, by number of the command that waits for its second answer."""
        self._context = context
        self._record = context.record
        self._supervision = context.supervision
        self._manager = manager
        self._gate = gate
        self._schedule = context.schedule
        self._actions = actions

    def _answer(self, number: int, answer: Answer) -> None:
        self.inbox.answer_command(number, answer)

    def execute_commands(self, commands: Sequence[CommandMessage]) -> int:
        """Execute and answer client commands, and end streams and pauses whose lease expired.

        The loop calls it only if there are commands, streams, a pause or a halt.

        Args:
            commands: Commands from the inbox.

        Returns:
            Number of commands that were passed to controllers.
        """
        count = 0
        record, manager = self._record, self._manager
        if self.halt.waiting:
            self.halt.check_rest()
        if self.paused:
            self.anchoring.watch_pause()
        for place, command in enumerate(commands, 1):
            self._context.command_log.record_command(
                TakenCommand(
                    t_ns=record.woken_ns,
                    cycle=record.cycle,
                    planned=-1,
                    controller=command.controller,
                    kind=command.kind,
                    origin=command.origin,
                    data=command.data,
                    lease_ns=command.lease_ns,
                    request=command.request,
                )
            )
            answer: Answer | None
            if command.controller == LOOP:
                answer, words = self._for_loop(command)
                self._report_command(command, answer, place, words)
                if self.paused:
                    self.paused_until_ns = record.woken_ns + PAUSE_LEASE_NS
            elif isinstance(found := manager.dispatch_command(command), Refusal):
                answer = found
                self._report_command(command, answer, place, "")
            else:
                answer = Completion(record.cycle) if found is None else self._goal_answer(found)
                if found is not None and isinstance(answer, Acceptance):
                    self.planned[command.number] = found
                count += 1
            if answer is not None:
                self.inbox.answer_command(command.number, answer)
        if 0 < self.paused_until_ns < record.woken_ns:
            self._expire_pause()
        if manager.streams:
            self._end_streams()
        return count

    def _expire_pause(self) -> None:
        """End a pause whose lease expired, by the policy `on_stale_command`."""
        self.resume_controllers()
        what = "its controllers are deactivated, and the joints are held"
        if not (ends := self._stale(texts.PAUSE_EXPIRED)):
            switching = self._manager.switching
            switching.switch_controllers((), self._commanding(), why=texts.PAUSE_EXPIRED)
        self._context.events.emit_event("loop", texts.pause_expired(ends or what))

    def _end_streams(self) -> None:
        """End the command streams whose lease expired, by the policy `on_stale_command`."""
        for name in self._manager.stale(self._record.woken_ns):
            if not (ends := self._stale(f"the stream of commands for {name} ended")):
                self._manager.hold_controller(name)
            event, data = texts.stream_expired(ends or "its joints are held"), StreamEnd(held=not ends)
            self._context.events.emit_event(name, event, msgspec.json.encode(data))

    def refuse_commands(self) -> None:
        """Refuse new client commands because the run is ending.

        They are not logged, as they have no effect.
        """
        for command in self.inbox.drain_commands():
            self.inbox.answer_command(command.number, Refusal(Code.RUN_ENDING))

    def answer_remaining(self) -> None:
        """Answer all client commands that still wait, after the last deactivation of controllers."""
        self.answer_late()
        self.joints.refuse_pending()
        self.halt.refuse_waiting()

    def answer_late(self) -> None:
        """Answer the `switch` commands whose wait for joint modes has ended, and goals that were planned."""
        ended = self._manager.switching.ended
        for number, refusal in ended:
            self.inbox.answer_command(number, refusal or Completion(self._record.cycle))
        ended.clear()
        for number, goal in tuple(self.planned.items()):
            if not isinstance(answer := self._goal_answer(goal), Acceptance):
                del self.planned[number]
                self.inbox.answer_command(number, answer)

    def _goal_answer(self, goal: RunningGoal) -> Answer:
        """Return the answer to the command of a goal: `Acceptance` while its controller plans it.

        A pause stops the planning, so it is not awaited.
        """
        if (refusal := goal.refusal) is not None:
            return refusal
        waited_ns = self._schedule.time_ns - goal.accepted_ns
        if goal.has_begun or goal.outcome is not None or self.paused or waited_ns >= LONGEST_PLANNING_NS:
            return Completion(self._record.cycle, goals=(goal.number,))
        return Acceptance((goal.controller,))

    # Rate and pause

    @property
    def paused(self) -> bool:
        """True while a client's `pause` command is in effect."""
        return self.paused_until_ns > 0

    def change_rate(self, rate: float) -> Refusal | None:
        """Change the rate of the loop from the next cycle on; refuse a rate that the robot cannot keep.

        Args:
            rate: Hz.

        Returns:
            The refusal, or None on success.
        """
        if not LEAST_RATE <= rate <= MOST_RATE:
            bounds = {"rate": rate, "lowest": LEAST_RATE, "highest": MOST_RATE}
            return Refusal(Code.RATE_OUT_OF_RANGE, bounds)
        plan, period_ns = self._context.plan, round(1e9 / rate)
        if period_ns < plan.least_period_ns:
            return Refusal(Code.RATE_OVER_BUSES, {"highest": 1e9 / plan.least_period_ns})
        if 0 < plan.slowest_period_ns < period_ns:
            return Refusal(Code.RATE_UNDER_WATCHDOG, {"lowest": 1e9 / plan.slowest_period_ns})
        ending_ns = plan.policies.slowest_period_ns(plan.period_ns)
        if ending_ns < period_ns:
            return Refusal(Code.RATE_UNDER_EXIT, {"lowest": 1e9 / ending_ns})
        if refusal := self._manager.change_period(period_ns):
            return refusal
        self._schedule.period_ns = period_ns
        self._set_cycle_limit()
        self._supervision.set_period(period_ns)
        return None

    def pause(self) -> Refusal | None:
        """Pause the loop: servos are read and held, but controllers are not updated and their time stops.

        Returns: The refusal if the loop is paused already, else None.
        """
        if self.paused:
            return Refusal(Code.PAUSED_ALREADY)
        self.stood = True
        self.anchoring.begin_pause()
        self.paused_until_ns = self._record.woken_ns + PAUSE_LEASE_NS
        self._set_cycle_limit()
        return None

    def resume_controllers(self) -> Refusal | None:
        """End the pause, with a slow start toward commands that differ from the goals.

        Returns: The refusal if the loop is not paused, else None.
        """
        if not self.paused:
            hint = "no controller commands its joints; activate one by `dxlrun switch --activate NAME`"
            return Refusal(Code.NOT_PAUSED, {} if self._commanding() else {"hint": hint})
        self.paused_until_ns = 0
        self.anchoring.end_pause()
        self._gate.ease_in()
        self._set_cycle_limit()
        return None

    def _commanding(self) -> tuple[str, ...]:
        """Return the controllers that command joints."""
        return self._manager.switching.commanding(self._record.layout.joints)

    def _set_cycle_limit(self) -> None:
        """Set the guardian's timeout of a cycle for the current period or pause, and send a heartbeat."""
        self._supervision.beat()
        period_ns = self._schedule.period_ns
        self._supervision.limit_cycle(max(period_ns, PAUSED_CYCLE_NS) if self.paused else period_ns)

    def _stale(self, why: str) -> str:
        """End the run if the policy `on_stale_command` requires it; return the text for the event.

        The text is empty if the run continues.
        """
        policy = self._context.plan.policies.of_features.get("on_stale_command", HOLD)
        if policy.goes_on:
            return ""
        self._actions.end_run("on_stale_command", why)
        return f"the run ends: {policy.text}"

    # Commands

    def _for_loop(self, command: CommandMessage) -> tuple[Answer | None, str]:
        """Decode and execute a command for the loop itself.

        Returns its answer, None if that comes later, and its data as text for the event.
        """
        kind, data, numbers = command.kind, command.data, b""
        if kind not in FORMS:
            problem = f"the loop has no command {kind}; known: {', '.join(FORMS)}"
            return Refusal(Code.INVALID, {"problem": problem}), ""
        if kind in ("load", "unload") and not self.paused:
            return Refusal(Code.NOT_IN_PAUSE), ""
        if kind == "play":
            data, _, numbers = data.partition(b"\n")
        form = FORMS[kind]
        try:
            request = None if form is None else msgspec.json.decode(data, type=form)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            return Refusal(Code.INVALID, {"problem": f"wrong data for {kind}: {error}"}), ""
        words = request.name if isinstance(request, ControllerPlan) else getattr(request, "words", "")
        if isinstance(request, TorqueRequest | RebootRequest | Register | RegisterReading):
            return self.joints.execute_request(command.number, request), words
        return self._execute(command, request, numbers) or Completion(self._record.cycle), words

    def _execute(
        self, command: CommandMessage, request: msgspec.Struct | None, numbers: bytes
    ) -> Answer | None:
        """Execute a decoded command for the loop; return its answer, or None on success without a result."""
        manager = self._manager
        found: Answer | None = None
        match request:
            case Switch():
                activate, deactivate = request.activate, request.deactivate
                found = manager.switching.switch_controllers(activate, deactivate, command.number)
            case Cancel():
                found = manager.cancel_goal(request.goal, request.controller)
            case Play():
                goals = manager.play_motion(request.parts, numbers, command.origin)
                found = goals if isinstance(goals, Refusal) else Completion(self._record.cycle, goals=goals)
            case ParametersRequest():
                found = manager.change_parameters(request.controller, request.values)
            case Rate():
                found = self.change_rate(request.rate)
            case ControllerPlan():
                place = manager.load_controller(request)
                self._supervision.beat()  # loading takes long: the guardian's timeout applies to each load
                found = place if isinstance(place, Refusal) else Completion(self._record.cycle, place)
            case Unload():
                found = manager.unload_controller(request.controller)
            case NewCommander():
                pass
            case _ if command.kind == "halt":
                found = self.halt.halt_joints(command.number)
            case _ if command.kind == "pause":
                found = self.pause()
            case _ if command.kind == "resume":
                found = self.resume_controllers()
            case _:
                self._supervision.stop.request()
        return found

    # Reports

    def _report_command(self, command: CommandMessage, answer: Answer | None, place: int, words: str) -> None:
        """Emit an event for a refused command or a command for the loop.

        `Manager` reports accepted ones for controllers.
        """
        refusal = answer if isinstance(answer, Refusal) else None
        if refusal is not None:
            source = command.controller or "loop"
            event = texts.command_refused(command.kind, command.origin, refusal.text)
        else:
            source = "loop"
            shown = f"{command.kind} {words}".strip()
            if len(shown) > LONGEST_SHOWN:
                shown = f"{shown[:LONGEST_SHOWN]} ..."
            event = texts.loop_steered(shown, command.origin)
        data = msgspec.json.encode(CommandOutcome(command.kind, command.origin, refusal, place))
        self._context.events.emit_event(source, event, data)
