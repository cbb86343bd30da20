"""Runs at the terminal: what a run is asked for, its verdict, its log, its progress, its signals."""

import io
import re
import resource
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest
from msgspec.structs import replace
from rich.console import Console
from tests.kit.answers import result_of
from tests.kit.commands import Dxlrun, Said
from tests.kit.judges import log_has_every_byte

from dxlrun.channels.event_records import (
    RUN_ENDED,
    CommandOutside,
    EventBody,
    EventCode,
    EventGroup,
    EventRing,
    EventTotals,
    GoalHistory,
    GoalReport,
    GoalTotals,
    Severity,
)
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.log.log_reader import read_log
from dxlrun.plan.machine_load import MachineLoad, SimulationWait
from dxlrun.run.run_summary import RunOptions, RunStatusLine, RunSummary, run_verdict
from dxlrun.run.virtual_run import VirtualRobot, run_virtual
from dxlrun.testing import plan_of
from dxlsim.bus.ledger import read_ledger

Meanwhile = Callable[[float, Callable[[VirtualRobot], object]], None]
GOOD = RunSummary(0, "ended", 100, 2, (), events=EventTotals(goals=GoalTotals()))


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Stand in for the supervisor, which is given a plan and options."""
    runs = Mock(return_value=GOOD)
    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", runs)
    return runs


@pytest.fixture
def meanwhile(reader: Path, monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Return what lets something happen to a robot on virtual time, in a directory of its own."""

    def meanwhile(at_s: float, happen: Callable[[VirtualRobot], object]) -> None:
        born = VirtualRobot.__init__

        def planned(robot: VirtualRobot, *arguments: object, **options: object) -> None:
            born(robot, *arguments, **options)  # type: ignore[arg-type]
            robot.buses[0].at(round(at_s * 1e9), lambda: happen(robot))

        monkeypatch.setattr(VirtualRobot, "__init__", planned)

    return meanwhile


def test_options_reach_plan_and_run(dxlrun: Dxlrun, runs: Mock, torso: Path, three_parts: Path) -> None:
    said = dxlrun(torso, "rate:=25", "--play", three_parts, "--duration", "1.5", "--no-record", "--take-over")
    assert said.code == 1, "no motion of the plan began"
    (plan, options, _), _ = runs.call_args
    assert options == RunOptions(record=False, take_over=True, debug=False)
    assert (plan.loop.period_ns, plan.loop.end_ns) == (40_000_000, 1_500_000_000)
    assert {c.controller for c in plan.loop.commands} == {"head", "left_arm", "right_arm"}


# What a run says

BUSY = MachineLoad(6.0, busy_s=5.2, no_idle_core_s=5.2)
MACHINE = "The machine was too busy: no core was idle in 5.2 of 6 s. End other programs, or use --virtual."
WAITED = (
    "The machine was too busy: the loop waited 3 times, 210 ms in all, for the process of the simulated "
    "servos. End other programs, or use --virtual."
)
SILENT = RunSummary(1, "start-up", 0, 0, ("servo 3 does not answer",))
FAULT = EventGroup(EventCode.CONTROLLER_FAULT, Severity.ERROR, "head", 1, 5_100_000_000, "head: nan")
LIMP = EventGroup(EventCode.SERVO_LIMP, Severity.ERROR, "head_pitch_joint", 1, 5_100_000_000, "torque is off")
LOST = EventGroup(EventCode.SERVO_LOST, Severity.ERROR, "head", 1, 10**9, "no longer there")
TAKEOVER = EventGroup(EventCode.TAKEOVER, Severity.WARNING, "reflex", 1, 5_100_000_000, "it falls")
EXPIRED = EventGroup(
    EventCode.STALE_COMMAND, Severity.WARNING, "loop", 1, 5_100_000_000, "no client is there"
)
KEPT = "The loop kept 50 Hz: 0 of 100 periods skipped."
VALID = (0,) * 8


