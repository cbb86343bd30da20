"""`dxlrun analyze A B`: what changed, and which figures differ by more than their noise; no others."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from dxlrun.log.reader import Log, read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.season.blocks import MOST, Blocks, Figure
from dxlrun_analysis.season.changes import changes
from dxlrun_analysis.season.comparison import LEVEL, chance, compare, differing, holm

Dxlrun = Callable[..., SimpleNamespace]
ROBOT = """name: pair
arguments:
  rate: {default: 50}
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}, return_delay_time: 0 us}
loop: {rate: "${rate}"}
joints:
  elbow: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
  wrist: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  arm: {type: joint_trajectory_controller, joints: [elbow, wrist]}
"""
RUNS = int(os.environ.get("DXLRUN_COMPARISONS", "60"))
"""Pairs of runs that are alike."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run, and one with another file: a slower line and a baud rate that shows in all replies."""
    directory = tmp_path_factory.mktemp("two")
    texts = {"a": ROBOT, "b": ROBOT.replace("baud_rate: 1_000_000", "baud_rate: 57_600")}
    for name, text in texts.items():
        robot = directory / f"{name}.yaml"
        robot.write_text(text)
        simulated_robot(robot, duration_s=8, log=directory / f"{name}.mcap").run()
    return directory / "a.mcap", directory / "b.mcap"


def measured(log: Log, noise: int | None = None, **changed: Callable[[NDArray[np.void]], None]) -> Blocks:
    """Return the blocks of a log in slices of 37 cycles, with noise in its times, and changed cycles."""
    blocks = Blocks()
    cycles = log.cycles.copy()
    if noise is not None:
        random = np.random.default_rng(noise)
        late = random.gamma(2, 20_000, len(cycles)).astype(np.int64)
        for name in ("woken_ns", "read_ns", "updated_ns", "written_ns"):
            late += random.gamma(4, 10_000, len(cycles)).astype(np.int64)
            cycles[name] += late
        cycles["position"] += random.normal(0, 0.002, cycles["position"].shape)
    for change in changed.values():
        change(cycles)
    for start in range(0, len(cycles), 37):
        part = cycles[start : start + 37]
        chosen = np.isin(log.packets.cycle, part["cycle"])
        blocks.take(replace(log, cycles=part, packets=log.packets.take(chosen)))
    return blocks


def test_the_test_is_mann_and_whitneys() -> None:
    """Without autocorrelation as scipy computes it, ties too."""
    random = np.random.default_rng(3)
    near = 0
    for _ in range(200):
        one, other = random.integers(0, 9, 24).astype(float), random.integers(0, 9, 31).astype(float)
        expected = stats.mannwhitneyu(one, other, method="asymptotic").pvalue
        found = chance(one, other)
        assert found >= expected * 0.999  # fewer independent values never give more certainty
        near += found < expected * 1.5
    assert near > 60
    assert chance(np.ones(20), np.ones(30)) == 1.0
    assert chance(np.arange(20.0) % 2, 5 + np.arange(20.0) % 2) < 1e-6


def test_holms_correction_is_that_of_the_paper() -> None:
    corrected = holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.005})
    assert corrected == pytest.approx({"d": 0.02, "a": 0.03, "c": 0.06, "b": 0.06})


@pytest.mark.campaign
@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.9])
def test_runs_that_are_alike_do_not_differ(correlation: float) -> None:
    """60 figures of 20 to 40 blocks with noise that is correlated from block to block."""
    random = np.random.default_rng(int(10 * correlation))
    false = 0
    for _ in range(RUNS):
        pairs = []
        for _ in range(2):
            blocks = random.normal(size=(60, int(random.integers(20, 41))))
            for block in range(1, blocks.shape[1]):
                kept = correlation * blocks[:, block - 1]
                blocks[:, block] = kept + np.sqrt(1 - correlation**2) * blocks[:, block]
            pairs.append({str(n): Figure("", 0.0, row) for n, row in enumerate(blocks)})
        false += bool(differing(*pairs)[0])
    assert false <= 2 + 0.02 * RUNS, f"{false} of {RUNS} pairs of runs"


