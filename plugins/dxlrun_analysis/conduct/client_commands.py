"""Client commands in a log, each matched with the event that reports its execution or refusal."""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np

from dxlrun import Log
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.records import ClientCommand, CommandOutcome, Event, EventCode, TakenCommand

POLICY = "policy"  # Kind of the command that the loop logs when the steps of a policy begin
_LOOP = "loop"


def client_commands(log: Log) -> tuple[ClientCommand, ...]:
    """Return the commands of all clients in order of the cycles, each with the reason of its refusal, if any.

    Planned commands of the robot file, and the record of a policy's begin, are omitted.
    """
    answers = _answers(log)
    last = policy_begun(log)
    found: list[ClientCommand] = []
    place = 0
    for command in log.commands:
        if command.planned < 0 and command is not last:
            place = place + 1 if found and found[-1].command.cycle == command.cycle else 1
            refusal = _refusal(command, place, answers.get(command.cycle, deque()))
            found.append(ClientCommand(command, refusal))
    return tuple(found)


def policy_begun(log: Log) -> TakenCommand | None:
    """Return the loop's own record of the cycle in which the steps of a policy begin, or None.

    The time of this record is before the wake-up of its cycle. A client's command of the same kind has the
    time of the cycle itself.
    """
    last = log.commands[-1] if log.commands else None
    if last is None or not last.for_loop or (last.kind, last.origin) != (POLICY, _LOOP):
        return None
    woken = log.cycles["woken_ns"][log.cycles["cycle"] == last.cycle]
    return None if len(woken) and int(woken[0]) <= last.t_ns else last


def unlogged_commands(log: Log) -> tuple[int, ...]:
    """Return the cycles in which the loop answered more commands than the log has."""
    named_loop = any(controller.name == _LOOP for controller in log.controllers)
    held: dict[int, int] = {}
    for command in log.commands:
        if command.for_loop or (named_loop and command.controller == _LOOP):
            held[command.cycle] = held.get(command.cycle, 0) + 1
    missing = (
        cycle
        for cycle, events in _answers(log).items()
        if sum(event.source == _LOOP for event in events) > held.get(cycle, 0)
    )
    return tuple(sorted(missing))


def _answers(log: Log) -> dict[int, deque[Event]]:
    """Return the events that report an executed or refused command, by number of the cycle."""
    woken, updated, numbers = (log.cycles[name] for name in ("woken_ns", "updated_ns", "cycle"))
    answers: dict[int, deque[Event]] = {}
    for event in log.events:
        if event.code not in (EventCode.STEERED, EventCode.COMMAND_REFUSED):
            continue
        index = int(np.searchsorted(woken, event.t_ns, side="right")) - 1
        if index >= 0 and event.t_ns <= updated[index]:
            answers.setdefault(int(numbers[index]), deque()).append(event)
    return answers


def _refusal(command: TakenCommand, place: int, answers: deque[Event]) -> str:
    """Remove the answer to a command from the answers of its cycle; return the reason of its refusal, empty
    if there is none.

    `place` counts the client commands of the cycle from 1. Controllers answer only commands that they refuse.
    """
    source = command.controller or _LOOP
    for event in answers:
        outcome = _outcome(event, command)
        if event.source != source or (outcome.kind, outcome.origin) != (command.kind, command.origin):
            continue
        if outcome.place not in (0, place):
            continue  # The answer belongs to another command of this cycle with the same kind and origin
        answers.remove(event)
        return outcome.refusal.text if outcome.refusal else ""
    return ""


def _outcome(event: Event, command: TakenCommand) -> CommandOutcome:
    try:
        return msgspec.json.decode(event.data, type=CommandOutcome)
    except UNREADABLE:
        return CommandOutcome("", "")
