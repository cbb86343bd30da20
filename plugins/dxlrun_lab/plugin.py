"""Plug-in with the commands that measure robots or replay logs. It uses the same hooks as other packages."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_lab.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the plug-in contract; this package is published together with the runtime."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands that measure robots or replay logs, each with the function imported on use."""
    return (
        Command("replay", f"{_PLACE}.replay:replay", group="Logs"),
        Command("convert", f"{_PLACE}.convert:convert", group="Logs"),
        Command("bench", f"{_PLACE}.bench:bench", group="Experiments"),
        Command("latency", f"{_PLACE}.latency:latency", group="Experiments"),
        Command("characterize", f"{_PLACE}.characterize:characterize", group="Servos"),
        Command("experiment", f"{_PLACE}.tracking:experiment", group="Experiments"),
        Command("identify", f"{_PLACE}.identify:identify", group="Servos"),
    )