@pytest.mark.parametrize(("shift", "found"), [(0.0, 0), (4.0, 60)])
def test_a_difference_of_four_deviations_is_found(shift: float, found: int) -> None:
    random = np.random.default_rng(7)
    one, other = (
        {str(n): Figure("us", 100 + s, 100 + s + random.normal(size=30)) for n in range(60)}
        for s in (0.0, shift)
    )
    assert len(differing(one, other)[0]) >= 0.95 * found
    assert shift or not differing(one, other)[0]


def test_halves_of_a_run_do_not_differ(runs: tuple[Path, Path]) -> None:
    log = read_log(runs[0])
    half = len(log.cycles) // 2
    false = 0
    for seed in range(8):
        halves = []
        for part in (log.cycles[:half], log.cycles[half:]):
            chosen = np.isin(log.packets.cycle, part["cycle"])
            packets = log.packets.take(chosen)
            halves.append(measured(replace(log, cycles=part, packets=packets), 2 * seed + len(halves)))
        one, other = (blocks.figures() for blocks in halves)
        found, compared, _ = differing(one, other)
        assert compared > 15
        false += bool(found)
    assert false == 0


def later(column: str, extra: int) -> Callable[[NDArray[np.void]], None]:
    def change(cycles: NDArray[np.void]) -> None:
        times = ["scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns"]
        for name in times[times.index(column) :]:
            cycles[name] += extra

    return change


def hotter(cycles: NDArray[np.void]) -> None:
    cycles["temperature"][:, 1] += 9


def lagging(cycles: NDArray[np.void]) -> None:
    cycles["position"][:, 0] += 0.01


def skipping(cycles: NDArray[np.void]) -> None:
    cycles["skipped"][::3] = 1


@pytest.mark.parametrize(
    ("change", "figures"),
    [
        (later("woken_ns", 40_000), {"wake-up latency, median", "wake-up latency, 99 %"}),
        (later("updated_ns", 60_000), {"update, median", "update, 99 %"}),
        (hotter, {"temperature of wrist"}),
        (lagging, {"tracking error of elbow"}),
        (skipping, {"skipped periods"}),
    ],
)
def test_what_differs_is_found_and_nothing_else(
    runs: tuple[Path, Path], change: Callable[[NDArray[np.void]], None], figures: set[str]
) -> None:
    log = read_log(runs[0])
    one, other = measured(log, 1).figures(), measured(log, 2, change=change).figures()
    found = {each.figure for each in differing(one, other)[0]}
    assert figures & found
    assert found <= figures


def test_blocks_are_the_same_however_the_log_is_sliced(runs: tuple[Path, Path]) -> None:
    log = read_log(runs[0])
    whole = Blocks()
    whole.take(log)
    sliced = measured(log).figures()
    figures = whole.figures()
    assert figures.keys() == sliced.keys()
    for name, figure in figures.items():
        assert MOST // 2 <= len(figure.blocks) <= MOST, name
        np.testing.assert_allclose(figure.blocks, sliced[name].blocks, rtol=1e-12)
    late = (log.cycles["read_ns"] - log.cycles["woken_ns"]) / 1e3
    assert figures["read, median"].overall == pytest.approx(np.median(late), rel=0.025)
    assert figures["lost replies of elbow"].overall == 0.0
    assert figures["reply of elbow, median"].overall > 100


def test_blocks_are_of_equal_length_and_in_order(runs: tuple[Path, Path]) -> None:
    log = read_log(runs[0])
    cycles = np.tile(log.cycles, 10)[:3900]
    cycles["cycle"] = np.arange(len(cycles))
    cycles["read_ns"] = cycles["woken_ns"] + 1_000_000 + 1000 * cycles["cycle"]
    assert len(cycles) > 4 * 16 * MOST  # blocks are joined more than once
    blocks = measured(replace(log, cycles=cycles)).figures()["read, median"].blocks
    assert len(blocks) == 30  # the last one has too few
    np.testing.assert_allclose(np.diff(blocks), np.full(29, 128.0), rtol=0.1)


