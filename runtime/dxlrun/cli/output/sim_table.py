"""What `dxlrun sim` shows on a terminal: a live table, above it what happened, below it what is typed."""

from __future__ import annotations

import math
import os
import signal
import sys
import termios
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from dxlrun.cli.output.sim_views import Shown, fault_lines
from dxlrun.run.simulation_front import Look

if TYPE_CHECKING:
    from dxlrun.run.simulation_front import ServoLook

_LOOK_S = 0.25
_AROUND = 7
"""Lines of the screen that are not servos: head and rule of the table, lateness, prompt, what happened."""


class TableView:
    """A table that is drawn again four times a second; what happens scrolls away above it."""

    look_every_s: float | None = _LOOK_S

    def __init__(self, shown: Shown, console: Console) -> None:
        self._shown = shown
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._newest = Look()

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Show it; the terminal hands letters over one by one meanwhile, and does not show them itself."""
        with _letters(), self._live:
            yield
            self._draw(None)  # what was being typed is of no use any more

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Say where the buses are."""
        for line in self._shown.lines(ports, real_time):
            self._say(line)

    def moved(self, ports: Mapping[str, str]) -> None:
        """Say where the buses are now."""
        for line in self._shown.moves(ports):
            self._say(line)

    def fault(self, text: str) -> None:
        """Say that a fault happened."""
        self._say(f"fault: {text}", "yellow")

    def accepted(self, text: str) -> None:
        """Say how a line was understood: it may be planned for later."""
        self._say(f"understood: {text}", "dim")

    def refused(self, sentence: str) -> None:
        """Say what is wrong with a line that was typed."""
        self._say(sentence, "bold red")

    def help(self) -> None:
        """List the faults."""
        for line in fault_lines():
            self._say(line)

    def look(self, look: Look, typed: str) -> None:
        """Draw the servos, and what was typed so far."""
        self._newest = look
        self._draw(typed)

    def _draw(self, typed: str | None) -> None:
        several = len(self._shown.buses) > 1
        self._live.update(page(self._newest, typed, self._console.height, several=several), refresh=True)

    def _say(self, line: str, style: str = "") -> None:
        # folded, not soft_wrap: rich does not draw the table again below a line that is wider than the window
        self._console.print(Text(line, style=style))


def page(look: Look, typed: str | None, height: int, *, several: bool) -> Group:
    """Return what stands at the bottom of a screen of `height` lines; `several`: buses are told apart.

    `typed` is None when nothing more can be typed.
    """
    room = max(1, height - _AROUND)
    parts: list[Table | Text] = [servo_table(look.servos[:room], several=several)]
    if len(look.servos) > room:
        parts.append(Text(f"... and {len(look.servos) - room} more; a higher window shows them", style="dim"))
    if look.lateness_us:
        late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
        parts.append(Text(f"replies later than planned: {late}", style="dim"))
    if typed is not None:
        parts.append(Text.assemble(("fault> ", "bold"), typed, ("\N{LOWER ONE EIGHTH BLOCK}", "blink")))
    return Group(*parts)


def servo_table(servos: Sequence[ServoLook], *, several: bool) -> Table:
    """Return one line a servo."""
    shown = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for name in (["bus"] if several else []) + ["ID"]:
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("model", no_wrap=True)
    shown.add_column("torque", no_wrap=True)
    for name in ("goal\ndeg", "present\ndeg", "degC", "V"):
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("errors", no_wrap=True)
    for name in ("heard", "said"):
        shown.add_column(name, justify="right", no_wrap=True)
    for servo in servos:
        shown.add_row(*([servo.bus] if several else []), *_cells(servo), style="red" if servo.error else "")
    return shown


def _cells(servo: ServoLook) -> list[str]:
    return [
        str(servo.id),
        servo.model,
        "on" if servo.torque else "-",
        "-" if servo.goal is None else f"{math.degrees(servo.goal):.1f}",
        f"{math.degrees(servo.present):.1f}",
        f"{servo.temperature:.0f}",
        f"{servo.voltage:.1f}",
        f"{servo.error:#04x}" if servo.error else "-",
        str(servo.heard),
        str(servo.answered),
    ]


@contextmanager
def _letters() -> Iterator[None]:
    """Let the terminal of stdin hand over each letter, unseen; Ctrl-C and Ctrl-Z do what they always do."""
    if not sys.stdin.isatty():
        yield
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    changed = termios.tcgetattr(descriptor)
    changed[3] &= ~(termios.ICANON | termios.ECHO)

    def set_up(mode: list[int | list[bytes | int]]) -> None:
        # a job in the background that touches its terminal would be stopped; and the terminal may be gone
        with suppress(termios.error, OSError):
            if os.tcgetpgrp(descriptor) == os.getpgrp():
                termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)

    set_up(changed)
    # after Ctrl-Z and fg the shell may have set it otherwise
    continued = signal.signal(signal.SIGCONT, lambda *_: set_up(changed))
    try:
        yield
    finally:
        signal.signal(signal.SIGCONT, continued)
        set_up(before)
