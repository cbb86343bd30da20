"""Plug-in of this package: registers the commands that read logs, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_analysis.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract version that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands `analyze`, `export`, `logs` and `upload`."""
    return (
        Command("analyze", f"{_PLACE}.analyze:analyze", group="Every day"),
        Command("export", f"{_PLACE}.export:export", group="Logs"),
        Command("logs", f"{_PLACE}.season_logs:logs", group="Logs"),
        Command("upload", f"{_PLACE}.season_logs:upload", group="Logs"),
    )
