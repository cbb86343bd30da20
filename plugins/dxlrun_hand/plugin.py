"""The verbs of what is done by hand, by the same hooks as any other package."""

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
    """Return the verbs that lead a person through a task, step by step."""
    return (
        Command(
            "setup",
            f"{_PLACE}.setup:setup",
            "Give new servos the ID, rate and registers of a robot file: one after the other.",
            "Servos",
        ),
        Command(
            "calibrate",
            f"{_PLACE}.calibrate:calibrate",
            "Measure reference, direction and limits of joints by hand: for the robot file.",
            "Servos",
        ),
        Command(
            "teach",
            f"{_PLACE}.teach:teach",
            "Show a running robot a motion by hand, and save it as a motion file.",
            "Robots that run",
        ),
    )
