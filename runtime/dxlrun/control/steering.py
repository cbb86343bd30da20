"""Steering: what the loop does with commands from outside, at the start of a cycle, so many and no more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import msgspec
import numpy as np

from dxlrun.control.controllers.manager import Manager
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.run.channels.commands import LOOP, Command, CommandSink, Inbox, TakenCommand
from dxlrun.run.channels.cycle import CycleRecord
from dxlrun.run.channels.events import EventCode, EventSink, Severity


class Steered(Protocol):
    """What can be done to a loop from outside; each returns why it was refused, empty when it was done."""

    def change_rate(self, rate: float) -> str:
        """Run in another period from the next cycle on; Hz."""
        ...

    def pause(self) -> str:
        """Stop the controllers' time: servos are read and held, nobody is updated."""
        ...

    def resume(self) -> str:
        """Let the controllers' time go on."""
        ...

    def load(self, plan: ControllerPlan) -> str:
        """Configure one more controller; the guardian has patience for each of them."""
        ...

    def set_register(self, joint: str, item: str, value: int, done: Callable[[str], None]) -> str:
        """Have a RAM item of a joint's servo written; `done` is called when it is, or with why it is not."""
        ...

    def finish(self) -> str:
        """End the run in order after this cycle."""
        ...

    def expire(self, controller: str) -> str:
        """Do what the policy for a stale command says; return that in words."""
        ...

    @property
    def paused(self) -> bool:
        """True between `pause` and `resume`."""
        ...


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


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `register`; what may be written was checked before it came here."""

    joint: str
    item: str
    value: int
    """The integer on the wire, signed where the item is."""


KINDS = ("switch", "rate", "pause", "resume", "load", "unload", "register", "stop")
"""Commands for the loop itself; `load` carries a ControllerPlan, `pause`, `resume` and `stop` nothing."""


@dataclass(slots=True)
class Steering:
    """Takes commands out of an inbox and answers each of them once: at once, but for registers, which take
    some gaps between cycles."""

    inbox: Inbox
    loop: Steered
    manager: Manager
    record: CycleRecord
    events: EventSink
    taken: CommandSink

    def take(self, time_ns: int) -> int:
        """Do what waits, and end streams whose lease ran out; return how many commands controllers took."""
        count = 0
        for command in self.inbox.take():
            self._log(command)
            obey = self._obey if command.controller == LOOP else self._hand
            refusal = obey(command, time_ns)
            if refusal:
                source = command.controller or "loop"
                text = f"{command.kind} from {command.origin} refused: {refusal}"
                self.events.emit(EventCode.COMMAND_REFUSED, Severity.WARNING, source, text)
            elif command.controller == LOOP:
                text = f"{command.kind} {command.data.decode(errors='replace')}".strip()
                self.events.emit(EventCode.STEERED, Severity.INFO, "loop", f"{text} from {command.origin}")
            else:
                count += 1
            if refusal is not None:
                self.inbox.answer(command.number, refusal)
        self._expire()
        return count

    def refuse(self, why: str) -> None:
        """Answer what waits without doing it; it is not in the log, as it changes nothing."""
        for command in self.inbox.take():
            self.inbox.answer(command.number, why)

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
            )
        )

    def _hand(self, command: Command, time_ns: int) -> str | None:
        if len(command.data) % 8:
            return f"{len(command.data)} bytes are no array of numbers"
        data = np.frombuffer(command.data, dtype="<f8")
        until_ns = self.record.woken_ns + command.lease_ns if command.lease_ns else 0
        name, kind, origin = command.controller, command.kind, command.origin
        return self.manager.hand(name, kind, data, origin, time_ns, until_ns)

    def _expire(self) -> None:
        for name in self.manager.stale(self.record.woken_ns):
            text = f"the stream of commands ended; {self.loop.expire(name)}"
            self.events.emit(EventCode.STALE_COMMAND, Severity.WARNING, name, text)

    def _obey(self, command: Command, time_ns: int) -> str | None:
        """Return why a command for the loop is refused, empty when it is done, None while it is not yet."""
        try:
            return self._do(command, time_ns)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            return f"its data does not fit: {error}"

    def _do(self, command: Command, time_ns: int) -> str | None:
        loop, manager, data = self.loop, self.manager, command.data
        refusal: str | None
        match command.kind:
            case "switch":
                switch = msgspec.json.decode(data, type=Switch)
                refusal = manager.switch(switch.activate, switch.deactivate, time_ns)
            case "rate":
                refusal = loop.change_rate(msgspec.json.decode(data, type=Rate).rate)
            case "pause":
                refusal = loop.pause()
            case "resume":
                refusal = loop.resume()
            case "stop":
                refusal = loop.finish()
            case "load" | "unload" if not loop.paused:
                refusal = "pause the loop first: it stands still meanwhile"
            case "load":
                refusal = loop.load(msgspec.json.decode(data, type=ControllerPlan))
            case "unload":
                refusal = manager.unload(msgspec.json.decode(data, type=Unload).controller)
            case "register":
                wish = msgspec.json.decode(data, type=Register)
                done = partial(self.inbox.answer, command.number)
                refusal = loop.set_register(wish.joint, wish.item, wish.value, done) or None
            case _:
                refusal = f"the loop knows {', '.join(KINDS)}"
        return refusal
