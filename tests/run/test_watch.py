"""The rules of watching, without processes: what counts as standing still, and what a wish to stop does."""

import io
import os
import select
import signal
import socket
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import msgspec
import pytest
from msgspec.json import Decoder
from rich.console import Console
from tests.kit.live_run import ROBOT

from dxlrun.channels import child_processes, heartbeat
from dxlrun.channels.child_processes import Cut, LineLost, LineReturned, MessageChannel, Stop
from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import Event, EventBody, EventCode, EventRing, Severity, SimulationStall
from dxlrun.channels.heartbeat import ControllerMethod, Heartbeat, Phase, ProcessorTime, Standstill
from dxlrun.channels.ring import Handover
from dxlrun.compile.simulation import simulation_of
from dxlrun.control.context import StopFlag
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlrun.plan.robot_plan import Plan
from dxlrun.process_table import read_stat
from dxlrun.run import guardian, process_watch, supervisor
from dxlrun.run.guardian import LONGEST_LOOK_NS, Ended, Guardian, GuardianMessage
from dxlrun.run.loop_process import LineReopener, Pulse, StallReport, StopRequest
from dxlrun.run.process_watch import (
    HALTED_NS,
    LEAST_TIMEOUT_NS,
    Duty,
    LoopWatch,
    SignsOfLife,
    WatchedProcess,
    duty_of,
    standstill_timeout_ns,
)
from dxlrun.run.run_processes import create_memory, guardian_job
from dxlrun.run.run_summary import RunOptions
from dxlrun.testing import plan_of
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.exchange import bus_engine
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketLog
from dxlwire.port.ports import StallCounter
from dxlwire.port.reopening import KeptLines

pytestmark = pytest.mark.usefixtures("no_memory_left")

MS = 1_000_000


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    path = tmp_path_factory.mktemp("pair") / "pair.yaml"
    path.write_text(ROBOT)
    return plan_of(path)


@pytest.fixture
def page():
    descriptor = heartbeat.create()
    made = Heartbeat(descriptor)
    os.close(descriptor)
    return made


def test_a_machine_that_slept_is_no_hung_loop():
    """Suspended, paused or starved: the loop could not run either."""
    still = Standstill(LONGEST_LOOK_NS, 0)
    still.ns("same", 0)
    assert still.ns("same", 3_600_000 * MS) == LONGEST_LOOK_NS


def test_a_hung_loop_is_found_by_a_watcher_that_is_always_late():
    still = Standstill(LONGEST_LOOK_NS, 0)
    looks = [still.ns("same", at * 200 * MS) for at in range(10)]
    assert looks[-1] > LEAST_TIMEOUT_NS


def test_what_makes_the_timeout_shorter_is_seen_behind_the_beat_before_it(page, monkeypatch):
    stored, loaded = [], []
    monkeypatch.setattr(heartbeat, "store", lambda words, *word: stored.append((*word, page.beats)))
    monkeypatch.setattr(heartbeat, "load", lambda words, index: loaded.append(index) or words[index])
    page.cycle(1, 0)
    page.beat()
    page.may_take(20 * MS)
    assert stored == [(2, 1, 1), (5, 20 * MS, 2)]  # word, value, and the beats that are seen with it
    assert (page.cycles, page.cycle_ns, loaded) == (0, 0, [2, 5])


# Why it stood still


def stat_line(state: str, start_ticks: int = 5) -> str:
    """Return the line of a process in /proc/PID/stat; parentheses and spaces may be in its name."""
    return f"7 (a) S name) {state} 1 {'0 ' * 17}{start_ticks} 0 0\n"


@pytest.fixture
def processor(tmp_path):
    """Return what makes a process' entry in /proc say so: its processor time, ms, and its state."""
    made = ProcessorTime(tmp_path)

    def shown(run_ms, state):
        (tmp_path / "schedstat").write_text(f"{run_ms * MS} 5 9\n")
        (tmp_path / "stat").write_text(stat_line(state))
        return made

    return shown


