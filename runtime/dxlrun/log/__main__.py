"""The recorder's process: `python -m dxlrun.log --job-fd N --control-fd M`."""

from __future__ import annotations

import argparse
import sys

from dxlrun.log.recorder import main

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="dxlrun.log", description=__doc__)
    parser.add_argument("--job-fd", type=int, required=True, help="a descriptor with the job as JSON")
    parser.add_argument("--control-fd", type=int, required=True, help="one end of a socket pair")
    arguments = parser.parse_args()
    sys.exit(main(arguments.job_fd, arguments.control_fd))
