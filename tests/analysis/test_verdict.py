"""The verdict on logs: what it takes from them, and one verdict everywhere. See totals.txt, too."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from tests.analysis.judged import MS, totals
from tests.kit.cases import TextCase
from tests.kit.made_logs import Cycle, Said, Wire, loop_of
from tests.kit.told_stories import check_story, story_parameters
from tests.kit.totals import totals_of
from tests.kit.virtual_run import VirtualRun, ask, rate

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.log import log_reader, log_writer
from dxlrun.log.log_reader import open_log, read_log
from dxlrun.output.json import json_text
from dxlrun.run.run_log import log_header
from dxlrun.testing import plan_of, simulated_robot
from dxlrun_analysis.conduct import steering_history
from dxlrun_analysis.conduct.conduct import ConductHistory
from dxlrun_analysis.cycles import punctuality
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan_excerpt import LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.plan_excerpt import plan_of as plan_in
from dxlrun_analysis.report import analyze, analyze_log
from dxlrun_analysis.servos import exchanges as pairing
from dxlrun_analysis.servos.losses import ServoLosses
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RealTime, Tally
from dxlrun_analysis.verdict import judge_run
from dxlwire.packets import PacketKind

ROBOTS = Path(__file__).parents[2] / "robots"
PLANNED = {"name": "main", "port": "/dev/ttyUSB3", "baud_rate": 1_000_000, "return_delay_ns": 500_000}
ASK = bytes.fromhex("ffff0504022406ca")
ANSWER = bytes.fromhex("ffff05080000020000000000f0")


# What is taken from a log


def test_failure_beside_the_loop_and_invalid_states_are_the_runs(write):
    cycles = [Cycle(number, valid=number % 2 == 0) for number in range(100)]
    path = write(cycles, metadata={"failures": {"0": "the simulated bus exited before the end of the run"}})
    verdict = analyze_log(path).verdict
    assert not verdict.good
    assert verdict.sentences[1] == "The run failed: the simulated bus exited before the end of the run."
    assert verdict.sentences[2].startswith("States were invalid: left_elbow_joint in 50.0% of the cycles;")


def test_tolerance_is_that_of_the_robot_file_in_the_log(tmp_path, write):
    text = (ROBOTS / "bioloid_torso.yaml").read_text().replace("loop:\n", "loop:\n  tolerated_skips: 60 %\n")
    (tmp_path / "robot.yaml").write_text(text.replace("model: {urdf", "# {"))
    simulated_robot(tmp_path / "robot.yaml", duration_s=0.1, log=tmp_path / "simulated.mcap").run()
    assert totals_of(tmp_path / "simulated.mcap").plan.loop.tolerated_skips == 0.6
    for tolerated, good in ((0.6, True), ("all", False)):
        path = write([Cycle(0), Cycle(20, skipped=19)], plan={"loop": loop_of(tolerated_skips=tolerated)})
        assert analyze_log(path).verdict.good is good


@pytest.mark.parametrize(("own", "waiting", "subject"), [(40, 1, "elbow"), (1, 2, "main")])
def test_invalid_states_are_those_of_the_first_servo_without_a_reply(own, waiting, subject):
    servos = [LoggedServo(joint, at, row=at) for at, joint in enumerate(("elbow", "wrist"))]
    counts = (0, 1000, 50, 950, 0, (), 900.0, 990.0, 950.0)
    losses = ServoLosses(1000, own, broken_off=50 - own), ServoLosses(1000, 0, broken_off=0)
    replies = tuple(
        ServoTraffic("main", at, joint, *counts, losses=losses[at])
        for at, joint in enumerate(("elbow", "wrist"))
    )
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=servos)])
    findings = judge_run(totals(plan=plan, invalid=(50, 50), servos=replies)).findings
    (found,) = (one for one in findings if one.code == "invalid_states")
    assert found.subject == subject
    assert found.sentence.startswith("States were invalid: elbow in 5.0%, wrist in 5.0% of the cycles, ")
    assert f"{waiting} of these joints because a preceding reply was missing" in found.sentence


def test_findings_are_sorted_and_decide_whether_a_run_was_good():
    remark = Finding("oscillates", "elbow", "oscillates.")
    cause = Finding("supply", "wrist", "supply.", "Mend it.", Rank.CAUSE)
    verdict = judge_run(totals(findings=(remark, cause)))
    bad = judge_run(totals(findings=(remark, cause, Finding("silent", "foot", "silent.", "", Rank.SERVO))))
    assert (verdict.good, bad.good) == (True, False)
    assert verdict.sentences[1] == "supply. Mend it."
    assert any(one.startswith("oscillates.") for one in verdict.sentences[2:])
    assert [one.code for one in bad.findings][1:4] == ["silent", "supply", "oscillates"]
    shown = json.loads(json_text(verdict))
    assert list(shown) == ["good", "word", "sentences", "findings"]
    told = {"code": "supply", "subject": "wrist", "sentence": "supply.", "remedy": "Mend it."}
    assert shown["findings"][1] == told | {"rank": 8, "share": 0.0}


def test_line_of_the_robot_is_first_and_accuses_nothing():
    hot = Finding("servo_error", "elbow", "It is hot.", rank=Rank.LINE)
    robot, first, *_ = judge_run(totals(findings=(hot,))).findings
    assert (robot.code, robot.subject, robot.rank, first) == ("robot", "", Rank.REMARK, hot)


@pytest.mark.parametrize(
    ("data", "granted"),
    [
        (b'{"request":"scheduler","granted":true}', True),
        (b'{"request":"scheduler","granted":false}', False),
        (b'{"request":"locked memory","granted":true}', False),
        (b"", False),
    ],
)
def test_what_was_granted_is_read_from_the_log(write, data, granted):
    about = {"scheduler": {"policy": "round_robin"}, "kernel": {"version": "#1 SMP PREEMPT_RT"}}
    path = write(events=[Said(EventCode.SCHEDULER, Severity.INFO, "in words", "loop", data)], metadata=about)
    assert totals_of(path).real_time == RealTime(True, granted, True)


@pytest.mark.parametrize(
    ("extra_us", "latency_ms", "shown"),
    [
        (300, 1, ""),
        (2900, 1, ""),
        (3100, 1, "Replies on bus main are delayed by 3.1 ms (planned for the adapter: 1 ms"),
        (
            15_800,
            1,
            "a latency timer of 16 ms: 100% of its exchanges. `echo 1 | sudo tee /sys/bus/usb-serial/",
        ),
        (15_800, 16, ""),
    ],
)
def test_replies_are_compared_with_the_plan(write, extra_us, latency_ms, shown):
    end = 10 * (len(ASK) + len(ANSWER)) + 500 + extra_us
    packets = []
    for at in range(0, 1_250_000, 50_000):
        packets += [
            Wire(PacketKind.INSTRUCTION, 5, at, ASK),
            Wire(PacketKind.STATUS, 5, at + end - 10, ANSWER, at + end),
        ]
    plan = {"buses": [PLANNED | {"latency_ns": latency_ms * MS}]}
    report = analyze_log(write([Cycle(0)], packets, plan=plan))
    assert report.totals.buses[0].extra_us == pytest.approx(extra_us)
    assert report.verdict.good
    (late,) = [one for one in report.verdict.sentences if one.startswith("Replies on")] or [""]
    assert shown in late
    assert ("latency timer" in late) is (extra_us > 12_000 and latency_ms == 1)
    assert "cable" not in late


def test_request_that_waits_for_the_line_is_not_late(write):
    goals = bytes.fromhex("ffffff") + bytes(500)  # 5 ms of the line
    packets = []
    for at in range(0, 250_000, 50_000):
        packets += [
            Wire(PacketKind.INSTRUCTION, 254, at, goals),
            Wire(PacketKind.INSTRUCTION, 5, at + 10, ASK),
        ]
        packets.append(Wire(PacketKind.STATUS, 5, at + 5900, ANSWER))
    plan = {"buses": [PLANNED | {"latency_ns": MS}]}
    extra_us = analyze_log(write([Cycle(0)], packets, plan=plan)).totals.buses[0].extra_us
    assert extra_us is not None
    assert extra_us < 500


@pytest.mark.parametrize("virtual", [False, True])
def test_simulated_bus_is_known_when_the_link_to_its_port_is_gone(write, tmp_path, virtual):
    master, line = os.openpty()
    link = tmp_path / "robot"
    link.symlink_to(os.ttyname(line))
    arguments = {"port": "/dev/ttyUSB0" if virtual else str(link)}
    try:
        header = log_header(plan_of("robots/single_joint.yaml", arguments=arguments), 0, virtual=virtual)
    finally:
        link.unlink()
        os.close(master)
        os.close(line)
    plan = json.loads(header.attachments["plan.json"])
    for run, simulated in (({}, False), (header.metadata["run"], True)):
        path = write([Cycle(0)], plan=plan, metadata={"run": run})
        assert plan_in(read_log(path)).is_simulated("main") is simulated


@pytest.fixture(scope="module")
def storm(tmp_path_factory):
    """The log of a stormy run, in small chunks, with streams, pauses and refusals."""
    path = tmp_path_factory.mktemp("storm") / "run.mcap"
    run = VirtualRun(ROBOTS / "bioloid_torso.yaml", path, duration_s=4.0)
    run.fault("storm seed=3 faults=12 within=3s kinds=lose,silence,noise,reboot at=300ms")
    pause, resume = ask("pause"), ask("resume")
    asked = {600: rate(40), 1900: rate(40), 700: pause, 750: pause, 2000: pause, 900: resume, 2500: resume}
    for ms, command in asked.items():
        run.post_at(ms, command)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_writer, "CHUNK_BYTES", 4096)
        return run.logged()


def test_log_counted_in_slices_is_the_log_counted_as_a_whole(storm, monkeypatch):
    for module in (pairing, punctuality, steering_history):
        monkeypatch.setattr(module, "DISORDER_NS", 200 * MS)
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    slices = list(open_log(storm).slices())
    assert len(slices) > 20
    assert max(len(one.cycles) for one in slices) < 20
    tally, log = Tally(), read_log(storm)
    tally.add_slice(log)
    whole = tally.totals(log)
    assert totals_of(storm) == whole
    assert whole.servos[0].lost
    assert len(whole.pauses) == 2
    assert whole.events


def test_event_is_not_cut_where_a_slice_ends(write, monkeypatch):
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 64)
    text = "Traceback\n" + "x" * 2000 + "\nValueError: the end"
    path = write(
        events=[
            Said(EventCode.CONTROLLER_FAULT, Severity.ERROR, text),
            Said(EventCode.LOOP_STARTED, Severity.INFO, ""),
        ]
    )
    assert [(one.code, one.text) for one in totals_of(path).events] == [
        (EventCode.CONTROLLER_FAULT, text),
        (EventCode.LOOP_STARTED, ""),
    ]


def test_json_and_run_have_the_same_verdict(storm, tmp_path):
    log, said = read_log(storm), judge_run(totals_of(storm))
    report = analyze(log)
    assert not said.good
    assert report.verdict == said
    shown = json.loads(json_text(report.numbers))["verdict"]
    assert (shown["good"], tuple(shown["sentences"])) == (said.good, said.sentences)

    cut, data = tmp_path / "cut.mcap", storm.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert judge_run(totals_of(cut)) == analyze_log(cut).verdict
    assert any("log is incomplete" in sentence for sentence in judge_run(totals_of(cut)).sentences)


@pytest.mark.parametrize("case", [*story_parameters(Path(__file__).with_name("stories"))])
def test_story(case: TextCase, tmp_path: Path) -> None:
    check_story(case, tmp_path)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The log of a robot without an IMU."""
    path = tmp_path_factory.mktemp("short") / "run.mcap"
    simulated_robot(ROBOTS / "single_joint.yaml", duration_s=0.02, log=path).run()
    return read_log(path)


