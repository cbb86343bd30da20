"""Command that serves Foxglove and Lichtblick, registered by the same hooks as that of any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the command."""
    return (Command("foxglove", "dxlrun_foxglove.command:foxglove", group="Robots that run"),)
