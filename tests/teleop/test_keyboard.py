"""The keyboard behind a terminal: keys that are held, for how long, and the terminal as it was before."""

import io
import os
import sys
import termios
from contextlib import closing
from types import SimpleNamespace
from typing import NamedTuple

import pytest

from dxlrun.errors import InputError
from dxlrun_teleop.keyboard import HELD_S, TerminalKeyboard
from dxlrun_teleop.source import Press


class Terminal(NamedTuple):
    master: int
    slave: int
    patch: pytest.MonkeyPatch

    def keyboard(self) -> TerminalKeyboard:
        """Open the keyboard, where the streams are those of a terminal."""
        for name in ("stdin", "stdout"):
            self.patch.setattr(sys, name, SimpleNamespace(isatty=lambda: True, fileno=lambda: self.slave))
        return TerminalKeyboard()

    def types(self, text: str) -> None:
        os.write(self.master, text.encode())


@pytest.fixture
def terminal(monkeypatch):
    master, slave = os.openpty()
    yield Terminal(master, slave, monkeypatch)
    os.close(slave)
    os.close(master)


def axes(**sides: float) -> tuple[float, ...]:
    """Return eight axes: `a0=1.0`."""
    return tuple(sides.get(f"a{axis}", 0.0) for axis in range(8))


def test_a_key_counts_as_held_until_it_was_not_repeated_for_a_while(terminal):
    with closing(terminal.keyboard()) as keyboard:
        assert keyboard.read_input(9.0) == (axes(), False, frozenset())
        terminal.types("q")
        assert keyboard.read_input(10.0) == (axes(a0=1.0), True, frozenset())
        assert keyboard.read_input(9.99 + HELD_S) == (axes(a0=1.0), True, frozenset())
        terminal.types("q")  # repeated
        assert keyboard.read_input(10.1).enabled
        assert keyboard.read_input(10.09 + HELD_S).enabled
        assert keyboard.read_input(10.11 + HELD_S) == (axes(), False, frozenset())


@pytest.mark.parametrize(
    ("typed", "sides"),
    [
        ("S", {"a1": -1.0}),
        ("ik", {"a7": -1.0}),
        ("qd", {"a0": 1.0, "a2": -1.0}),
        ("\x1b[A", {"a0": 1.0}),
        ("\x1bOB", {"a0": -1.0}),
        ("\x1b[D", {"a1": 1.0}),
        ("\x1b[1;2C", {"a1": -1.0}),
        ("\x1b[3~\x1b[Z ä1", {}),
        ("q ", {}),
    ],
)
def test_keys_and_arrows_move_axes(terminal, typed, sides):
    with closing(terminal.keyboard()) as keyboard:
        terminal.types(typed)
        assert keyboard.read_input(0.0) == (axes(**sides), bool(sides), frozenset())


def test_an_arrow_that_comes_in_parts_is_no_letter(terminal):
    with closing(terminal.keyboard()) as keyboard:
        for part in ("\x1b", "[", "1;"):
            terminal.types(part)
            assert not keyboard.read_input(0.0).enabled
        terminal.types("5A")
        assert keyboard.read_input(0.0).axes == axes(a0=1.0)


def test_what_is_pressed_and_the_end_of_the_terminal(terminal):
    with closing(terminal.keyboard()) as keyboard:
        terminal.types("\t+-\x1b")
        assert keyboard.read_input(0.0).presses == {Press.NEXT, Press.FASTER, Press.SLOWER}
        terminal.types("\x04")
        assert keyboard.read_input(0.0).presses == {Press.QUIT}


def test_the_terminal_is_as_it_was(terminal):
    before = termios.tcgetattr(terminal.slave)
    keyboard = terminal.keyboard()
    assert not termios.tcgetattr(terminal.slave)[3] & (termios.ECHO | termios.ICANON)
    assert termios.tcgetattr(terminal.slave)[3] & termios.ISIG  # Ctrl-C
    keyboard.close()
    assert termios.tcgetattr(terminal.slave) == before


def test_without_a_terminal_a_device_is_asked_for(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with pytest.raises(InputError, match=r"needs a terminal or an input device; .*--gamepad"):
        TerminalKeyboard()