@pytest.mark.parametrize("kind", ["orientation", "linear_acceleration"])
@pytest.mark.parametrize(
    ("begin", "end", "lies"),
    [
        *((0, 0, False), (0, 59, False), (0, 61, True), (10, -80, True), (0, 180, True)),
        *((90, 0, False), (90, 170, True)),
    ],
)
def test_robot_lies_whose_gravity_has_turned(short, kind, begin, end, lies):
    pitch = np.radians(np.interp(np.arange(200), [0, 60, 120, 200], [begin, begin, end, end]))
    zero, volts = np.zeros(200), np.full(200, 12.0)
    values = [-9.81 * np.sin(pitch), zero, 9.81 * np.cos(pitch)]
    if kind == "orientation":
        values = [zero, np.sin(pitch / 2), zero, np.cos(pitch / 2)]
    states = tuple(f"{kind}.{axis}" for axis in "xyzw"[: len(values)])
    header = structs.replace(short.header, sources={"board": ("voltage",), "imu": states})
    cycles = np.zeros(200, header.layout.dtype)
    cycles["source_state"], cycles["source_valid"] = np.stack([volts, *values], axis=1), True
    cycles["source_valid"][::3], cycles["source_state"][::3] = False, np.nan
    history = ConductHistory()
    for part in np.split(cycles, 4):
        history.add_slice(replace(short, header=header, cycles=part))
    found = history.summarize_conduct()
    assert found.turned_rad == pytest.approx(abs(np.radians(end - begin)), abs=1e-6)
    assert found.lies is lies


def test_robot_without_an_imu_does_not_fall(short):
    history = ConductHistory()
    history.add_slice(short)
    assert (history.summarize_conduct().turned_rad, history.summarize_conduct().lies) == (None, False)
