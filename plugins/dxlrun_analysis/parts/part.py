"""Part of the report: numbers of a log under one key of `--json`, and the table that shows them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

from dxlrun import Log
from dxlrun.tooling.output import Columns, Table
from dxlrun_analysis.tally import Collector, RunTotals, Tally
from dxlrun_analysis.verdict import Verdict

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Report:
    """All results of `dxlrun analyze` on a log."""

    about: Log  # The log without its records
    tally: Tally
    totals: RunTotals
    verdict: Verdict
    numbers: dict[str, object]  # Numbers of each part by name: the output of `--json`

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self.about.header.robot


@dataclass(frozen=True, slots=True)
class ReportPart(Generic[T]):
    """One part of the report of `dxlrun analyze`: functions that return its numbers and its table."""

    name: str  # Key of `--json`, and name of its table
    numbers: Callable[[Report], T]
    table: Callable[[Report, T], Table] | None = None  # A table without rows is not shown
    # Accumulator that receives the log slice by slice; `report.tally.of` returns it.
    collector: type[Collector] | None = None
    section: str = ""  # Section of the page that has the table
    first: bool = False  # The table is the first of its section
    late: int = 0  # In a terminal, tables with a higher number come later

    def numbers_of(self, report: Report) -> T:
        """Return the numbers of this part from a finished report."""
        return cast("T", report.numbers[self.name])

    def table_of(self, report: Report) -> Table | None:
        """Return the table of this part for a report, or None without a table or rows."""
        found = self.table and self.table(report, self.numbers_of(report))
        return found if found and found.rows else None


def listing(title: str, columns: Columns[T]) -> Callable[[Report, Sequence[T]], Table]:
    """Return a function for `ReportPart.table` that makes a table with a row for each item."""
    return lambda _, things: Table.listing(title, columns, things)