def test_a_loop_that_got_no_processor_is_told_from_one_that_hangs(processor, tmp_path):
    processor(100, "R").note_standstill(0)
    processor(110, "R").note_standstill(10 * MS)
    processor(113, "R").note_standstill(20 * MS)
    assert processor(113, "R").starved_ns(80 * MS) == 3 * MS
    assert processor(149, "R").starved_ns(80 * MS) == 39 * MS
    assert processor(150, "R").starved_ns(80 * MS) is None  # it computes and computes
    assert processor(113, "S").starved_ns(80 * MS) is None  # it waits for what does not come
    assert processor(113, "D").starved_ns(80 * MS) is None
    processor(200, "R").note_standstill(0)
    assert processor(200, "R").starved_ns(0) is None
    processor(300, "R").note_standstill(10 * MS)
    made = processor(301, "R")
    assert made.starved_ns(80 * MS) == MS, "each standstill counts from its own begin"
    (tmp_path / "schedstat").unlink()  # a kernel may have none
    assert made.starved_ns(80 * MS) is None


@pytest.mark.parametrize(
    ("priority", "fix"), [(0, "; write loop.scheduler.policy: round_robin to run it"), (32, "")]
)
def test_the_guardian_says_that_other_programs_kept_the_loop_from_running(watcher, processor, priority, fix):
    made, _, page = watcher
    made._job = replace(made._job, plan=replace(made._job.plan, priority=priority))
    page.enter_phase(Phase.RUNNING)
    page.cycle(1, 0)
    page.beat()
    found = []
    for at in range(0, 130 * MS, 10 * MS):
        made._clock = VirtualClock(at)  # type: ignore[assignment]  # as in the fixture
        found.append(reason_to_kill(made, processor(50, "R")))
    assert set(found) == {None, "hung"}
    how = made._how("hung", None)  # type: ignore[arg-type]  # asked of one that ended by itself
    said = " and was killed; it was ready to run but received only 0.0 ms of processor time"
    assert said + fix in how
    assert how.endswith("processor time") == (not fix)


