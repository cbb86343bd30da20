"""What clients did to controllers: streams that ran out, and controllers that took turns.

- A stream of set-points ran out where the loop noted that it ended, and its client went on with it within
  2 s: what was to be one movement was several. One that simply ends is no fault.
- Controllers flap where they were activated six times beside the start, each of them at least twice, one soon
  after the other: 0.7 s in the median, or 2 s where goals were cut off by it.
"""

from __future__ import annotations

import statistics
from bisect import bisect_right
from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import msgspec

from dxlrun.channels.answers import CommandOutcome
from dxlrun.channels.commands import TakenCommand
from dxlrun.channels.events import Event, EventCode, GoalReport
from dxlrun.errors import counted
from dxlrun.log.reader import UNREADABLE, Log
from dxlrun_analysis.cycles.latency import begins, first_deadline_ns
from dxlrun_analysis.finding import Finding, Rank, cause
from dxlrun_analysis.plan import LoggedPlan, plan_of

_SOON_NS = 2_000_000_000  # A client that goes on later has begun anew
_QUICK_NS = 700_000_000
_TURNS, _FEWEST = 2, 6  # Activations of each controller, and of all, from which they flap
_CYCLE_NS = 50_000_000  # So long after a cycle woke it has refused a set-point
_MOST_KEPT = 10_000
_MOST_NAMED = 3


class _Gap(NamedTuple):
    """A time in which a stream had run out."""

    begin_ns: int  # Of the last set-point before it
    ns: int
    lease_ns: int
    origin: str


class Clients:
    """Collects what clients did to controllers, in memory that hardly grows with the log."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._plan = LoggedPlan()
        self._streams: dict[str, TakenCommand] = {}
        self._gaps: dict[str, list[_Gap]] = {}
        self._ended: dict[str, list[int]] = {}
        """When the loop noted that a stream had ended, ns: where the loop itself stalled it did not."""
        self._refused: dict[str, list[int]] = {}  # When a controller's commands were refused, ns
        self._changes: list[tuple[int, str]] = []  # When which controller was activated after the start, ns
        self._switches: list[tuple[int, str]] = []  # When which client requested one, ns
        self._cut: list[int] = []  # When goals were aborted, ns

    def take(self, log: Log) -> None:
        """Take the next slice."""
        self._plan = plan_of(log)
        if self._begin_ns is None and begins(log):
            self._begin_ns = first_deadline_ns(log)
        for command in log.commands:
            self._command(command)
        for event in log.events:
            with suppress(*UNREADABLE):
                self._event(event)

    def _command(self, command: TakenCommand) -> None:
        last = self._streams.pop(command.controller, None)
        if not command.lease_ns:
            return
        self._streams[command.controller] = command
        if last is None or (last.kind, last.origin) != (command.kind, command.origin):
            return
        ns = command.t_ns - last.t_ns
        gaps = self._gaps.setdefault(command.controller, [])
        if last.lease_ns < ns <= last.lease_ns + _SOON_NS and len(gaps) < _MOST_KEPT:
            gaps.append(_Gap(last.t_ns, ns, last.lease_ns, command.origin))

    def _event(self, event: Event) -> None:
        started = self._begin_ns is not None and event.t_ns > self._begin_ns
        if event.code == EventCode.CONTROLLER_ACTIVATED and started and len(self._changes) < _MOST_KEPT:
            self._changes.append((event.t_ns, event.source))
        elif event.code == EventCode.STALE_COMMAND:
            self._ended.setdefault(event.source, []).append(event.t_ns)
        elif event.code == EventCode.COMMAND_REFUSED:
            self._refused.setdefault(event.source, []).append(event.t_ns)
        elif event.code == EventCode.GOAL_ENDED and len(self._cut) < _MOST_KEPT:
            if msgspec.json.decode(event.data, type=GoalReport).status == "aborted":
                self._cut.append(event.t_ns)
        elif event.code == EventCode.STEERED and len(self._switches) < _MOST_KEPT:
            outcome = msgspec.json.decode(event.data, type=CommandOutcome)
            if outcome.kind == "switch":
                self._switches.append((event.t_ns, outcome.origin))

    # Results

    def findings(self) -> Iterable[Finding]:
        """Name streams that ran out, and controllers that flapped."""
        for controller, all_gaps in self._gaps.items():
            ended, refused = (of.get(controller, []) for of in (self._ended, self._refused))
            gaps = [
                gap
                for gap in all_gaps
                if _any_within(ended, gap.begin_ns, gap.ns)
                and not _any_within(refused, gap.begin_ns + gap.ns - 1, _CYCLE_NS)
            ]
            if gaps:
                yield self._ran_out(controller, gaps)
        yield from self._flapping()

    def _ran_out(self, controller: str, gaps: list[_Gap]) -> Finding:
        times = "once" if len(gaps) == 1 else counted(len(gaps), "time", "times")
        longest = max(gaps, key=lambda gap: gap.ns)
        joints = counted(len(self._plan.controller(controller).joints), "joint", "joints")
        return Finding(
            "stream_ran_out",
            controller,
            f"The stream of commands for {controller} ({joints}) ran out {times}, and went on: "
            f"no set-point of {longest.origin} for up to {longest.ns / 1e6:.0f} ms, each counts for "
            f"{longest.lease_ns / 1e6:g} ms; first at {self._at_s(gaps[0].begin_ns):.1f} s.",
            "Look at what keeps the client from sending; `on_stale_command` in the robot file has "
            "what its joints do meanwhile.",
            Rank.CAUSE if len(gaps) > 1 else Rank.REMARK,
            1.0,
        )

    def _flapping(self) -> Iterable[Finding]:
        by_name: dict[str, list[int]] = {}
        for at_ns, name in self._changes:
            by_name.setdefault(name, []).append(at_ns)
        turns = [name for name, times in by_name.items() if len(times) >= _TURNS]
        changes = [(at_ns, name) for at_ns, name in self._changes if name in turns]
        between = [after - before for (before, _), (after, _) in pairwise(changes) if after > before]
        if len(changes) < _FEWEST or not between:
            return
        begin, end = changes[0][0], changes[-1][0]
        usual = statistics.median(between)
        cut = any(begin - _SOON_NS <= at_ns <= end for at_ns in self._cut)
        if usual > (_SOON_NS if cut else _QUICK_NS):
            return
        clients = dict.fromkeys(origin for at_ns, origin in self._switches if begin - 1 <= at_ns <= end)
        asked = f", asked for by {' and '.join(list(clients)[:_MOST_NAMED])}" if clients else ""
        when = f"from {self._at_s(begin):.1f} s to {self._at_s(end):.1f} s"
        turned = f"Controllers took turns: {' and '.join(turns[:_MOST_NAMED])} were"
        if len(turns) == 1:
            turned = f"Controller {turns[0]} was deactivated again and again, and"
        yield cause(
            "controllers_flap",
            turns[0],
            f"{turned} activated {len(changes)} times {when}, "
            f"every {usual / 1e9:.2f} s{asked}{'; goals were cut off' if cut else ''}.",
            "Let one program alone decide which controller has these joints.",
        )

    def _at_s(self, at_ns: int) -> float:
        return 0.0 if self._begin_ns is None else (at_ns - self._begin_ns) / 1e9


def _any_within(times: list[int], begin_ns: int, ns: int) -> bool:
    """Return whether one of some times, ascending, is behind a moment, and no later than so long."""
    return bisect_right(times, begin_ns) < bisect_right(times, begin_ns + ns)
