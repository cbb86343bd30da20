"""Dialogue: output and questions at the terminal, and measurements that run until the user presses Enter."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dxlrun import InputError
from dxlrun.tooling.output import print_error
from dxlrun_hand.typed_keys import TerminalKeys, WindowsKeys

LOOK_S = 0.02
"""Interval of measurements while the dialogue waits for Enter, s."""


def yes(dialogue: Dialogue, question: str) -> bool:
    """Ask the user a yes/no question; return True only for y or yes."""
    return dialogue.ask_question(f"{question} [y/N] ").lower() in ("y", "yes")


@contextmanager
def ending_with(sentence: Callable[[], str]) -> Iterator[None]:
    """Print a sentence to stderr, unless it is empty, if the context ends by Ctrl-C or an error.

    The sentence says in which state the robot or its file was left.
    """
    try:
        yield
    except BaseException:
        if left := sentence():
            print_error(left)
        raise


class Dialogue:
    """Questions and output of one command at the terminal. Ctrl-C raises KeyboardInterrupt."""

    def __init__(self, verb: str) -> None:
        """Check that this process has a terminal; `verb` is the command's name for the error message.

        Raises:
            InputError: Standard input or output is not a terminal.
        """
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise InputError(
                f"`dxlrun {verb}` needs a terminal, and nothing was done; start it in a terminal"
            )
        system = sys.platform
        self._keys = WindowsKeys() if system == "win32" else TerminalKeys()
        self._typed = ""

    def print_lines(self, *lines: str) -> None:
        """Print lines to the terminal."""
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()

    def ask_question(self, question: str) -> str:
        """Ask, and return the line that the user types. Input from before the question is discarded."""
        return self._read_answer(question, None)

    def ask_while(self, question: str, look: Callable[[], str]) -> str:
        """Ask, and call `look` every LOOK_S until the user has typed a line, which is returned.

        The text that `look` returns is shown in a line that is updated in place.
        """
        return self._read_answer(f"{question}\n", look)

    def _read_answer(self, question: str, look: Callable[[], str] | None) -> str:
        self._typed = ""
        self._keys.discard_keys()
        self._write_text(question)
        try:
            while (line := self._line(LOOK_S if look else None)) is None:
                if not look:
                    continue
                text = look()[: shutil.get_terminal_size().columns - 1]
                # The terminal has echoed an Enter that is waiting, so the cursor is on the next line.
                if not self._keys.await_key(0.0):
                    self._write_text(f"\r\x1b[K{text}")
        except BaseException:  # The next output must begin a new line
            self._write_text("\n")
            raise
        return line

    def _write_text(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()

    def _line(self, timeout_s: float | None) -> str | None:
        """Return the next complete line of input, or None if there is none within the timeout, s. The end of
        the input counts as Ctrl-C."""
        if self._keys.await_key(timeout_s):
            self._typed += self._keys.read_keys()
        line, end, rest = self._typed.partition("\n")
        if not end:
            return None
        self._typed = rest
        return line.strip()
