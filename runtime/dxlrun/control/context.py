"""Control context: the parts of one run that its loop, its controllers and the requests of clients share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import msgspec

from dxlrun.channels.commands import CommandSink, Inbox, NoCommands, NoInbox
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventSink
from dxlrun.contract.hardware import Hardware
from dxlrun.control.schedule import Schedule, schedule_of
from dxlrun.plan.loop_plan import LoopPlan
from dxlwire.clock import Clock


class StopFlag(msgspec.Struct):
    """The request to stop; set by a signal's handler, seen at the next cycle."""

    requested: bool = False

    def request(self) -> None:
        """Ask the loop to end orderly."""
        self.requested = True


class Supervision(Protocol):
    """The process of a loop, as the loop sees it: requests the stop, and shows others that the loop lives."""

    stop: StopFlag

    def beat(self) -> None:
        """Show the guardian that the loop lives; called once a cycle, and between long steps."""

    def limit_cycle(self, limit_ns: int) -> None:
        """Set how long the guardian lets a cycle take from now on."""

    def set_period(self, period_ns: int) -> None:
        """Adapt to another period, so that the clock's polling stays a small share of it."""


class Unsupervised:
    """Supervision of a loop that no other process watches."""

    def __init__(self, stop: StopFlag | None = None) -> None:
        self.stop = stop or StopFlag()

    def beat(self) -> None:
        """Do nothing."""

    def limit_cycle(self, limit_ns: int) -> None:
        """Do nothing: a cycle may take any time."""

    def set_period(self, period_ns: int) -> None:
        """Do nothing: the clock does not poll."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlContext:
    """One robot under control, from its assembly to the end of its loop.

    Built once a run. Its users bind what a cycle reads when they are built.
    """

    plan: LoopPlan
    record: CycleRecord
    """Memory of the cycle, with the arrays that all share."""
    clock: Clock
    hardware: Hardware
    """Started before and stopped after the loop by what built it."""
    events: EventSink
    command_log: CommandSink = field(default_factory=NoCommands)
    """Commands that cycles took."""
    inbox: Inbox = field(default_factory=NoInbox)
    """Commands of clients, and the way of their answers."""
    supervision: Supervision = field(default_factory=Unsupervised)
    schedule: Schedule = field(init=False)
    """When cycles are due, their period, and the controllers' time."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "schedule", schedule_of(self.plan))
