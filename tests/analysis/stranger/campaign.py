"""Run fault cases on robots, and print what the verdict names of them.

python -m tests.analysis.stranger.campaign [--only NAME ...] [--virtual] [--findings]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from tests.analysis.stranger.cases import innocents, line, movement
from tests.analysis.stranger.cases import robot as robots
from tests.analysis.stranger.expectation import Judged, judged

from dxlrun.errors import DxlrunError

FILES = (line, robots, movement, innocents)
CASES = tuple(case for file in FILES for case in file.CASES)
PAIRS = [(case, robot) for case in CASES for robot in case.robots]


def main() -> None:
    """Run them all, and print a table and its sums."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=(), help="names of cases")
    parser.add_argument("--virtual", action="store_true", help="leave out what needs real time")
    parser.add_argument("--findings", action="store_true", help="print all findings of each")
    options = parser.parse_args()
    rows: list[Judged] = []
    failed = 0
    for case, robot in PAIRS:
        if (options.only and case.name not in options.only) or (options.virtual and case.live):
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as directory:
            try:
                rows.append(judged(case, robot, Path(directory)))
            except (AssertionError, DxlrunError, LookupError, TypeError, AttributeError) as error:
                failed += 1
                print(f"{case.name} {robot}: THE FAULT DID NOT HAPPEN: {error!r}", flush=True)
                continue
        print(rows[-1].row, f"[{time.monotonic() - began:.1f} s]", flush=True)
        if options.findings:
            for one in rows[-1].verdict.findings:
                print(f"      {one.rank!r} {one.code} {one.subject!r}: {one.sentence} -> {one.remedy}")
    for kind in dict.fromkeys(row.kind for row in rows):
        of = [row for row in rows if row.kind == kind]
        named, right = sum(row.named for row in of), sum(row.right for row in of)
        accused = sum(bool(row.accused) for row in of)
        print(
            f"{kind}: {len(of)} pairs, {named} named, {accused} with an innocent accused, {right} all right"
        )
    print(f"all: {len(rows)} pairs, {sum(row.named for row in rows)} named,", end=" ")
    print(f"{sum(bool(row.accused) for row in rows)} with an innocent accused, {failed} did not happen")


if __name__ == "__main__":
    main()
