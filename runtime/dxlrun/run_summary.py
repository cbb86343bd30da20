"""What a person decides about a run, and what they are told of it afterwards; the same on both clocks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line decides about one run."""

    record: bool = True
    take_over: bool = False
    """Accept servos that are already torqued."""
    debug: bool = False
    ledger: Path | None = None
    """Where simulated buses write what they saw; None: beside the log, on virtual time nowhere."""
    gateway: bool = True
    """Let others steer the run, over a Unix socket."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """How a run went, for the terminal and for `--json`."""

    exit_code: int
    reason: str
    cycles: int
    skipped: int
    elapsed_s: float
    sentences: tuple[str, ...]
    """What went wrong, one sentence each; empty after a good run."""
    remarks: tuple[str, ...] = ()
    """What the operating system did not grant, and what went wrong beside the robot."""
    log: str | None = None
    messages: int = 0
    """Messages in the log."""
