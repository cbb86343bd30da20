"""Control context: objects of one run that its loop, its controllers and client requests share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import msgspec

from dxlrun.channels.commands import CommandSink, Inbox, NoCommands, NoInbox
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventSink
from dxlrun.contract.hardware import Hardware
from dxlrun.control.schedule import Schedule, schedule_of
from dxlrun.plan.loop_plan import LoopPlan
from dxlwire.clock import Clock


class StopFlag(msgspec.Struct):
    """Flag that asks the loop to end the run.

    A signal handler sets it, and the loop checks it once a cycle.
    """

    requested: bool = False

    def request(self) -> None:
        """Ask the loop to end the run after the current cycle, with the policy `on_exit`."""
        self.requested = True


class Supervision(Protocol):
    """Interface from the loop to its process: the stop request and the heartbeat for the guardian process."""

    stop: StopFlag

    def beat(self) -> None:
        """Send a heartbeat to the guardian process. Called once a cycle and between long steps."""

    def limit_cycle(self, limit_ns: int) -> None:
        """Set the time, ns, that a cycle may take before the guardian process intervenes."""

    def set_period(self, period_ns: int) -> None:
        """Limit the polling time before deadlines to a small share of a new loop period, ns."""


class Unsupervised:
    """Supervision for a loop without a guardian process, as in tests and replays: all methods do nothing."""

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
    """Arrays of states, commands and goals of the current cycle, in memory that all users share."""
    clock: Clock
    hardware: Hardware
    """Interface to the servos. The code that builds the context starts it before the loop and stops it
    after."""
    events: EventSink
    command_log: CommandSink = field(default_factory=NoCommands)
    """Log of the commands that cycles executed; discards them by default."""
    inbox: Inbox = field(default_factory=NoInbox)
    """Queue of client commands, which also sends the answers; empty by default."""
    supervision: Supervision = field(default_factory=Unsupervised)
    schedule: Schedule = field(init=False)
    """Deadlines, period and the controllers' time of the loop; built from the plan."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "schedule", schedule_of(self.plan))
