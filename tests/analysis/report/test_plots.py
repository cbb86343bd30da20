"""Analysis: each curve, bar and mark of a report's plots is the log's own data, computed here once more."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.kit.made_logs import Cycle, Said, Wire, made_log

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.log.log_reader import Log, read_log
from dxlrun_analysis.cycles.punctuality import Punctuality
from dxlrun_analysis.page import run_curves as curves_module
from dxlrun_analysis.page.canvas import Canvas, Plot
from dxlrun_analysis.page.event_plots import EventCollector, events_plot
from dxlrun_analysis.page.joint_plots import joint_plots
from dxlrun_analysis.page.loop_plots import latency_plots
from dxlrun_analysis.page.reply_collector import ReplyCollector
from dxlrun_analysis.page.run_curves import CurveCollector, CurvesOfRun, joint_curve
from dxlrun_analysis.report import analyze
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

Data = NDArray[np.float64]
COUNT, LONG = 40, 9000
PERIOD_NS, START_NS = 20_000_000, 10**9


def filled(log: Log, count: int) -> Log:
    """Repeat the cycles of a log, and give each field of each cycle and each joint a number of its own."""
    rng, cycles = np.random.default_rng(count), np.resize(log.cycles, count).copy()
    for name in ("position", "velocity"):
        for field in (name, f"command_{name}", f"goal_{name}"):
            cycles[field] = rng.normal(size=cycles[field].shape)
    numbers = np.arange(count) + (np.arange(count) >= count // 2) * 3
    cycles["cycle"], cycles["scheduled_ns"] = numbers, START_NS + numbers * PERIOD_NS
    cycles["skipped"] = (np.arange(count) == count // 2) * 3
    before = cycles["scheduled_ns"]
    for most_us, field in ((300, "woken_ns"), (6000, "read_ns"), (900, "updated_ns"), (500, "written_ns")):
        cycles[field] = before + rng.integers(1000, most_us * 1000, count)
        before = cycles[field]
    cycles["valid"] = rng.random(cycles["valid"].shape) < 0.9
    cycles["clamped"] = rng.random(cycles["clamped"].shape) < 0.1
    return replace(log, cycles=cycles)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A short log, of which each sample is drawn, and a long one, of which most are in bins."""
    log = read_log(made_log(tmp_path_factory.mktemp("log"), [Cycle(number) for number in range(3)]))
    return {count: filled(log, count) for count in (COUNT, LONG)}


def collected(log: Log, worst_ns: tuple[int, ...] = (), slices: int = 1) -> CurvesOfRun:
    collector = CurveCollector(worst_ns)
    for cycles in np.array_split(log.cycles, slices):
        collector.add_slice(replace(log, cycles=cycles))
    return collector.build_curves()


def canvas_of(run: CurvesOfRun) -> Canvas:
    return Canvas(START_NS, run.begin_ns, run.end_ns)


def glyphs(plot: Plot, kind: str) -> list[tuple[dict[str, Any], Any]]:
    """Return the data of each glyph of a kind, and the glyph."""
    return [
        (dict(one.data_source.data), one.glyph)
        for one in plot.model.renderers
        if type(one.glyph).__name__ == kind
    ]


def lines(plot: Plot) -> dict[str, tuple[Data, Data]]:
    """Return the first line of each name in the legend: times and values."""
    found: dict[str, tuple[Data, Data]] = {}
    for one in plot.model.renderers:
        if one.name is not None and one.name not in found:
            data, glyph = one.data_source.data, one.glyph
            found[one.name] = np.asarray(data[glyph.x]), np.asarray(data[glyph.y])
    return found


def seconds(log: Log) -> Data:
    return np.asarray((log.cycles["scheduled_ns"] - START_NS) / 1e9)


@pytest.mark.parametrize("slices", [1, 7])
@pytest.mark.parametrize("row", [0, 1])
def test_each_sample_of_a_joint_is_on_the_curve_of_its_name(logs, row, slices):
    log = logs[COUNT]
    run = collected(log, slices=slices)
    joint = analyze(log).totals.tracking[row]
    plots = joint_plots(canvas_of(run), run.cycles, row, joint)
    by_label = {plot.model.yaxis[0].axis_label: lines(plot) for plot in plots}
    degree = np.float32(180 / np.pi)
    for quantity, unit in (("position", "deg"), ("velocity", "deg/s")):
        drawn = by_label[f"{quantity}, {unit}"]
        fields = {"desired": f"command_{quantity}", "sent": f"goal_{quantity}", "read": quantity}
        for name, field in fields.items():
            values = log.cycles[field][:, row]
            expected = np.where(log.cycles["valid"][:, row], values, np.nan) if name == "read" else values
            np.testing.assert_allclose(drawn[name][0], seconds(log))
            np.testing.assert_array_equal(drawn[name][1], expected.astype(np.float32) * degree)
    widths = {
        one.name: one.glyph.line_width
        for one in plots[0].model.renderers
        if type(one.glyph).__name__ == "Line"
    }
    assert list(widths) == ["read", "sent", "desired"]  # from below
    assert widths["read"] > widths["sent"] + 1 > widths["desired"]
    for name, flags in (("no reply", ~log.cycles["valid"]), ("clamped", log.cycles["clamped"] != 0)):
        x, y = by_label["position, deg"][name]
        np.testing.assert_allclose(x[np.isfinite(y)], seconds(log)[flags[:, row]])


