"""Load of the machine: samples count by the part of the interval that they cover."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from dxlrun.log import schemas
from dxlrun.log.machine import load_sample
from dxlrun.messages.cdr import Codec
from dxlrun.plan.machine_load import LoadMeter, LoadSample, MachineLoad

SECOND = 10**9


def sample(
    begin_s: float, end_s: float, idle: float = 0.9, stolen: float = 0.0, waiting: float = 0.0
) -> LoadSample:
    return LoadSample(round(begin_s * SECOND), round(end_s * SECOND), idle, stolen, waiting)


def measured(*samples: LoadSample, begin_s: float = 0, end_s: float | None = None) -> MachineLoad:
    meter = LoadMeter(round(begin_s * SECOND), None if end_s is None else round(end_s * SECOND))
    for one in samples:
        meter.add_sample(one)
    return meter.compute_load()


@pytest.mark.parametrize(
    ("busy", "text"),
    [
        ({"idle": 0.06, "stolen": 0.05, "waiting": 0.010}, ""),
        ({"idle": nan, "waiting": nan}, ""),
        ({"idle": 0.04}, "no core was idle in 1 of 2 s"),
        ({"stolen": 0.06}, "the host withheld cores in 1 of 2 s"),
        ({"waiting": 0.011}, "the loop waited for a core in 1 of 2 s"),
        ({"idle": 0, "waiting": 1}, "no core was idle in 1 of 2 s, the loop waited for a core in 1 of 2 s"),
    ],
)
def test_sample_is_busy_by_idle_cores_steal_and_waiting(busy: dict[str, float], text: str) -> None:
    load = measured(sample(0, 1), sample(1, 2, **busy))
    assert (load.clause, load.busy_s, load.seconds) == (text, float(bool(text)), 2.0)


def test_sample_counts_by_its_overlap_with_the_interval() -> None:
    load = measured(sample(0, 4, idle=0), sample(4, 5), sample(5, 6, idle=0), begin_s=3.5, end_s=5.2)
    assert load.clause == "no core was idle in 0.7 of 1.7 s, the recorder took no sample in 0.5 of 1.7 s"
    assert (load.busy_s, load.seconds) == pytest.approx((0.7, 1.7))


def test_sample_outside_of_the_interval_does_not_count() -> None:
    assert measured(sample(0, 1, idle=0), sample(3, 4, idle=0), begin_s=1, end_s=3) == MachineLoad()


@pytest.mark.parametrize(
    ("length_s", "idle", "busy"),
    [(11, 0.1, True), (11, 0.6, False), (11, nan, True), (1.9, 0.1, False)],
    ids=["starved", "waited for its disk", "unknown", "a little late"],
)
def test_sampler_without_a_core_is_evidence_of_a_busy_machine(
    length_s: float, idle: float, busy: bool
) -> None:
    """humanoid_20 at 1 kHz on two cores left one sample of 11 s, which began before the first deadline."""
    load = measured(sample(-5, length_s - 5, idle), begin_s=-2, end_s=6)
    assert load.too_busy is busy
    assert ("the recorder took no sample in" in load.clause) is busy


@pytest.mark.parametrize("gap_s", [1.9, 2.1])
@pytest.mark.parametrize("before", [True, False])
def test_seconds_without_a_sample_count_as_busy(gap_s: float, before: bool) -> None:
    sampled = sample(gap_s, gap_s + 1) if before else sample(0, 1)
    load = measured(sampled, end_s=gap_s + 1)
    assert load.silent_s == pytest.approx(gap_s if gap_s > 2 else 0)
    assert load.seconds == pytest.approx(1 + load.silent_s)


def test_interval_without_any_sample_says_nothing() -> None:
    assert measured(end_s=60) == MachineLoad()
    assert not MachineLoad().too_busy
    assert MachineLoad().share == 0


def test_sample_that_is_shorter_than_the_steps_of_proc_stat_is_not_judged() -> None:
    assert measured(sample(0, 1), sample(1, 1.05, idle=0)) == MachineLoad(seconds=1.0)


@pytest.mark.parametrize(
    ("busy", "seconds", "share"),
    [(3, 3, 1.0), (3, 30, 0.1), (3, 31, 0.0), (2.9, 29, 0.0), (1, 2, 0.5), (0.9, 2, 0.0), (10, 40, 0.25)],
)
def test_machine_is_too_busy_from_a_tenth_and_3_s_or_half_of_the_interval_on(
    busy: float, seconds: float, share: float
) -> None:
    load = MachineLoad(seconds, busy_s=busy)
    assert (load.share, load.too_busy) == (share, share > 0)


def test_message_of_the_log_becomes_a_sample() -> None:
    shares = {name: np.zeros(2) for name in ("user", "system", "irq", "softirq")}
    values = shares | {"steal": np.array([nan, 0.2]), "idle": np.array([0.1, 0.3])}
    data = Codec(schemas.MACHINE).pack(
        5 * SECOND, 2 * SECOND, 0, *values.values(), np.zeros(2), *(0.0,) * 3, 0.5, *(0.0,) * 4
    )
    read = load_sample(Codec(schemas.MACHINE).unpack(data))
    assert read == LoadSample(3 * SECOND, 5 * SECOND, 0.3, 0.2, 0.25)