def totals(group: EventGroup) -> EventTotals:
    return EventTotals((group,), started_ns=5_000_000_000)


@pytest.mark.parametrize(
    ("changed", "code", "shown"),
    [
        ({"skipped": 1}, 0, ["done: ran for 2.0 s.", "1 of 101 periods skipped (0.99%; 10 tolerated)."]),
        (
            {"cycles": 700, "skipped": 300},
            1,
            ["ran for 20.0 s.", "did not keep 50 Hz: 300 of 1000 periods skipped (30.00%; 100 tolerated)."],
        ),
        ({"paused": 60}, 0, ["done: ran for 0.8 s and was paused for 1.2 s.", KEPT]),
        (
            {"outside": (*[CommandOutside(0, 1.0472, 9)] * 3, CommandOutside(0, 57.3, 90))},
            0,
            [
                "ran for 2.0 s.",
                "left_shoulder_swing_joint was commanded to 57.3 rad, outside of its limits "
                "-3.142..1.047 rad; clamped in 90 cycles.",
            ],
        ),
        ({"invalid": (0, 2)}, 0, ["ran for 2.0 s.", KEPT]),
        ({"invalid": (0, 3)}, 1, ["ran for 2.0 s.", "left_shoulder_lateral_joint in 3.0% of the cycles."]),
        (
            {"events": totals(LIMP)},
            1,
            [
                "failed: head_pitch_joint went limp at 0.1 s; ran for 2.0 s.",
                "head_pitch_joint: torque is off.",
            ],
        ),
        (
            {"events": EventTotals((replace(LOST, source="neck", t_ns=3 * 10**9), LOST))},
            1,
            ["neck, head were lost at 1.0 s"],
        ),
        (
            {"events": totals(TAKEOVER)},
            0,
            ["done: at 0.1 s reflex took over the robot: it falls; ran for 2.0 s.", KEPT],
        ),
        ({"events": totals(EXPIRED)}, 0, ["done: at 0.1 s no client is there; ran for 2.0 s.", KEPT]),
        ({"events": totals(FAULT)}, 1, ["ran for 2.0 s.", "head: head: nan."]),
        (
            {
                "events": EventTotals(
                    goals=GoalTotals({"accepted": 4, "reached": 1, "cancelled": 1, "refused": 1})
                )
            },
            0,
            ["1 of 2 goals reached.", KEPT],
        ),
        (
            {"log": "logs/run.mcap", "messages": 10**9, "virtual": True, "invalid": VALID},
            0,
            [
                "bioloid_torso: done: ran for 2.0 s.",
                "  The loop kept 50 Hz: 0 of 100 periods skipped, on virtual time.",
                "  The states of all joints were valid in every cycle.",
                "log: logs/run.mcap (1000000000 messages)",
                "next: dxlrun analyze logs/run.mcap",
            ],
        ),
        ({"run_load": BUSY, "invalid": VALID}, 0, ["ran for 2.0 s.", KEPT]),
        ({"run_load": BUSY, "skipped": 2, "invalid": VALID}, 0, ["ran for 2.0 s.", f"  {MACHINE}"]),
        ({"skipped": 3, "simulation_wait": SimulationWait(210_000_000, 3)}, 0, ["ran for 2.", f"  {WAITED}"]),
        ({"run_load": BUSY, "events": totals(LOST), "invalid": VALID}, 1, ["head was lost", f"  {MACHINE}"]),
        (
            {"run_load": BUSY, "events": totals(FAULT), "invalid": VALID},
            1,
            ["ran for 2.0 s.", "head: head: nan."],
        ),
    ],
)
def test_counts_and_events_of_a_run_make_its_verdict(
    *, dxlrun: Dxlrun, runs: Mock, torso: Path, changed: dict[str, Any], code: int, shown: list[str]
) -> None:
    runs.return_value = replace(GOOD, **{"skipped": 0, **changed})
    said = dxlrun(torso)
    assert said.code == code
    first, *lines = said.out.splitlines()
    assert first.startswith(f"bioloid_torso: {'failed' if code else 'done'}: ")
    assert shown[0] in first
    rest = iter(lines)
    assert [one for one in shown[1:] if not any(one in line for line in rest)] == [], said.out
    assert ("machine" in said.out) == (" machine " in " ".join(shown))
    assert said.out.count("outside") == " ".join(shown).count("outside")


