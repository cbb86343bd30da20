"""Tables that are wider than their terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from rich.table import Table

from dxlrun.cli.output.narrow import fitting


def servos() -> Table:
    table = Table(box=None, pad_edge=False)
    for head in ("ID", "model", "return delay", "firmware"):
        table.add_column(head)
    table.add_row("1", "XM430-W350", "500 us", "52")
    table.add_row("2", "AX-12A", "", "24")
    return table


@pytest.mark.parametrize(
    ("width", "shown"),
    [
        (
            60,
            "ID  model       return delay  firmware\n"
            "1   XM430-W350  500 us        52      \n"
            "2   AX-12A                    24      \n",
        ),
        (
            30,
            "              return         \n"
            "ID model      delay  firmware\n"
            "1  XM430-W350 500 us 52      \n"
            "2  AX-12A            24      \n",
        ),
        (
            24,
            "ID 1: model XM430-W350,\n"
            "  return delay 500 us,\n"
            "  firmware 52\n"
            "ID 2: model AX-12A,\n"
            "  firmware 24\n",
        ),
    ],
)
def test_a_table_that_does_not_fit_becomes_paragraphs_in_which_nothing_is_cut(width: int, shown: str) -> None:
    console = Console(file=io.StringIO(), width=width)
    console.print(fitting(servos(), width))
    assert console.file.getvalue() == shown  # type: ignore[attr-defined]