@pytest.mark.parametrize(
    ("phase", "rate", "patience"),
    [
        (Phase.LOADING, 50, 60_000 * MS),
        (Phase.SETUP, 50, 30_000 * MS),  # without torque
        (Phase.ENGAGING, 50, 1000 * MS),
        (Phase.RUNNING, 50, 100 * MS),
        (Phase.RUNNING, 1000, 80 * MS),
        (Phase.STOPPING, 50, 1000 * MS),
        (Phase.DONE, 50, 5000 * MS),
    ],
)
def test_standstill_timeout(phase, rate, patience):
    assert standstill_timeout_ns(phase, 1_000_000_000 // rate) == patience


@pytest.mark.parametrize(("period_ms", "first", "later"), [(2000, 10_000, 10_000), (20, 1000, 100)])
def test_the_first_cycle_may_take_longer_never_less(watcher, period_ms, first, later):
    made, _, page = watcher
    page.may_take(period_ms * MS)
    page.enter_phase(Phase.RUNNING)
    assert made._timeout_ns() == first * MS
    page.cycle(1, 0)
    assert made._timeout_ns() == later * MS


@pytest.mark.parametrize(
    ("phase", "patience", "called", "ending", "how"),
    [
        (
            Phase.LOADING,
            "LOADING_TIMEOUT_NS",
            ControllerMethod.ON_CONFIGURE,
            "unused",
            " in on_configure of controller arm",
        ),
        (Phase.LOADING, "LOADING_TIMEOUT_NS", ControllerMethod.NONE, "unused", ""),
        (Phase.DONE, "ENDING_TIMEOUT_NS", ControllerMethod.NONE, "done", ""),
    ],
)
def test_a_loop_that_never_gets_on_is_ended(  # noqa: PLR0917  fixtures
    plan: Plan,
    monkeypatch: pytest.MonkeyPatch,
    phase: Phase,
    patience: str,
    called: ControllerMethod,
    ending: str,
    how: str,
) -> None:
    """Such as one whose plug-in waits for a server in on_configure, or for a child process at the end."""
    monkeypatch.setattr(process_watch, patience, 100 * MS)
    memory = create_memory(plan)
    page = Heartbeat(memory.heartbeat)
    page.name_controller(1, "arm")
    page.enter_phase(phase)
    page.call(1, called)
    control, terminal = child_processes.message_channel(Decoder(Stop | Cut))
    line, loops_end = child_processes.message_channel(Decoder(LineLost))
    watcher = Guardian(guardian_job(plan, {}, memory, take_over=False), control)
    with terminal, loops_end, subprocess.Popen(["/bin/sleep", "60"]) as loop:
        ended = watcher._watch(loop, KeptLines(()), line)
        assert loop.returncode == -signal.SIGKILL
    control.close()
    line.close()
    assert ended == ending
    assert watcher._how(ended, loop) == f"the loop did not respond for more than 100 ms{how} and was killed"


class Unwatched(LoopWatch):
    """Supervisor and guardian of a test: they respond."""

    def __init__(self) -> None:
        pass

    def duty(self, now_ns: int) -> Duty:
        return Duty.NONE


def no_stalls() -> StallReport:
    return StallReport(StallCounter(), no_events())


def no_events() -> EventRing:
    return EventRing(Handover(lambda kind, payload: None), VirtualClock())


def test_only_a_set_up_is_given_up_and_only_once(page):
    stop = StopFlag(requested=True)
    beat = Pulse(page, stop, Unwatched(), no_events(), no_stalls(), lambda: 0).beat
    for phase in (Phase.LOADING, Phase.RUNNING, Phase.STOPPING):
        page.enter_phase(phase)
        beat()
    page.enter_phase(Phase.SETUP)
    with pytest.raises(StopRequest):
        beat()
    beat()  # torque off goes on beating
    assert page.phase is Phase.STOPPING
    assert page.beats == 5


def test_a_stop_anywhere_in_the_set_up_leaves_no_servo_with_torque(plan, monkeypatch):
    """Ask to stop at the first transaction, at the second ...: until one set-up is through without us."""
    monkeypatch.setattr(bus_engine, "BEAT_NS", 0)
    given = []
    while (found := set_up(plan, len(given) + 1)) is not None:
        given.append(found)
    assert len(given) > 20
    assert any(given)
    assert not all(given)


def set_up(plan: Plan, transactions: int) -> bool | None:
    """Ask to stop after so many; return whether torque had been given, None when the set-up was through."""
    descriptor = heartbeat.create()
    page = Heartbeat(descriptor)
    os.close(descriptor)
    stop = StopFlag()
    pulse = Pulse(page, stop, Unwatched(), no_events(), no_stalls(), lambda: 0)
    count = 0

    def beat() -> None:
        nonlocal count
        count += 1
        stop.requested = count >= transactions
        pulse.beat()

    clock, ledger = VirtualClock(), Ledger()
    buses = [SimulatedBus(config, ledger, 0) for config in simulation_of(plan).buses]
    events = EventRing(Handover(lambda kind, payload: None), clock)
    packets = PacketLog()
    lines = Lines(plan.buses, VirtualPorts(clock, buses), clock, packets, beat)
    hardware = DynamixelHardware(lines, packets, ServoArrays(States.empty(2), Commands.empty(2)), events)
    page.enter_phase(Phase.SETUP)
    try:
        hardware.start(lambda: page.enter_phase(Phase.ENGAGING))
    except StopRequest:
        assert [servo.torque_on for servo in buses[0].servos] == [False, False]
        return any(bytes((24, 1)) in entry.data for entry in ledger.entries if entry.direction == "in")
    return None


def test_a_channel_gives_messages_in_pieces_and_the_last_ones_of_an_end_that_is_gone():
    ours, theirs = child_processes.message_channel(Decoder(GuardianMessage))
    theirs.sendall(b'{"type": "Ended", ')
    assert ours.receive_messages() == []
    theirs.sendall(b'"ending": "done"}\n{"type": "Ended", "ending": "died"}\n')
    theirs.close()
    ours.send_message(Stop())
    assert not ours.closed
    assert ours.receive_messages() == [Ended("done"), Ended("died")]
    assert ours.receive_messages() == []
    assert ours.closed
    ours.close()


# The guardian's judgement, without its processes


def reason_to_kill(made: Guardian, processor: ProcessorTime | None = None) -> str | None:
    """Let a guardian look once, as its loop does."""
    processor = processor or ProcessorTime(Path("none"))
    reason = made._reason_to_kill(duty_of(WatchedProcess.GUARDIAN, made._silent()))
    processor.note_standstill(made._loop_signs.still_ns)
    if reason and not made._killed:
        made._note_standstill(reason, processor)
        made._killed = reason
    return reason


@pytest.fixture
def watcher(plan):
    """A guardian of the robot `pair` on virtual time, the terminal's end of its line, and the loop's page."""
    memory = create_memory(plan)
    control, terminal = child_processes.message_channel(Decoder(Stop | Cut))
    made = Guardian(guardian_job(plan, {}, memory, take_over=False), control)
    made._clock = VirtualClock(0)  # type: ignore[assignment]  # so that the test says how time passes
    made._loop_signs = SignsOfLife(os.getpid(), LONGEST_LOOK_NS, 0)
    with terminal:
        yield made, terminal, Heartbeat(memory.heartbeat)
    control.close()


@pytest.mark.parametrize(
    ("phase", "code", "killed", "ending"),
    [
        (Phase.DONE, 0, None, "done"),
        (Phase.DONE, 1, None, "done"),
        (Phase.DONE, 1, "late", "done"),  # it was through when it was killed
        (Phase.DONE, -11, None, "died"),
        (Phase.DONE, -9, "hung", "done"),  # torque was off before it hung at its exit
        (Phase.DONE, -9, "cut", "cut"),
        (Phase.LOADING, -9, "hung", "unused"),
        (Phase.LOADING, -9, "late", "unused"),
        (Phase.LOADING, 2, None, "unused"),
        (Phase.LOADING, -15, None, "unused"),
        (Phase.SETUP, 1, None, "died"),  # some servos may have torque
        (Phase.RUNNING, 0, None, "died"),
        (Phase.STOPPING, -9, "late", "late"),
    ],
)
def test_a_loop_is_done_only_when_it_reports_it_and_ends_well(watcher, phase, code, killed, ending):
    made, _, page = watcher
    page.enter_phase(phase)
    made._killed = killed
    assert made._ending(code) == ending


def test_a_line_that_is_back_when_the_loop_died_gets_torque_off(watcher, monkeypatch):
    made, _, _ = watcher
    lines = Mock(descriptors=[7], done=(), remarks=())
    lines.returned.side_effect = lambda: lines.descriptors.append(8)
    monkeypatch.setattr(guardian, "KeptLines", lambda *_, **__: lines)
    monkeypatch.setattr(child_processes, "message_channel", lambda _: (Mock(), Mock()))
    monkeypatch.setattr(guardian.realtime_grants, "apply_to_guardian", lambda *_: ())
    for name, value in (("_start_loop", Mock(pid=1)), ("_watch", "died"), ("_how", "it died")):
        monkeypatch.setattr(made, name, Mock(return_value=value))
    made._safe_stop = Mock(apply_final_state=Mock(return_value=()))
    made._control = Mock()
    made.guard_loop()
    assert made._safe_stop.apply_final_state.call_args[0][0] == [7, 8]


def test_the_guardian_runs_one_priority_above_the_loop(watcher):
    assert watcher[0]._job.plan.priority == 32  # the loop of `pair` has 31


def test_a_loop_that_was_asked_to_stop_while_it_loads_is_done(watcher):
    made, _, page = watcher
    page.enter_phase(Phase.LOADING)
    made._stop_by_ns = 5
    assert made._ending(-15) == "done"


@pytest.mark.parametrize(
    ("said", "wish"),
    [
        (b'{"type": "Stop"}\n', "stop"),
        (b'{"type": "Cut"}\n', "cut"),
        (b'{"type": "Stop"}\n{"type": "Cut"}\n', "cut"),  # two interrupts that arrive together
        (None, None),  # the terminal is gone: it is silent from now on
    ],
)
def test_what_the_terminal_asks_for(watcher, said, wish):
    made, terminal, _ = watcher
    if said is None:
        terminal.shutdown(socket.SHUT_RDWR)
    else:
        terminal.sendall(said)
    assert made._request() == wish
    assert made._silent() == ({WatchedProcess.SUPERVISOR} if said is None else set())


def test_a_loop_that_stands_still_hangs_and_one_that_does_not_stop_is_late(watcher):
    made, _, page = watcher
    page.enter_phase(Phase.RUNNING)
    page.cycle(1, 0)
    told = []
    for at_ms in range(0, 130, 10):
        made._clock.wait_until(at_ms * MS)
        told.append(reason_to_kill(made))
    assert told == [None] * 11 + ["hung"] * 2  # five periods of 20 ms
    made._killed = None
    page.beat()
    assert reason_to_kill(made) is None
    made._stop_by_ns = 125 * MS
    page.beat()
    made._clock.wait_until(126 * MS)
    assert reason_to_kill(made) == "late"


# Who acts when others are silent


@pytest.mark.parametrize(
    ("watcher", "silent", "duty"),
    [
        ("guardian", {"supervisor"}, Duty.STOP_LOOP),
        ("supervisor", {"guardian"}, Duty.KILL_GUARDIAN),
        ("loop", {"guardian"}, Duty.NONE),
        ("guardian", {"loop"}, Duty.KILL_LOOP),
        ("loop", {"supervisor", "guardian"}, Duty.END),
        ("guardian", {"supervisor", "loop"}, Duty.KILL_LOOP),
        ("supervisor", {"guardian", "loop"}, Duty.KILL_BOTH),
    ],
)
def test_duty_of_each_survivor(watcher, silent, duty):
    assert duty_of(WatchedProcess(watcher), {WatchedProcess(one) for one in silent}) is duty


@pytest.fixture
def watched(tmp_path):
    """Return what sets the state of process 7 in a table of processes, and the table's folder."""
    (tmp_path / "7").mkdir()

    def write_state(state, start_ticks=5):
        (tmp_path / "7/stat").write_text(stat_line(state, start_ticks))
        return tmp_path

    return write_state


def without_entry(folder: Path) -> None:
    (folder / "7/stat").unlink(missing_ok=True)


def unreadable(folder: Path) -> None:
    """Make the entry one that cannot be read, such as where no descriptor is left for it: EISDIR."""
    without_entry(folder)
    (folder / "7/stat").mkdir()


LATE_NS = 5000 * MS


@pytest.mark.parametrize(
    ("change", "after_ns"),
    [
        *(pytest.param(state, HALTED_NS, id=f"{state}: stopped or dead") for state in "TtZX"),
        *(pytest.param(state, LATE_NS, id=f"{state}: starved at most") for state in "RSD"),
        pytest.param(6, HALTED_NS, id="its ID is that of another process"),
        pytest.param(without_entry, HALTED_NS, id="it has no entry"),
        pytest.param(unreadable, LATE_NS, id="its entry is unreadable"),
        pytest.param("no entry at first", LATE_NS, id="its time of start is unknown"),
        pytest.param("unreadable at first", LATE_NS, id="its time of start was unreadable"),
    ],
)
def test_a_process_is_silent_soon_only_if_it_cannot_run(watched, change, after_ns):
    folder = watched("S")
    if change == "no entry at first":
        without_entry(folder)
    elif change == "unreadable at first":
        unreadable(folder)
    signs = SignsOfLife(7, 100 * MS, 0, folder)
    if change == "unreadable at first":
        (folder / "7/stat").rmdir()
        watched("S")
    elif change in {*"TtZXRSD"}:
        watched(change)
    elif isinstance(change, int):
        watched("S", start_ticks=change)
    elif callable(change):
        change(folder)
    times = range(0, 5300, 50)
    silent = []
    for at_ms in times:
        signs.record_beat("same", at_ms * MS)
        silent.append(signs.is_silent(LATE_NS))
    assert silent == [at_ms * MS > after_ns for at_ms in times]
    signs.record_beat("beat", 5300 * MS)
    assert not signs.is_silent(LATE_NS)


def test_a_loop_that_nobody_looks_at_reads_the_process_table_ten_times_a_second(page, monkeypatch):
    read = []
    monkeypatch.setattr(process_watch, "read_stat", lambda folder: read.append(folder) or read_stat(folder))
    loop_watch = LoopWatch(page, os.getpid(), os.getpid(), MS, 0)
    read.clear()
    for at_ms in range(1250):
        loop_watch.duty(at_ms * MS)
    assert 18 <= len(read) <= 20  # for two processes, in the second after HALTED_NS


class Stopped:
    """A child that a signal has stopped, and that is killed in the end."""

    def __enter__(self) -> int:
        self._child = subprocess.Popen(["/bin/sleep", "60"])
        self._child.send_signal(signal.SIGSTOP)
        os.waitpid(self._child.pid, os.WUNTRACED)
        return self._child.pid

    def __exit__(self, *_: object) -> None:
        self._child.kill()
        self._child.wait()


@pytest.mark.parametrize("beating", ["supervisor", "guardian", "neither"])
def test_a_loop_ends_by_itself_only_when_neither_of_the_others_responds(page, beating):
    with Stopped() as supervisor, Stopped() as guardian:
        loop_watch = LoopWatch(page, supervisor, guardian, 20 * MS, 0)
        duties = []
        for at_ms in range(0, 500, 20):
            if beating == "supervisor":
                page.supervisor_look()
            elif beating == "guardian":
                page.mark_guardian_alive()
            duties.append(loop_watch.duty(at_ms * MS))
    ended = [duty is Duty.END for duty in duties]
    assert ended == [beating == "neither" and at_ms * MS > HALTED_NS for at_ms in range(0, 500, 20)]


def test_a_slow_loop_ends_when_neither_has_responded_for_a_period(page):
    with Stopped() as supervisor, Stopped() as guardian:
        loop_watch = LoopWatch(page, supervisor, guardian, 2000 * MS, 0)
        assert [loop_watch.duty(at_ms * MS) for at_ms in (2000, 4000)] == [Duty.NONE, Duty.END]


def test_a_loop_that_nobody_watches_asks_itself_to_stop_and_reports_why(page):
    stop, reported = StopFlag(), []
    events = EventRing(Handover(lambda kind, payload: reported.append(bytes(payload))), VirtualClock())
    with Stopped() as supervisor, Stopped() as guardian:
        loop_watch = LoopWatch(page, supervisor, guardian, 20 * MS, 0)
        clock = VirtualClock(0)
        beat = Pulse(page, stop, loop_watch, events, no_stalls(), clock.now_ns).beat
        page.enter_phase(Phase.RUNNING)
        while not stop.requested:
            clock.wait_until(clock.now_ns() + 20 * MS)
            beat()
            assert clock.now_ns() < 1000 * MS
        beat()
    assert len(reported) == 1
    assert b"neither the supervisor nor the guardian responds" in reported[0]


def test_a_guardian_stops_the_loop_in_order_when_its_supervisor_was_stopped(watcher):
    made, _, page = watcher
    page.enter_phase(Phase.RUNNING)
    page.cycle(1, 0)
    with Stopped() as supervisor:
        made._supervisor_signs = SignsOfLife(supervisor, LONGEST_LOOK_NS, 0)
        found = []
        for at_ms in range(0, 300, 10):
            made._clock.wait_until(at_ms * MS)
            page.beat()
            found.append(duty_of(WatchedProcess.GUARDIAN, made._silent()) is Duty.STOP_LOOP)
    assert found == [at_ms * MS > HALTED_NS for at_ms in range(0, 300, 10)]


class HangingGuardian:
    """A guardian that neither responds nor is stopped, as on a machine that gives it no processor."""

    def __init__(self, pid: int) -> None:
        self.process = SimpleNamespace(pid=pid)
        self.channel, self.theirs = child_processes.message_channel(Decoder(GuardianMessage))
        self.now_ns = 0
        self.killed_ns = 0

    def poll_message(self, timeout_s: float, *_: int) -> None:
        self.now_ns += round(timeout_s * 1e9)

    def kill(self) -> None:
        self.killed_ns = self.now_ns


@pytest.mark.parametrize(
    ("signals", "loop_exited", "phase", "least_s", "most_s"),
    [
        (2, False, Phase.RUNNING, 0.1, 0.5),
        (2, False, Phase.ENGAGING, 0.1, 0.5),
        (0, True, Phase.RUNNING, 0.1, 0.5),
        (1, False, Phase.RUNNING, 5.0, 5.5),
        (2, False, Phase.LOADING, 5.0, 5.5),
    ],
)
def test_a_supervisor_waits_for_a_guardian_only_shortly_once_torque_is_to_be_cut(  # noqa: PLR0917  fixtures
    plan, monkeypatch, signals, loop_exited, phase, least_s, most_s
):
    memory = create_memory(plan)
    Heartbeat(memory.heartbeat).enter_phase(phase)
    run = supervisor._Run(plan, RunOptions(gateway=False), memory, Console(file=io.StringIO()))
    run.signals = signals
    if loop_exited:
        with subprocess.Popen(["/bin/true"]) as loop:
            run.loop = os.pidfd_open(loop.pid)
    guardian = HangingGuardian(os.getpid())
    monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic_ns=lambda: guardian.now_ns))
    run.watch_guardian(guardian, lambda heartbeat: None)  # type: ignore[arg-type]  # what stands for the guardian
    assert least_s < guardian.killed_ns * 1e-9 <= most_s
    assert run.sentences == ["the guardian stopped watching the loop and was killed"]
    guardian.channel.close()
    guardian.theirs.close()
    if run.loop is not None:
        os.close(run.loop)


