"""Analysis: the timelines of the worst cycles, the machine's samples and the joints' errors in plots."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.kit.made_logs import Cycle

from dxlrun.log.log_reader import Log, read_log
from dxlrun.log.schemas import LogTopic
from dxlrun_analysis.cycles.worst_cycles import CauseShare, TimelinePacket, WorstCycle
from dxlrun_analysis.page.canvas import Canvas, Plot
from dxlrun_analysis.page.machine_plots import MachineCollector, machine_plots
from dxlrun_analysis.page.reply_collector import ReplyCollector
from dxlrun_analysis.page.report_page import page
from dxlrun_analysis.page.run_curves import CurveCollector
from dxlrun_analysis.page.worst_plots import worst_plots
from dxlrun_analysis.report import analyze

ASK = TimelinePacket("main", "instruction", 254, "", 1300.0, 1320.0, 1350.0, 14)
REPLIES = (
    TimelinePacket("main", "status", 5, "elbow", 2000.0, 2100.0, 1900.0, 12),
    TimelinePacket("main", "status", 21, "", 30_000.0, 30_000.0, 2400.0, 12),
)
NOISE = TimelinePacket("arm", "noise", 5, "", -500.0, -400.0, None, 3)
WORST = WorstCycle(
    cycle=7,
    seconds=0.14,
    scheduled_ns=10**9,
    period_us=20_000.0,
    woken_us=1200.0,
    read_us=30_100.0,
    updated_us=30_200.0,
    written_us=30_500.0,
    skipped=1,
    excess_us=29_000.0,
    causes=(CauseShare("late reply", "servo 21 (head)", 27_600.0),),
    packets=(NOISE, ASK, *REPLIES),
)


def drawn(plot: Plot) -> dict[str, dict[str, list[Any]]]:
    """Return the data of each name in the legend."""
    return {
        one.name: {name: list(values) for name, values in one.data_source.data.items()}
        for one in plot.model.renderers
        if one.name is not None
    }


def labels(plot: Plot) -> list[str]:
    return list(plot.model.yaxis[0].major_label_overrides.values())


def test_a_worst_cycle_is_drawn_with_its_steps_its_packets_and_the_plan():
    (plot,) = worst_plots(Canvas(0, 0, 10**9), [WORST])
    assert plot.title.startswith("Cycle 7, 0.140 s, 29.00 ms beyond the plan, then 1 period skipped")
    assert plot.title.endswith("late reply of servo 21 (head) 27.60 ms")
    found = drawn(plot)
    steps = {
        name: (found[name]["begin"], found[name]["end"])
        for name in ("late wake-up", "read", "update", "write")
    }
    assert steps == {
        "late wake-up": ([0.0], [1.2]),
        "read": ([1.2], [30.1]),
        "update": ([30.1], [30.2]),
        "write": ([30.2], [30.5]),
    }
    assert labels(plot) == ["loop", "arm 5", "main, all", "elbow 5", "main 21"]
    assert found["noise"]["y"] == [1]
    assert (found["instruction"]["y"], found["instruction"]["begin"]) == ([2], [1.3])
    replies = found["reply"]
    assert (replies["y"], replies["begin"], replies["end"]) == ([3, 4], [2.0, 30.0], [2.1, 30.0])
    assert replies["planned"] == [1.9, 2.4]
    assert found["reply as planned"] == replies
    shown = plot.model.x_range
    assert shown.start < -0.5
    assert shown.end > 30.5
    assert [span.location for span in plot.model.center if hasattr(span, "location")] == [0.0, 20.0]


def test_a_short_cycle_is_drawn_in_us_and_its_idle_step_is_left_out():
    short = replace(
        WORST, period_us=1000, woken_us=0, read_us=400, updated_us=500, written_us=600, packets=()
    )
    (plot,) = worst_plots(Canvas(0, 0, 10**9), [short])
    found = drawn(plot)
    assert found["read"]["end"] == [400.0]
    assert "late wake-up" not in found
    assert plot.model.xaxis[0].axis_label.endswith(", us")


class Samples:
    """A slice of a log of which only the samples of the machine are read."""

    topics = (LogTopic.MACHINE,)

    def __init__(self, *samples: dict[str, Any]) -> None:
        self._samples = samples

    def messages(self, _: str) -> tuple[dict[str, Any], ...]:
        return self._samples


def sample(second: int, cores: int, **values: object) -> dict[str, Any]:
    shares = {
        name: np.full(cores, share)
        for name, share in (("user", 0.2), ("system", 0.1), ("irq", 0.02), ("softirq", 0.01), ("steal", 0.0))
    }
    unknown = {"frequency": np.full(cores, np.nan), "temperature": float("nan"), "loop_waiting": 0.004}
    about = {"t_ns": second * 10**9, "interval_ns": 10**9, "loop_core": 1}
    return {**shares, **unknown, **about, **values}


def collected(*slices: Any) -> tuple[Any, tuple[int, ...]]:
    collector = MachineCollector()
    for one in slices:
        collector.add_slice(one)
    return collector.build_curves()


def test_the_machine_is_drawn_as_it_was_sampled():
    late = sample(2, 2, steal=np.array([0.0, 0.25]), frequency=np.array([1e9, 3e9]), loop_waiting=0.3)
    curves, cores = collected(Samples(sample(1, 2)), Samples(late))
    assert cores == (1, 0)
    for name, expected in (
        ("busy 0", [33, 33]),
        ("interrupts 1", [3, 3]),
        ("steal 1", [0, 25]),
        ("frequency 1", [np.nan, 3]),
        ("waiting", [4, 300]),
    ):
        np.testing.assert_allclose(curves.low(name), expected, rtol=1e-6)
    assert "temperature" not in curves
    names = [plot.name for plot in machine_plots(Canvas(0, 0, 2 * 10**9), curves, cores)]
    assert names == [f"machine-{kind}" for kind in ("waiting", "busy", "interrupts", "steal", "frequency")]


@pytest.mark.parametrize("slices", [1, 4])
def test_the_error_is_that_against_the_goal_of_the_cycle_before(write, slices, monkeypatch):
    monkeypatch.setattr("dxlrun_analysis.page.run_curves._AT_ONCE", 1)
    made = [Cycle(n, position=0.1 * n, goal=n * n, valid=n != 5) for n in range(12)]
    log: Log = read_log(write(made))
    collector = CurveCollector()
    for part in np.array_split(log.cycles, slices):
        collector.add_slice(replace(log, cycles=part))
    error = collector.build_curves().cycles.low("error left_elbow_joint")
    expected = [np.nan, *(0.1 * n - (n - 1) ** 2 if n != 5 else np.nan for n in range(1, 12))]
    np.testing.assert_allclose(error, expected, rtol=1e-5)


def test_the_page_has_timelines_and_the_machine(write, monkeypatch):
    monkeypatch.setattr(
        MachineCollector, "add_slice", lambda collector, _: collector._add(sample(1, 2, temperature=55.0))
    )
    log = read_log(write([Cycle(0), Cycle(1)]))
    report = analyze(log)
    causes = replace(report.totals.causes, worst=(WORST,))
    report = replace(report, totals=replace(report.totals, causes=causes))
    text = page(log, report, ReplyCollector().build_curves())
    for name in ("worst-0", "machine-busy", "machine-temperature", "joint-0-error"):
        assert f'id="plot-{name}"' in text
    assert "late reply of servo 21 (head) 27.60 ms" in text