@pytest.mark.parametrize(
    ("answer", "out", "errors"),
    [
        (
            replace(GOOD, exit_code=1, reason="fault", sentences=("servo 3 does not answer",)),
            "failed: ",
            None,
        ),
        (replace(GOOD, exit_code=130, sentences=("servo 3 does not answer",)), "interrupted: ", None),
        (
            replace(SILENT, log="logs/torso.mcap", messages=9),
            "failed: the loop never ran a cycle.\nlog: ",
            None,
        ),
        (replace(SILENT, start_up_load=BUSY, refused_for_replies=True), "failed: ", [MACHINE]),
        (replace(SILENT, start_up_load=BUSY), "failed: ", []),  # a plug-in that cannot be imported
        (replace(GOOD, exit_code=1, remarks=("no real-time priority",)), "", ["no real-time priority"]),
    ],
)
def test_bad_run_prints_the_reason_on_stderr(
    *, dxlrun: Dxlrun, runs: Mock, torso: Path, answer: RunSummary, out: str, errors: list[str] | None
) -> None:
    runs.return_value = answer
    said = dxlrun(torso)
    assert said.code == answer.exit_code
    assert said.out.startswith(f"bioloid_torso: {out}")
    assert said.errors[1:] == [f"bioloid_torso: {one}" for one in (*(errors or ()), *answer.sentences)]
    assert "next: " not in said.out


def test_real_servos_of_a_busy_machine_are_not_to_be_simulated(
    dxlrun: Dxlrun, runs: Mock, torso: Path
) -> None:
    runs.return_value = replace(GOOD, run_load=BUSY)
    assert dxlrun(torso, "port:=/dev/ttyUSB0").out.splitlines()[1].endswith(" s. End other programs.")


def test_played_motion_that_missed_its_goal_fails_the_run(
    dxlrun: Dxlrun, runs: Mock, torso: Path, three_parts: Path
) -> None:
    plan = plan_of(torso, play=[three_parts])
    own = plan.loop.commands[0].origin
    off = "after 2 s, joint elbow is 9.00 deg off"

    def ends(status: str, origin: str, text: str = off, **ran: Any) -> Said:
        history = GoalHistory()
        history.planned = plan.loop.origins
        for one in plan.loop.commands:
            if one.goal is not None:
                history.count_report(GoalReport(1, one.controller, one.kind, one.origin, "accepted"))
        history.count_report(GoalReport(1, "left_arm", "trajectory", origin, status, text, "elbow", 0.157))
        runs.return_value = replace(GOOD, events=EventTotals(goals=history.totals), **ran)
        return dxlrun(torso, "--play", three_parts)

    assert ends("missed", "a client").code == 0
    for status in ("missed", "aborted"):
        said = ends(status, own)
        assert said.code == 1
        assert f"left_arm {status} the goal of its trajectory: {off}." in said.out
    assert ends("reached", own).code == 0
    stopped = ends("aborted", own, RUN_ENDED)
    assert (stopped.code, "The run ended at 2.04 s, before three_parts of " in stopped.out) == (1, True)
    interrupted = ends("aborted", own, RUN_ENDED, exit_code=130, reason="interrupted")
    assert (interrupted.code, interrupted.out.split(": ")[1]) == (130, "interrupted")
    assert ends("missed", own, exit_code=130, reason="interrupted").code == 1


