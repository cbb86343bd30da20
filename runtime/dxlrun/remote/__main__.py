"""`python -m dxlrun.remote`: the gateway's process."""

from __future__ import annotations

from dxlrun.remote.process import main

if __name__ == "__main__":
    main()
