"""Live view of `dxlrun teleop` in the terminal: keys of the axes, commands and positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dxlrun import RemoteRobot
from dxlrun.tooling.output import Column, Table, fitted, out
from dxlrun_teleop.drive import Drive
from dxlrun_teleop.source import InputSource

REFRESH_S = 0.1
"""Shortest time between two updates of the screen, s"""
_SHOWN = {"rad": (180 / math.pi, "deg"), "m": (1e3, "mm")}


def view(robot: RemoteRobot, drive: Drive, source: InputSource) -> tuple[str, Table]:
    """Return a headline (robot, controller, speed factor), and a table with joint, command and position of
    each axis."""
    bank, values, states = drive.bank, drive.values, robot.states()
    positions = dict(zip(states.joints, states.position.tolist(), strict=True))
    rows = []
    for label, index in zip(source.axes, bank.driven, strict=False):
        slot = bank.slots[index]
        factor, unit = _SHOWN[slot.unit]
        per_s = "" if bank.form.integrates else "/s"
        commanded = f"{values[index] * factor:.1f} {unit}{per_s}" if values else ""
        at = f"{positions[slot.name] * factor:.1f} {unit}" if slot.name in positions else ""
        rows.append((label, slot.name, commanded, at))
    head = f"{robot.name}: {bank.controller} {'moves' if values else 'holds'}, speed x{drive.factor:.2g}"
    columns = (Column("axis", "name"), Column("moves", "name"), Column("commanded"), Column("position"))
    return head, Table.from_rows("", columns, rows)


@contextmanager
def screen(robot: RemoteRobot, drive: Drive, source: InputSource) -> Iterator[Callable[[float], None]]:
    """Yield a function that draws the view, at most every REFRESH_S of the time (s) it is called with.

    Without a terminal, it does nothing.
    """
    console = out()
    if not console.is_terminal:
        yield lambda now: None
        return
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

    drawn_s = -math.inf
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def draw_screen(now: float) -> None:
            nonlocal drawn_s
            if now - drawn_s >= REFRESH_S:
                drawn_s = now
                head, table = view(robot, drive, source)
                style = "green" if drive.values else ""
                lines = [[(head, style)], *fitted(table, console.width), [(source.help, "dim")]]
                texts = (Text.assemble(*line, no_wrap=True, overflow="ellipsis") for line in lines)
                live.update(Group(*texts), refresh=True)

        yield draw_screen
