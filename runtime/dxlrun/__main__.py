"""`python -m dxlrun` is `dxlrun`."""

import sys

from dxlrun.cli import main

if __name__ == "__main__":
    sys.exit(main())
