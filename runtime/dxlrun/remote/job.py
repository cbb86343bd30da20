"""Job: the parameters that the supervisor gives to the gateway's process. It imports little."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Descriptors:
    """File descriptors of the shared memory of gateway and loop, one for each ring or mailbox."""

    heartbeat: int
    cycles: int
    events: int
    guardian: int
    mailbox: int
    answers: int
    messages: int


@dataclass(frozen=True, slots=True)
class GatewayJob:
    """Parameters of the gateway's process for one run, which it reads as JSON at its start."""

    plan: int
    """Descriptor of the memory file with the plan's JSON."""
    memory: Descriptors
    log: str | None
    """Absolute path of the run's log; None when no log is written."""
    epoch_offset_ns: int = 0
    """Wall time minus the run's clock, ns."""
    listen: str = ""
    """Address for clients of other computers, `[NAME@]HOST:PORT`; empty: no network access."""
