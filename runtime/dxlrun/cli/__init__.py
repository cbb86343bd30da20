"""The command line: parses, prints, returns exit codes; everything else is done by the rooms below."""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: this process' own) and return its exit code.

    0 good, 1 the robot or the run failed, 2 the input is wrong, 130 interrupted.
    """
    from dxlrun.cli.app import run_tokens  # not above: importing the package must cost nothing

    return run_tokens(tuple(sys.argv[1:] if arguments is None else arguments))
