"""Requests of clients in a run: commands, streams of set-points as one entry each, and pauses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.records import ClientCommand, Event, EventCode, StreamEnd, TakenCommand
from dxlrun_analysis.conduct.client_commands import client_commands, policy_begun
from dxlrun_analysis.cycles.punctuality import DISORDER_NS, begins, first_deadline_ns

_LONGEST = 80  # Characters of unreadable data that are shown
_ANSWERS = frozenset((EventCode.STEERED, EventCode.COMMAND_REFUSED))
_CYCLE = np.dtype([(name, "i8") for name in ("cycle", "scheduled_ns", "woken_ns", "updated_ns")])
"""Fields of a cycle that are kept until its commands and answers are complete."""


class _Data(msgspec.Struct):
    """Data of a command that the loop executes itself; a command has the keys of its kind."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()
    rate: float | None = None
    name: str = ""
    controller: str = ""
    policy: str = ""
    joint: str = ""
    item: str = ""
    value: int = 0
    joints: tuple[str, ...] = ()
    on: bool = False


@dataclass(frozen=True, slots=True)
class Act:
    """One client command, or a whole stream of set-points from one client."""

    time_s: float  # Time since the first deadline
    cycle: int
    kind: str
    what: str  # Description in words
    origin: str
    refusal: str  # Reason of the refusal; empty if the command was executed
    set_points: int = 0  # Number of set-points; 0 if this is not a stream
    controller: str = ""  # Controller of a stream
    ended_s: float | None = None
    """Time at which the lease of a stream ran out for good; None if it did not."""
    held: bool = False  # The controller then held its joints until the end of the run


@dataclass(frozen=True, slots=True)
class Pause:
    """One pause of the loop, in which the time of the controllers stood still."""

    begin_s: float  # Time since the first deadline
    end_s: float
    periods: int


class SteeringHistory:
    """Accumulator of client commands, fed with the log slice by slice. A stream is one entry.

    An answer and its cycle can be in a later slice than the command. The newest commands are kept until their
    answers are complete.
    """

    def __init__(self) -> None:
        self._log: Log | None = None
        self._start_ns = 0
        self._begun = False
        self._commands: list[TakenCommand] = []
        self._events: list[Event] = []
        self._cycles: NDArray[np.void] = np.zeros(0, _CYCLE)
        self._acts: list[Act] = []
        self._pauses: list[Pause] = []
        self._since: tuple[int, int] | None = None
        """Cycle and deadline at which the current pause began, or None."""
        self._streams: dict[str, tuple[int, TakenCommand]] = {}
        self._last: TakenCommand | None = None
        self._stale: dict[str, tuple[int, bool]] = {}
        """Time at which the last stream of each controller ran out, and whether its joints were held."""
        self._left_ns: dict[str, int] = {}
        """Time at which a controller whose last stream ran out was deactivated."""
        self._expired_ns: list[int] = []
        """Times at which a pause ended without a client, oldest first, that are not matched yet."""

    def add_slice(self, log: Log) -> None:
        """Add the commands and their answers in the next slice of the log."""
        if not self._begun:
            self._start_ns = first_deadline_ns(log)
            self._begun = begins(log)
        self._log = replace(log, cycles=log.cycles[:0], packets=log.packets[:0], events=(), commands=())
        self._commands += log.commands
        for event in log.events:
            if event.code in _ANSWERS:
                self._events.append(event)
            elif event.code == EventCode.STALE_COMMAND and event.source == "loop":
                self._expired_ns.append(event.t_ns)
            elif event.code == EventCode.STALE_COMMAND:
                held = bool(event.data) and msgspec.json.decode(event.data, type=StreamEnd).held
                self._stale[event.source] = event.t_ns, held
            elif event.code == EventCode.CONTROLLER_DEACTIVATED and event.source in self._stale:
                self._left_ns[event.source] = event.t_ns
        rows = np.zeros(len(log.cycles), _CYCLE)
        for name in _CYCLE.names or ():
            rows[name] = log.cycles[name]
        self._cycles = np.concatenate([self._cycles, rows])
        due = self._cycles["scheduled_ns"]
        if len(due) and due[-1] - due[0] > 2 * DISORDER_NS:
            self._digest(int(due[-1]) - DISORDER_NS)

    def collect_acts(self) -> tuple[tuple[Act, ...], tuple[Pause, ...]]:
        """Return the commands in order of the cycles, including the begin of a policy, and the pauses.

        The last pause can end with the run or at the begin of a policy.
        """
        if self._log is None:
            return (), ()
        commands = self._commands[-1:] or ([self._last] if self._last is not None else [])
        begun = policy_begun(replace(self._log, cycles=self._cycles, commands=tuple(commands)))
        end_ns = int(self._cycles["updated_ns"][-1]) if len(self._cycles) else 0
        self._digest(None)
        for controller, (index, last) in self._streams.items():
            ended_ns, held = self._stale.get(controller, (0, False))
            if ended_ns > last.t_ns and not self._acts[index].refusal:
                left_ns = self._left_ns.get(controller, 0)
                held &= not ended_ns < left_ns < end_ns
                ended_s = (ended_ns - self._start_ns) / 1e9
                self._acts[index] = replace(self._acts[index], ended_s=ended_s, held=held)
        if begun is not None:
            self._acts.append(_act(ClientCommand(begun, ""), self._start_ns))
        if self._since is not None and len(self._cycles):
            end = int(self._cycles["cycle"][-1]) + 1 if begun is None else begun.cycle
            if end > self._since[0]:
                self._pause(end)
        return tuple(self._acts), tuple(self._pauses)

    def _digest(self, until_ns: int | None) -> None:
        """Match the commands before a time (ns; None: all) with their answers, and add them."""
        log = self._log
        if log is None:
            return
        now = [one for one in self._commands if until_ns is None or one.t_ns < until_ns]
        part = replace(log, cycles=self._cycles, events=tuple(self._events), commands=tuple(now))
        for one in client_commands(part):
            self._expire_pauses(one.command.t_ns)
            self._add(one)
        self._expire_pauses(until_ns)
        self._last = now[-1] if now else self._last
        if until_ns is not None:
            self._commands = [one for one in self._commands if one.t_ns >= until_ns]
            self._events = [event for event in self._events if event.t_ns >= until_ns]
            self._cycles = self._cycles[self._cycles["updated_ns"] >= until_ns]

    def _add(self, one: ClientCommand) -> None:
        command, found = one.command, self._acts
        index, last = self._streams.pop(command.controller, (-1, None))
        if last is not None and found[index].refusal == one.refusal and _continues(last, command):
            found[index] = _one_more(found[index], command)
        else:
            index = len(found)
            found.append(_act(one, self._start_ns))
        if command.lease_ns:
            self._streams[command.controller] = index, command
        kind = command.kind if command.for_loop and not one.refusal else ""
        if kind == "pause" and self._since is None:
            self._since = command.cycle, self._due_ns(command.cycle)
        elif kind == "resume":
            self._pause(command.cycle)

    def _expire_pauses(self, until_ns: int | None) -> None:
        """End the pause that no client ended before a time (ns; None: any)."""
        while self._expired_ns and (until_ns is None or self._expired_ns[0] < until_ns):
            index = int(np.searchsorted(self._cycles["scheduled_ns"], self._expired_ns.pop(0), "right")) - 1
            if index >= 0:
                self._pause(int(self._cycles["cycle"][index]))

    def _pause(self, end: int) -> None:
        """Add the current pause, if there is one, with its last cycle before `end`."""
        if self._since is None:
            return
        (begin, begin_ns), self._since = self._since, None
        start_ns = self._start_ns
        times = ((begin_ns - start_ns) / 1e9, (self._due_ns(end) - start_ns) / 1e9)
        self._pauses.append(Pause(*times, end - begin))

    def _due_ns(self, cycle: int) -> int:
        index = min(int(np.searchsorted(self._cycles["cycle"], cycle)), len(self._cycles) - 1)
        return int(self._cycles["scheduled_ns"][index]) if index >= 0 else self._start_ns


