"""Run summary: a run's options, grants, progress and verdict in the terminal."""

from __future__ import annotations

import signal
import time
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from dxlrun.channels.event_records import CommandOutside, EventCode, EventGroup, EventTotals, Severity
from dxlrun.dynamixel.remedies import free_machine
from dxlrun.errors import counted
from dxlrun.output.terminal import live_line, show_parts
from dxlrun.output.text_table import Cell, Column, Sentence, Table
from dxlrun.plan.machine_load import MachineLoad, SimulationWait, describe_busy_machine
from dxlrun.plan.played_goals import find_unreached_goals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rich.console import Console
    from rich.status import Status

    from dxlrun.control.realtime_grants import Grant
    from dxlrun.plan.robot_plan import Plan

_REFRESH_S = 0.1
FEW_INVALID = 2
"""Number of cycles with an invalid state of a joint that is tolerated in any run; three in a row lose a
servo.
"""
INVALID_SHARE = 0.01
"""Share of cycles with an invalid state of a joint that is tolerated."""
SHORT_RUN_NS = 2_000_000_000
"""Length of a run, ns, up to which it may skip as many periods as a run of this length: one stall of the
machine is not an overload.
"""
# Names or sentences of one kind in a summary, which must fit on a screen.
_MOST = 3
_LOSSES = {
    EventCode.PORT_LOST: "lost",
    EventCode.SERVO_LIMP: "went limp",
    EventCode.SERVO_LOST: "lost",
    EventCode.SERVO_REBOOTED: "rebooted",
}
_SLOW_REPLIES = frozenset((EventCode.SERVO_LOST, EventCode.DEVICE_LOST, EventCode.WATCHDOG))
"""Errors that a busy machine may cause, in addition to invalid states and skipped periods."""
_LINE_S = 5.0
"""Interval of progress lines when the output is a pipe or a file, s."""


class RunOptions(msgspec.Struct, frozen=True):
    """Options of one run from the command line."""

    record: bool = True
    take_over: bool = False
    """True to accept servos that already have torque."""
    debug: bool = False
    verbose: bool = False
    """True to show the results of all real-time requests."""
    ledger: Path | None = None
    """File in which simulated buses record their traffic; None: next to the log; no file in virtual time."""
    gateway: bool = True
    """True to start the gateway, by which clients command the run over a Unix socket."""
    listen: str = ""
    """Address for clients over mutual TLS; empty: none."""


class RunSummary(msgspec.Struct, frozen=True):
    """Result of a run, for the terminal and for `--json`."""

    exit_code: int
    reason: str
    cycles: int
    skipped: int
    sentences: tuple[str, ...]
    """Errors, one sentence each; empty after a good run."""
    remarks: tuple[str, ...] = ()
    """Sentences about refused real-time requests and problems outside the robot."""
    log: str | None = None
    messages: int = 0
    """Number of messages in the log."""
    invalid: tuple[int, ...] = ()
    """Number of cycles with an invalid servo state, a value for each joint."""
    paused: int = 0
    """Number of the elapsed periods in which the loop was paused."""
    outside: tuple[CommandOutside, ...] = ()
    events: EventTotals = EventTotals()
    virtual: bool = False
    """True for a run in virtual time."""
    refused_for_replies: bool = False
    """True when the start was refused because of late or missing replies."""
    start_up_load: MachineLoad = MachineLoad()
    """Load of the machine before the first cycle, as far as the recorder has sampled it."""
    run_load: MachineLoad = MachineLoad()
    """Load of the machine from the first cycle on."""
    simulation_wait: SimulationWait = SimulationWait()
    """Time for which the loop waited for simulated servos that had no processor."""

    def describe_machine(self, plan: Plan) -> str:
        """Return a sentence with remedy if the machine was too busy for this run; else an empty string."""
        load = self.run_load if self.cycles else self.start_up_load
        observed = describe_busy_machine(load, self.simulation_wait)
        remedy = free_machine(bus.port for bus in plan.buses)
        return observed and f"{observed} {remedy[0].upper()}{remedy[1:]}."


