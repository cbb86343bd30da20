"""Plug-in with the verb `teleop`. It uses the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version. This package is released together with it."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the verb that drives a running robot."""
    return (Command("teleop", "dxlrun_teleop.command:teleop", group="Robots that run"),)
