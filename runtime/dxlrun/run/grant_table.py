"""What the operating system granted to a run, for the terminal and for the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table
from rich.text import Text

from dxlrun.control.realtime import Grant


@dataclass(frozen=True, slots=True)
class ProcessGrant:
    """One wish of one process, and what became of it."""

    process: str
    """loop, guardian"""
    grant: Grant

    @property
    def name(self) -> str:
        """The wish; whose it is where it is not the loop's."""
        return self.grant.request if self.process == "loop" else f"{self.process}: {self.grant.request}"


def show_grants(grants: Sequence[ProcessGrant], out: Console) -> None:
    """Print a table, and the commands that would mend what is missing; only where somebody looks."""
    if not out.is_terminal:
        return
    table = Table("real time", "granted", "", box=None, pad_edge=False, header_style="bold")
    for one in grants:
        answer = Text("yes", "green") if one.grant.granted else Text("no", "yellow")
        table.add_row(one.name, answer, Text(one.grant.sentence))
    out.print(table)
    for mend in dict.fromkeys(one.grant.fix for one in grants if one.grant.fix):
        out.print(Text(f"  {mend}", "yellow"), soft_wrap=True)  # unbroken: it is there to be copied


def refusals(grants: Sequence[ProcessGrant], out: Console) -> tuple[str, ...]:
    """Return what was not granted, one sentence each, where no table has shown it."""
    if out.is_terminal:
        return ()
    refused = (one for one in grants if not one.grant.granted)
    return tuple(
        one.grant.text if one.process == "loop" else f"{one.process}: {one.grant.text}" for one in refused
    )


def granted_text(grants: Sequence[ProcessGrant]) -> dict[str, str]:
    """Return the table as the log's metadata carries it."""
    return {one.name: f"{'yes' if one.grant.granted else 'no'}: {one.grant.sentence}" for one in grants}
