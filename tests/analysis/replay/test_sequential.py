"""A log of the sequential sender, yardstick of `dxlrun experiment tracking`, is one like any other."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from tests.kit.totals import totals_of

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import LogError
from dxlrun.log.log_reader import read_log
from dxlrun.testing import VirtualRobot
from dxlrun_analysis.replay import recorded_inputs, replay_log
from dxlrun_analysis.report import analyze, facts
from dxlrun_analysis.verdict import judge_run

ROBOTS = Path(__file__).parents[3] / "robots"
PERIOD_NS = 3_125_000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second on virtual time, where every tenth wake-up or so is late."""
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    plan = compile_files(ROBOTS / "single_joint.yaml", {}, [], 1_000_000_000).plan
    robot = VirtualRobot(
        structs.replace(plan, loop=structs.replace(plan.loop, schedule="sequential")), log=path
    )
    chance, clock = random.Random(3), robot.clock

    class LateClock:
        now_ns = clock.now_ns

        def wait_until(self, deadline_ns: int) -> int:
            return clock.wait_until(
                max(deadline_ns, clock.now_ns()) + (chance.random() < 0.1) * chance.randrange(3 * PERIOD_NS)
            )

    robot.robot.loop.clock = LateClock()
    robot.run()
    return path


def test_its_delays_add_up_and_its_replay_has_no_difference(log: Path) -> None:
    cycles = read_log(log).cycles
    delays = cycles["woken_ns"] - cycles["scheduled_ns"]
    assert cycles["cycle"].tolist() == list(range(320))
    assert delays.max() > 2 * PERIOD_NS
    assert int(cycles["woken_ns"][-1]) == int(cycles["scheduled_ns"][0]) + 319 * PERIOD_NS + int(delays.sum())
    assert replay_log(log).sentence == "single_joint: 320 cycles replayed, 0 differences"


def test_its_analysis_finds_one_rate_and_every_period(log: Path) -> None:
    read = read_log(log)
    report = analyze(read)
    assert any(
        "delays add up" in cell.text for table in facts(read, report) for row in table.rows for cell in row
    )
    assert report.verdict.good
    sentence = "The loop ran sequentially, not by the clock: 320 periods of 320 Hz took 1."
    assert any(one.startswith(sentence) for one in report.verdict.sentences)
    assert judge_run(totals_of(log)).sentences[1] == report.verdict.sentences[1]
    periods = report.totals.periods
    assert periods.rates_hz == (320.0,)
    assert (periods.elapsed, periods.skipped, periods.agree) == (320, 0, True)
    assert periods.seconds > 1.1
    assert report.totals.latency is not None
    assert report.totals.latency.max_us > 6_000


def test_times_that_a_schedule_cannot_have_are_refused(log: Path) -> None:
    read = read_log(log)
    cycles = read.cycles.copy()
    cycles["scheduled_ns"][100] -= 1
    with pytest.raises(LogError, match="the times of cycle 100 contradict its number"):
        recorded_inputs.recorded(replace(read, cycles=cycles))

    absolute = read.attachments["plan.json"].replace(b'"schedule":"sequential"', b'"schedule":"absolute"')
    with pytest.raises(LogError, match="contradict its number"):
        recorded_inputs.recorded(replace(read, attachments={**read.attachments, "plan.json": absolute}))
    assert np.diff(read.cycles["scheduled_ns"]).max() > PERIOD_NS
