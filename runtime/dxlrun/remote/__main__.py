"""`python -m dxlrun.remote`: the gateway's process."""

from __future__ import annotations

import os
from contextlib import suppress

NICENESS = 10
"""nice(2) value of the gateway's process: loop, guardian and recorder take precedence."""


def main() -> None:
    """Lower the process's priority, then import and run the server: imports are most of its work in a short
    run.
    """
    with suppress(OSError):
        os.nice(NICENESS)
    from dxlrun.remote.server import main as serve_run

    serve_run()


if __name__ == "__main__":
    main()
