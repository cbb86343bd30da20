"""Inputs beside the servos': what clients asked of the loop, given to the same cycles again."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from dxlrun.errors import LogError
from dxlrun.log.steered import Steered
from dxlrun.run.channels.answers import Answer, Refusal
from dxlrun.run.channels.commands import Command, TakenCommand
from dxlrun.run.channels.cycle import CycleRecord


class RecordedInbox:
    """Where the loop finds in each cycle what it found then, however much that was.

    `remarks`: a sentence for each command that was done in the run and is refused now, or the other way.
    """

    def __init__(self, steered: Iterable[Steered], record: CycleRecord) -> None:
        self.remarks: list[str] = []
        self._steered = tuple(steered)
        self._answered: set[int] = set()
        self._record = record
        self._by_cycle: dict[int, list[Command]] = {}
        for number, one in enumerate(self._steered):
            then = one.command
            self._by_cycle.setdefault(then.cycle, []).append(
                Command(number, then.controller, then.kind, then.data, then.origin, then.lease_ns)
            )

    def take(self) -> Sequence[Command]:
        """Return what this cycle took then."""
        return self._by_cycle.get(self._record.cycle, ())

    def answer(self, number: int, answer: Answer) -> None:
        """Compare the first answer to a command with the one in the run."""
        if number in self._answered:
            return  # a switch that waited for modes: the states decide about it, and they are compared
        self._answered.add(number)
        then = self._steered[number]
        refusal = answer.text if isinstance(answer, Refusal) else ""
        if bool(refusal) == bool(then.refusal):
            return
        command = then.command
        what = f"{command.kind} for {command.controller or 'the loop'} in cycle {command.cycle}"
        was, now = (one or "done" for one in (then.refusal, refusal))
        self.remarks.append(f"{what} was {_told(was)} in the run and is {_told(now)} in the replay")


def _told(outcome: str) -> str:
    return outcome if outcome == "done" else f"refused ({outcome})"


class PlannedCommands:
    """Takes what the replayed loop hands over; a planned command belongs into the cycle that took it then."""

    def __init__(self, commands: Iterable[TakenCommand], log: str) -> None:
        self._log = log
        self._then: Collection[tuple[int, str, str]] = {
            (one.cycle, one.controller, one.kind) for one in commands if one.planned >= 0
        }

    def take(self, command: TakenCommand) -> None:
        """Compare one command. Raises LogError when another cycle took it in the run."""
        if command.planned >= 0 and (command.cycle, command.controller, command.kind) not in self._then:
            raise LogError(
                f"{self._log}: {command.kind} of the plan for {command.controller} was not taken by cycle "
                f"{command.cycle} in the run, but is due then: the log is damaged"
            )
