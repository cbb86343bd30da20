"""Job of the gateway's process. It imports little, because the process in the terminal imports it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Descriptors:
    """File descriptors of the memory that the gateway shares with the loop's process."""

    heartbeat: int
    cycles: int
    events: int
    guardian: int
    mailbox: int
    answers: int
    messages: int


@dataclass(frozen=True, slots=True)
class GatewayJob:
    """Parameters of the gateway's process for one run."""

    plan: int
    """Descriptor of the plan's JSON."""
    memory: Descriptors
    log: str | None
    """Absolute path of the log; None without a log."""
    epoch_offset_ns: int = 0
    """Wall time minus the run's clock."""
    listen: str = ""
    """Address for clients of other computers, `[NAME@]HOST:PORT`; empty: no network access."""