def test_goals_of_a_loop_that_was_killed_are_unknown(
    dxlrun: Dxlrun, runs: Mock, torso: Path, three_parts: Path
) -> None:
    runs.return_value = replace(GOOD, exit_code=1, reason="fault", events=EventTotals(), log="a.mcap")
    unknown = "reached their goals is unknown: the loop did not say so; dxlrun analyze a.mcap reads it from"
    assert unknown in (said := dxlrun(torso, "--play", three_parts)).out
    assert (said.code, "never began" in said.out) == (1, False)
    assert "unknown" not in dxlrun(torso).out


def test_controller_with_a_fallback_may_fail(torso: Path) -> None:
    plan = plan_of(torso)
    failing = next(one for one in plan.loop.controllers if not one.into)
    failed = replace(GOOD, events=EventTotals((replace(FAULT, source=failing.name),)))
    taken = tuple(replace(one, fallback="hold") for one in plan.loop.controllers)
    caught = replace(plan, loop=replace(plan.loop, controllers=taken))
    assert run_verdict(failed, plan).exit_code == 1
    verdict = run_verdict(failed, caught)
    reported = f"{failing.name} failed, and a fallback controller took over;"
    assert (verdict.exit_code, reported in verdict.line) == (0, True)
    verdict = run_verdict(replace(failed, reason="fault"), caught)
    assert (verdict.exit_code, "fallback" in verdict.line) == (1, False)


def event_ring(append: Callable[[object, bytes], None]) -> EventRing:
    log: Any = SimpleNamespace(append=append, now_ns=int)
    return EventRing(log, log)


def test_traceback_with_any_bytes_reaches_the_end_of_the_run() -> None:
    written: list[bytes] = []
    ring = event_ring(lambda _, data: written.append(data))
    ring.emit_event("arm", EventBody(EventCode.CONTROLLER_FAULT, Severity.ERROR, "no file \udcff"))
    outcome = msgspec.json.encode(ring.totals)
    assert msgspec.json.decode(outcome, type=EventTotals).named[0].text == "no file ?"
    assert len(written) == 1


def test_totals_have_the_expiry_of_a_pause_but_not_of_a_stream() -> None:
    ring = event_ring(lambda *_: None)
    for source in ("arm", "loop"):
        ring.emit_event(source, EventBody(EventCode.STALE_COMMAND, Severity.WARNING, "ended"))
    assert [one.source for one in ring.totals.named] == ["loop"]


# On virtual time


@pytest.mark.needs("report")
@pytest.mark.parametrize("code", [0, 130])
def test_run_with_a_loss_in_its_log_has_failed_for_the_terminal_and_for_analyze(
    dxlrun: Dxlrun, torso: Path, meanwhile: Meanwhile, code: int
) -> None:
    meanwhile(0.3, lambda robot: robot.buses[0].servos[0].trigger_overload())
    if code == 130:
        meanwhile(1.5, lambda _: signal.raise_signal(signal.SIGINT))
    said = dxlrun(torso, "--virtual", "--duration", "2")
    assert said.code == 1
    first, *sentences, log, _ = said.out.splitlines()
    assert first.startswith("bioloid_torso: failed: left_shoulder_swing_joint went limp at 0.")
    assert sentences[0].startswith("  left_shoulder_swing_joint: ")
    path = log.split()[1]
    printed = dxlrun("analyze", path, "--json")
    verdict = result_of(printed.out)["verdict"]
    assert (printed.code, verdict["good"]) == (1, False)
    if code:
        return
    shown = dxlrun("analyze", path, "--report", "run.html")
    assert (shown.code, shown.out.splitlines()[0]) == (1, verdict["sentences"][0])
    assert verdict["sentences"][0] in Path("run.html").read_text()


