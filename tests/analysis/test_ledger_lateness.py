"""How late the simulation was, beside the loop's overruns."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dxlrun.channels.packets import PacketKind
from dxlrun.log.reader import read_log
from dxlrun.output.table import Table
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.ledger.comparison import compare, parts
from dxlrun_analysis.ledger.overruns import lateness

BEGIN_NS = 10**9
PERIOD_NS = 20_000_000


def out(t_ns: int, late_us: int) -> LedgerEntry:
    return LedgerEntry(t_ns, "main", "out", b"\x00", "", late_us * 1000)


@pytest.fixture
def entries() -> list[LedgerEntry]:
    """A reply a cycle, one of them 5 ms late."""
    return [out(BEGIN_NS + n * PERIOD_NS + 10**6, 5000 if n == 30 else n) for n in range(100)]


def test_it_counts_what_was_late_and_how_much(write: Callable[..., Path], cycle: type, entries):
    found = lateness(read_log(write([cycle(n) for n in range(100)])), entries)

    assert found is not None
    assert (found.deliveries, found.rough, found.overruns, found.overruns_beside) == (100, 1, 0, 0)
    assert found.max_us == 5000
    assert found.median_us == pytest.approx(50.5)


def test_of_answers_that_came_together_the_last_one_counts(write: Callable[..., Path], cycle: type):
    together = [
        out(BEGIN_NS + us * 1000, 100 - us) for us in (0, 35, 70)
    ]  # all of them 100 us after the begin

    found = lateness(read_log(write([cycle(0)])), [*together, out(BEGIN_NS + 10**6, 10)])

    assert found is not None
    assert (found.deliveries, found.max_us, found.median_us) == (2, 30, 20)


def test_an_overrun_with_a_late_reply_in_its_time_is_distinguished_from_one_without(
    write: Callable[..., Path], cycle: type, entries
):
    cycles = [cycle(n) for n in range(31)] + [cycle(33, skipped=2)] + [cycle(n) for n in range(34, 80)]
    cycles += [cycle(81, skipped=1)]

    found = lateness(read_log(write(cycles)), entries)

    assert found is not None
    assert (found.overruns, found.overruns_beside) == (2, 1)


def test_without_a_delivery_there_is_no_lateness(write: Callable[..., Path], cycle: type):
    assert lateness(read_log(write([cycle(0)])), []) is None


def test_the_terminal_shows_it_in_a_table_and_a_sentence(
    write: Callable[..., Path], cycle: type, wire: type, entries
):
    cycles = [cycle(n) for n in range(31)] + [cycle(33, skipped=2)]
    wires = [wire(PacketKind.NOISE, 254, entry.t_ns // 1000, entry.data) for entry in entries]

    report = compare(read_log(write(cycles, wires)), entries, Path("seen.jsonl"))

    assert report.same
    said = "The loop overran 1 time, 1 time with a simulated reply that was more than 1 ms late."
    assert said in report.sentences
    titles = [part.title for part in parts(report) if isinstance(part, Table) and part.rows]
    assert titles[:2] == ["Buses", "How late the simulated buses were"]
