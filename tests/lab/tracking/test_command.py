"""`dxlrun experiment tracking`: a whole run, its page, and what becomes of wrong words and failed runs."""

import json
import os
import re
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from msgspec.structs import replace
from tests.kit.answers import read_answer, result_of
from tests.kit.awaited import until
from tests.kit.experiments import ROBOTS
from tests.kit.pages import page_commands

from dxlrun.control import realtime_grants
from dxlrun.output.terminal import fitted
from dxlrun.run.run_summary import RunSummary
from dxlrun_analysis.replay import replay_log
from dxlrun_lab.stress import Stress
from dxlrun_lab.tracking import setups, tracking_experiment
from dxlrun_lab.tracking.figures import drawings
from dxlrun_lab.tracking.setups import SETUPS
from dxlrun_lab.tracking.tracking_experiment import TrackingExperiment
from dxlrun_lab.tracking.tracking_report import page, table

pytestmark = pytest.mark.long

Make = Callable[..., Any]
NORMAL = "sequential-normal,loop-normal"


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_two_setups_are_run_measured_and_shown(dxlrun, motion_file):
    """In real time, with all processes; judged by what is there, not by how punctual this machine is.

    A loop or guardian without priority that gets no processor on a busy machine is killed; it is run again.
    """
    motion = motion_file("300 ms", 30)

    def run():
        said = dxlrun(
            "experiment", "tracking", ROBOTS / "single_joint.yaml", "position_trajectory:=false",
            "posvel_trajectory:=true", "--play", motion,
            "--setups", NORMAL, "--no-stress", "--json",
        )  # fmt: skip
        errors = read_answer(said.out).errors
        starved = ("ms of processor time", "stopped watching the loop")
        return None if any(words in error.what + error.fix for error in errors for words in starved) else said

    said = until(run)
    assert said.code == 0, said.out
    assert "1 of 2: sequential sender, normal scheduler" in said.err
    shown = result_of(said.out)
    assert (shown["joint"], shown["motion_ns"], shown["load"]) == ("joint", 300_000_000, "")
    sequential, loop = shown["setups"]
    assert (sequential["setup"], loop["setup"]) == tuple(NORMAL.split(","))
    assert sequential["cycles"] == 97
    assert sequential["drift_ns"] == sequential["start_delays_ns"]
    assert -150_000 <= loop["drift_ns"] < shown["period_ns"] + loop["last_late_ns"]
    assert f"{sequential['start_delays_ns']} ns in 96 poses" in shown["sentences"][0]
    for one in (sequential, loop):
        assert one["ended"]
        assert one["late_by_bus_us"] >= 0
        assert replay_log(Path(one["log"])).same
        assert "320 Hz" in dxlrun("analyze", one["log"]).out
        assert not list(Path(one["log"]).parent.glob("*.jsonl"))


def test_the_page_has_the_table_and_a_figure_a_setup_with_the_same_axes(runs):
    measured = [runs(name, "random").measured for name in NORMAL.split(",")]
    desired = runs("loop-normal", "random").desired
    result = TrackingExperiment("single_joint", 3_125_000, desired, "2 busy processes", measured)
    text = page(result)
    assert not re.findall(r"""(?:src|href)=["'](?!#)""", text)
    numbers = json.loads(
        re.findall(r'<script type="application/json" id="report">(.*?)</script>', text, re.S)[0]
    )
    assert [one["drift_ns"] for one in numbers["setups"]] == [one.tracked.drift_ns for one in measured]
    for one in measured:
        assert f"{one.tracked.rms_rad:.4f} rad" in text
        assert one.tracked.title.capitalize() in text
    # the sequential sender ends at 1.5 s, so the loop's axis has room for that, but only beside it
    figures = text.partition('<figure id="loop-normal">')
    (alone,) = drawings(measured[1:], desired)
    assert ">1.4</text>" in figures[0]
    assert ">1.4</text>" in figures[2]
    assert ">1.4</text>" not in ET.tostring(alone, encoding="unicode")
    # one column a set-up; a table that does not fit a terminal would become paragraphs
    tracked = measured[1].tracked
    shown = fitted(table([replace(tracked, setup=one.name, late_by_bus_us=2e5) for one in SETUPS]), 80)
    heads, *_ = ("".join(text for text, _ in line) for line in shown)
    assert all(one.name in heads for one in SETUPS)


@pytest.fixture
def pretend(monkeypatch):
    """Return what lets runs end in this way, each with the log of a run; gives the plans that are run."""

    def pretend(*ends):
        plans, left = [], iter(ends)

        def run_robot(plan, *_):
            plans.append(plan)
            code, run, *sentences = next(left)
            return RunSummary(code, "", 1, 0, tuple(sentences), log=str(run.log.path))

        monkeypatch.setattr(tracking_experiment, "run_robot", run_robot)
        monkeypatch.setattr(setups, "missing_priority", lambda scheduler: "")
        return plans

    return pretend


def all_ended(runs: Make, named: Sequence[str] = ()) -> list[tuple[int, Any]]:
    """Return ends of runs by their schedule; on virtual time the scheduler is all the same."""
    names = named or [one.name for one in SETUPS]
    return [(0, runs(f"{name.partition('-')[0]}-normal", "none")) for name in names]


