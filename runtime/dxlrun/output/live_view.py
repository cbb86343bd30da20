"""Live view: shows a table on the whole terminal and redraws it until the key q is pressed."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dxlrun.output.terminal import STYLES, out
from dxlrun.output.text_table import Table

if TYPE_CHECKING:
    from rich.console import RenderableType


def show_live(table: Callable[[], Table], every_s: float) -> None:
    """Show a table on the whole terminal and redraw it periodically until q or Ctrl-C.

    Args:
        table: Returns the present table.
        every_s: Interval of drawings, s.
    """
    from rich.live import Live

    with (
        suppress(KeyboardInterrupt),
        keys_pressed() as pressed,
        Live(console=out(), screen=True, auto_refresh=False) as live,
    ):
        while True:
            live.update(compact(table()), refresh=True)
            if pressed(every_s):
                return


@contextmanager
def keys_pressed() -> Iterator[QuitKey]:
    """Context manager that switches the terminal to single keys and restores it at the end.

    Yields a `QuitKey`. Without a terminal on stdin it only sleeps for the given time.
    """
    if not sys.stdin.isatty():
        yield QuitKey(None)
        return
    import termios
    import tty

    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        yield QuitKey(keyboard)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)


@dataclass(frozen=True, slots=True)
class QuitKey:
    """Callable that waits for the key q on a keyboard."""

    keyboard: int | None
    """File descriptor of the terminal; None without a terminal."""

    def __call__(self, seconds: float) -> bool:
        """Wait up to `seconds`; return True at once if q is pressed or the terminal is gone."""
        if self.keyboard is None:
            time.sleep(seconds)
            return False
        if not select.select([self.keyboard], [], [], seconds)[0]:
            return False
        import os

        typed = os.read(self.keyboard, 64)
        return not typed or b"q" in typed


def compact(table: Table) -> RenderableType:
    """Convert a table for rich without rules; its `text` columns are shortened if space is short."""
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table = table.escaped()
    for column in table.columns:
        right = column.kind == "number"
        shown.add_column(
            column.name,
            justify="right" if right else "left",
            # Only these columns shrink when space is short.
            no_wrap=column.kind != "text",
            overflow="ellipsis",
            min_width=5 if right else None,
        )
    for row in table.rows:
        shown.add_row(*(Text(cell.text, style=STYLES[cell.tone], no_wrap=True) for cell in row))
    return shown
