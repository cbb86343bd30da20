"""Command line: parses arguments, calls a lower room, prints the result, returns the exit code.

Decisions belong in the lower rooms. Importing this package loads neither numpy nor pydantic.
"""

from __future__ import annotations

import gc
import os
import sys

# Ctrl-C during these imports is still Python's own traceback, so they are few.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: that of this process) and return its exit code.

    0 good, 1 the robot or the run failed, 2 the input is wrong, 130 interrupted.
    """
    if arguments is not None:
        return _run(tuple(arguments))
    # Only in our own process: a start creates 100,000 to 150,000 permanent objects. One garbage collection of
    # them takes 30 ms; the default threshold, 700, costs a tenth of the start-up.
    gc.set_threshold(200_000, 20, 20)
    # Pydantic's search for plug-ins would read all entry points once more.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
    # On import, numpy would start a thread for each core: 16 ms of processor time with two cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = _run(tuple(sys.argv[1:]))
    # Otherwise the interpreter would search all modules for garbage at exit: a seventh of `check`.
    gc.freeze()
    return code


def _run(tokens: tuple[str, ...]) -> int:
    try:
        _open_standard_streams()
        # The framework takes longer to import than the output takes to print.
        if tokens == ("--version",):
            from dxlrun.cli.help import version

            sys.stdout.write(f"{version()}\n")
            return 0
        if not tokens or tokens in (("--help",), ("-h",), ("help",)):
            from dxlrun.cli.help import print_help, print_short_help

            (print_help if tokens else print_short_help)()
            return 0 if tokens else 2
        # Imported here because importing the package must cost nothing.
        from dxlrun.cli.app import run_tokens

        return run_tokens(tokens)
    # Ctrl-C during an import, or during the report of an error.
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130


def _open_standard_streams() -> None:
    """Open /dev/null in place of a closed standard stream, whose number the next opened file would get.

    That file would be a run's shared memory, which the output of the first child would overwrite.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.dup2(descriptor, number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
