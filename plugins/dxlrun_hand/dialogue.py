"""Dialogue: sentences and questions at the terminal, and what is measured until a person presses Enter."""

from __future__ import annotations

import os
import select
import shutil
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dxlrun import InputError
from dxlrun.tooling.output import print_error

LOOK_S = 0.02
"""Between two looks while Enter is awaited."""


def yes(dialogue: Dialogue, question: str) -> bool:
    """Ask a question that only a clear yes agrees to."""
    return dialogue.ask(f"{question} [y/N] ").lower() in ("y", "yes")


@contextmanager
def ending_with(sentence: Callable[[], str]) -> Iterator[None]:
    """Print how things are left when what is inside ends early, by Ctrl-C or an error; empty: nothing."""
    try:
        yield
    except BaseException:
        if left := sentence():
            print_error(left)
        raise


class Dialogue:
    """What a task says and asks at the terminal; raises KeyboardInterrupt at Ctrl-C."""

    def __init__(self, verb: str) -> None:
        """Raises InputError where there is no terminal."""
        self._input = sys.stdin.fileno() if sys.stdin.isatty() else -1
        if self._input < 0 or not sys.stdout.isatty():
            raise InputError(
                f"`dxlrun {verb}` is a dialogue, and this is no terminal; nothing was done: start it in one"
            )
        self._typed = b""

    def say(self, *lines: str) -> None:
        """Print lines."""
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()

    def ask(self, question: str) -> str:
        """Return the line that a person types; what was typed before the question does not count."""
        return self._answer(question, None)

    def ask_while(self, question: str, look: Callable[[], str]) -> str:
        """Ask, and call `look` until the answer comes; its text is one line that changes."""
        return self._answer(f"{question}\n", look)

    def _answer(self, question: str, look: Callable[[], str] | None) -> str:
        self._typed = b""
        termios.tcflush(self._input, termios.TCIFLUSH)
        self._write(question)
        try:
            while (line := self._line(LOOK_S if look else None)) is None:
                if look:
                    self._write(f"\r\x1b[K{look()[: shutil.get_terminal_size().columns - 1]}")
        except BaseException:  # what is said next begins a line
            self._write("\n")
            raise
        return line

    def _write(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()

    def _line(self, timeout_s: float | None) -> str | None:
        """Return the line that is complete, None where none is yet; the end of the input is as Ctrl-C."""
        if select.select([self._input], [], [], timeout_s)[0]:
            data = os.read(self._input, 4096)
            if not data:
                raise KeyboardInterrupt
            self._typed += data
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        return line.decode(errors="replace").strip()
