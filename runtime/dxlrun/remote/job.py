"""What the gateway's process is given; light, because the process in the terminal imports it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Descriptors:
    """The memory that the gateway shares with the loop's process."""

    heartbeat: int
    cycles: int
    events: int
    guardian: int
    mailbox: int
    answers: int
    messages: int


@dataclass(frozen=True, slots=True)
class GatewayJob:
    """A run, for its gateway."""

    plan: int
    """Descriptor of the plan's JSON."""
    memory: Descriptors
    log: str | None
    """Where the log is written, from the root; None: there is none."""
    epoch_offset_ns: int = 0
    """Wall time minus the run's clock."""
    listen: str = ""
    """Where clients of other computers are served, as `[NAME@]HOST:PORT`; empty: nowhere."""
