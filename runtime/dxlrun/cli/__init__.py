"""Command line: parses words, calls a room below, prints the result, returns the exit code.

Decisions belong in the rooms below. Importing this package loads neither numpy nor pydantic.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: this process' own) and return its exit code.

    0 good, 1 the robot or the run failed, 2 the input is wrong, 130 interrupted.
    """
    _open_standard_streams()
    if arguments is not None:
        return _run(tuple(arguments))
    # A process of our own: a start makes 100,000 to 150,000 objects that stay. One collection among them
    # takes 30 ms; the default threshold, 700, costs a tenth of the start-up.
    gc.set_threshold(200_000, 20, 20)
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # it would read all entry points once more
    code = _run(tuple(sys.argv[1:]))
    gc.freeze()  # the interpreter's end would look through all modules for garbage: a seventh of `check`
    return code


def _run(tokens: tuple[str, ...]) -> int:
    try:
        if tokens == ("--version",):  # the framework takes longer to import than all that is printed
            from dxlrun.cli.help import version

            sys.stdout.write(f"{version()}\n")
            return 0
        if not tokens or tokens in (("--help",), ("-h",), ("help",)):
            from dxlrun.cli.help import print_help, print_short_help

            (print_help if tokens else print_short_help)()
            return 0 if tokens else 2
        from dxlrun.cli.app import run_tokens  # not above: importing the package must cost nothing

        return run_tokens(tokens)
    except KeyboardInterrupt:  # while that was being imported, or an error reported
        sys.stderr.write("interrupted\n")
        return 130


def _open_standard_streams() -> None:
    """Open /dev/null where the caller closed a standard stream: the next file would take its number.

    A run's shared memory would do so, and then be replaced by the output of the first child.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.dup2(descriptor, number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