def test_loss_without_a_log_is_reported_and_fails_the_run(
    dxlrun: Dxlrun, torso: Path, meanwhile: Meanwhile
) -> None:
    meanwhile(1.0, lambda robot: robot.buses[0].servos[1].silence(True))
    printed = [dxlrun(torso, "--virtual", "--duration", "2", *words) for words in ((), ("--no-record",))]
    assert [said.code for said in printed] == [1, 1]
    # the loop starts some 0.1 s after the bus, as long as the start-up takes
    lost = r"bioloid_torso: failed: left_shoulder_lateral_joint was lost at 0\.[89] s; ran for .*\n"
    assert re.match(rf"{lost}  left_shoulder_lateral_joint: ", printed[0].out)
    assert re.search(r"  States were invalid: left_shoulder_lateral_joint in 6\d\.\d% of", printed[0].out)
    assert printed[0].out.splitlines()[:4] == printed[1].out.splitlines()[:4]


def nod(start: str, time: str) -> str:
    """Return a motion file of the head."""
    joints = [f"head_{axis}_joint: {{position: 5 deg, velocity: 30 deg/s}}" for axis in ("pitch", "yaw")]
    point = f"{{time: {time}, joints: {{{', '.join(joints)}}}}}"
    return f"name: nod\nmotions:\n  - {{controller: head, start: {start}, points: [{point}]}}\n"


def test_motion_decides_when_a_run_ends_and_fails_it_when_it_is_cut(
    dxlrun: Dxlrun, torso: Path, reader: Path, three_parts: Path
) -> None:
    (reader / "nod.yaml").write_text(nod("0 s", "0.2 s"))
    (reader / "late.yaml").write_text(nod("3 s", "1 s"))
    words = (torso, "--virtual", "--no-record", "--play")
    said = dxlrun(*words, "nod.yaml")
    assert (said.code, "1 of 1 goal reached" in said.out) == (0, True), said
    said = dxlrun(*words, "late.yaml", "--duration", "1")
    assert (said.code, "before late of head ended at 4 s" in said.out) == (1, True), said
    said = dxlrun(*words, three_parts, "--duration", "1.5")
    assert said.code == 1
    assert said.out.startswith("bioloid_torso: failed: ran for 1.5 s; 0 of ")
    assert re.search(
        r"by its duration at 1\.5 s, before three.* s; omit --duration\.$", said.out, re.MULTILINE
    )
    assert any("but the run ends at 1.5 s; omit --duration" in line for line in said.errors)


