"""Plug-in that adds the commands `dxlrun fleet` and `dxlrun keys`, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the plug-in contract; this package is published together with the runtime."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands `fleet` and `keys`, each with the function that is imported on use."""
    return (
        Command("fleet", "dxlrun_fleet.fleet:fleet", group="Robots that run"),
        Command("keys", "dxlrun_fleet.keys:keys", group="Robots that run"),
    )