@pytest.mark.parametrize("slices", [1, 50])
def test_a_long_run_has_each_extreme_and_each_sample_around_its_worst_cycles(logs, slices):
    log = logs[LONG]
    due = log.cycles["scheduled_ns"]
    worst = (int(due[LONG // 3]), int(due[LONG // 3 + 20]), int(due[8000]))
    run = collected(log, worst, slices)
    rows, name = run.cycles.rows, joint_curve("goal_position", log.joints[1])
    values = log.cycles["goal_position"][:, 1].astype(np.float32)
    assert len(rows.t_ns) < curves_module._MOST_ROWS + 10
    assert len(run.windows) == 2
    inside = np.zeros(LONG, dtype=bool)
    for begin, end in run.windows:
        inside |= (due >= begin) & (due < end)
    assert 100 < inside.sum() < LONG // 4
    assert inside[[LONG // 3, LONG // 3 + 20, 8000]].all()
    at = np.searchsorted(rows.t_ns, due[inside])
    np.testing.assert_array_equal(rows.t_ns[at], due[inside])
    np.testing.assert_array_equal(run.cycles.low(name)[at], values[inside])
    np.testing.assert_array_equal(run.cycles.high(name)[at], values[inside])
    assert np.nanmax(run.cycles.high(name)) == values.max()
    assert np.nanmin(run.cycles.low(name)) == values.min()
    of = np.searchsorted(rows.t_ns, due, side="right") - 1
    outside = ~inside
    assert (run.cycles.low(name)[of[outside]] <= values[outside]).all()
    assert (run.cycles.high(name)[of[outside]] >= values[outside]).all()


def test_the_distribution_of_the_wake_ups_counts_each(logs):
    log = logs[LONG]
    late = (log.cycles["woken_ns"] - log.cycles["scheduled_ns"]) / 1e3
    run = collected(log, slices=9)
    punctuality = Punctuality()
    punctuality.add_slice(log)
    _, statistics = punctuality.compute_latency()
    assert statistics is not None
    first, second, third = latency_plots(canvas_of(run), run, statistics)
    assert first.model.y_scale.__class__.__name__ == "LogScale"
    _, y = lines(first)["delay after the deadline"]
    ((data, _),) = [one for one in glyphs(first, "Line") if str(one[1].y).startswith("high")]
    assert np.nanmax(np.asarray(list(data.values())[1:])) > 0
    assert np.nanmin(y) == np.float32(late.min())
    ((bars, glyph),) = glyphs(second, "Quad")
    left, top = (np.asarray(bars[side]).tolist() for side in (glyph.left, glyph.top))
    counts = dict(zip(left, top, strict=True))
    floor = np.floor(late).astype(int)
    assert counts == {one: int((floor == one).sum()) for one in set(floor[floor <= 150].tolist())}
    x, share = ((data[glyph.x], data[glyph.y]) for data, glyph in glyphs(third, "Line")).__next__()
    for delay, logit in zip(x, share, strict=True):  # half of the wake-up itself is counted
        up_to = 1 / (1 + np.exp(-logit))
        assert np.mean(floor < delay) < up_to < np.mean(floor <= delay)


def test_reply_times_and_lost_replies_are_those_of_the_packets(write):
    ask, answer = bytes.fromhex("ffff0504022406ca"), bytes.fromhex("ffff05082000020000000000f0")
    packets = []
    for number in range(20):
        packets.append(Wire(PacketKind.INSTRUCTION, 5, 1000 + number * 20_000, ask))
        if number != 7:
            packets.append(Wire(PacketKind.STATUS, 5, 1400 + number * 20_000 + 10 * number, answer))
    packets.append(Wire(PacketKind.INSTRUCTION, 5, 1000 + 20 * 20_000, ask))  # open where the log ends
    log = read_log(write([Cycle(number) for number in range(20)], packets))
    collector = ReplyCollector()
    analyze(log, exchanges=collector.add_exchanges)
    replies = collector.build_curves()
    times = replies.low("reply main 5")
    known = np.isfinite(times)
    np.testing.assert_allclose(times[known], [400 + 10 * number for number in range(20) if number != 7])
    lost = replies.rows.t_ns[np.isfinite(replies.low("lost main 5"))]
    assert lost.tolist() == [1_000_000 + 7 * 20_000_000]
    assert "reply main 21" not in replies


def test_each_event_is_on_the_row_of_its_kind_with_its_text(write):
    happened = [
        Said(EventCode.SCHEDULER, Severity.INFO, "one"),
        Said(EventCode.SCHEDULER, Severity.WARNING, "two"),
        Said(EventCode.CONTROLLER_FAULT, Severity.ERROR, "three"),
    ]
    log = read_log(write([Cycle(number) for number in range(3)], (), happened))
    collector = EventCollector()
    for event in log.events:
        collector.add_slice(replace(log, events=(event,)))
    events = collector.sort_events()
    assert events == log.events
    plot = events_plot(Canvas(0, 0, 10**9), events, 3)
    drawn = [(dict(data)["text"], dict(data)["y"].tolist()) for data, _ in glyphs(plot, "Scatter")]
    assert drawn == [(["head: one"], [0.0]), (["head: two"], [0.0]), (["head: three"], [1.0])]
