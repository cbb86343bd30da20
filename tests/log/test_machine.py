"""Samples of the machine, by a fake /proc and /sys, and its load: each counts by the time that it covers."""

from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.log import schemas
from dxlrun.log.machine import MachineSampler, load_sample
from dxlrun.messages.cdr import Codec
from dxlrun.plan.machine_load import LoadMeter, LoadSample, MachineLoad

PID = 4711
BEFORE = {
    "proc/stat": "cpu  1 2 3 4\ncpu0 100 0 50 800 10 5 6 29 0 0\ncpu1 10 0 5 80 1 0 0 0 0 0\nintr 5\n",
    "proc/pressure/memory": "some avg10=0.00 avg60=0.00 avg300=0.00 total=1000000\nfull avg10=0 total=9\n",
    f"proc/{PID}/schedstat": "5000000000 1000000 900\n",
    f"proc/{PID}/status": "Name:\tloop\nvoluntary_ctxt_switches:\t100\nnonvoluntary_ctxt_switches:\t7\n",
    f"proc/{PID}/stat": f"{PID} (a (name) b) R " + " ".join(str(n) for n in range(4, 53)) + "\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_cur_freq": "1800000\n",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_cur_freq": "600000\n",
    "sys/class/thermal/thermal_zone0/temp": "48000\n",
    "sys/class/hwmon/hwmon0/temp1_input": "61500\n",
}
AFTER = BEFORE | {
    "proc/stat": "cpu  1 2 3 4\ncpu0 120 10 60 820 20 10 8 52 0 0\ncpu1 10 0 5 180 1 0 0 0 0 0\nintr 6\n",
    "proc/pressure/memory": "some avg10=0.00 avg60=0.00 avg300=0.00 total=1250000\nfull avg10=0 total=9\n",
    f"proc/{PID}/schedstat": "5300000000 41000000 990\n",
    f"proc/{PID}/status": "Name:\tloop\nvoluntary_ctxt_switches:\t150\nnonvoluntary_ctxt_switches:\t10\n",
    f"proc/{PID}/stat": f"{PID} (a (name) b) R " + " ".join(str(n * 2) for n in range(4, 53)) + "\n",
}


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def sampled(root: Path, first: dict[str, str], then: dict[str, str]) -> Any:
    write(root, first)
    sampler = MachineSampler(PID, root)
    assert sampler.sample_machine(10**9) is None
    write(root, then)
    data = sampler.sample_machine(2 * 10**9)
    assert data is not None
    return Codec(schemas.MACHINE).unpack(data)


def test_a_sample_has_what_changed_since_the_one_before(tmp_path):
    values = sampled(tmp_path, BEFORE, AFTER)
    assert (values["t_ns"], values["interval_ns"], values["loop_core"]) == (2 * 10**9, 10**9, 78)
    # core 0 in ticks of 100: user 20 + nice 10, system 10, irq 5, softirq 2, steal 23, idle 20 + iowait 10
    shares = {"user": 0.3, "system": 0.1, "irq": 0.05, "softirq": 0.02, "steal": 0.23}
    assert {name: values[name].tolist() for name in shares} == {
        name: pytest.approx([share, 0.0]) for name, share in shares.items()
    }
    assert values["idle"].tolist() == pytest.approx([0.3, 1.0])
    assert values["frequency"].tolist() == [1.8e9, 0.6e9]
    assert values["temperature"] == 61.5
    assert values["memory_pressure"] == pytest.approx(0.25)
    assert values["loop_running"] == pytest.approx(0.3)
    assert values["loop_waiting"] == pytest.approx(0.04)
    assert (values["loop_voluntary"], values["loop_involuntary"]) == (50, 3)
    assert (values["loop_minor_faults"], values["loop_major_faults"]) == (10, 12)


@pytest.mark.parametrize("text", [None, "", "nonsense", "cpu0 1 x\n", "some\n", "0 0 1\n"])
@pytest.mark.parametrize("name", list(BEFORE))
def test_what_is_missing_or_damaged_is_not_a_number(tmp_path, name, text):
    files = {key: value for key, value in BEFORE.items() if key != name or text is not None}
    values = sampled(tmp_path, files | ({name: text} if text is not None else {}), {})
    fields = {
        "stat": (("loop_minor_faults", "loop_major_faults") if str(PID) in name else ("user", "steal")),
        "memory": ("memory_pressure",),
        "schedstat": ("loop_running", "loop_waiting"),
        "status": ("loop_voluntary", "loop_involuntary"),
        "scaling_cur_freq": ("frequency",),
    }.get(Path(name).name, ())
    assert all(np.isnan(np.atleast_1d(values[one])).any() for one in fields)


