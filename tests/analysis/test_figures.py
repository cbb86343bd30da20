"""Analysis: each curve, bar and mark of a report's figures is the log's own data, computed here once more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dxlrun.analysis.cycles.latency import Punctuality
from dxlrun.analysis.figures.drawing import SteeringMarks
from dxlrun.analysis.figures.events import events_drawing, reply_drawing
from dxlrun.analysis.figures.joints import joint_drawings
from dxlrun.analysis.figures.timing import budget_drawings, latency_drawings
from dxlrun.analysis.joints.tracking import reachable
from dxlrun.analysis.report import analyze
from dxlrun.analysis.servos.traffic import ServoTraffic
from dxlrun.analysis.steering import Pause
from dxlrun.log.reader import Log, read_log
from dxlrun.run.channels.events import EventCode, Severity

Make = Callable[..., Any]
Data = NDArray[np.float64]
COUNT, LONG = 40, 2500
PERIOD_NS, START_NS = 20_000_000, 10**9
STEPS = {
    "wake-up": ("scheduled_ns", "woken_ns"),
    "read": ("woken_ns", "read_ns"),
    "update": ("read_ns", "updated_ns"),
    "write": ("updated_ns", "written_ns"),
}


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were drawn, in order."""
    drawn: list[Figure] = []
    write_out = Figure.savefig

    def savefig(figure: Figure, *arguments: Any, **options: Any) -> None:
        drawn.append(figure)
        write_out(figure, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return drawn


def filled(log: Log, seed: int) -> Log:
    """Give each field of each cycle and each joint a number of its own."""
    rng, cycles = np.random.default_rng(seed), log.cycles.copy()
    for name in ("position", "velocity"):
        for field in (name, f"command_{name}", f"goal_{name}"):
            cycles[field] = rng.normal(size=cycles[field].shape)
    count = len(cycles)
    numbers = np.arange(count) + (np.arange(count) >= count // 2) * 3
    cycles["cycle"], cycles["scheduled_ns"] = numbers, START_NS + numbers * PERIOD_NS
    cycles["skipped"] = (np.arange(count) == count // 2) * 3
    before = cycles["scheduled_ns"]
    for most_us, field in ((300, "woken_ns"), (6000, "read_ns"), (900, "updated_ns"), (500, "written_ns")):
        cycles[field] = before + rng.integers(0, most_us * 1000, count)
        before = cycles[field]
    cycles["valid"] = rng.random((count, 2)) < 0.9
    cycles["clamped"] = rng.random((count, 2)) < 0.1
    return replace(log, cycles=cycles)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, write_to: Make, cycle: Make) -> dict[int, Log]:
    """A short log, of which each sample is drawn, and a long one, of which columns are."""

    def made(count: int) -> Log:
        path = write_to(tmp_path_factory.mktemp("log"), [cycle(number) for number in range(count)])
        return filled(read_log(path), count)

    return {count: made(count) for count in (COUNT, LONG)}


@pytest.fixture
def short(logs: dict[int, Log]) -> Log:
    return logs[COUNT]


@pytest.fixture
def long(logs: dict[int, Log]) -> Log:
    return logs[LONG]


def seconds(log: Log) -> Data:
    return np.asarray((log.cycles["scheduled_ns"] - START_NS) / 1e9)


def lines(axes: Axes) -> dict[str, tuple[Data, Data]]:
    """Return the labelled curves."""
    return {
        str(line.get_label()): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
        for line in axes.lines
        if not str(line.get_label()).startswith("_")
    }


def labels(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.get_yticklabels()]


def verticals(axes: Axes) -> list[float]:
    """Return where lines stand from the bottom of the axes to their top."""
    spans = [(np.asarray(line.get_xdata()), list(line.get_ydata())) for line in axes.lines]  # type: ignore[arg-type]  # two numbers each
    return [float(x[0]) for x, y in spans if y == [0, 1]]


def horizontals(axes: Axes) -> list[float]:
    spans = [(list(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.lines]  # type: ignore[arg-type]  # two numbers each
    return [float(y[0]) for x, y in spans if x == [0, 1]]


def fields(quantity: str) -> dict[str, str]:
    """What each curve of a joint shows; the reachable trajectory is one of positions."""
    curves = {"desired (command)": f"command_{quantity}", "sent (goal)": f"goal_{quantity}", "read": quantity}
    return curves | ({"reachable": "reachable"} if quantity == "position" else {})


def shown(log: Log, field: str, row: int) -> Data:
    if field == "reachable":
        return reachable(log, row)
    values = log.cycles[field][:, row]
    return np.asarray(values if "_" in field else np.where(log.cycles["valid"][:, row], values, np.nan))


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("quantity", ["position", "velocity"])
def test_each_sample_of_a_joint_is_on_the_curve_of_its_name(
    figures: list[Figure], short: Log, row: int, quantity: str
) -> None:
    joint_drawings(short, analyze(short).joints)
    axes = figures[row].axes[("position", "velocity").index(quantity)]
    assert axes.get_ylabel() == {"position": "position, rad", "velocity": "velocity, rad/s"}[quantity]
    curves = lines(axes)
    assert list(curves) == list(fields(quantity))
    for label, field in fields(quantity).items():
        x, y = curves[label]
        np.testing.assert_allclose(x, seconds(short))
        np.testing.assert_array_equal(y, shown(short, field, row))
    held = {str(line.get_label()): line.get_drawstyle() for line in axes.lines}
    assert {label for label in curves if held[label] == "default"} == {"read"}
    assert {held[label] for label in curves} == {"default", "steps-post"}


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("quantity", ["position", "velocity"])
def test_the_curves_of_a_long_run_have_the_extremes_of_each_column(
    figures: list[Figure], long: Log, row: int, quantity: str
) -> None:
    joint_drawings(long, analyze(long).joints)
    curves = lines(figures[row].axes[("position", "velocity").index(quantity)])
    width = -(-LONG // 900)
    assert list(curves) == list(fields(quantity))
    for label, field in fields(quantity).items():
        values, (x, y) = shown(long, field, row), curves[label]
        at = np.searchsorted(seconds(long), x - 1e-9)
        np.testing.assert_array_equal(y, values[at])
        for start in range(0, LONG, width):
            part, drawn = values[start : start + width], y[(at >= start) & (at < start + width)]
            if np.isfinite(part).any():
                assert (np.nanmin(drawn), np.nanmax(drawn)) == (np.nanmin(part), np.nanmax(part))


@pytest.mark.parametrize("row", [0, 1])
def test_the_ticks_under_a_joint_are_the_cycles_of_their_reason(
    figures: list[Figure], short: Log, row: int
) -> None:
    joint_drawings(short, analyze(short).joints)
    position, velocity, strip = figures[row].axes
    cycles, times = short.cycles, seconds(short)
    reasons = {
        "late": cycles["woken_ns"] - cycles["scheduled_ns"] > 150_000,
        "skipped": cycles["skipped"] > 0,
        "no reply": ~cycles["valid"][:, row],
        "clamped": cycles["clamped"][:, row] != 0,
    }
    assert labels(strip) == list(reasons)
    for number, flags in enumerate(reasons.values()):
        segments = np.array(strip.collections[number].get_segments())  # type: ignore[attr-defined]  # of LineCollection
        assert flags.any()
        np.testing.assert_allclose(segments[:, 0, 0], times[flags])
        np.testing.assert_allclose(segments[:, :, 1].mean(axis=1), number)
    for axes in (position, velocity):
        assert verticals(axes) == pytest.approx(times[reasons["skipped"]])


def late_us(log: Log) -> Data:
    return np.asarray((log.cycles["woken_ns"] - log.cycles["scheduled_ns"]) / 1e3)


def drawn_latency(figures: list[Figure], log: Log) -> tuple[Axes, Axes, Axes]:
    punctuality = Punctuality()
    punctuality.take(log)
    _, statistics = punctuality.finish()
    assert statistics is not None
    latency_drawings(log, statistics)
    first, second, third = (figure.axes[0] for figure in figures)
    return first, second, third


def test_each_wake_up_is_drawn_at_its_iteration(figures: list[Figure], short: Log) -> None:
    axes, _, _ = drawn_latency(figures, short)
    late, numbers = np.maximum(late_us(short), 1.0), short.cycles["cycle"]
    assert axes.get_yscale() == "log"
    points, triangles = axes.lines[:2]
    np.testing.assert_array_equal(points.get_xdata(), numbers)
    np.testing.assert_allclose(np.asarray(points.get_ydata()), late)
    rough = late > 150
    assert rough.any()
    np.testing.assert_array_equal(triangles.get_xdata(), numbers[rough])
    np.testing.assert_allclose(np.asarray(triangles.get_ydata()), late[rough])
    assert horizontals(axes) == [150.0]


def test_the_columns_of_many_wake_ups_span_from_the_smallest_to_the_largest(
    figures: list[Figure], long: Log
) -> None:
    axes, _, _ = drawn_latency(figures, long)
    width = -(-LONG // 900)
    late = np.maximum(late_us(long), 1.0)
    columns = [late[start : start + width] for start in range(0, LONG, width)]
    x, y = lines(axes)["median"]
    np.testing.assert_array_equal(x, long.cycles["cycle"][::width])
    np.testing.assert_allclose(y, [np.median(column) for column in columns])
    (band,) = axes.collections
    corners = band.get_paths()[0].vertices
    for number, column in zip(x, columns, strict=True):
        at = corners[corners[:, 0] == number][:, 1]  # type: ignore[index]  # an array, whatever the stubs say
        assert (at.min(), at.max()) == pytest.approx((column.min(), column.max()))


def test_each_bin_of_the_histogram_counts_its_wake_ups(figures: list[Figure], long: Log) -> None:
    _, axes, _ = drawn_latency(figures, long)
    (stairs,) = axes.patches
    values, edges, _ = stairs.get_data()  # type: ignore[attr-defined]  # of StepPatch
    late = late_us(long)
    assert (edges[0], edges[-1]) == (0, 151)
    for low, high, count in zip(edges[:-1], edges[1:], values, strict=True):
        assert count == np.count_nonzero((late >= low) & (late < high) & (late <= 150))
    assert axes.get_yscale() == "log"


@pytest.mark.parametrize("count", [COUNT, LONG])
def test_the_cumulative_curve_is_the_share_of_wake_ups_up_to_each(
    figures: list[Figure], logs: dict[int, Log], count: int
) -> None:
    _, _, axes = drawn_latency(figures, logs[count])
    late = np.maximum(late_us(logs[count]), 1.0)
    x, y = (np.asarray(data) for data in axes.lines[0].get_data())
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "logit")
    assert x[-1] == late.max()
    assert len(x) == count
    for delay, share in zip(x, y, strict=True):  # half of the wake-up itself is counted
        below, up_to = np.mean(late < delay), np.mean(late <= delay)
        assert below < share < up_to
    assert verticals(axes) == [150.0]


def test_the_period_is_marked_where_a_wake_up_comes_near_to_it(figures: list[Figure], short: Log) -> None:
    cycles = short.cycles.copy()
    cycles["woken_ns"][5] = cycles["scheduled_ns"][5] + 7_000_000
    first, _, third = drawn_latency(figures, replace(short, cycles=cycles))
    assert horizontals(first) == verticals(third) == [150.0, PERIOD_NS / 1e3]


def step_rows(log: Log) -> Data:
    """Return how long each step of each cycle took, ms, shape (steps, cycles)."""
    return np.array([(log.cycles[end] - log.cycles[begin]) / 1e6 for begin, end in STEPS.values()])


def colours(axes: Axes) -> dict[str, str]:
    """Return the colour of each step in the legend."""
    legend = axes.get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    handles = zip(texts, legend.legend_handles, strict=True)
    return {text: to_hex(handle.get_facecolor()[:3]) for text, handle in handles if text in STEPS}  # type: ignore[union-attr]  # a patch


def test_the_bars_of_the_budget_are_the_longest_cycle_the_99_percent_and_the_median(
    figures: list[Figure], long: Log
) -> None:
    budget_drawings(long)
    axes, steps = figures[0].axes[0], step_rows(long)
    expected = {
        "longest cycle": steps[:, np.argmax(steps.sum(axis=0))],
        "99 % of each step": np.percentile(steps, 99, axis=1),
        "median of each step": np.median(steps, axis=1),
    }
    assert labels(axes) == list(expected)
    bars = iter(axes.patches)
    for row, values in enumerate(expected.values()):
        left = 0.0
        for name, value in zip(STEPS, values, strict=True):
            bar: Any = next(bars)
            assert (bar.get_x(), bar.get_width()) == pytest.approx((left, value))
            assert bar.get_y() + bar.get_height() / 2 == pytest.approx(row)
            assert to_hex(bar.get_facecolor()) == colours(axes)[name]
            left += value
    assert next(bars, None) is None
    assert verticals(axes) == [20.0]


@pytest.mark.parametrize("count", [COUNT, LONG])
def test_the_areas_of_the_budget_are_the_steps_of_the_longest_cycle_of_each_column(
    figures: list[Figure], logs: dict[int, Log], count: int
) -> None:
    log = logs[count]
    budget_drawings(log)
    axes, steps, times = figures[1].axes[0], step_rows(log), seconds(log)
    total, width = steps.sum(axis=0), -(-count // 900)
    starts = range(0, count, width)
    picked = [start + int(np.argmax(total[start : start + width])) for start in starts]
    tops = np.cumsum(steps[:, picked], axis=0)
    areas = [area for area in axes.collections if len(area.get_paths())][: len(STEPS)]
    for number, (name, area) in enumerate(zip(STEPS, areas, strict=True)):
        corners: Any = area.get_paths()[0].vertices
        assert to_hex(np.asarray(area.get_facecolor())[0]) == colours(axes)[name]
        below = tops[number - 1] if number else np.zeros(len(picked))
        for index in (0, 1, len(picked) // 2, len(picked) - 1):
            near = corners[np.abs(corners[:, 0] - times[picked[index]]) < PERIOD_NS * width * 1.01e-9]
            assert np.abs(near[:, 1] - tops[number][index]).min() < 1e-9
            assert np.abs(near[:, 1] - below[index]).min() < 1e-9
    if width > 1:
        x, y = lines(axes)["median cycle"]
        np.testing.assert_allclose(x, times[picked])
        np.testing.assert_allclose(y, [np.median(total[start : start + width]) for start in starts])
    assert horizontals(axes) == [20.0]


def test_a_cycle_beyond_the_figure_is_a_triangle_at_its_time(figures: list[Figure], short: Log) -> None:
    cycles = short.cycles.copy()
    cycles["written_ns"][7] += 900_000_000
    budget_drawings(replace(short, cycles=cycles))
    axes = figures[1].axes[0]
    (triangles,) = (line for line in axes.lines if line.get_marker() == "^")
    np.testing.assert_allclose(np.asarray(triangles.get_xdata()), seconds(short)[[7]])
    assert "goes on to 9" in " ".join(text.get_text() for text in figures[0].axes[0].texts)


def test_the_period_is_drawn_as_it_changed(figures: list[Figure], short: Log) -> None:
    cycles = short.cycles.copy()
    cycles["scheduled_ns"][30:] -= np.arange(1, 11) * 10_000_000  # twice the rate from there on
    budget_drawings(replace(short, cycles=cycles))
    _, y = next(line.get_data() for line in figures[1].axes[0].lines if line.get_drawstyle() == "steps-post")
    np.testing.assert_allclose(np.asarray(y), np.where(np.arange(COUNT) < 29, 20.0, 10.0))
    assert verticals(figures[0].axes[0]) == [10.0, 20.0]


def answering(servo_id: int, median_us: float, slowest_us: float, lost: int = 0) -> ServoTraffic:
    return ServoTraffic(
        "main", servo_id, f"joint_{servo_id}", 9, 9, lost, 9 - lost, 0, (), median_us, slowest_us
    )


def test_each_servo_has_its_median_and_its_slowest_reply(figures: list[Figure]) -> None:
    reply_drawing([answering(5, 310.0, 900.0), answering(7, 0.0, 0.0, lost=9), answering(9, 420.0, 1700.0)])
    axes = figures[0].axes[0]
    assert labels(axes) == ["joint_5 5", "joint_9 9"]
    curves = lines(axes)
    for label, expected in (("median", [0.31, 0.42]), ("slowest", [0.9, 1.7])):
        x, y = curves[label]
        np.testing.assert_allclose(x, expected)
        np.testing.assert_array_equal(y, [0, 1])
    (between,) = axes.collections
    segments = np.array(between.get_segments())  # type: ignore[attr-defined]  # of LineCollection
    np.testing.assert_allclose(segments, [[[0.31, 0], [0.9, 0]], [[0.42, 1], [1.7, 1]]])


@dataclass(frozen=True)
class Happened:
    """An event at a time that the test chose."""

    code: EventCode
    severity: Severity
    at_s: float


def test_each_event_is_on_the_row_of_its_kind_with_the_shape_of_its_severity(
    figures: list[Figure], write: Make, cycle: Make, said: Make
) -> None:
    happened = [
        Happened(EventCode.SCHEDULER, Severity.INFO, -0.5),
        Happened(EventCode.SCHEDULER, Severity.WARNING, 0.25),
        Happened(EventCode.CONTROLLER_FAULT, Severity.ERROR, 0.5),
        Happened(EventCode.CONTROLLER_FAULT, Severity.INFO, 0.75),
    ]
    texts = [said(one.code, one.severity, "text") for one in happened]
    log = read_log(write([cycle(number) for number in range(COUNT)], (), texts))
    at_ns = [START_NS + int(one.at_s * 1e9) for one in happened]
    events = tuple(replace(event, t_ns=at) for event, at in zip(log.events, at_ns, strict=True))
    events_drawing(replace(log, events=events))
    axes = figures[0].axes[0]
    kinds = [event.name.replace("_", " ") for event in (events[0], events[2])]
    assert labels(axes) == kinds
    points = {label: sorted(zip(*data, strict=True)) for label, data in lines(axes).items()}
    assert points == {
        "information": [(-0.5, 0.0), (0.75, 1.0)],
        "warning": [(0.25, 0.0)],
        "error": [(0.5, 1.0)],
    }


def test_pauses_are_shaded_and_other_steering_is_a_dotted_line(figures: list[Figure], short: Log) -> None:
    figure = Figure()
    axes = figure.subplots()
    axes.set_xlim(0, 4)
    SteeringMarks((0.5, 3.5), (Pause(1.0, 2.0, 50),)).draw(axes)
    figure.canvas.draw()
    assert verticals(axes) == [0.5, 3.5]
    (shade,) = axes.patches
    box = shade.get_extents().transformed(axes.transData.inverted())
    assert (box.x0, box.x1) == pytest.approx((1.0, 2.0))
