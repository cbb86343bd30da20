"""The verbs of the analysis, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_analysis.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the verbs that read logs."""
    return (
        Command(
            "analyze",
            f"{_PLACE}.analyze:analyze",
            "Analyze a log: latency, duration of each step, skipped periods, packets and errors per servo.",
            "Every day",
        ),
        Command(
            "export",
            f"{_PLACE}.export:export",
            "Write a log in another format, to a new file or directory; nothing is written over.",
            "Logs",
        ),
        Command(
            "logs",
            f"{_PLACE}.logs:logs",
            "Show all logs below a directory as a table, one row a log.",
            "Logs",
        ),
        Command(
            "upload",
            f"{_PLACE}.logs:upload",
            "Copy the logs below a directory to an object store, each with its row of `dxlrun logs`.",
            "Logs",
        ),
    )
