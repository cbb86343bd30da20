"""Plug-in that adds the commands `setup`, `calibrate` and `teach`, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_hand.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the plug-in contract; this package is published together with the runtime."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands `setup`, `calibrate` and `teach`, which are dialogues at the terminal."""
    return (
        Command("setup", f"{_PLACE}.setup:setup", group="Servos"),
        Command("calibrate", f"{_PLACE}.calibrate:calibrate", group="Servos"),
        Command("teach", f"{_PLACE}.teach:teach", group="Robots that run"),
    )
