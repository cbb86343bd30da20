"""Steering: after a cycle's read, take commands from outside, a bounded number, and answer each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np

from dxlrun.channels.answers import Answer, Code, CommandOutcome, Done, Refusal, Waiting
from dxlrun.channels.commands import LOOP, Command, CommandSink, Inbox, TakenCommand
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.control.controllers.goals import PlayedPart
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.halt import Halt
from dxlrun.control.joint_requests import JOINT_KINDS, JointRequests
from dxlrun.plan.loop_plan import ControllerPlan


class Steered(Protocol):
    """What commands from outside do to a loop; None: it is done."""

    def change_rate(self, rate: float) -> Refusal | None:
        """Run in another period from the next cycle on; Hz."""

    def pause(self) -> Refusal | None:
        """Stop the controllers' time: servos are read and held, no controller is updated."""

    def resume(self) -> Refusal | None:
        """Let the controllers' time run again."""

    def load(self, plan: ControllerPlan) -> int | Refusal:
        """Configure one more controller; return its place."""

    def finish(self) -> None:
        """End the run in order after this cycle."""

    def expire(self, controller: str) -> str:
        """Execute the policy for a stale command; return it in words, for the log."""

    @property
    def paused(self) -> bool:
        """True between `pause` and `resume`."""

    @property
    def paused_until_ns(self) -> int:
        """When a pause ends without its client; 0: no pause."""

    def renew_pause(self) -> None:
        """Let a pause go on: a client gave the loop a command."""

    def end_pause(self) -> str:
        """Execute the policy for a pause that no client ended; return it in words, for the log."""


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `switch`: names of controllers; all of it happens in one cycle, or nothing does."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()


class Rate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `rate`."""

    rate: float
    """Hz"""


class Unload(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `unload`."""

    controller: str


class Cancel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `cancel`: a goal by its number, or the one that a controller has."""

    goal: int = 0
    controller: str = ""


class Play(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `play`: what controllers are given from this cycle on; the array has all commands in a row."""

    parts: tuple[PlayedPart, ...]


class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `parameters`: live parameters of a controller, checked against its model before."""

    controller: str
    values: dict[str, bool | int | float]
    """By dotted name, in SI units."""


KINDS = (
    "switch",
    "halt",
    "cancel",
    "play",
    "parameters",
    "rate",
    "pause",
    "resume",
    "load",
    "unload",
    *JOINT_KINDS,
    "stop",
)
"""Commands for the loop; `load` carries a ControllerPlan, `halt`, `pause`, `resume` and `stop` nothing."""


LONGEST_SHOWN = 120
"""Characters of a command's data in the event that reports it."""