@contextmanager
def caught_signals(act: Callable[[], None]) -> Iterator[None]:
    """Context manager that calls `act` at each SIGINT and SIGTERM, and restores the handlers afterwards."""
    before = {number: signal.signal(number, lambda *_: act()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class RunVerdict(NamedTuple):
    """Verdict on a run from the loop's own counters and events; `dxlrun analyze` finds the causes."""

    exit_code: int
    """Exit code of the command: 0 good, 1 failed, 130 interrupted."""
    line: str
    """Events of the run in one line, without the word for the verdict."""
    sentences: tuple[str, ...]


def run_verdict(run: RunSummary, plan: Plan) -> RunVerdict:
    """Judge a run by its events, states, goals and skipped periods.

    A run is good when no event is an error, states were valid, played motions reached their goals, and no
    more periods were skipped than the robot file tolerates. Failed controllers with a fallback are reported
    and tolerated; `plan` names them. A run that was interrupted before its motions ended counts as
    interrupted, not as failed.
    """
    if not run.cycles:
        return RunVerdict(run.exit_code, "the loop never ran a cycle.", ())
    loop, events, happened = plan.loop, run.events, list[str]()
    fallbacks = {one.name for one in loop.controllers if one.fallback}
    while above := {one.name for one in loop.controllers if fallbacks & {*one.into}} - fallbacks:
        # The controllers below a failed controller fail with it.
        fallbacks |= above
    faults = [one for one in events.named if one.code == EventCode.CONTROLLER_FAULT]
    # Without a fallback, the fault ended the run.
    fell_back = [one for one in faults if one.source in fallbacks and run.reason != "fault"]
    warnings = [one for one in events.named if one.severity < Severity.ERROR]
    errors = [one for one in events.named if one not in (*fell_back, *warnings)]
    for code, what in _LOSSES.items():
        if of := [one for one in errors if one.code == code]:
            after_s = max(min(one.t_ns for one in of) - events.started_ns, 0) / 1e9
            verb = "" if what != "lost" else "was " if len({one.source for one in of}) == 1 else "were "
            happened.append(f"{named(one.source for one in of)} {verb}{what} at {after_s:.1f} s")
    if fell_back:
        happened.append(
            f"{named(one.source for one in fell_back)} failed, and a fallback controller took over"
        )
    for one in warnings:
        after_s = max(one.t_ns - events.started_ns, 0) / 1e9
        what = f"{one.source} took over the robot: " if one.code == EventCode.TAKEOVER else ""
        happened.append(f"at {after_s:.1f} s {what}{last_line(one)}")
    ran_ns = (run.cycles + run.skipped - run.paused) * loop.period_ns
    paused = f" and was paused for {run.paused * loop.period_ns / 1e9:.1f} s" if run.paused else ""
    without = f" without {', '.join(plan.omitted)}" if plan.omitted else ""
    happened.append(f"ran for {ran_ns / 1e9:.1f} s{without}{paused}")
    if events.goals and events.goals.asked:
        asked = counted(events.goals.asked, "goal", "goals")
        happened.append(f"{events.goals.reached} of {asked} reached")
    kept, rate = _rate(run, plan)
    fewest = max(FEW_INVALID, INVALID_SHARE * run.cycles)
    invalid = zip(run.invalid, (joint.name for joint in loop.joints), strict=False)
    often = sorted(((count, name) for count, name in invalid if count > fewest), reverse=True)
    sentences = [*(f"{one.source}: {last_line(one)}." for one in errors[:_MOST]), rate]
    if often:
        shares = ", ".join(f"{name} in {count / run.cycles:.1%}" for count, name in often[:_MOST])
        sentences.append(f"States were invalid: {shares} of the cycles.")
    elif run.invalid and not any(run.invalid):
        sentences.append("The states of all joints were valid in every cycle.")
    sentences += islice(_commands_outside(run, plan), _MOST)
    unreached = list(find_unreached_goals(loop, events.goals, ran_ns)) if events.goals else []
    if events.goals is None and any(command.goal for command in loop.commands):
        read = f"; dxlrun analyze {run.log} reads it from the log" if run.log else ""
        sentences.append(
            f"Whether the motions reached their goals is unknown: the loop did not say so{read}."
        )
    sentences += [f"{'; '.join(filter(None, (one.sentence, one.remedy)))}." for one in unreached[:_MOST]]
    if often or run.skipped or any(one.code in _SLOW_REPLIES for one in errors):
        sentences[:0] = filter(None, (run.describe_machine(plan),))
    failed = errors or often or not kept or any(one.failed for one in unreached)
    exit_code = 1 if failed or (unreached and not run.exit_code) else run.exit_code
    return RunVerdict(exit_code, f"{'; '.join(happened)}.", tuple(sentences))


def named(names: Iterable[str]) -> str:
    """Return the first three different names as text, and the number of the others."""
    shown = list(dict.fromkeys(names))
    more = f" and {len(shown) - _MOST} more" if len(shown) > _MOST else ""
    return ", ".join(shown[:_MOST]) + more


def last_line(group: EventGroup) -> str:
    """Return the last line of a group's event text (of a traceback, the exception) without full stop."""
    lines = group.text.strip().splitlines() or [group.name]
    return lines[-1].removesuffix(".")


def _commands_outside(run: RunSummary, plan: Plan) -> Iterator[str]:
    """Yield a sentence for each joint whose position commands were outside of its limits."""
    for one in run.outside:
        joint, cycles = plan.loop.joints[one.row], counted(one.cycles, "cycle", "cycles")
        farthest, lower, upper = (f"{value:.4g}" for value in (one.farthest, joint.lower, joint.upper))
        if farthest not in (lower, upper):  # else at its limit within rounding
            yield (
                f"{joint.name} was commanded to {farthest} {joint.unit.si}, outside of its limits "
                f"{lower}..{upper} {joint.unit.si}; clamped in {cycles}."
            )


def _rate(run: RunSummary, plan: Plan) -> tuple[bool, str]:
    """Return whether the loop kept its rate, and the sentence about it."""
    loop, elapsed = plan.loop, run.cycles + run.skipped
    tolerated = loop.tolerated_skips * max(elapsed, SHORT_RUN_NS / loop.period_ns)
    kept = run.skipped <= tolerated or loop.schedule == "sequential"
    shares = f" ({run.skipped / elapsed:.2%}; {tolerated:.0f} tolerated)" if run.skipped else ""
    time = ", on virtual time" if run.virtual else ""
    rate = f"{1e9 / loop.period_ns:g} Hz"
    verb = "kept" if kept else "did not keep"
    return kept, f"The loop {verb} {rate}: {run.skipped} of {elapsed} periods skipped{shares}{time}."


class RunStatusLine:
    """Status line of a run: its time, and in virtual time the factor of its speed over real time.

    A console that is not a terminal gets a line every few seconds instead.
    """

    def __init__(self, plan: Plan, status: Status, *, virtual: bool = False) -> None:
        self._plan = plan
        self._status = status
        self._virtual = virtual
        self._every_s = _REFRESH_S if status.console.is_terminal else _LINE_S
        self._began = self._shown = time.monotonic()

    def setting_up(self) -> None:
        """Show in the status line that servos are being checked and torque enabled."""
        self._status.update(f"{self._plan.robot}: checking servos, torque on")

    def ran(self, cycles: int, skipped: int) -> None:
        """Update the status line from the number of cycles and skipped periods.

        Cheap enough for every cycle.
        """
        now = time.monotonic()
        if now - self._shown < self._every_s:
            return
        self._shown, elapsed_s = now, now - self._began
        ran_ns, end_ns = (cycles + skipped) * self._plan.loop.period_ns, self._plan.loop.end_ns
        # The steps of a policy come after the end time, which is then omitted.
        end = f" of {end_ns / 1e9:.1f}" if end_ns and ran_ns <= end_ns else ""
        speed = f", {ran_ns / 1e9 / elapsed_s:.3g} x" if self._virtual else ""
        skips = f"{counted(skipped, 'period', 'periods')} skipped"
        line = f"{self._plan.robot}: {ran_ns / 1e9:.1f}{end} s{speed}, {skips}"
        if self._status.console.is_terminal:
            self._status.update(live_line(line, " (Ctrl-C stops)"))
        else:
            self._status.console.print(line, markup=False, soft_wrap=True)
            self._status.console.file.flush()


def show_grants(grants: Sequence[Grant], out: Console, *, verbose: bool = False) -> None:
    """Print whether all real-time requests were granted, else a table and the commands that fix refusals.

    Prints only on a terminal. `verbose` always prints the table.
    """
    if not out.is_terminal:
        return
    if not verbose and all(one.granted for one in grants):
        show_parts("real time: all granted", console=out)
        return
    columns = [Column("real time", "name"), Column("granted", "name"), Column("", "text")]
    rows = [
        (one.full_request, Cell("yes", "good") if one.granted else Cell("no", "warning"), one.sentence)
        for one in grants
    ]
    fixes = dict.fromkeys(one.fix for one in grants if one.fix)
    show_parts(
        Table.from_rows("", columns, rows), *(Sentence(f"  {fix}", "warning") for fix in fixes), console=out
    )


def refusals(grants: Sequence[Grant], out: Console) -> tuple[str, ...]:
    """Return refused real-time requests, one sentence each; empty on a terminal, where a table shows them."""
    if out.is_terminal:
        return ()
    return tuple(one.full_sentence for one in grants if not one.granted)


def granted_text(grants: Sequence[Grant]) -> dict[str, str]:
    """Return the results of real-time requests for the log's metadata, by name of the request."""
    return {one.full_request: f"{'yes' if one.granted else 'no'}: {one.sentence}" for one in grants}
