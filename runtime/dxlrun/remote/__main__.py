"""`python -m dxlrun.remote`: the gateway's process."""

from __future__ import annotations

import os
from contextlib import suppress

NICENESS = 10
"""nice(2) value. Loop, guardian and recorder take precedence over a busy gateway."""


def main() -> None:
    """Lower the priority before the imports, which are most of the gateway's work in a short run."""
    with suppress(OSError):
        os.nice(NICENESS)
    from dxlrun.remote.server import main as serve_run

    serve_run()


if __name__ == "__main__":
    main()
