"""What was steered: commands from outside, streams as one, and for how long the loop was paused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from dxlrun.analysis.latency import first_deadline_ns
from dxlrun.commands import TakenCommand
from dxlrun.recording.reader import Log
from dxlrun.recording.steered import Steered, policy_begun, steered

_LONGEST = 80


class _Data(msgspec.Struct):
    """What the JSON of the loop's commands may say; each kind has some of it."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()
    rate: float | None = None
    name: str = ""
    controller: str = ""
    policy: str = ""
    joint: str = ""
    item: str = ""
    value: int = 0


@dataclass(frozen=True, slots=True)
class Act:
    """One thing that somebody asked, or a stream of set-points."""

    time_s: float
    """Since the loop's first deadline."""
    cycle: int
    kind: str
    what: str
    """In words."""
    origin: str
    refusal: str
    """Why it was not done; empty: it was."""
    set_points: int = 0
    """Of a stream; 0: this is none."""


@dataclass(frozen=True, slots=True)
class Pause:
    """One pause of the controllers' time."""

    begin_s: float
    """Since the loop's first deadline."""
    end_s: float
    periods: int


def acts(log: Log) -> tuple[Act, ...]:
    """Return what was asked, in the order of the cycles, and which policy began at the end."""
    start_ns = first_deadline_ns(log)
    found: list[Act] = []
    streams: dict[str, tuple[int, TakenCommand]] = {}
    for one in steered(log):
        command = one.command
        index, last = streams.pop(command.controller, (-1, None))
        if last is not None and found[index].refusal == one.refusal and _goes_on(last, command):
            found[index] = _one_more(found[index], command)
        else:
            index = len(found)
            found.append(_act(one, start_ns))
        if command.lease_ns:
            streams[command.controller] = index, command
    begun = policy_begun(log)
    if begun is not None:
        found.append(_act(Steered(begun, ""), start_ns))
    return tuple(found)


def pauses(log: Log) -> tuple[Pause, ...]:
    """Return the pauses; the last one may end with the run, or where a policy begins."""
    cycles = log.cycles
    if not len(cycles):
        return ()
    begun = policy_begun(log)
    end = int(cycles["cycle"][-1]) + 1 if begun is None else begun.cycle
    found: list[Pause] = []
    since: int | None = None
    for one in steered(log):
        kind = one.command.kind if one.command.for_loop and not one.refusal else ""
        if kind == "pause" and since is None:
            since = one.command.cycle
        elif kind == "resume" and since is not None:
            found.append(_pause(log, since, one.command.cycle))
            since = None
    if since is not None and end > since:
        found.append(_pause(log, since, end))
    return tuple(found)


def _pause(log: Log, begin: int, end: int) -> Pause:
    cycles, start_ns = log.cycles, first_deadline_ns(log)
    due = cycles["scheduled_ns"]
    first, last = (
        min(int(np.searchsorted(cycles["cycle"], cycle)), len(cycles) - 1) for cycle in (begin, end)
    )
    return Pause((int(due[first]) - start_ns) / 1e9, (int(due[last]) - start_ns) / 1e9, end - begin)


def _goes_on(last: TakenCommand, command: TakenCommand) -> bool:
    """Say whether a set-point belongs to the stream of the one before."""
    return (
        bool(command.lease_ns)
        and (command.kind, command.origin) == (last.kind, last.origin)
        and command.t_ns <= last.t_ns + last.lease_ns
    )


def _one_more(act: Act, command: TakenCommand) -> Act:
    count = act.set_points + 1
    return replace(act, set_points=count, what=_stream(command, count))


def _act(one: Steered, start_ns: int) -> Act:
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
    )


def _stream(command: TakenCommand, count: int) -> str:
    points = "1 set-point" if count == 1 else f"{count} set-points"
    return f"stream of {command.kind} for {command.controller}, {points}, lease {command.lease_ns / 1e6:g} ms"


def _words(command: TakenCommand) -> str:
    """Return a command as a person says it; what cannot be read as it is."""
    if not command.for_loop:
        return f"{command.kind} for {command.controller}"
    try:
        data = msgspec.json.decode(command.data or b"{}", type=_Data)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        text = f"{command.kind} {command.text}"
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
        "policy": data.policy,
    }
    return f"{command.kind} {known.get(command.kind, '')}".strip()
