"""Streams that ran out, and controllers that took turns; and clients that only stop or switch."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import structs
from tests.kit.made_logs import loop_of

from dxlrun.channels.answers import CommandOutcome
from dxlrun.channels.commands import TakenCommand
from dxlrun.channels.events import Event, EventCode, GoalReport, Severity
from dxlrun_analysis.conduct.clients import Clients
from dxlrun_analysis.finding import Rank
from dxlrun_analysis.plan import LoggedPlan

S, LEASE = 10**9, 200_000_000
PLAN = {"loop": loop_of(controllers=(structs.replace(LoggedPlan().controller("arms"), joints=("a", "b")),))}


def findings(commands: tuple[Any, ...] = (), events: tuple[Any, ...] = (), slices: int = 3) -> list[Any]:
    clients = Clients()
    for at in range(slices):
        low, high = 10 * at * S / slices, 10 * (at + 1) * S / slices
        part: Any = SimpleNamespace(
            commands=[one for one in commands if low <= one.t_ns < high],
            events=[one for one in events if low <= one.t_ns < high],
            attachments={"plan.json": json.dumps(PLAN).encode()},
            metadata={},
            activation={"scheduled_ns": [0]},
        )
        clients.take(part)
    return list(clients.findings())


def stream(*gaps: tuple[float, float], lease_ns: int = LEASE, until: float = 9.0) -> tuple[TakenCommand, ...]:
    times = [t for t in np.arange(0.5, until, 0.03) if not any(a < t < a + length for a, length in gaps)]
    return tuple(TakenCommand(round(t * S), 0, -1, "arms", "positions", "bob", b"", lease_ns) for t in times)


def ended(*times: float) -> tuple[Event, ...]:
    code = EventCode.STALE_COMMAND
    return tuple(Event(round(t * S), code, Severity.WARNING, "arms", "the stream ended") for t in times)


def refused(at_s: float) -> Event:
    code = EventCode.COMMAND_REFUSED
    return Event(round(at_s * S), code, Severity.WARNING, "arms", "positions from bob refused")


def test_a_stream_that_runs_out_again_and_again_is_told_with_its_longest_gap() -> None:
    gaps = ((2.0, 0.4), (4.0, 0.7), (6.0, 0.4))
    (finding,) = findings(stream(*gaps), ended(2.2, 4.2, 6.2))
    assert (finding.code, finding.subject, finding.rank) == ("stream_ran_out", "arms", Rank.CAUSE)
    assert "arms (2 joints) ran out 3 times" in finding.sentence
    assert "no set-point of bob for up to 720 ms, each counts for 200 ms" in finding.sentence


def test_one_that_ran_out_once_is_only_told() -> None:
    (finding,) = findings(stream((2.0, 0.4)), ended(2.2))
    assert (finding.rank, "ran out once" in finding.sentence) == (Rank.REMARK, True)


@pytest.mark.parametrize(
    ("commands", "events"),
    [
        (stream(), ()),
        (stream(until=5.0), ended(5.2)),
        (stream((2.0, 2.5), (6.0, 2.5)), ended(2.2, 6.2)),
        (stream((2.0, 0.4), (4.0, 0.4), lease_ns=0), ()),
        (stream((2.0, 0.4), (4.0, 0.4)), ()),
        (stream((2.0, 0.4)), (*ended(2.2), refused(2.42))),
    ],
    ids=["never", "it ends", "it begins anew", "no lease", "the loop stalled", "it is refused"],
)
def test_a_client_that_has_ended_or_did_not_stop_is_not(commands: Any, events: Any) -> None:
    assert findings(commands, events) == []


def turns(
    every_s: float, count: int, names: tuple[str, ...] = ("arms", "carry"), begin_s: float = 2.0
) -> Any:
    outcome = msgspec.json.encode(CommandOutcome("switch", "anna"))
    found = [Event(0, EventCode.CONTROLLER_ACTIVATED, Severity.INFO, "arms", "active")]
    for at in range(count):
        t_ns = round((begin_s + at * every_s) * S)
        found.append(Event(t_ns, EventCode.CONTROLLER_ACTIVATED, Severity.INFO, names[at % len(names)], ""))
        found.append(Event(t_ns, EventCode.STEERED, Severity.INFO, "loop", "", outcome))
    return tuple(found)


def aborted(at_s: float) -> tuple[Event, ...]:
    data = msgspec.json.encode(GoalReport(1, "arms", "play", "anna", "aborted"))
    return (Event(round(at_s * S), EventCode.GOAL_ENDED, Severity.WARNING, "arms", "", data),)


def test_controllers_that_take_turns_are_told_with_how_often_and_for_which_client() -> None:
    (finding,) = findings(events=turns(0.31, 8))
    assert (finding.code, finding.subject, finding.rank) == ("controllers_flap", "arms", Rank.CAUSE)
    assert "arms and carry were activated 8 times from 2.0 s to 4.2 s, every 0.31 s" in finding.sentence
    assert "asked for by anna" in finding.sentence
    (finding,) = findings(events=turns(0.31, 8, ("arms",)))
    assert "Controller arms was deactivated again and again" in finding.sentence


def test_slow_turns_are_told_only_where_they_cut_goals_off() -> None:
    assert findings(events=turns(1.0, 7)) == []
    (finding,) = findings(events=(*turns(1.0, 7), *aborted(3.0)))
    assert "goals were cut off" in finding.sentence
    assert findings(events=(*turns(1.0, 7, begin_s=2.9), *aborted(0.5))) == []
    assert findings(events=(*turns(2.5, 6, begin_s=0.5)[:4], *aborted(3.0))) == []


def test_a_few_switches_are_no_turns() -> None:
    assert findings(events=turns(0.3, 5)) == []
    assert findings(events=turns(0.3, 8, tuple("abcdefgh"))) == []
    assert findings() == []
