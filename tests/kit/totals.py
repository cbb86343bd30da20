"""What the analysis counts of a log."""

from pathlib import Path

from dxlrun import open_log
from dxlrun_analysis.tally import RunTotals, Tally


def totals_of(path: str | Path) -> RunTotals:
    """Count the log at a path, slice by slice. Raises LogError when it cannot be read."""
    tally, reader = Tally(), open_log(path)
    for part in reader.slices():
        tally.add_slice(part)
    return tally.totals(reader.about)
