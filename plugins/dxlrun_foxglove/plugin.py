"""Plug-in that adds the command `dxlrun foxglove`, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the plug-in contract; this package is published together with the runtime."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the command `foxglove`, with the function that is imported on use."""
    return (Command("foxglove", "dxlrun_foxglove.foxglove:foxglove", group="Robots that run"),)
