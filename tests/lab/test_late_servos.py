"""How long a loop waited for simulated servos, by their ledger: in its read, and behind its deadline."""

import pytest
from tests.kit.made_logs import Cycle, Wire, made_log

from dxlrun.log.log_reader import read_log
from dxlrun_lab.late_servos import overruns_by_servos, transactions, waits_for_servos
from dxlsim.bus.ledger import LedgerEntry
from dxlwire.packets import PacketKind

PERIOD_US = 20_000
ASKED = b"\xff\xff\x05\x04\x02\x24\x02\xcc"
LATE = 15  # The cycle that overran; the one after it is the last
GONE = 3  # Periods that were left out behind it


def entry(direction: str, at_us: float, data: bytes = ASKED, late_us: int = 0) -> LedgerEntry:
    return LedgerEntry(round(at_us * 1000), "main", direction, data, "", late_us * 1000)  # type: ignore[arg-type]


def asked_us(n: int, woke_us: int = 0) -> int:
    return 1_000_000 + n * PERIOD_US + 10 + (woke_us if n == LATE else 0)


def ledger(handed_late_us: int = 0, taken_late_us: int = 0, woke_us: int = 0) -> list[LedgerEntry]:
    """A question and a reply 1 ms after it in each cycle; one of them is late, us."""
    found = []
    for n in range(LATE + 1):
        taken = asked_us(n, woke_us) + (taken_late_us if n == LATE else 0)
        found.append(entry("in", taken))
        found.append(entry("out", taken + 1000, late_us=handed_late_us if n == LATE else 0))
    return found


@pytest.fixture
def waits(tmp_path):
    """Return overruns by servos, and how long the cycle that took more waited: read, idle, us."""

    def waits(entries, **more):
        cycles = [Cycle(n, **(more if n == LATE else {})) for n in range(LATE + 1)]
        cycles.append(Cycle(LATE + 1 + GONE, skipped=GONE))
        woke = more.get("late", 0)
        asked = [Wire(PacketKind.INSTRUCTION, 5, asked_us(n, woke), ASKED) for n in range(LATE + 1)]
        log = read_log(made_log(tmp_path, cycles, asked))
        in_read, in_idle = waits_for_servos(log, entries)
        assert not in_read[:LATE].any()
        return overruns_by_servos(log, entries), in_read[LATE] / 1e3, in_idle[LATE] / 1e3

    return waits


@pytest.mark.parametrize(
    ("late", "cycle", "expected"),
    [
        ({"handed_late_us": 17_000}, {"read": 22_000}, (1, 17_000, 0)),
        ({"taken_late_us": 17_000}, {"read": 22_000}, (1, 17_000, 0)),
        # too long without the late reply: our own
        ({}, {"update": 20_000}, (0, 0, 0)),
        ({"woke_us": 16_000}, {"late": 16_000}, (0, 0, 0)),
        ({"handed_late_us": 30_000}, {"read": 35_000, "update": 16_000}, (0, 30_000, 0)),
    ],
)
def test_only_a_late_reply_or_question_counts(waits, late, cycle, expected):
    assert waits(ledger(**late), **cycle) == expected


def test_a_late_reply_in_the_idle_time_holds_up_the_wake_up(waits):
    at = 1_000_000 + LATE * PERIOD_US
    entries = ledger(woke_us=16_000)
    entries[2 * LATE : 2 * LATE] = [entry("in", at - 300), entry("out", at - 100, late_us=16_000)]
    assert waits(entries, late=16_000) == (1, 0, 15_900)


def test_a_reply_that_was_asked_for_before_counts_only_as_long_as_it_was_waited_for(waits):
    entries = ledger()
    at = 1_000_000 + LATE * PERIOD_US
    entries[2 * LATE + 1] = entry("out", at - 6_000, late_us=8_000)  # handed over 2 ms after the cycle woke
    assert waits(entries, update=16_000) == (1, 2_000, 0)
    assert waits(entries, update=17_000) == (0, 2_000, 0)


def test_bytes_that_wait_for_the_line_are_not_late():
    goals, question = bytes(100), bytes(10)
    sent = [(0, 100), (100_000, 10)]
    entries = [
        entry("in", 50, goals),  # taken 50 us late: the line is free 50 us later, too
        entry("in", 100, question),
        entry("out", 1_500, late_us=7),
    ]
    (one,) = transactions(entries, sent, 10_000.0)
    assert one.late_ns == 57_000
    (one,) = transactions(entries, (), 10_000.0)  # a host that does not record when it wrote
    assert one.late_ns == 7_000
