"""Causes of late and long cycles: runs of which one cycle took more of something, without a ledger."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.kit.made_logs import Cycle, Wire

from dxlrun.log.log_reader import Log, read_log
from dxlrun_analysis.causes.causes import Causes, CycleCauses
from dxlrun_analysis.counts import has_them_alone
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
PERIOD = 20_000  # us, as all times here
COUNT = 30
BAD = 17  # The cycle that is late or long
SERVOS = (5, 21)
ASK = {5: bytes.fromhex("ffff0504022406ca"), 21: bytes.fromhex("ffff1504022406ba")}
ANSWER = {servo: bytes([255, 255, servo, 8, 0, 0, 2, 0, 0, 0, 0, 0xF0]) for servo in SERVOS}
PLANNED = 8 * 10 + 500 + 12 * 10  # Of one exchange: instruction, return delay and reply at 1 Mbit/s
PLAN = {
    "buses": [
        {
            "name": "main",
            "protocol": 1.0,
            "baud_rate": 1_000_000,
            "return_delay_ns": 500_000,
            "latency_ns": 0,
            "servos": [{"joint": f"joint_{servo}", "servo_id": servo} for servo in SERVOS],
        }
    ]
}


def due(number: int) -> int:
    return 1_000_000 + number * PERIOD


class Run:
    """A run of two servos that are read one after the other; `late`, `silent` ... hold for cycle BAD."""

    def __init__(self, write: Make) -> None:
        self._write = write

    def log(
        self,
        *,
        woken: int = 0,
        late: dict[int, int] | None = None,
        silent: dict[int, int] | None = None,
        asked_again: dict[int, int] | None = None,
        blocked: int = 0,
        update: int = 100,
        before_reads: int = 0,
        write_call: int = 10,
        idle: Sequence[Any] = (),
        bad: Sequence[int] = (BAD,),
        plan: object = PLAN,
    ) -> Log:
        """Return the log; `late`: servo -> us, `silent`: servo -> how long it was waited for."""
        cycles, wires = [], []
        skipped = 0
        for number in range(COUNT):
            if skipped:
                skipped -= 1
                continue
            is_bad = number in bad
            woke = due(number) + (woken if is_bad else 0)
            at = woke + 10 + (before_reads if is_bad else 0)
            for servo in SERVOS:
                *exchange, at = self._exchange(
                    servo,
                    at,
                    late=(late or {}).get(servo, 0) if is_bad else 0,
                    silent=(silent or {}).get(servo) if is_bad else None,
                    blocked=blocked if is_bad and servo == SERVOS[0] else 10,
                )
                wires += exchange
            for servo, extra in (asked_again or {}).items() if is_bad else ():
                *exchange, at = self._exchange(servo, at, late=extra, silent=None, blocked=10)
                wires += exchange
            read = at + 10 - woke
            updated = woke + read + (update if is_bad else 100)
            took = write_call if is_bad else 10
            wires.append(Wire(PacketKind.INSTRUCTION, 254, updated, b"\xff\xff\xfe\x04\x83", updated + took))
            if number == BAD - 1:
                wires += idle
            left_out = number - 1 - cycles[-1].number if cycles else 0
            update_us = updated - woke - read
            cycles.append(Cycle(number, left_out, woke - due(number), read, update_us, took))
            skipped = max(0, -(-(updated + took - due(number)) // PERIOD) - 1)
        return read_log(self._write(cycles, wires, plan=plan))

    def _exchange(self, servo: int, at: int, *, late: int, silent: int | None, blocked: int) -> Iterator[Any]:
        """Yield the packets, and at last when the next one may begin."""
        yield Wire(PacketKind.INSTRUCTION, servo, at, ASK[servo], at + blocked)
        if silent is not None:
            yield at + silent
            return
        end = at + max(0, blocked - 80) + PLANNED + late
        yield Wire(PacketKind.STATUS, servo, end - 100, ANSWER[servo], end)
        yield end


@pytest.fixture
def run(write):
    return Run(write)


def causes_of(log: Log, pieces: int = 1) -> Causes:
    found = CycleCauses()
    for part in sliced(log, pieces):
        found.add_slice(part)
    return found.find_causes()


def sliced(log: Log, pieces: int) -> Iterator[Log]:
    """Yield a log in pieces, each with the packets up to the first cycle of the next."""
    parts = np.array_split(np.arange(len(log.cycles)), pieces)
    begins = [0, *(int(log.cycles["woken_ns"][part[0]]) for part in parts[1:]), 1 << 62]
    for part, (begin, end) in zip(parts, itertools.pairwise(begins), strict=True):
        mine = (log.packets.first_ns >= begin) & (log.packets.first_ns < end)
        yield replace(log, cycles=log.cycles[part], packets=log.packets.select_rows(mine))


def shares(found: Causes) -> dict[tuple[str, str], float]:
    return {(one.kind, one.subject): one.total_ns / 1e3 for one in found.causes}


def first(found: Causes) -> tuple[str, str]:
    return found.causes[0].kind, found.causes[0].subject


def test_a_run_in_time_has_no_causes(run):
    found = causes_of(run.log())
    assert (found.late, found.long, found.excess_ns, found.causes, found.worst) == (0, 0, 0, (), ())


@pytest.mark.parametrize(("woken", "counts"), [(150, 0), (151, 1), (7_000, 1)])
def test_a_late_wake_up_is_one_from_150_us_on(run, woken, counts):
    found = causes_of(run.log(woken=woken))
    assert (found.late, found.long) == (counts, 0)
    assert shares(found) == ({("late wake-up", ""): woken} if counts else {})


LONG: dict[str, tuple[dict[str, Any], tuple[str, str], float]] = {
    "late reply": ({"late": {21: 25_000}}, ("late reply", "bus main"), 25_000),
    "missing reply": ({"silent": {5: 30_000}}, ("missing reply", "servo 5 (joint_5)"), 30_000 - 80),
    "retry": ({"asked_again": {21: 22_000}}, ("retry", "servo 21 (joint_21)"), 22_000 + PLANNED),
    "write() of an instruction": ({"blocked": 25_000}, ("write call", "bus main"), 25_000 - 80 + 10),
    "write() of goals": ({"write_call": 25_000}, ("write call", "bus main"), 25_000),
    "controller": ({"update": 50_000}, ("controller", "head"), 25_000),
    "own work": ({"before_reads": 25_000}, ("own work", ""), 25_000 + 20 + 50),
    "late wake-up": ({"woken": 25_000}, ("late wake-up", ""), 25_000),
}


@pytest.mark.parametrize("pieces", [1, 4])
@pytest.mark.parametrize("what", list(LONG))
def test_a_long_cycle_names_its_cause(run, what, pieces):
    changed, cause, us = LONG[what]
    found = causes_of(run.log(**changed), pieces)
    assert found.long == 1
    assert (found.late, found.worst[0].cycle) == (int(what == "late wake-up"), BAD)
    if what != "controller":  # the controller has half of the update, own work the other half
        assert first(found) == cause
    assert shares(found)[cause] == pytest.approx(us)
    assert sum(shares(found).values()) * 1e3 == pytest.approx(found.excess_ns)
    (worst,) = found.worst
    assert sum(one.us for one in worst.causes) == pytest.approx(worst.excess_us)
    assert worst.excess_us * 1e3 == pytest.approx(found.excess_ns)
    assert ("unexplained", "") not in shares(found)


def test_a_cycle_that_was_planned_too_long_is_the_plan_s(run):
    slow = {"buses": [{**PLAN["buses"][0], "return_delay_ns": 15_000_000}]}
    found = causes_of(run.log(late={5: 14_500, 21: 14_500}, plan=slow))
    planned = 2 * (20 * 10 + 15_000)
    assert first(found) == ("plan", "")
    assert shares(found)["plan", ""] == pytest.approx(planned - PERIOD, abs=1)


@pytest.mark.parametrize(
    ("replied", "expected"),
    [
        (4_000, {("late reply", "bus main"): 4_000, ("late wake-up", ""): 100}),
        (None, {("missing reply", "servo 21 (joint_21)"): 4_100}),
        (-20, {("late wake-up", ""): 4_100}),  # in time
    ],
)
def test_an_exchange_of_the_idle_time_that_ended_too_late_has_the_lateness(run, replied, expected):
    """`replied`: us behind the deadline."""
    asked = due(BAD) - 900
    idle = [Wire(PacketKind.INSTRUCTION, 21, asked, ASK[21], asked + 10)]
    if replied is not None:
        end = due(BAD) + replied
        idle.append(Wire(PacketKind.STATUS, 21, end - 10, ANSWER[21], end))
    assert shares(causes_of(run.log(woken=4_100, idle=idle))) == expected


def test_late_replies_are_their_bus_s_however_often_one_servo_has_them(run):
    bad = range(0, COUNT, 2)
    found = causes_of(run.log(late={21: 19_500}, bad=bad))
    assert first(found) == ("late reply", "bus main")
    assert found.causes[0].cycles == found.long == len(bad)


@pytest.mark.parametrize(
    ("own", "others", "expected"),
    [(9, 0, False), (10, 0, True), (10, 1, True), (10, 2, False), (1000, 100, True), (1000, 101, False)],
)
def test_one_is_named_that_has_them_alone(own, others, expected):
    assert has_them_alone(own, others) is expected


def test_the_worst_cycle_is_a_timeline_with_the_plan_beside_it(run):
    (worst,) = causes_of(run.log(late={21: 25_000}, woken=40)).worst
    assert (worst.cycle, worst.seconds, worst.woken_us, worst.skipped) == (BAD, BAD * PERIOD / 1e6, 40, 1)
    kinds = [(one.kind, one.servo_id, one.joint) for one in worst.packets]
    assert kinds == [
        ("instruction", 5, "joint_5"),
        ("status", 5, "joint_5"),
        ("instruction", 21, "joint_21"),
        ("status", 21, "joint_21"),
        ("instruction", 254, ""),
    ]
    ends = [(one.end_us, one.planned_us) for one in worst.packets]
    begin = 40 + 10
    assert ends[1] == (begin + PLANNED, begin + PLANNED)
    assert ends[3] == (begin + 2 * PLANNED + 25_000, begin + 2 * PLANNED)


def test_only_the_worst_are_kept_the_worst_first(run):
    found = causes_of(run.log(woken=400, bad=range(20)), 4)
    assert (found.late, len(found.worst)) == (20, 10)
