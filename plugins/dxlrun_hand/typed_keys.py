"""Typed keys: what the user types at the terminal of a dialogue, on every system."""

from __future__ import annotations

import os
import select
import sys
import time
from importlib import import_module

_LOOK_S = 0.01  # interval at which a console of Windows is asked for keys, s


class TerminalKeys:
    """Keys of a POSIX terminal, which lets the user edit each line."""

    def __init__(self) -> None:
        self._input = sys.stdin.fileno()

    def discard_keys(self) -> None:
        """Discard what was typed until now."""
        import termios  # Imported here because Windows has no such module

        termios.tcflush(self._input, termios.TCIFLUSH)

    def await_key(self, timeout_s: float | None) -> bool:
        """Wait for a key; return False after the timeout, s. None: no timeout."""
        return bool(select.select([self._input], [], [], timeout_s)[0])

    def read_keys(self) -> str:
        """Return what was typed; the end of the input counts as Ctrl-C."""
        if not (data := os.read(self._input, 4096)):
            raise KeyboardInterrupt
        return data.decode(errors="replace")


class WindowsKeys:
    """Keys of a console of Windows, which `select` cannot await: it is asked for them one by one."""

    def __init__(self) -> None:
        self._console, self._line = import_module("msvcrt"), ""

    def discard_keys(self) -> None:
        """Discard what was typed until now."""
        self._line = ""
        while self._console.kbhit():
            self._console.getwch()

    def await_key(self, timeout_s: float | None) -> bool:
        """Wait for a key; return False after the timeout, s. None: no timeout."""
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._console.kbhit():
            if end is not None and time.monotonic() >= end:
                return False
            time.sleep(_LOOK_S)
        return True

    def read_keys(self) -> str:
        """Return the line if this key ends it, and echo the key; empty otherwise."""
        key: str = self._console.getwch()
        if key == "\x03":  # Ctrl-C
            raise KeyboardInterrupt
        if key in "\0\xe0":  # the first half of a function key
            self._console.getwch()
        elif key == "\b":
            self._line = self._line[:-1]
            _echo("\b \b")
        elif key == "\r":
            line, self._line = self._line, ""
            _echo("\n")
            return f"{line}\n"
        else:
            self._line += key
            _echo(key)
        return ""


def _echo(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()
