"""Commands with a dialogue, registered by the same hooks as those of any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_hand.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the commands that guide the user through a task step by step."""
    return (
        Command("setup", f"{_PLACE}.setup:setup", group="Servos"),
        Command("calibrate", f"{_PLACE}.calibrate:calibrate", group="Servos"),
        Command("teach", f"{_PLACE}.teach:teach", group="Robots that run"),
    )
