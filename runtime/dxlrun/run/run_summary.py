"""What a terminal shows of a run: its options, what the system granted, its progress and its summary."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.errors import counted
from dxlrun.output.table import Cell, Column, Sentence, Table
from dxlrun.output.terminal import live_line, show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console
    from rich.status import Status

    from dxlrun.channels.events import EventGroup
    from dxlrun.control.realtime import Grant
    from dxlrun.plan.robot_plan import Plan

_REFRESH_S = 0.1
_LINE_S = 5.0
"""Between two lines in a pipe or a file."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line decides about one run."""

    record: bool = True
    take_over: bool = False
    """Accept servos that are already torqued."""
    debug: bool = False
    verbose: bool = False
    """Show all that the system granted."""
    ledger: Path | None = None
    """Where simulated buses write what they saw; None: beside the log, on virtual time nowhere."""
    gateway: bool = True
    """Let others steer the run, over a Unix socket."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """How a run went, for the terminal and for `--json`."""

    exit_code: int
    reason: str
    cycles: int
    skipped: int
    elapsed_s: float
    sentences: tuple[str, ...]
    """What went wrong, one sentence each; empty after a good run."""
    remarks: tuple[str, ...] = ()
    """What the operating system did not grant, and what went wrong beside the robot."""
    log: str | None = None
    messages: int = 0
    """Messages in the log."""
    invalid: tuple[int, ...] = ()
    """Cycles in which the state of each joint was not valid."""
    errors: tuple[EventGroup, ...] = ()
    """Events of the loop that were errors."""
    virtual: bool = False
    """It was on virtual time."""


class Progress:
    """The status line of a run: how far it has come, and on virtual time how many times as fast as real time.

    A console that is no terminal shows no status; it gets a line every few seconds.
    """

    def __init__(self, plan: Plan, status: Status, *, virtual: bool = False) -> None:
        self._plan = plan
        self._status = status
        self._virtual = virtual
        self._every_s = _REFRESH_S if status.console.is_terminal else _LINE_S
        self._began = self._shown = time.monotonic()

    def setting_up(self) -> None:
        """Show that the servos are set up."""
        self._status.update(f"{self._plan.robot}: checking servos, torque on")

    def ran(self, cycles: int, skipped: int) -> None:
        """Show how many cycles ran and how many periods were skipped; cheap when called for every cycle."""
        now = time.monotonic()
        if now - self._shown < self._every_s:
            return
        self._shown, elapsed_s = now, now - self._began
        ran_ns, end_ns = (cycles + skipped) * self._plan.loop.period_ns, self._plan.loop.end_ns
        # the steps of a policy come after the end: none is shown beside them
        end = f" of {end_ns / 1e9:.1f}" if end_ns and ran_ns <= end_ns else ""
        speed = f", {ran_ns / 1e9 / elapsed_s:.3g} x" if self._virtual else ""
        skips = f"{counted(skipped, 'period', 'periods')} skipped"
        line = f"{self._plan.robot}: {ran_ns / 1e9:.1f}{end} s{speed}, {skips}"
        if self._status.console.is_terminal:
            self._status.update(live_line(line, " (Ctrl-C stops)"))
        else:
            self._status.console.print(line, markup=False, soft_wrap=True)
            self._status.console.file.flush()


@dataclass(frozen=True, slots=True)
class ProcessGrant:
    """What the operating system granted to one process of the run, or refused."""

    process: str
    """loop, guardian"""
    grant: Grant

    @property
    def name(self) -> str:
        """What was asked for; with the process where that is not the loop."""
        return self.grant.request if self.process == "loop" else f"{self.process}: {self.grant.request}"


def show_grants(grants: Sequence[ProcessGrant], out: Console, *, verbose: bool = False) -> None:
    """Print one line where all was granted, else a table, and the commands that fix what was refused.

    Only on a terminal. `verbose`: the table in any case.
    """
    if not out.is_terminal:
        return
    if not verbose and all(one.grant.granted for one in grants):
        show("real time: all granted", console=out)
        return
    columns = [Column("real time", "name"), Column("granted", "name"), Column("", "text")]
    rows = [
        (one.name, Cell("yes", "good") if one.grant.granted else Cell("no", "warning"), one.grant.sentence)
        for one in grants
    ]
    fixes = dict.fromkeys(one.grant.fix for one in grants if one.grant.fix)
    show(Table.of("", columns, rows), *(Sentence(f"  {fix}", "warning") for fix in fixes), console=out)


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