@dataclass(slots=True)
class Steering:
    """Executes the commands of an inbox, logs them, and answers them.

    Most are answered in the cycle that takes them. A switch that waits for modes is answered by `Waiting`
    first, and again when its controllers are active or given up; so are torque, reboots, and a halt when the
    joints stand still. A register is
    answered when the servo has it.
    """

    inbox: Inbox
    loop: Steered
    manager: Manager
    joints: JointRequests
    halt: Halt
    record: CycleRecord
    events: EventSink
    taken: CommandSink

    def take(self, time_ns: int) -> int:
        """Execute what has come, and end streams and pauses whose lease ran out.

        Returns the number of commands for controllers.
        """
        count = 0
        if self.halt.waiting:
            self.halt.watch()
        for place, command in enumerate(self.inbox.take(), 1):
            self._log(command)
            execute = self._for_loop if command.controller == LOOP else self._for_controller
            answer = execute(command, time_ns)
            if isinstance(answer, Refusal):
                self._report_refusal(command, answer, place)
            elif command.controller == LOOP:
                shown = command.data.partition(b"\n")[0].decode(errors="replace")
                if len(shown) > LONGEST_SHOWN:
                    shown = f"{shown[:LONGEST_SHOWN]} ..."  # all of it is among the log's commands
                text = f"{command.kind} {shown}".strip()
                data = msgspec.json.encode(CommandOutcome(command.kind, command.origin, place=place))
                text = f"{text} from {command.origin}"
                self.events.emit(EventCode.STEERED, Severity.INFO, "loop", text, data)
            else:
                count += 1
            if command.controller == LOOP:
                self.loop.renew_pause()
            if answer is not None:
                self.inbox.answer(command.number, answer)
        if 0 < self.loop.paused_until_ns < self.record.woken_ns:
            text = f"no client ended the pause; {self.loop.end_pause()}"
            self.events.emit(EventCode.STALE_COMMAND, Severity.WARNING, "loop", text)
        for name in self.manager.stale(self.record.woken_ns):
            text = f"the stream of commands ended; {self.loop.expire(name)}"
            self.events.emit(EventCode.STALE_COMMAND, Severity.WARNING, name, text)
        return count

    def refuse(self) -> None:
        """Refuse what has come, because the run is ending; it is not in the log, as it changes nothing."""
        for command in self.inbox.take():
            self.inbox.answer(command.number, Refusal(Code.RUN_ENDING))

    def end(self) -> None:
        """Answer what waits still: the controllers are inactive."""
        self.answer_late()
        self.joints.end()
        self.halt.end()

    def answer_late(self) -> None:
        """Answer the switches that waited for modes and have come to an end."""
        ended = self.manager.ended_switches
        for number, refusal in ended:
            self.inbox.answer(number, refusal or Done(self.record.cycle))
        ended.clear()

    def _report_refusal(self, command: Command, refusal: Refusal, place: int) -> None:
        source = command.controller or "loop"
        text = f"{command.kind} from {command.origin} refused: {refusal.text}"
        data = msgspec.json.encode(CommandOutcome(command.kind, command.origin, refusal, place))
        self.events.emit(EventCode.COMMAND_REFUSED, Severity.WARNING, source, text, data)

    def _log(self, command: Command) -> None:
        record = self.record
        self.taken.take(
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

    def _for_controller(self, command: Command, time_ns: int) -> Answer:
        if len(command.data) % 8:
            problem = f"{len(command.data)} bytes are no array of numbers"
            return Refusal(Code.INVALID, {"problem": problem})
        data = np.frombuffer(command.data, dtype="<f8")
        until_ns = self.record.woken_ns + command.lease_ns if command.lease_ns else 0
        name, kind, origin = command.controller, command.kind, command.origin
        found = self.manager.hand(name, kind, data, origin, time_ns, until_ns)
        if isinstance(found, Refusal):
            return found
        return Done(self.record.cycle, goals=(found,) if found else ())

    def _for_loop(self, command: Command, time_ns: int) -> Answer | None:
        """Execute a command for the loop itself; None: it is answered later."""
        if command.kind == "halt":
            return self.halt.begin(command.number, time_ns)
        try:
            return self._execute(command, time_ns)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            return Refusal(Code.INVALID, {"problem": f"the data of {command.kind} do not fit: {error}"})

    def _to_controllers(self, command: Command, time_ns: int) -> Answer:
        """Execute what the loop does with the goals and the parameters of controllers."""
        manager, data, refusal = self.manager, command.data, None
        if command.kind == "play":
            head, _, numbers = data.partition(b"\n")
            parts = msgspec.json.decode(head, type=Play).parts
            goals = manager.play(parts, numbers, command.origin, time_ns)
            return goals if isinstance(goals, Refusal) else Done(self.record.cycle, goals=goals)
        if command.kind == "cancel":
            cancel = msgspec.json.decode(data, type=Cancel)
            refusal = manager.cancel(cancel.goal, cancel.controller, time_ns)
        else:
            changed = msgspec.json.decode(data, type=Parameters)
            refusal = manager.change_parameters(changed.controller, changed.values, time_ns)
        return refusal or Done(self.record.cycle)

    def _execute(self, command: Command, time_ns: int) -> Answer | None:
        loop, manager, data = self.loop, self.manager, command.data
        answer: Refusal | Waiting | None = None
        match command.kind:
            case "switch":
                switch = msgspec.json.decode(data, type=Switch)
                answer = manager.switch(switch.activate, switch.deactivate, time_ns, command.number)
            case "cancel" | "play" | "parameters":
                return self._to_controllers(command, time_ns)
            case "rate":
                answer = loop.change_rate(msgspec.json.decode(data, type=Rate).rate)
            case "pause":
                answer = loop.pause()
            case "resume":
                answer = loop.resume()
            case "stop":
                loop.finish()
            case "load" | "unload" if not loop.paused:
                answer = Refusal(Code.NOT_IN_PAUSE)
            case "load":
                found = loop.load(msgspec.json.decode(data, type=ControllerPlan))
                return found if isinstance(found, Refusal) else Done(self.record.cycle, found)
            case "unload":
                answer = manager.unload(msgspec.json.decode(data, type=Unload).controller)
            case kind if kind in JOINT_KINDS:
                return self.joints.execute(command, time_ns)
            case _:
                problem = f"the loop has no command {command.kind}; known: {', '.join(KINDS)}"
                answer = Refusal(Code.INVALID, {"problem": problem})
        return answer or Done(self.record.cycle)
