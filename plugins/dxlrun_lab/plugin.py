"""The verbs that measure robots, and those that run a log again, by the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import CONTRACT_VERSION, Command, hookimpl

_PLACE = "dxlrun_lab.commands"


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for: the one it is published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the verbs that run something: a log again, or a measurement."""
    return (
        Command("replay", f"{_PLACE}.replay:replay", group="Logs"),
        Command("convert", f"{_PLACE}.convert:convert", group="Logs"),
        Command("bench", f"{_PLACE}.bench:bench", group="Experiments"),
        Command("latency", f"{_PLACE}.latency:latency", group="Experiments"),
        Command("characterize", f"{_PLACE}.characterize:characterize", group="Servos"),
        Command("experiment", f"{_PLACE}.tracking:experiment", group="Experiments"),
        Command("identify", f"{_PLACE}.identify:identify", group="Servos"),
    )