def test_the_tracking_error_is_that_of_the_goal_before(runs: tuple[Path, Path]) -> None:
    def moving(cycles: NDArray[np.void]) -> None:
        number = np.arange(len(cycles))[:, None]
        cycles["goal_position"] = 0.1 * (number + 1)
        cycles["position"] = 0.1 * number + [0.002, 0.0]

    figures = measured(read_log(runs[0]), change=moving).figures()
    assert figures["tracking error of elbow"].overall == pytest.approx(0.002)
    assert figures["tracking error of wrist"].overall == pytest.approx(0.0, abs=1e-9)


def test_two_logs_are_compared_below_their_lines(runs: tuple[Path, Path], dxlrun: Dxlrun) -> None:
    first, second = runs
    said = dxlrun("analyze", first, second)
    lines = said.out.splitlines()
    assert said.code == 0
    assert [line.split(": ")[0] for line in lines[:2]] == [str(first), str(second)]
    text = " ".join(said.out.split())
    assert "plan buses[main].baud_rate 1000000 57600" in text
    assert "- main: {port: sim, protocol: 2.0, baud_rate: 1_000_000" in text
    assert "+ main: {port: sim, protocol: 2.0, baud_rate: 57_600" in text
    assert "reply of elbow, median" in text
    assert "figures differ by more than their noise within the runs." in text

    found = json.loads(dxlrun("analyze", first, second, "--json").out)
    assert [log["log"] for log in found["logs"]] == [str(first), str(second)]
    by_name = {each["figure"]: each for each in found["comparison"]["differences"]}
    reply = by_name["reply of elbow, median"]
    assert reply["second"] > 2 * reply["first"]
    assert reply["probability"] < LEVEL
    assert {change["what"] for change in found["comparison"]["changes"]} >= {"plan", "identity"}


def test_a_run_and_itself_are_the_same(runs: tuple[Path, Path], dxlrun: Dxlrun) -> None:
    text = dxlrun("analyze", runs[0], runs[0]).out
    assert "Nothing changed: robot file, plan, code and machine are the same." in text
    assert "0 of " in text
    assert "differs" not in text


def test_a_log_that_cannot_be_read_leaves_the_other_and_no_comparison(
    runs: tuple[Path, Path], tmp_path: Path, dxlrun: Dxlrun
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no log")
    said = dxlrun("analyze", runs[0], broken)
    assert (said.code, len(said.out.splitlines()), len(said.errors)) == (2, 1, 1)
    found = json.loads(dxlrun("analyze", runs[0], broken, "--json").out)
    assert found["comparison"] is None
    assert [log.get("ok", True) for log in found["logs"]] == [True, False]


def test_a_short_run_is_not_judged(tmp_path: Path, dxlrun: Dxlrun) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").write_text(ROBOT)
        simulated_robot(tmp_path / f"{name}.yaml", duration_s=1.0, log=tmp_path / f"{name}.mcap").run()
    text = dxlrun("analyze", tmp_path / "a.mcap", tmp_path / "b.mcap").out
    assert "figures were not compared: a run is too short for its noise." in text


def test_what_changed_is_named_by_record_and_key(runs: tuple[Path, Path]) -> None:
    first = read_log(runs[0])
    versions = first.metadata["versions"] | {"numpy": "0.1", "new": "1"}
    kernel = first.metadata["kernel"] | {"release": "2.6"}
    second = replace(first, metadata=first.metadata | {"versions": versions, "kernel": kernel})
    found, lines = changes(first, second)
    assert {(each.what, each.key, each.second) for each in found} == {
        ("versions", "numpy", "0.1"),
        ("versions", "new", "1"),
        ("kernel", "release", "2.6"),
    }
    assert lines == ()
    assert compare((first, measured(first)), (second, measured(second))).differences == ()


def test_a_long_difference_of_the_robot_file_is_cut(runs: tuple[Path, Path]) -> None:
    first = read_log(runs[0])
    text = b"\n".join(b"# line %d" % number for number in range(200))
    _, lines = changes(first, replace(first, attachments=first.attachments | {"robot.yaml": text}))
    assert len(lines) == 41
    assert lines[-1].endswith("more lines")
