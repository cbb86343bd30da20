"""`python -m dxlrun.simulation`: the process of the simulated buses."""

from __future__ import annotations

import sys

from dxlrun.simulation.process import main

if __name__ == "__main__":
    sys.exit(main())
