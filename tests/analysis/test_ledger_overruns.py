"""Why a loop on simulated buses overran: its servos, the kernel, its wake-up, or its own work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dxlrun.channels.packets import PacketKind
from dxlrun.log.reader import read_log
from dxlrun.output.table import Table
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.causes.causes import CycleCauses
from dxlrun_analysis.ledger.comparison import compare, parts
from dxlrun_analysis.ledger.overruns import overrun_causes, transactions

BEGIN_NS = 10**9
PERIOD_US = 20_000
ASKED = b"\xff\xff\x05\x04\x02\x24\x02\xcc"
LATE = 15
"""The cycle that overran; the one after it is the last."""
GONE = 3
"""Periods that were left out behind it."""
COUNT = LATE + 2


def entry(direction: str, at_us: float, data: bytes = ASKED, late_us: int = 0) -> LedgerEntry:
    return LedgerEntry(round(at_us * 1000), "main", direction, data, "", late_us * 1000)  # type: ignore[arg-type]


def asked_us(n: int, woke_us: int = 0) -> int:
    return BEGIN_NS // 1000 + n * PERIOD_US + 10 + (woke_us if n == LATE else 0)


def ledger(handed_late_us: int = 0, taken_late_us: int = 0, woke_us: int = 0) -> list[LedgerEntry]:
    """A question and a reply 1 ms after it in each cycle; one of them is late, us."""
    found = []
    for n in range(LATE + 1):
        taken = asked_us(n, woke_us) + (taken_late_us if n == LATE else 0)
        found.append(entry("in", taken))
        found.append(entry("out", taken + 1000, late_us=handed_late_us if n == LATE else 0))
    return found


@pytest.fixture
def causes_of(write: Callable[..., Path], cycle: type, wire: type) -> Callable[..., Any]:
    """Return the causes in a run, one cycle of which took more of something, us."""

    def causes(entries: list[LedgerEntry], **more: int) -> object:
        cycles = [cycle(n, **(more if n == LATE else {})) for n in range(LATE + 1)]
        cycles.append(cycle(LATE + 1 + GONE, skipped=GONE))
        woke = more.get("late", 0)
        asked = [wire(PacketKind.INSTRUCTION, 5, asked_us(n, woke), ASKED) for n in range(LATE + 1)]
        return overrun_causes(read_log(write(cycles, asked)), {"main": entries})

    return causes


def counts(found: Any) -> tuple[int, int, int]:
    return found.simulation, found.wake_up, found.own_work


def test_a_reply_that_came_late_is_the_simulation_s(causes_of: Callable[..., Any]) -> None:
    found = causes_of(ledger(handed_late_us=17_000), read=22_000)
    assert counts(found) == (1, 0, 0)
    (one,) = found.overruns
    assert (one.simulation_us, one.wake_up_us, one.own_us) == (17_000, 0, 0)


def test_a_question_that_was_taken_late_is_the_simulation_s(causes_of: Callable[..., Any]) -> None:
    assert counts(causes_of(ledger(taken_late_us=17_000), read=22_000)) == (1, 0, 0)


KEPT = 16_000
"""For so long after it was handed over the last reply came to the loop, us."""


def run_with_a_reply_kept(
    write: Callable[..., Path], cycle: type, wire: type, *, received: bytes = ASKED, update: int = 100
) -> object:
    cycles = [cycle(n, read=18_000 if n == LATE else 2_000) for n in range(LATE)]
    cycles.append(cycle(LATE, read=18_000, update=update))
    cycles.append(cycle(LATE + 1 + GONE, skipped=GONE))
    wires = []
    for n in range(LATE + 1):
        wires.append(wire(PacketKind.INSTRUCTION, 5, asked_us(n), ASKED))
        came = asked_us(n) + 1000 + (KEPT if n == LATE else 300)
        wires.append(wire(PacketKind.STATUS, 5, came, received if n == LATE else ASKED))
    return overrun_causes(read_log(write(cycles, wires)), {"main": ledger()})


def test_a_reply_that_the_kernel_kept_is_neither_the_simulation_s_nor_our_own(
    write: Callable[..., Path], cycle: type, wire: type
) -> None:
    found = run_with_a_reply_kept(write, cycle, wire, update=3_000)
    assert (found.kernel, *counts(found)) == (1, 0, 0, 0)
    (one,) = found.overruns
    assert (one.kernel_us, one.own_us) == (KEPT - 300, 18_000 - 2_000 + 2_900 - (KEPT - 300))


def test_what_the_kernel_kept_is_no_excuse_for_a_cycle_that_was_too_long_without_it(
    write: Callable[..., Path], cycle: type, wire: type
) -> None:
    assert counts(run_with_a_reply_kept(write, cycle, wire, update=20_000)) == (0, 0, 1)


def test_where_log_and_ledger_differ_a_reply_that_was_kept_is_our_own(
    write: Callable[..., Path], cycle: type, wire: type
) -> None:
    other = ASKED[:-1] + b"\x00"
    assert counts(run_with_a_reply_kept(write, cycle, wire, received=other)) == (0, 0, 1)


def test_a_late_reply_of_another_cycle_is_no_excuse(causes_of: Callable[..., Any]) -> None:
    entries = ledger()
    entries[2 * LATE - 1] = entry("out", asked_us(LATE - 1) + 1000, late_us=3_000)
    assert counts(causes_of(entries, update=17_000)) == (0, 0, 1)


@pytest.mark.parametrize(
    ("late", "update", "expected"), [(16_000, 100, (0, 1, 0)), (2_000, 16_000, (0, 0, 1))]
)
def test_a_late_wake_up_is_distinguished_from_work(
    causes_of: Callable[..., Any], late: int, update: int, expected: tuple[int, int, int]
) -> None:
    assert counts(causes_of(ledger(woke_us=late), late=late, update=update)) == expected


def test_the_largest_of_three_is_the_cause_and_the_share_is_of_all_cycles(
    causes_of: Callable[..., Any],
) -> None:
    found = causes_of(ledger(handed_late_us=4_000, woke_us=3_000), read=9_000, late=3_000, update=9_000)
    assert counts(found) == (0, 0, 1)
    assert found.own_share == pytest.approx(1 / COUNT)
    (one,) = found.overruns
    assert (one.simulation_us, one.wake_up_us, one.own_us) == (4_000, 3_000, 8_900)


def test_a_late_reply_in_the_gap_that_holds_up_the_wake_up_is_the_simulation_s(
    write: Callable[..., Path], cycle: type, wire: type
) -> None:
    at = BEGIN_NS // 1000 + LATE * PERIOD_US
    entries = ledger(woke_us=16_000)
    entries[2 * LATE : 2 * LATE] = [entry("in", at - 300), entry("out", at - 100, late_us=16_000)]
    cycles = [cycle(n, late=16_000 if n == LATE else 0) for n in range(LATE + 1)]
    cycles.append(cycle(LATE + 1 + GONE, skipped=GONE))
    found = overrun_causes(read_log(write(cycles)), {"main": entries})
    assert counts(found) == (1, 0, 0)
    (one,) = found.overruns
    assert (one.simulation_us, one.wake_up_us) == (15_900, 100)


def test_a_cycle_that_was_too_long_without_the_late_reply_is_our_own(
    causes_of: Callable[..., Any],
) -> None:
    found = causes_of(ledger(handed_late_us=30_000), read=35_000, update=16_000)
    assert counts(found) == (0, 0, 1)


def test_a_reply_that_was_asked_for_before_counts_only_as_long_as_it_was_waited_for(
    causes_of: Callable[..., Any],
) -> None:
    entries = ledger()
    at = BEGIN_NS // 1000 + LATE * PERIOD_US
    entries[2 * LATE + 1] = entry("out", at - 6_000, late_us=8_000)  # handed over 2 ms after the cycle woke
    (one,) = causes_of(entries, update=17_000).overruns
    assert one.simulation_us == 2_000


def test_bytes_that_wait_for_the_line_are_not_late() -> None:
    goals, question = bytes(100), bytes(10)
    sent = [(0, 100), (100_000, 10)]
    entries = [
        entry("in", 50, goals),  # taken 50 us late: the line is free 50 us later, too
        entry("in", 100, question),
        entry("out", 1_500, late_us=7),
    ]
    (one,) = transactions(entries, sent, 10_000.0)
    assert one.late_ns == 57_000
    (one,) = transactions(entries, (), 10_000.0)  # a host that does not say when it wrote
    assert one.late_ns == 7_000


def test_the_terminal_shows_the_causes_and_the_worst_overruns(
    write: Callable[..., Path], cycle: type, wire: type
) -> None:
    entries = ledger(handed_late_us=17_000)
    cycles = [cycle(n, read=22_000 if n == LATE else 5_000) for n in range(LATE + 1)]
    cycles.append(cycle(LATE + 1 + GONE, skipped=GONE))
    wires = [wire(PacketKind.INSTRUCTION, 5, asked_us(n), ASKED) for n in range(LATE + 1)]
    wires += [wire(PacketKind.STATUS, 5, asked_us(n) + 1000, ASKED) for n in range(LATE + 1)]
    report = compare(read_log(write(cycles, wires)), entries, Path("seen.jsonl"))
    assert report.sentences[-1] == (
        "The cause was the simulated servos 1 time, the kernel 0 times, which hands replies over, a late "
        f"wake-up 0 times, and our own work 0 times: 0.000% of {COUNT} cycles."
    )
    tables = [part for part in parts(report) if isinstance(part, Table) and part.rows]
    assert tables[-1].title == "Why the loop overran; a cycle usually takes 5400 us"
    assert [cell.text for cell in tables[-1].rows[0]][1:4] == ["simulation", str(GONE), "17.00 ms"]


@pytest.mark.parametrize(
    "took",
    [
        (17_000, {"read": 22_000}, {"late reply"}),
        (0, {"late": 16_000}, {"late wake-up"}),
        (0, {"update": 17_000}, {"own work", "controller"}),
    ],
    ids=["simulation", "wake-up", "own work"],
)
def test_causes_by_packets_alone_do_not_contradict_the_ledger(
    write: Callable[..., Path], cycle: type, wire: type, took: tuple[int, dict[str, int], set[str]]
) -> None:
    handed, more, expected = took
    woke = more.get("late", 0)
    cycles = [cycle(n, **(more if n == LATE else {})) for n in range(LATE + 1)]
    cycles.append(cycle(LATE + 1 + GONE, skipped=GONE))
    wires = []
    for n in range(LATE + 1):
        asked = asked_us(n, woke)
        wires.append(wire(PacketKind.INSTRUCTION, 5, asked, ASKED))
        wires.append(wire(PacketKind.STATUS, 5, asked + 1000 + (handed if n == LATE else 0), ASKED))
    log = read_log(write(cycles, wires))
    (one,) = overrun_causes(log, {"main": ledger(handed_late_us=handed, woke_us=woke)}).overruns  # type: ignore[union-attr]
    by_ledger = {"simulation": {"late reply"}, "wake-up": {"late wake-up"}}
    assert by_ledger.get(one.cause, {"own work", "controller"}) == expected
    found = CycleCauses()
    found.take(log)
    worst = found.finish().worst[0]
    assert worst.cycle == LATE
    assert worst.causes[0].kind in expected
    by_kind = sum(share.us for share in worst.causes if share.kind in expected)
    ledger_us = {"simulation": one.simulation_us, "wake-up": one.wake_up_us}.get(one.cause, one.own_us)
    assert (
        ledger_us - 1_500 <= by_kind <= ledger_us + 5_400
    )  # own work counts whole here, there beyond the usual
