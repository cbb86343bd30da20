"""`python -m dxlrun.remote`: the gateway's process."""

from __future__ import annotations

import os
from contextlib import suppress

NICENESS = 10
"""The robot comes first: a busy gateway gets what loop, guardian and recorder leave over."""


def main() -> None:
    """Step back before anything is imported, which is most of the gateway's work in a short run."""
    with suppress(OSError):
        os.nice(NICENESS)
    from dxlrun.remote.process import main as serve_run

    serve_run()


if __name__ == "__main__":
    main()
