import io
import re
import resource
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from msgspec import structs
from msgspec.structs import replace
from rich.console import Console
from tests.kit.answers import result_of
from tests.kit.commands import Said

from dxlrun.channels.event_records import (
    RUN_ENDED,
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
from dxlrun.errors import PortError
from dxlrun.log.log_reader import read_log
from dxlrun.plan.machine_load import MachineLoad, SimulationWait
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.run_summary import RunOptions, RunStatusLine, RunSummary, run_verdict
from dxlrun.run.virtual_run import VirtualRobot, run_virtual
from dxlrun.testing import plan_of

Meanwhile = Callable[[float, Callable[[VirtualRobot], object]], None]
GOOD = RunSummary(0, "ended", 100, 2, 2.03, ())


class Runs:
    """Stands in for the supervisor; remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[Plan, RunOptions]] = []
        self.answer: RunSummary | Exception = GOOD

    def run(self, plan: Plan, options: RunOptions, out: Console) -> RunSummary:
        self.asked.append((plan, options))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    runs = Runs()
    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", runs.run)
    return runs


@pytest.fixture
def meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Meanwhile:
    """Return what lets something happen to a robot on virtual time, in a directory of its own."""
    monkeypatch.chdir(tmp_path)

    def meanwhile(at_s: float, happen: Callable[[VirtualRobot], object]) -> None:
        born = VirtualRobot.__init__

        def planned(robot: VirtualRobot, *arguments: object, **options: object) -> None:
            born(robot, *arguments, **options)
            robot.buses[0].at(round(at_s * 1e9), lambda: happen(robot))

        monkeypatch.setattr(VirtualRobot, "__init__", planned)

    return meanwhile


def test_options_reach_plan_and_run(dxlrun: Callable, runs: Runs, torso: Path, three_parts: Path):
    said = dxlrun(torso, "rate:=25", "--play", three_parts, "--duration", "1.5", "--no-record", "--take-over")

    assert said.code == 1, "no motion of the plan began"
    ((plan, options),) = runs.asked
    assert options == RunOptions(record=False, take_over=True, debug=False)
    assert plan.loop.period_ns == 40_000_000
    assert plan.loop.end_ns == 1_500_000_000
    assert {c.controller for c in plan.loop.commands} == {"head", "left_arm", "right_arm"}


def test_a_run_names_its_log_and_what_reads_it(dxlrun: Callable, runs: Runs, torso: Path):
    runs.answer = RunSummary(
        *(0, "ended", 10, 0, 2.03, ()), log="logs/run.mcap", messages=10**9, virtual=True, invalid=(0,) * 8
    )

    said = dxlrun(torso)

    assert said.code == 0
    assert said.out.splitlines() == [
        "bioloid_torso: done: ran for 0.2 s.",
        "  The loop kept 50 Hz: 0 of 10 periods skipped, on virtual time.",
        "  The states of all joints were valid in every cycle.",
        "log: logs/run.mcap (1000000000 messages)",
        "next: dxlrun analyze logs/run.mcap",
    ]


@pytest.mark.needs("report")
@pytest.mark.parametrize("code", [0, 130])
def test_a_run_with_a_loss_in_its_log_has_failed_for_the_terminal_and_for_analyze(
    dxlrun: Callable, torso: Path, meanwhile: Meanwhile, code: int
):
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
    shown = dxlrun("analyze", path, "--report", "run.html")
    assert shown.code == 1
    robot = verdict["sentences"][0]
    assert shown.out.splitlines()[0] == robot
    assert robot in Path("run.html").read_text()


@pytest.mark.parametrize(("code", "word"), [(1, "failed"), (130, "interrupted")])
def test_a_bad_run_prints_the_reason_on_stderr(
    dxlrun: Callable, runs: Runs, torso: Path, code: int, word: str
):
    runs.answer = RunSummary(
        code, "fault", 5, 0, 0.1, ("servo 3 does not answer",), remarks=("no real-time priority",)
    )

    said = dxlrun(torso)

    assert said.code == code
    assert said.out.startswith(f"bioloid_torso: {word}: ran for 0.1 s")
    assert said.errors[1:] == [
        "bioloid_torso: no real-time priority",
        "bioloid_torso: servo 3 does not answer",
    ]


BUSY = MachineLoad(6.0, busy_s=5.2, no_idle_core_s=5.2)
MACHINE = "The machine was too busy: no core was idle in 5.2 of 6 s. End other programs, or use --virtual."


@pytest.mark.parametrize("skipped", [0, 2])
def test_busy_machine_is_the_first_sentence_about_a_run_that_it_disturbed(
    dxlrun: Callable, runs: Runs, torso: Path, skipped: int
):
    runs.answer = RunSummary(0, "ended", 100, skipped, 2.0, (), invalid=(0,) * 8, run_load=BUSY)

    lines = dxlrun(torso).out.splitlines()

    assert (lines[1] == f"  {MACHINE}") is bool(skipped)
    assert ("The machine" in "".join(lines)) is bool(skipped)


def test_wait_for_simulated_servos_names_the_machine(dxlrun: Callable, runs: Runs, torso: Path):
    wait = SimulationWait(210_000_000, 3)
    runs.answer = RunSummary(0, "ended", 100, 3, 2.0, (), simulation_wait=wait)

    assert dxlrun(torso).out.splitlines()[1] == (
        "  The machine was too busy: the loop waited 3 times, 210 ms in all, for the process of the "
        "simulated servos. End other programs, or use --virtual."
    )


def test_busy_machine_comes_before_the_servos_that_refused_a_start(dxlrun: Callable, runs: Runs, torso: Path):
    summary = RunSummary(
        1, "start-up", 0, 0, 0.1, ("no servo answers",), start_up_load=BUSY, refused_for_replies=True
    )
    runs.answer = summary

    assert dxlrun(torso).errors[1:] == [f"bioloid_torso: {MACHINE}", "bioloid_torso: no servo answers"]

    runs.answer = replace(summary, refused_for_replies=False)  # a plug-in that cannot be imported

    assert dxlrun(torso).errors[1:] == ["bioloid_torso: no servo answers"]


@pytest.mark.parametrize(
    ("code", "named"), [(EventCode.SERVO_LOST, True), (EventCode.CONTROLLER_FAULT, False)]
)
def test_busy_machine_is_named_before_errors_that_it_explains(
    dxlrun: Callable, runs: Runs, torso: Path, code: EventCode, named: bool
):
    group = EventGroup(code, Severity.ERROR, "head", 1, 10**9, "no longer there")
    runs.answer = RunSummary(
        1, "stopped", 100, 0, 2.0, (), events=EventTotals((group,)), invalid=(0,) * 8, run_load=BUSY
    )

    assert (MACHINE in dxlrun(torso).out) is named


def test_real_servos_of_a_busy_machine_are_not_to_be_simulated(dxlrun: Callable, runs: Runs, torso: Path):
    runs.answer = RunSummary(0, "ended", 100, 1, 2.0, (), run_load=BUSY)

    assert dxlrun(torso, "port:=/dev/ttyUSB0").out.splitlines()[1].endswith(" s. End other programs.")


def test_a_run_without_a_cycle_suggests_no_analysis(dxlrun: Callable, runs: Runs, torso: Path):
    runs.answer = RunSummary(
        1, "start-up", 0, 0, 0.1, ("servo 3 does not answer",), log="logs/torso.mcap", messages=9
    )

    assert dxlrun(torso).out.splitlines() == [
        "bioloid_torso: failed: the loop never ran a cycle.",
        "log: logs/torso.mcap (9 messages)",
    ]


def test_a_port_that_cannot_be_opened_is_one_sentence(dxlrun: Callable, runs: Runs, torso: Path):
    runs.answer = PortError("port /dev/ttyUSB7 does not exist; plug the adapter in")

    said = dxlrun(torso, "port:=/dev/ttyUSB7")

    assert said.code == 1
    assert said.errors[1:] == ["dxlrun: port /dev/ttyUSB7 does not exist; plug the adapter in"]


def test_virtual_time_runs_in_this_process(
    dxlrun: Callable, torso: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)

    said = dxlrun(torso, "--virtual", "--duration", "1")

    assert said.code == 0
    assert "0 of 50 periods skipped" in said.out
    (log,) = (tmp_path / "logs").glob("*.mcap")

    analyzed = dxlrun("analyze", log)
    assert analyzed.code == 0
    assert "50" in analyzed.out
    assert dxlrun("analyze", log, "--json").out.startswith("{")


TOO_MANY = "The loop did not keep 50 Hz: 300 of 1000 periods skipped (30.00%; 100 tolerated)."
LIMP = EventGroup(EventCode.SERVO_LIMP, Severity.ERROR, "head_pitch_joint", 1, 5_100_000_000, "torque is off")
TAKEOVER = EventGroup(EventCode.TAKEOVER, Severity.WARNING, "reflex", 1, 5_100_000_000, "it falls")
FAULT = EventGroup(EventCode.CONTROLLER_FAULT, Severity.ERROR, "head", 1, 5_100_000_000, "head: nan")


@pytest.mark.parametrize(
    ("counted", "code", "line", "sentence"),
    [
        (
            {"cycles": 100, "skipped": 1},
            0,
            "ran for 2.0 s.",
            "1 of 101 periods skipped (0.99%; 10 tolerated).",
        ),
        ({"cycles": 700, "skipped": 300}, 1, "ran for 20.0 s.", TOO_MANY),
        ({"invalid": (0, 2)}, 0, "ran for 2.0 s.", "0 of 100 periods skipped."),
        ({"invalid": (0, 3)}, 1, "ran for 2.0 s.", "left_shoulder_lateral_joint in 3.0% of the cycles."),
        (
            {"events": EventTotals((LIMP,), started_ns=5_000_000_000)},
            1,
            "head_pitch_joint went limp at 0.1 s; ran for 2.0 s.",
            "head_pitch_joint: torque is off.",
        ),
        (
            {"events": EventTotals((TAKEOVER,), started_ns=5_000_000_000)},
            0,
            "at 0.1 s reflex took over the robot: it falls; ran for 2.0 s.",
            "0 of 100 periods skipped.",
        ),
        ({"events": EventTotals((FAULT,))}, 1, "ran for 2.0 s.", "head: head: nan."),
        (
            {"events": EventTotals(goals=GoalTotals({"accepted": 3, "reached": 1, "cancelled": 1}))},
            0,
            "1 of 2 goals reached.",
            "",
        ),
    ],
)
def test_the_loop_s_own_counts_make_the_verdict(  # noqa: PLR0917  fixtures
    dxlrun: Callable, runs: Runs, torso: Path, counted: dict, code: int, line: str, sentence: str
):
    runs.answer = structs.replace(GOOD, **{"skipped": 0, **counted})
    said = dxlrun(torso, "--no-record")
    assert said.code == code
    first, *others = said.out.splitlines()
    assert first.startswith(f"bioloid_torso: {'failed' if code else 'done'}: ")
    assert first.endswith(line)
    assert any(one.endswith(sentence) for one in others)


def test_a_played_motion_that_missed_its_goal_fails_the_run(
    dxlrun: Callable, runs: Runs, torso: Path, three_parts: Path
):
    plan = plan_of(torso, play=[three_parts])
    own = plan.loop.commands[0].origin

    def ends(
        status: str, origin: str, text: str = "after 2 s, joint elbow is 9.00 deg off", **ran: Any
    ) -> Said:
        history = GoalHistory()
        history.planned = plan.loop.origins
        for command in plan.loop.commands:
            if command.goal is not None:
                history.count_report(
                    GoalReport(1, command.controller, command.kind, command.origin, "accepted")
                )
        history.count_report(GoalReport(1, "left_arm", "trajectory", origin, status, text, "elbow", 0.157))
        runs.answer = structs.replace(GOOD, events=EventTotals(goals=history.totals), **ran)
        return dxlrun(torso, "--play", three_parts)

    assert ends("missed", "a client").code == 0
    for status in ("missed", "aborted"):
        said = ends(status, own)
        assert said.code == 1
        sentence = f"left_arm {status} the goal of its trajectory: after 2 s, joint elbow is 9.00 deg off."
        assert sentence in said.out
    assert ends("reached", own).code == 0
    stopped = ends("aborted", own, RUN_ENDED)
    assert (stopped.code, "The run ended at 2.04 s, before three_parts of " in stopped.out) == (1, True)
    interrupted = ends("aborted", own, RUN_ENDED, exit_code=130, reason="interrupted")
    assert (interrupted.code, interrupted.out.split(": ")[1]) == (130, "interrupted")
    assert ends("missed", own, exit_code=130, reason="interrupted").code == 1


def test_duration_that_cuts_a_played_motion_fails_the_run(dxlrun: Callable, torso: Path, three_parts: Path):
    said = dxlrun(torso, "--virtual", "--play", three_parts, "--duration", "1.5", "--no-record")
    assert said.code == 1
    assert said.out.startswith("bioloid_torso: failed: ran for 1.5 s; 0 of ")
    (sentence,) = [
        line for line in said.out.splitlines() if "by its duration at 1.5 s, before three" in line
    ][:1]
    assert sentence.endswith(" s; omit --duration.")
    assert any("but the run ends at 1.5 s; omit --duration" in line for line in said.errors)


def test_run_that_ends_before_a_motion_begins_fails(dxlrun: Callable, torso: Path, tmp_path: Path):
    motion = tmp_path / "nod.yaml"
    motion.write_text(
        "name: nod\nmotions:\n  - controller: head\n    start: 3 s\n    points:\n"
        "      - {time: 1 s, joints: {head_yaw_joint: {position: 0 deg, velocity: 1 rad/s},"
        " head_pitch_joint: {position: 0 deg, velocity: 1 rad/s}}}\n"
    )
    said = dxlrun(torso, "--virtual", "--play", motion, "--duration", "1", "--no-record")
    assert (said.code, "before nod of head ended at 4 s" in said.out) == (1, True)


def test_a_controller_with_a_fallback_may_fail(torso: Path):
    plan = plan_of(torso)
    failing = next(one for one in plan.loop.controllers if not one.into)
    assert run_verdict(structs.replace(GOOD, events=EventTotals((group(failing.name),))), plan).exit_code == 1
    taken = [structs.replace(one, fallback="hold") for one in plan.loop.controllers]
    caught = structs.replace(plan, loop=structs.replace(plan.loop, controllers=tuple(taken)))
    verdict = run_verdict(structs.replace(GOOD, events=EventTotals((group(failing.name),))), caught)
    reported = f"{failing.name} failed, and a fallback controller took over;"
    assert (verdict.exit_code, reported in verdict.line) == (0, True)
    refused = structs.replace(GOOD, reason="fault", events=EventTotals((group(failing.name),)))
    verdict = run_verdict(refused, caught)
    assert (verdict.exit_code, "fallback" in verdict.line) == (1, False)


def test_a_traceback_with_any_bytes_reaches_the_end_of_the_run():
    written: list[bytes] = []
    ring = EventRing(
        SimpleNamespace(append=lambda _, data: written.append(data)), SimpleNamespace(now_ns=int)
    )
    ring.emit_event("arm", EventBody(EventCode.CONTROLLER_FAULT, Severity.ERROR, "no file \udcff"))
    outcome = msgspec.json.encode(ring.totals)
    assert msgspec.json.decode(outcome, type=EventTotals).errors[0].text == "no file ?"
    assert len(written) == 1


def group(source: str) -> EventGroup:
    """Return the fault of a controller."""
    return structs.replace(FAULT, source=source)


def test_a_loss_without_a_log_is_reported_and_fails_the_run(
    dxlrun: Callable, torso: Path, meanwhile: Meanwhile
):
    meanwhile(1.0, lambda robot: robot.buses[0].servos[1].silence(True))

    printed = [dxlrun(torso, "--virtual", "--duration", "2", *words) for words in ((), ("--no-record",))]

    assert [said.code for said in printed] == [1, 1]
    for said in printed:
        first, lost, *_ = said.out.splitlines()
        # the loop starts some 0.1 s after the bus, as long as the start-up takes
        assert re.match(
            r"bioloid_torso: failed: left_shoulder_lateral_joint was lost at 0\.[89] s; ran for", first
        )
        assert lost.startswith("  left_shoulder_lateral_joint: ")
        assert re.search(
            r"  States were invalid: left_shoulder_lateral_joint in 6\d\.\d% of the cycles", said.out
        )
    assert printed[0].out.splitlines()[:4] == printed[1].out.splitlines()[:4]


def test_virtual_time_ends_with_the_motions(
    dxlrun: Callable, torso: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    motion = tmp_path / "nod.yaml"
    motion.write_text(
        "name: nod\nmotions:\n  - controller: head\n    points:\n"
        "      - {time: 0.2 s, joints: {head_pitch_joint: {position: 5 deg, velocity: 30 deg/s},\n"
        "         head_yaw_joint: {position: 0 deg, velocity: 30 deg/s}}}\n"
    )
    said = dxlrun(torso, "--virtual", "--play", motion, "--no-record")

    assert said.code == 0, said.err


@pytest.mark.parametrize("signals", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_on_virtual_time_with_its_summary_and_log(
    dxlrun: Callable, torso: Path, meanwhile: Meanwhile, number: signal.Signals, signals: int
):
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
    assert recorded.complete
    assert len(recorded.cycles) == cycles
    last_s = recorded.cycles["woken_ns"][-1] / 1e9
    assert 0.96 < last_s < 1.02  # at 50 Hz; the cycle that a second signal breaks off is not recorded
    assert not any(servo.torque_on for servo in robots[0].buses[0].servos)
    assert signal.getsignal(number) is before


def full_disk(log: Path) -> None:
    """Let no file of this process grow beyond what the log has."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))


@pytest.mark.parametrize(
    ("harm", "said_of_it"),
    [
        (Path.unlink, "another program deleted or moved the file during the run"),
        (full_disk, "writing the log stopped: File too large"),
    ],
)
def test_a_log_that_is_gone_or_not_whole_is_no_good_run(
    dxlrun: Callable, torso: Path, meanwhile: Meanwhile, harm: Callable[[Path], None], said_of_it: str
):
    meanwhile(0.5, lambda _: harm(next(Path().glob("logs/*.mcap"))))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        said = dxlrun(torso, "--virtual", "--duration", "1")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    assert said.code == 1
    assert f"bioloid_torso: the log is incomplete: {said_of_it}" in said.errors
    assert said.out.startswith("bioloid_torso: failed: ")
    assert ("next: dxlrun analyze" in said.out) == bool(list(Path().glob("logs/*.mcap")))


class Line:
    """A terminal's status line, and what it showed."""

    def __init__(self, *, terminal: bool = True) -> None:
        self.shown: list[str] = []
        self.console = Console(file=io.StringIO(), force_terminal=terminal)

    def update(self, text: str) -> None:
        self.shown.append(text)


@pytest.mark.parametrize(
    ("virtual", "shown"),
    [
        (False, "bioloid_torso: 3.0 of 9.0 s, 50 periods skipped (Ctrl-C stops)"),
        (
            True,
            "bioloid_torso: 3.0 of 9.0 s, 1.5 x, 50 periods skipped (Ctrl-C stops)",
        ),
    ],
)
def test_progress_counts_skipped_periods(
    torso: Path, monkeypatch: pytest.MonkeyPatch, virtual: bool, shown: str
):
    now = iter((100.0, 100.05, 102.0))
    monkeypatch.setattr("dxlrun.run.run_summary.time.monotonic", lambda: next(now))
    line = Line()
    progress = RunStatusLine(plan_of(torso, duration_s=9.0), line, virtual=virtual)
    progress.ran(1, 0)
    progress.ran(100, 50)

    assert line.shown == [shown]


def test_without_a_terminal_a_line_every_five_seconds_shows_progress(
    torso: Path, monkeypatch: pytest.MonkeyPatch
):
    """Timed by a clock of the test: from 100 s on, one cycle every 20 ms."""
    now = iter([100.0, *(100 + 0.02 * cycle for cycle in range(1, 601))])
    monkeypatch.setattr("dxlrun.run.run_summary.time.monotonic", lambda: next(now))
    line = Line(terminal=False)
    progress = RunStatusLine(plan_of(torso, duration_s=12.0), line)
    for cycle in range(1, 601):
        progress.ran(cycle, 0)

    assert line.shown == []
    assert line.console.file.getvalue().splitlines() == [
        "bioloid_torso: 5.0 of 12.0 s, 0 periods skipped",
        "bioloid_torso: 10.0 of 12.0 s, 0 periods skipped",
    ]


def test_a_run_on_virtual_time_shows_its_progress(torso: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dxlrun.run.run_summary._REFRESH_S", 0.0)
    console = Console(file=io.StringIO())
    line = Line()
    monkeypatch.setattr(console, "status", lambda _: nullcontext(line))
    run_virtual(plan_of(torso, duration_s=0.2), RunOptions(record=False), console)

    assert len(line.shown) == 10
    assert line.shown[-1].startswith("bioloid_torso: 0.2 of 0.2 s, ")
    assert " x, 0 periods skipped (" in line.shown[-1]


def test_what_is_no_log_is_one_sentence(dxlrun: Callable, tmp_path: Path):
    file = tmp_path / "no.mcap"
    file.write_text("this is no log")

    said = dxlrun("analyze", file)

    assert said.code == 2
    assert len(said.errors) == 1