def test_of_a_system_that_tells_nothing_all_is_not_a_number(tmp_path):
    values = sampled(tmp_path, {}, {})
    assert values["loop_core"] == -1
    assert isnan(values["temperature"])
    assert len(values["user"]) == len(values["frequency"]) == 0


def test_a_core_that_goes_offline_and_comes_back_is_not_a_number_between(tmp_path):
    one = BEFORE | {"proc/stat": "cpu0 100 0 50 800 10 5 6 29 0 0\n"}
    values = sampled(tmp_path, BEFORE, one)
    assert np.isnan(values["user"]).all()
    assert len(values["user"]) == 2


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
def test_sample_is_busy_by_idle_cores_steal_and_waiting(busy, text):
    load = measured(sample(0, 1), sample(1, 2, **busy))
    assert (load.clause, load.busy_s, load.seconds) == (text, float(bool(text)), 2.0)


def test_sample_counts_by_its_overlap_with_the_interval():
    load = measured(sample(0, 4, idle=0), sample(4, 5), sample(5, 6, idle=0), begin_s=3.5, end_s=5.2)
    assert load.clause == "no core was idle in 0.7 of 1.7 s, the recorder took no sample in 0.5 of 1.7 s"
    assert (load.busy_s, load.seconds) == pytest.approx((0.7, 1.7))


def test_sample_outside_of_the_interval_does_not_count():
    assert measured(sample(0, 1, idle=0), sample(3, 4, idle=0), begin_s=1, end_s=3) == MachineLoad()


@pytest.mark.parametrize(
    ("length_s", "idle", "busy"),
    [(11, 0.1, True), (11, 0.6, False), (11, nan, True), (1.9, 0.1, False)],
    ids=["starved", "waited for its disk", "unknown", "a little late"],
)
def test_sampler_without_a_core_is_evidence_of_a_busy_machine(length_s, idle, busy):
    """humanoid_20 at 1 kHz on two cores left one sample of 11 s, which began before the first deadline."""
    load = measured(sample(-5, length_s - 5, idle), begin_s=-2, end_s=6)
    assert load.too_busy is busy
    assert ("the recorder took no sample in" in load.clause) is busy


@pytest.mark.parametrize("gap_s", [1.9, 2.1])
@pytest.mark.parametrize("before", [True, False])
def test_seconds_without_a_sample_count_as_busy(gap_s, before):
    sampled = sample(gap_s, gap_s + 1) if before else sample(0, 1)
    load = measured(sampled, end_s=gap_s + 1)
    assert load.silent_s == pytest.approx(gap_s if gap_s > 2 else 0)
    assert load.seconds == pytest.approx(1 + load.silent_s)


def test_interval_without_any_sample_says_nothing():
    assert measured(end_s=60) == MachineLoad()
    assert not MachineLoad().too_busy
    assert MachineLoad().share == 0


def test_sample_that_is_shorter_than_the_steps_of_proc_stat_is_not_judged():
    assert measured(sample(0, 1), sample(1, 1.05, idle=0)) == MachineLoad(seconds=1.0)


@pytest.mark.parametrize(
    ("busy", "seconds", "share"),
    [(3, 3, 1.0), (3, 30, 0.1), (3, 31, 0.0), (2.9, 29, 0.0), (1, 2, 0.5), (0.9, 2, 0.0), (10, 40, 0.25)],
)
def test_machine_is_too_busy_from_a_tenth_and_3_s_or_half_of_the_interval_on(busy, seconds, share):
    load = MachineLoad(seconds, busy_s=busy)
    assert (load.share, load.too_busy) == (share, share > 0)


def test_message_of_the_log_becomes_a_sample():
    shares = {name: np.zeros(2) for name in ("user", "system", "irq", "softirq")}
    values = shares | {"steal": np.array([nan, 0.2]), "idle": np.array([0.1, 0.3])}
    data = Codec(schemas.MACHINE).pack(
        5 * SECOND, 2 * SECOND, 0, *values.values(), np.zeros(2), *(0.0,) * 3, 0.5, *(0.0,) * 4
    )
    read = load_sample(Codec(schemas.MACHINE).unpack(data))
    assert read == LoadSample(3 * SECOND, 5 * SECOND, 0.3, 0.2, 0.25)
