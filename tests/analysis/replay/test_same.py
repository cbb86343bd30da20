"""A replay of what was not changed has no difference, whatever happened in the run; `dxlrun replay`."""

import random
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from tests.kit.answers import result_of
from tests.kit.changed_logs import command, edited, no_commands, put, versions
from tests.kit.commands import cases, play
from tests.kit.pages import page_text
from tests.kit.totals import totals_of
from tests.kit.virtual_run import differing

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import LogError
from dxlrun.testing import VirtualRobot, read_log
from dxlrun_analysis.replay import recorded_inputs, replay_log
from dxlrun_analysis.replay.recorded_inputs import recorded
from dxlrun_analysis.report import analyze, facts
from dxlrun_analysis.verdict import judge_run

pytestmark = pytest.mark.long


ROBOTS = Path(__file__).parents[3] / "robots"


def test_small_robot_shows_every_kind_of_value(pair_log):
    cycles = read_log(pair_log).cycles
    assert np.isnan(cycles["command_velocity"]).any()
    assert np.isfinite(cycles["command_velocity"][:, 2]).all()
    assert len(np.unique(cycles["command_position"][:, 2])) == len(cycles) == 50


def test_silent_servo_and_periods_that_were_skipped(run, changed, robot_file, tmp_path):
    robot = tmp_path / "fast.yaml"
    robot.write_text(robot_file.read_text().replace("default: 50,", "default: 200,").replace("25}", "50}"))
    log = run(lambda one: one.silence((3, 7, 8), 300, 600), robot, 4.0)  # a lost one is asked once a second
    cycles = read_log(log).cycles
    assert cycles["skipped"].sum() > 0
    assert not cycles["valid"].all()
    assert cycles["valid"][-1].all()
    assert replay_log(log).same
    late_after_the_read = edited(lambda cycles: cycles["read_ns"].__setitem__(..., cycles["woken_ns"]))
    assert replay_log(changed(log, late_after_the_read)).same


def test_commands_from_outside_come_from_the_log(pair_log, changed):
    (planned,) = recorded(read_log(pair_log)).plan.loop.commands
    by_value = command("trajectory", planned=-1, data=planned.data)
    assert replay_log(changed(pair_log, by_value)).same
    other_data = command("trajectory", data=(np.frombuffer(planned.data) * 1.01).tobytes())
    _, first = differing(changed(pair_log, by_value, other_data))
    assert first.joint == "pan"


PERIOD_NS = 3_125_000


@pytest.fixture(scope="module")
def log(tmp_path_factory):
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


def test_its_delays_add_up_and_its_replay_has_no_difference(log):
    cycles = read_log(log).cycles
    delays = cycles["woken_ns"] - cycles["scheduled_ns"]
    assert cycles["cycle"].tolist() == list(range(320))
    assert delays.max() > 2 * PERIOD_NS
    assert int(cycles["woken_ns"][-1]) == int(cycles["scheduled_ns"][0]) + 319 * PERIOD_NS + int(delays.sum())
    assert replay_log(log).sentence == "single_joint: 320 cycles replayed, 0 differences"


def test_its_analysis_finds_one_rate_and_every_period(log):
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


def test_times_that_a_schedule_cannot_have_are_refused(log):
    read = read_log(log)
    cycles = read.cycles.copy()
    cycles["scheduled_ns"][100] -= 1
    with pytest.raises(LogError, match="the times of cycle 100 contradict its number"):
        recorded_inputs.recorded(replace(read, cycles=cycles))

    absolute = read.attachments["plan.json"].replace(b'"schedule":"sequential"', b'"schedule":"absolute"')
    with pytest.raises(LogError, match="contradict its number"):
        recorded_inputs.recorded(replace(read, attachments={**read.attachments, "plan.json": absolute}))
    assert np.diff(read.cycles["scheduled_ns"]).max() > PERIOD_NS


TEXT = page_text("replay.md")
COMMANDS = [line.strip() for line in TEXT.splitlines() if line.startswith("    dxlrun ")]
OUTPUTS = re.findall(r"```\n(.*?)```", TEXT, re.DOTALL)


def test_the_document_shows_the_output(tmp_path, monkeypatch, dxlrun):
    (tmp_path / "robots").symlink_to(ROBOTS)
    monkeypatch.chdir(tmp_path)
    said = []
    for line in COMMANDS:
        (log,) = sorted(Path("logs").glob("*.mcap"))[:1] or [tmp_path]
        said.append(dxlrun(*line.replace(" LOG", f" {log}").split()[1:]))
    assert [one.code for one in said] == [0, 0, 1, 0, 0, 0], said
    logs = re.compile(r"logs/[^\s,]+")
    shown = [logs.sub("LOG", one.out).split() for one in said]
    assert shown[1:-1] == [output.split() for output in OUTPUTS]
    assert [one.err for one in said[1:3]] == ["", ""]


def test_json_is_for_programs(pair_log, dxlrun):
    report = result_of(dxlrun("replay", pair_log, "--json").out)
    assert (report["same"], report["compared"], report["first"]) == (True, 50, None)
    said = dxlrun("replay", pair_log, "--json", "--set", "all_inputs.gain=0.5")
    report = result_of(said.out)
    assert (said.code, report["same"]) == (1, False)
    assert (report["first"]["cycle"], report["first"]["joint"]) == (0, "tilt")
    assert len(report["joints"]) == 2


def test_remarks_go_to_stderr(pair_log, changed, dxlrun):
    said = dxlrun("replay", changed(pair_log, versions(numpy="1.0"), no_commands(), put("active", 2, 0)))
    assert said.code == 1
    assert said.out.splitlines() == [
        "pair: 1 of 10 replayed cycles differs",
        "first: cycle 2, 0.040 s, controller states: recorded not active, replayed active",
    ]
    version, gap = said.errors
    assert version.startswith("pair: numpy has version 1.0 in the run and ")
    assert gap.startswith("pair: the log lacks a command of cycle 10")


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(pair_log, tmp_path, monkeypatch, dxlrun, case):
    (tmp_path / "pair.mcap").symlink_to(pair_log)
    monkeypatch.chdir(tmp_path)
    play(case, dxlrun)