def run_short(dxlrun: Make, runs: Make, *words: object) -> Any:
    motion = runs("loop-normal", "none").desired.file
    return dxlrun("experiment", "tracking", "--play", motion, "--no-stress", *words)


def test_every_setup_has_its_schedule_and_scheduler(dxlrun, runs, pretend):
    plans = pretend(*all_ended(runs))
    said = run_short(dxlrun, runs)
    assert said.code == 0
    assert [(plan.loop.schedule, plan.loop.scheduler.policy) for plan in plans] == [
        ("sequential", "other"),
        ("absolute", "other"),
        ("absolute", "round_robin"),
        ("sequential", "round_robin"),
    ]
    lines = [line.split() for line in said.out.splitlines()]
    assert [one.name for one in SETUPS] in lines
    assert ["duration", *["1.000", "s"] * 4] in lines


@pytest.mark.parametrize("page", ["experiments.md", "results.md"])
def test_the_commands_of_the_pages_are_understood(dxlrun, runs, pretend, monkeypatch, page):
    monkeypatch.setattr("dxlrun_lab.stress.Stress", lambda *, wanted: Stress(wanted=False))
    monkeypatch.setattr("dxlrun_lab.tracking.tracking_report.page", lambda result: "a page")
    lines = page_commands(page, "Tracking")
    assert lines
    for words in lines:
        named = words[words.index("--setups") + 1].split(",") if "--setups" in words else ()
        plans = pretend(*all_ended(runs, named))
        assert dxlrun(*words).code == 0
        assert len(plans) == len(named or SETUPS)
        assert {plan.buses[0].port for plan in plans} == {
            "/dev/ttyUSB0" if any(word.startswith("port:=") for word in words) else "sim"
        }


def test_an_interrupt_keeps_what_was_measured(dxlrun, runs, pretend, monkeypatch):
    monkeypatch.setattr("dxlrun_lab.tracking.tracking_report.page", lambda result: "a page")
    plans = pretend((0, runs("sequential-normal", "none")), (130, runs("loop-normal", "none", 480)))
    said = run_short(dxlrun, runs, "--report", "page.html")
    assert said.code == 130
    assert len(plans) == 2
    assert said.err.endswith("interrupted\n")
    assert "loop-normal: measured for 0.5 of 1 s" in said.out
    assert "not ended" in said.out
    assert Path("page.html").is_file()


def test_a_termination_between_two_runs_keeps_what_was_measured(dxlrun, runs, pretend, monkeypatch):
    pretend(*all_ended(runs, NORMAL.split(",")))
    read = tracking_experiment.read_log

    def terminated(path):
        if path == str(runs("loop-normal", "none").log.path):
            os.kill(os.getpid(), signal.SIGTERM)
        return read(path)

    monkeypatch.setattr(tracking_experiment, "read_log", terminated)
    before = signal.getsignal(signal.SIGTERM)
    said = run_short(dxlrun, runs)
    assert (said.code, said.err.endswith("interrupted\n")) == (130, True)
    assert "sequential-normal" in said.out
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_that_fails_ends_in_a_sentence_and_the_others_follow(dxlrun, runs, pretend):
    failed = 1, runs("sequential-normal", "none", 480), "the loop stood still"
    plans = pretend(failed, (0, runs("loop-normal", "none")))
    said = run_short(dxlrun, runs, "--setups", NORMAL)
    assert said.code == 1
    assert len(plans) == 2
    assert said.err == "dxlrun: sequential-normal: the loop stood still\n"
    assert "sequential-normal: measured for 0.5 of 1 s" in said.out
    assert "loop-normal: ended" in said.out


def test_the_load_is_there_while_a_run_is_measured(runs, pretend, monkeypatch):
    ran = runs("loop-normal", "none")
    steps = []

    class Load(Stress):
        def __enter__(self):
            steps.append("loaded")
            return self

        def __exit__(self, *_):
            steps.append("free")

        def ended(self):
            return ("the load ended",)

    pretend((0, ran))
    monkeypatch.setattr(tracking_experiment, "read_log", lambda path: steps.append("measured") or ran.log)
    one = tracking_experiment.run_experiment(ran.plan, ran.desired, SETUPS[1:2], Load(), None)
    assert steps == ["loaded", "free", "measured"]
    assert one.measured[0].tracked.remarks == ("the load ended",)


def test_without_the_right_to_real_time_only_normal_setups_are_run(dxlrun, runs, pretend, monkeypatch):
    monkeypatch.setattr(realtime_grants, "highest_priority", lambda: 0)
    said = run_short(dxlrun, runs)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith(
        "dxlrun: this user may not use real-time priority, required by loop-realtime and sequential-realtime;"
    )
    assert realtime_grants.allow("rtprio", 32) in said.err
    assert f"--setups {NORMAL}" in said.err
    pretend(*all_ended(runs, NORMAL.split(",")))
    assert run_short(dxlrun, runs, "--setups", NORMAL).code == 0
