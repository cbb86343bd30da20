"""Commands for several robots and computers, registered by the same hooks as those of any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands."""
    return (
        Command("fleet", "dxlrun_fleet.fleet:fleet", group="Robots that run"),
        Command("keys", "dxlrun_fleet.keys:keys", group="Robots that run"),
    )
