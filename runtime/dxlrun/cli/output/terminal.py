"""The terminal: results to stdout, errors to stderr, one line each; colours only where somebody looks."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO, cast

from rich.console import Console
from rich.text import Text

from dxlrun.errors import Problem

_PIPE = 200
"""Columns of a pipe: wide enough not to break a table."""


def out(pipe: int = _PIPE) -> Console:
    """Return the console for results; a pipe gets plain text, `pipe` columns wide."""
    return _console(sys.stdout.isatty(), pipe, stderr=False)


def say_error(line: str) -> None:
    """Print one error to stderr, unbroken, so that an editor can jump to its `file:line:column`."""
    _say(line, "bold red")


def say_warning(line: str) -> None:
    """Print one warning to stderr, unbroken."""
    _say(line, "yellow")


def print_refusal(
    problems: Sequence[Problem], sentences: Sequence[str], reason: Mapping[str, object]
) -> None:
    """Print on stdout, as one line of JSON, why a command with --json was refused.

    `problems` have places in files; `sentences` are errors without one; `reason` is a running robot's: a code
    with its fields.
    """
    errors = [problem for problem in problems if problem.severity == "error"]
    refusal = {
        "ok": False,
        "errors": [*problems_json(errors), *({"what": sentence, **reason} for sentence in sentences)],
        "warnings": problems_json([problem for problem in problems if problem.severity == "warning"]),
    }
    with suppress(OSError):  # the reader is gone; the exit code says it too
        sys.stdout.write(json.dumps(refusal, ensure_ascii=False) + "\n")
        sys.stdout.flush()


def problems_json(problems: Sequence[Problem]) -> list[dict[str, object]]:
    """Return problems as commands print them under --json."""
    return [
        {
            "file": problem.mark.file,
            "line": problem.mark.line,
            "column": problem.mark.column,
            "what": problem.what,
            "mend": problem.fix,
        }
        for problem in problems
    ]


def _say(line: str, style: str) -> None:
    # a path or a name may hold line breaks or escape sequences; one problem stays one line
    safe = "".join(
        character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line
    )
    console = _console(sys.stderr.isatty(), _PIPE, stderr=True)
    with suppress(OSError):  # full, or gone: there is nobody left to tell, and the exit code says it too
        console.print(Text(safe, style=style), soft_wrap=True)


def _console(terminal: bool, pipe: int, *, stderr: bool) -> Console:
    if terminal:
        return Console(stderr=stderr, highlight=False, force_terminal=True)
    file = cast("IO[str]", _WithoutPadding(sys.stderr if stderr else sys.stdout))
    return Console(file=file, highlight=False, force_terminal=False, width=pipe)


class _WithoutPadding:
    """A stream that gets no blanks before the end of a line: rich fills the last column of a table."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text of whole lines, as a console does."""
        self._stream.write("\n".join(line.rstrip(" ") for line in text.split("\n")))
        return len(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)
