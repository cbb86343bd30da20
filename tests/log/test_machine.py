"""Samples of the machine: by a fake /proc and /sys, and what is missing there is NaN."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.log import schemas
from dxlrun.log.log_reader import read_log
from dxlrun.log.machine import MachineSampler
from dxlrun.messages.cdr import Codec
from dxlrun.testing import simulated_robot

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


def test_a_sample_has_what_changed_since_the_one_before(tmp_path: Path) -> None:
    values = sampled(tmp_path, BEFORE, AFTER)
    assert (values["t_ns"], values["interval_ns"], values["loop_core"]) == (2 * 10**9, 10**9, 78)
    # core 0 in ticks of 100: user 20 + nice 10, system 10, irq 5, softirq 2, steal 23, idle 20 + iowait 10
    for name, share in {
        "user": 0.3,
        "system": 0.1,
        "irq": 0.05,
        "softirq": 0.02,
        "steal": 0.23,
        "idle": 0.3,
    }.items():
        assert values[name].tolist() == pytest.approx([share, float(name == "idle")]), name
    assert values["frequency"].tolist() == [1.8e9, 0.6e9]
    assert values["temperature"] == 61.5
    assert values["memory_pressure"] == pytest.approx(0.25)
    assert values["loop_running"] == pytest.approx(0.3)
    assert values["loop_waiting"] == pytest.approx(0.04)
    assert (values["loop_voluntary"], values["loop_involuntary"]) == (50, 3)
    assert (values["loop_minor_faults"], values["loop_major_faults"]) == (10, 12)


@pytest.mark.parametrize("text", [None, "", "nonsense", "cpu0 1 x\n", "some\n", "0 0 1\n"])
@pytest.mark.parametrize("name", list(BEFORE))
def test_what_is_missing_or_damaged_is_not_a_number(tmp_path: Path, name: str, text: str | None) -> None:
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


def test_of_a_system_that_tells_nothing_all_is_not_a_number(tmp_path: Path) -> None:
    values = sampled(tmp_path, {}, {})
    assert values["loop_core"] == -1
    assert math.isnan(values["temperature"])
    assert len(values["user"]) == len(values["frequency"]) == 0


def test_a_core_that_goes_offline_and_comes_back_is_not_a_number_between(tmp_path: Path) -> None:
    one = BEFORE | {"proc/stat": "cpu0 100 0 50 800 10 5 6 29 0 0\n"}
    values = sampled(tmp_path, BEFORE, one)
    assert np.isnan(values["user"]).all()
    assert len(values["user"]) == 2


def test_virtual_runs_have_no_machine_and_stay_equal(tmp_path: Path) -> None:
    for name in ("a", "b"):
        simulated_robot("robots/single_joint.yaml", duration_s=0.2, log=tmp_path / f"{name}.mcap").run()
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert schemas.LogTopic.MACHINE not in read_log(tmp_path / "a.mcap").topics