@pytest.mark.parametrize(("sentences", "code"), [([], 0), (["3 records are missing in the log"], 1)])
def test_a_run_whose_supervisor_reports_a_failure_has_failed(plan, sentences, code):
    run = supervisor._Run(plan, RunOptions(), create_memory(plan), Console(file=io.StringIO()))
    run.ended, run.sentences = Ended("done"), sentences
    assert supervisor._summary(run).exit_code == code


def test_waits_for_simulated_servos_are_reported_once_a_second() -> None:
    reported: list[Event] = []
    clock = VirtualClock(10**10)

    class Sink:
        def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
            reported.append(Event(clock.now_ns(), event.code, event.severity, source, event.text, data))

    stalls = StallCounter()
    report = StallReport(stalls, Sink())
    for _ in range(3000):  # a wait of 1 ms in every period of 30 ms
        now_ns = clock.now_ns()
        stalls.count(now_ns, now_ns + MS)
        for _look in range(3):
            clock.wait_until(clock.now_ns() + 10 * MS)
            report.report_waits(clock.now_ns())
    report.emit_waits()
    report.emit_waits()  # nothing is left to report
    waited = [msgspec.json.decode(one.data, type=SimulationStall) for one in reported]
    assert 89 <= len(reported) <= 92  # in 90 s
    assert {(one.code, one.severity) for one in reported} == {
        (EventCode.SIMULATION_STALLED, Severity.WARNING)
    }
    assert sum(one.times for one in waited) == 3000
    assert sum(one.waited_ns for one in waited) == 3000 * MS == report.total.waited_ns


def test_looks_at_a_child_leave_no_descriptor_open():
    child = child_processes.Child.__new__(child_processes.Child)
    with subprocess.Popen(["/bin/sleep", "60"]) as child.process:
        opened = os.listdir("/proc/self/fd")
        assert not child.exited()
        child.process.kill()
        assert child.exited(60.0)
        assert os.listdir("/proc/self/fd") == opened


def test_lost_line_is_requested_once_per_loss(tmp_path):
    ours, theirs = socket.socketpair()
    guardian = MessageChannel(theirs, Decoder(LineLost))
    reopen = LineReopener(MessageChannel(ours, Decoder(LineReturned)))
    with open(tmp_path / "line", "w+b") as line:
        for _ in range(2):
            assert reopen(0) is None
            assert reopen(0) is None
            assert select.select([guardian], [], [], 0)[0], "the loss was not reported"
            assert guardian.receive_messages() == [LineLost(0)]
            guardian.send_message(LineReturned(0), [line.fileno()])
            descriptor = reopen(0)
            assert os.fstat(descriptor).st_ino == os.fstat(line.fileno()).st_ino
            os.close(descriptor)
    guardian.close()
    assert reopen(0) is None
    ours.close()
