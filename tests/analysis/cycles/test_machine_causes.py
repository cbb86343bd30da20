"""What the machine has of late wake-ups: by the samples beside the cycles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.kit.made_logs import Cycle

from dxlrun.log import schemas
from dxlrun.log.log_reader import read_log
from dxlrun.log.reading.logged_topics import LoggedTopic
from dxlrun.messages.cdr import Codec
from dxlrun_analysis.causes.causes import Causes, CycleCauses
from dxlrun_analysis.causes.machine_history import INTERRUPTS, OTHERS, STEAL

Make = Callable[..., Any]
SECOND = 10**9
LATE_US = 8_000
BAD = (60, 70)  # Cycles that wake late, both in the second second of the run, which begins at 1 s


def sample(end_s: float, *, core: int = 0, hot: bool = False, **values: float) -> bytes:
    """Return a message about the second before; two cores, of which the second one is idle."""
    rows = [
        np.array([values.get(name, 0.0), 0.0])
        for name in ("user", "system", "irq", "softirq", "steal", "idle")
    ]
    frequency = np.array([0.8e9, 0.8e9]) if hot else np.array([3.0e9, 0.8e9])
    return Codec(schemas.MACHINE).pack(
        round(end_s * SECOND),
        SECOND,
        core,
        *rows,
        frequency,
        95.0 if hot else 40.0,
        0.0,
        0.5,
        values.get("waiting", float("nan")),
        *(float("nan"),) * 4,
    )


@pytest.fixture
def found(write: Make) -> Callable[..., Causes]:
    def causes_of(*samples: bytes) -> Causes:
        log = read_log(write([Cycle(n, late=LATE_US if n in BAD else 0) for n in range(160)]))
        kind = schemas.MACHINE
        times = np.zeros(len(samples), np.int64)
        topics = {"/machine": LoggedTopic("/machine", kind, times, samples)}
        causes = CycleCauses()
        causes.add_slice(replace(log, topics=topics))
        return causes.find_causes()

    return causes_of


def shares(found: Causes) -> dict[tuple[str, str], float]:
    assert found.excess_ns == sum(one.total_ns for one in found.causes)
    return {(one.kind, one.subject): round(one.total_ns / 1e6, 3) for one in found.causes}


QUIET = sample(2.0, waiting=0.001)
AFTER = sample(4.0, waiting=0.001)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"steal": 0.5}, {("machine", STEAL): 16.0}),
        ({"waiting": 0.200}, {("machine", OTHERS): 16.0}),
        ({"irq": 0.3, "softirq": 0.2}, {("machine", INTERRUPTS): 16.0}),
        (
            {"steal": 0.004, "waiting": 0.005},
            {("machine", STEAL): 4.0, ("machine", OTHERS): 4.0, ("late wake-up", ""): 8.0},
        ),
        ({"irq": 0.04, "waiting": 0.001}, {("late wake-up", ""): 16.0}),
        ({}, {("late wake-up", ""): 16.0}),
    ],
    ids=["steal", "others", "interrupts", "some of each", "no more than usual", "nothing"],
)
def test_what_took_the_loop_s_core_has_the_lateness_of_that_second(
    found: Callable[..., Causes], values: dict[str, float], expected: dict[tuple[str, str], float]
) -> None:
    causes = found(QUIET, sample(3.0, **values), AFTER)
    assert shares(causes) == expected
    kinds = {(one.kind, one.subject): round(one.us / 1e3, 3) for one in causes.worst[0].causes}
    assert kinds == {key: value / 2 for key, value in expected.items()}


def test_another_second_or_another_core_is_no_excuse(found: Callable[..., Causes]) -> None:
    late = {("late wake-up", ""): 16.0}
    assert shares(found(sample(2.0, steal=0.9), sample(3.0), sample(4.0, steal=0.9))) == late


def test_another_core_is_no_excuse(found: Callable[..., Causes]) -> None:
    assert shares(found(QUIET, sample(3.0, core=1, steal=0.9), AFTER)) == {("late wake-up", ""): 16.0}


def test_of_a_loop_whose_core_is_not_known_the_busiest_counts(found: Callable[..., Causes]) -> None:
    assert shares(found(QUIET, sample(3.0, core=-1, steal=0.9), AFTER)) == {("machine", STEAL): 16.0}


def test_a_hot_and_slow_processor_is_counted(found: Callable[..., Causes]) -> None:
    assert found(QUIET, sample(3.0, hot=True), AFTER).throttled == 1


def test_a_slow_processor_that_is_cool_saves_power(found: Callable[..., Causes]) -> None:
    assert found(sample(2.0), sample(3.0)).throttled == 0


def test_load_counts_samples_from_the_first_deadline_on(found: Callable[..., Causes]) -> None:
    """The first cycle is at 1 s, in the first of these samples; the run ends within the last one."""
    load = found(sample(1.4), sample(2.4, idle=1.0), sample(3.4, idle=1.0), sample(4.4)).load
    assert load.no_idle_core_s == pytest.approx(1.2, abs=0.05)
    assert load.seconds == pytest.approx(3.2, abs=0.05)
