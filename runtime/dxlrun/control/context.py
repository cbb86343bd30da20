"""Control context: objects of one run that its loop, its controllers and client requests share."""

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
    """Stop request, set by a signal handler and checked once a cycle."""

    requested: bool = False

    def request(self) -> None:
        """Request an orderly end of the loop."""
        self.requested = True


class Supervision(Protocol):
    """Interface of the loop to its process: the stop request and the heartbeat for the guardian."""

    stop: StopFlag

    def beat(self) -> None:
        """Send a heartbeat to the guardian. Called once a cycle and between long steps."""

    def limit_cycle(self, limit_ns: int) -> None:
        """Set the guardian's timeout for a cycle, ns."""

    def set_period(self, period_ns: int) -> None:
        """Adapt the clock's polling time to a period, ns, so that it stays a small share of the period."""


class Unsupervised:
    """Supervision of a loop without a guardian."""

    def __init__(self, stop: StopFlag | None = None) -> None:
        self.stop = stop or StopFlag()

    def beat(self) -> None:
        """Do nothing."""

    def limit_cycle(self, limit_ns: int) -> None:
        """Do nothing: cycles have no timeout."""

    def set_period(self, period_ns: int) -> None:
        """Do nothing: the clock does not poll."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlContext:
    """Objects of one run, from its assembly to the end of its loop.

    Built once a run. Its users bind the arrays that a cycle reads when they are constructed.
    """

    plan: LoopPlan
    record: CycleRecord
    """Record of the current cycle, with the shared arrays."""
    clock: Clock
    hardware: Hardware
    """Started before the loop and stopped after it by the code that built it."""
    events: EventSink
    command_log: CommandSink = field(default_factory=NoCommands)
    """Log of the commands that cycles executed."""
    inbox: Inbox = field(default_factory=NoInbox)
    """Queue of client commands and their answers."""
    supervision: Supervision = field(default_factory=Unsupervised)
    schedule: Schedule = field(init=False)
    """Deadlines, period and the controllers' time."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "schedule", schedule_of(self.plan))
