"""Plug-in with the command `dxlrun view`: a browser page that shows a running robot or a log.

The scripts of the page are in `page/`, next to `src/`. Reports about logs are in `dxlrun_analysis`.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun import Command, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version that this package was written for."""
    return 4


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the command `view`, with the function that is imported on use."""
    help_line = "Show a running robot, or a log, on a page in the browser: 3-D, curves, joints, controllers."
    return (Command("view", "dxlrun_view.command:view", help_line, "Robots that run"),)