def _continues(last: TakenCommand, command: TakenCommand) -> bool:
    """Return whether a set-point continues the stream of the last: same kind and client, in its lease."""
    return (
        bool(command.lease_ns)
        and (command.kind, command.origin) == (last.kind, last.origin)
        and command.t_ns <= last.t_ns + last.lease_ns
    )


def _one_more(act: Act, command: TakenCommand) -> Act:
    count = act.set_points + 1
    return replace(act, set_points=count, what=_stream(command, count))


def _act(one: ClientCommand, start_ns: int) -> Act:
    command = one.command
    streamed = bool(command.lease_ns)
    return Act(
        time_s=(command.t_ns - start_ns) / 1e9,
        cycle=command.cycle,
        kind=command.kind,
        what=_stream(command, 1) if streamed else _words(command),
        origin=command.origin,
        refusal=one.refusal,
        set_points=int(streamed),
        controller=command.controller if streamed else "",
    )


def _stream(command: TakenCommand, count: int) -> str:
    points = "1 set-point" if count == 1 else f"{count} set-points"
    return f"stream of {command.kind} for {command.controller}, {points}, lease {command.lease_ns / 1e6:g} ms"


def _words(command: TakenCommand) -> str:
    """Return a command as text, such as `torque off: knee`; unreadable data are appended as they are."""
    if not command.for_loop:
        return f"{command.kind} for {command.controller}"
    try:
        data = msgspec.json.decode(command.data or b"{}", type=_Data)
    except UNREADABLE:
        text = f"{command.kind} {command.data_text}"
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
    parts = [f"activate {', '.join(data.activate)}"] if data.activate else []
    parts += [f"deactivate {', '.join(data.deactivate)}"] if data.deactivate else []
    rate = f"{data.rate:g} Hz" if command.kind == "rate" and data.rate is not None else ""
    known = {
        "switch": "; ".join(parts),
        "rate": rate,
        "load": data.name,
        "unload": data.controller,
        "register": f"{data.item} of {data.joint} = {data.value}",
        "get": f"{data.item} of {data.joint}",
        "torque": f"{'on' if data.on else 'off'}: {', '.join(data.joints)}",
        "reboot": ", ".join(data.joints),
        "policy": data.policy,
    }
    return f"{command.kind} {known.get(command.kind, '')}".strip()
