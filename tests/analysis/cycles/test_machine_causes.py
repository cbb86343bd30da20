"""What the machine has of late wake-ups: by the samples beside the cycles."""

from dataclasses import replace

import numpy as np
import pytest
from tests.kit.made_logs import Cycle

from dxlrun.log import schemas
from dxlrun.log.log_reader import read_log
from dxlrun.log.reading.logged_topics import LoggedTopic
from dxlrun.messages.cdr import Codec
from dxlrun_analysis.causes.causes import Causes, CycleCauses
from dxlrun_analysis.causes.machine_history import INTERRUPTS, OTHERS, STEAL

SECOND, NAN = 10**9, float("nan")
BAD = (60, 70)  # cycles that wake 8 ms late, both in the second second of the run, which begins at 1 s


def sample(end_s: float, *, core: int = 0, hot: bool = False, **values: float) -> bytes:
    """Return a message about the second before; two cores, of which the second one is idle."""
    names = ("user", "system", "irq", "softirq", "steal", "idle")
    rows = [np.array([values.get(name, 0.0), 0.0]) for name in names]
    frequency = np.array([0.8e9 if hot else 3.0e9, 0.8e9])
    about = (95.0 if hot else 40.0, 0.0, 0.5, values.get("waiting", NAN), *(NAN,) * 4)
    return Codec(schemas.MACHINE).pack(round(end_s * SECOND), SECOND, core, *rows, frequency, *about)


@pytest.fixture
def found(write):
    def causes_of(*samples: bytes) -> Causes:
        log = read_log(write([Cycle(n, late=8_000 if n in BAD else 0) for n in range(160)]))
        topic = LoggedTopic("/machine", schemas.MACHINE, np.zeros(len(samples), np.int64), samples)
        causes = CycleCauses()
        causes.add_slice(replace(log, topics={"/machine": topic}))
        return causes.find_causes()

    return causes_of


QUIET, AFTER = sample(2.0, waiting=0.001), sample(4.0, waiting=0.001)
LATE, STOLEN = {("late wake-up", ""): 16.0}, {("machine", STEAL): 16.0}
SOME = {("machine", STEAL): 4.0, ("machine", OTHERS): 4.0, ("late wake-up", ""): 8.0}


@pytest.mark.parametrize(
    ("samples", "expected"),
    [
        ((QUIET, sample(3.0, steal=0.5), AFTER), STOLEN),
        ((QUIET, sample(3.0, waiting=0.200), AFTER), {("machine", OTHERS): 16.0}),
        ((QUIET, sample(3.0, irq=0.3, softirq=0.2), AFTER), {("machine", INTERRUPTS): 16.0}),
        ((QUIET, sample(3.0, steal=0.004, waiting=0.005), AFTER), SOME),
        ((QUIET, sample(3.0, irq=0.04, waiting=0.001), AFTER), LATE),
        ((QUIET, sample(3.0), AFTER), LATE),
        ((sample(2.0, steal=0.9), sample(3.0), sample(4.0, steal=0.9)), LATE),
        ((QUIET, sample(3.0, core=1, steal=0.9), AFTER), LATE),
        ((QUIET, sample(3.0, core=-1, steal=0.9), AFTER), STOLEN),
    ],
    ids=[
        *("steal", "others", "interrupts", "some of each", "no more than usual", "nothing"),
        *("another second", "another core", "the busiest of unknown cores"),
    ],
)
def test_what_took_the_loop_s_core_has_the_lateness_of_that_second(found, samples, expected):
    causes = found(*samples)
    assert causes.excess_ns == sum(one.total_ns for one in causes.causes)
    assert {(one.kind, one.subject): round(one.total_ns / 1e6, 3) for one in causes.causes} == expected
    kinds = {(one.kind, one.subject): round(one.us / 1e3, 3) for one in causes.worst[0].causes}
    assert kinds == {key: value / 2 for key, value in expected.items()}


def test_slow_processor_that_is_hot_is_counted_and_one_that_is_cool_saves_power(found):
    assert found(QUIET, sample(3.0, hot=True), AFTER).throttled == 1
    assert found(sample(2.0), sample(3.0)).throttled == 0


def test_load_counts_samples_from_the_first_deadline_on(found):
    """The first cycle is at 1 s, in the first of these samples; the run ends within the last one."""
    load = found(sample(1.4), sample(2.4, idle=1.0), sample(3.4, idle=1.0), sample(4.4)).load
    assert load.no_idle_core_s == pytest.approx(1.2, abs=0.05)
    assert load.seconds == pytest.approx(3.2, abs=0.05)
