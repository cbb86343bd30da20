"""Keyboard of a terminal as the device of teleop. A terminal reports presses and repeats, but no releases."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty

from dxlrun import InputError
from dxlrun_teleop.source import InputState, Press

HELD_S = 0.13
"""Time for which a key counts as held after a press or repeat, s. It must exceed the repeat period, which is
92 ms on the Linux console (10.9 Hz, kbdrate(8)) and shorter on desktops."""
AXES: tuple[str, ...] = ("Q/A Up/Down", "W/S Left/Right", "E/D", "R/F", "T/G", "Y/H", "U/J", "I/K")
"""Keys of each axis, the positive direction first"""
_ROWS = ("qwertyui", 1.0), ("asdfghjk", -1.0)
_KEYS = {key: (axis, side) for row, side in _ROWS for axis, key in enumerate(row)}
_ARROWS = {"A": (0, 1.0), "B": (0, -1.0), "D": (1, 1.0), "C": (1, -1.0)}
"""Final letters of the escape sequences ESC [ A and so on: up, down, left, right"""
_PRESSES = {"\t": Press.NEXT, "+": Press.FASTER, "=": Press.FASTER, "-": Press.SLOWER, "\x04": Press.QUIT}
_TYPED = re.compile(r"\x1b[\[O](?:[\d;]*)([A-Za-z~])|(.)", re.DOTALL)
_PART = re.compile(r"\x1b(?:[\[O][\d;]*)?\Z")
"""Incomplete escape sequence at the end of the input, which the next read completes"""


class TerminalKeyboard:
    """Keyboard of the terminal, without echo until it is closed.

    A key is its own dead-man's switch. It counts as held until HELD_S after the last press or repeat. Until
    the keyboard starts to repeat (after 0.25 s to 0.66 s), a key causes one short step.
    """

    axes = AXES
    help = "hold a key to move; Tab: next controller; + -: speed; Ctrl-C: end"

    def __init__(self) -> None:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise InputError(
                "`dxlrun teleop` needs a terminal or an input device; start it in a terminal, or give "
                "--gamepad or --device /dev/input/eventN"
            )
        self._input = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._input)
        self._typed: dict[int, tuple[float, float]] = {}
        """Direction (1 or -1), and time of the last press or repeat of its key, s, by axis"""
        self._rest = ""
        tty.setcbreak(self._input, termios.TCSAFLUSH)

    def close(self) -> None:
        """Restore the terminal. Input that was not read is discarded."""
        termios.tcsetattr(self._input, termios.TCSAFLUSH, self._before)

    def read_input(self, now: float) -> InputState:
        """Return the input at `now`, s: axes whose keys count as held, and presses since the last call."""
        presses: set[Press] = set()
        while select.select([self._input], [], [], 0.0)[0]:
            if not (data := os.read(self._input, 4096)):
                return InputState((0.0,) * len(self.axes), False, frozenset({Press.QUIT}))
            text = self._rest + data.decode(errors="replace")
            part = _PART.search(text)
            self._rest = part[0] if part else ""
            for arrow, key in _TYPED.findall(text.removesuffix(self._rest)):
                side = _ARROWS.get(arrow) if arrow else _KEYS.get(key.lower())
                if side is not None:
                    self._typed[side[0]] = side[1], now
                elif key == " ":
                    self._typed.clear()
                elif key in _PRESSES:
                    presses.add(_PRESSES[key])
        held = {axis: side for axis, (side, typed) in self._typed.items() if now - typed <= HELD_S}
        axes = tuple(held.get(axis, 0.0) for axis in range(len(self.axes)))
        return InputState(axes, bool(held), frozenset(presses))