@pytest.mark.parametrize("signals", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_run_on_virtual_time_with_its_summary_and_log(
    dxlrun: Dxlrun, torso: Path, meanwhile: Meanwhile, number: signal.Signals, signals: int
) -> None:
    robots, went_on = [], []

    def interrupt(robot: VirtualRobot) -> None:
        robots.append(robot)
        for _ in range(signals):
            signal.raise_signal(number)
        went_on.append(True)

    meanwhile(1.0, interrupt)
    before = signal.getsignal(number)
    said = dxlrun(torso, "--virtual", "--duration", "1e6")
    assert said.code == 130, said.err
    assert bool(went_on) == (signals == 1)
    assert [line for line in said.errors if "warning" not in line] == []
    first, *_, log, _ = said.out.splitlines()
    assert first.startswith("bioloid_torso: interrupted: ran for ")
    (cycles,) = map(int, re.findall(r": 0 of (\d+) periods skipped", said.out))
    recorded = read_log(Path(log.split()[1]))
    assert (recorded.complete, len(recorded.cycles)) == (True, cycles)
    last_s = recorded.cycles["woken_ns"][-1] / 1e9
    assert 0.96 < last_s < 1.02  # at 50 Hz; the cycle that a second signal breaks off is not recorded
    assert not any(servo.torque_on for servo in robots[0].buses[0].servos)
    assert signal.getsignal(number) is before


def full_disk(log: Path) -> None:
    """Let no file of this process grow beyond what the log has."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (Path.unlink, "another program deleted or moved the file during the run"),
        (full_disk, "writing the log stopped: File too large"),
    ],
)
def test_run_whose_log_is_gone_or_not_whole_is_not_good(
    dxlrun: Dxlrun, torso: Path, meanwhile: Meanwhile, harm: Callable[[Path], None], reason: str
) -> None:
    meanwhile(0.5, lambda _: harm(next(Path().glob("logs/*.mcap"))))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        said = dxlrun(torso, "--virtual", "--duration", "1")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert said.code == 1
    assert f"bioloid_torso: the log is incomplete: {reason}" in said.errors
    assert said.out.startswith("bioloid_torso: failed: ")
    assert ("next: dxlrun analyze" in said.out) == bool(list(Path().glob("logs/*.mcap")))


# Progress


class Line:
    """A terminal's status line, and what it showed."""

    def __init__(self, *, terminal: bool = True) -> None:
        self.shown: list[str] = []
        self.file = io.StringIO()
        self.console = Console(file=self.file, force_terminal=terminal)

    def update(self, text: str) -> None:
        self.shown.append(text)


@pytest.mark.parametrize(("virtual", "factor"), [(False, ""), (True, "1.5 x, ")])
def test_progress_counts_skipped_periods(
    torso: Path, monkeypatch: pytest.MonkeyPatch, virtual: bool, factor: str
) -> None:
    now = iter((100.0, 100.05, 102.0))
    monkeypatch.setattr("dxlrun.run.run_summary.time.monotonic", lambda: next(now))
    line = Line()
    progress = RunStatusLine(plan_of(torso, duration_s=9.0), line, virtual=virtual)  # type: ignore[arg-type]
    progress.ran(1, 0)
    progress.ran(100, 50)
    assert line.shown == [f"bioloid_torso: 3.0 of 9.0 s, {factor}50 periods skipped (Ctrl-C stops)"]


def test_without_a_terminal_a_line_every_five_seconds_shows_progress(
    torso: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Timed by a clock of the test: from 100 s on, one cycle every 20 ms."""
    now = iter([100.0, *(100 + 0.02 * cycle for cycle in range(1, 601))])
    monkeypatch.setattr("dxlrun.run.run_summary.time.monotonic", lambda: next(now))
    line = Line(terminal=False)
    progress = RunStatusLine(plan_of(torso, duration_s=12.0), line)  # type: ignore[arg-type]
    for cycle in range(1, 601):
        progress.ran(cycle, 0)
    assert line.shown == []
    assert line.file.getvalue().splitlines() == [
        "bioloid_torso: 5.0 of 12.0 s, 0 periods skipped",
        "bioloid_torso: 10.0 of 12.0 s, 0 periods skipped",
    ]


def test_run_on_virtual_time_shows_its_progress(torso: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dxlrun.run.run_summary._REFRESH_S", 0.0)
    console, line = Console(file=io.StringIO()), Line()
    monkeypatch.setattr(console, "status", lambda _: nullcontext(line))
    # The run uses the plug-ins that were loaded to compile it.
    monkeypatch.delattr("dxlrun.run.virtual_run.load_plugins")
    run_virtual(plan_of(torso, duration_s=0.2), load_plugins(), RunOptions(record=False), console)
    assert len(line.shown) == 10
    assert re.fullmatch(r"bioloid_torso: 0\.2 of 0\.2 s, .* x, 0 periods skipped \(.*", line.shown[-1])


@pytest.mark.parametrize("virtual", [True, False])
@pytest.mark.usefixtures("reader")
def test_the_log_of_a_run_is_what_its_buses_saw(dxlrun: Callable, torso: Path, *, virtual: bool):
    dxlrun(torso, "--duration", "0.3", "--ledger", "seen.jsonl", *(["--virtual"] if virtual else []))
    (log,) = Path("logs").iterdir()  # no ledger beside the log
    log_has_every_byte(read_log(log), read_ledger(Path("seen.jsonl")))
