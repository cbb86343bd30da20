"""Page in the browser that shows a running robot or a log, offered to dxlrun by its entry point.

Its scripts are in `page/`, next to `src/`. Reports of a log belong in `dxlrun_analysis`.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that this package was written for."""
    return 4


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the verb."""
    help_line = "Show a running robot, or a log, on a page in the browser: 3-D, curves, joints, controllers."
    return (Command("view", "dxlrun_view.command:view", help_line, "Robots that run"),)
