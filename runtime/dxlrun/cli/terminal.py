"""The terminal: results to stdout, errors to stderr, one line each; colours only where somebody looks."""

from __future__ import annotations

import sys
from contextlib import suppress

from rich.console import Console
from rich.text import Text


def out() -> Console:
    """Return the console for results; a pipe gets plain text, wide enough not to break a table."""
    return _console(sys.stdout.isatty(), stderr=False)


def say_error(line: str) -> None:
    """Print one error to stderr, unbroken, so that an editor can jump to its `file:line:column`."""
    _say(line, "bold red")


def say_warning(line: str) -> None:
    """Print one warning to stderr, unbroken."""
    _say(line, "yellow")


def _say(line: str, style: str) -> None:
    # a path or a name may hold line breaks or escape sequences; one problem stays one line
    safe = "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line
    )
    console = _console(sys.stderr.isatty(), stderr=True)
    with suppress(OSError):  # full, or gone: there is nobody left to tell, and the exit code says it too
        console.print(Text(safe, style=style), soft_wrap=True)


def _console(terminal: bool, *, stderr: bool) -> Console:
    return Console(stderr=stderr, highlight=False, force_terminal=terminal, width=None if terminal else 200)
