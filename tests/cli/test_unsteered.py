"""Runs that cannot be steered: `dxlrun list` names them, `dxlrun stop` ends them."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.commands import Dxlrun

from dxlrun import process_table
from dxlrun.channels.heartbeat import GatewayAvailability, Phase, is_starting
from dxlrun.process_table import SUPERVISOR as SUPERVISOR_ROLE
from dxlrun.process_table import FoundRun, ProcessStat, RunProcess
from dxlrun.remote.sockets import await_sockets, create_listener
from dxlrun.run.unsteered import unsteered_runs

Begin = Callable[..., subprocess.Popen[str]]
LOOP = """\
import os, signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
plan = os.memfd_create("dxlrun-plan")
os.pwrite(plan, b'{"robot":"ROBOT","loop":{}}', 0)
print("ready", flush=True)
while True:
    signal.pause()
"""
SUPERVISOR = """\
import os, struct, subprocess, sys
plan = os.memfd_create("dxlrun-plan")
os.pwrite(plan, b'{"robot":"ROBOT","loop":{}}', 0)
page = os.memfd_create("dxlrun-heartbeat")
os.pwrite(page, struct.pack("Q7QQ", PHASE, *[0] * 7, STEERING), 0)
source = "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit()); "
source += "print('ready', flush=True); sys.stdin.read()"
loop = [sys.executable, "-c", source, "dxlrun.run.loop_process"]
sys.exit(subprocess.Popen(loop, stdin=subprocess.PIPE, pass_fds=[plan]).wait())  # it ends with this process
"""
EARLY = """\
import signal
print("ready", flush=True)
while True:
    signal.pause()
"""
NO_GATEWAY = "runs but cannot be steered: it has no gateway; end it by `dxlrun stop"
LOST = "it has no supervisor and no guardian and no gateway"


@pytest.fixture
def begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Begin]:
    """Start a stand-in for a process of a run; a loop is known by its last word, a supervisor by its file."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    program = tmp_path / "bin/dxlrun"
    program.parent.mkdir()
    with ExitStack() as stack:

        def begin(robot: str, source: str = LOOP, **values: int) -> subprocess.Popen[str]:
            for name, value in {"ROBOT": robot, **values}.items():
                source = source.replace(name, str(value))
            program.write_text(source)
            command = [program, "arm.yaml"] if values else ["-c", source, "dxlrun.run.loop_process"]
            child = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)
            stack.enter_context(child)
            stack.callback(child.kill)
            assert child.stdout
            assert child.stdout.readline() == "ready\n"
            return child

        yield begin


def test_loop_without_the_rest_of_its_run_is_named_and_ended(dxlrun: Dxlrun, begin: Begin) -> None:
    loop = begin("lonely_arm")
    fix = "end it by `dxlrun stop --robot lonely_arm`"
    named = f"dxlrun: lonely_arm runs but cannot be steered: {LOST}; {fix}\n"
    assert dxlrun("list") == (0, "", named)
    for words in (("list", "--robot", "lonely_arm"), ("halt",), ("halt", "--robot", "lonely_arm")):
        assert dxlrun(*words) == (1, "", named)
    assert dxlrun("stop") == (0, f"lonely_arm has ended; it could not be steered: {LOST}\n", "")
    assert loop.wait(DEADLINE_S) == 0
    assert "no running robot found" in dxlrun("list").out


@pytest.mark.parametrize(
    ("phase", "steering", "said"),
    [
        (Phase.LOADING, GatewayAvailability.IMPOSSIBLE, NO_GATEWAY),
        (Phase.RUNNING, GatewayAvailability.AWAITED, "is starting; try again when it runs"),
        (Phase.RUNNING, GatewayAvailability.IMPOSSIBLE, NO_GATEWAY),
        (Phase.DONE, GatewayAvailability.POSSIBLE, "is ending"),
        (Phase.DONE, GatewayAvailability.IMPOSSIBLE, "is ending"),
    ],
)
def test_only_a_run_without_a_gateway_gets_the_advice_to_stop_it(
    dxlrun: Dxlrun, begin: Begin, phase: Phase, steering: GatewayAvailability, said: str
) -> None:
    begin("young_arm", SUPERVISOR, PHASE=int(phase), STEERING=int(steering))
    err = dxlrun("list").err
    assert err.startswith(f"dxlrun: young_arm {said}")
    assert ("dxlrun stop" in err) == ("dxlrun stop" in said)


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("ends", [True, False])
def test_client_waits_while_a_robot_starts(
    dxlrun: Dxlrun,
    begin: Begin,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    *,
    early: bool,
    ends: bool,
) -> None:
    """Early: the process still reads the robot file, so the robot's name is not known yet."""
    awaited = {"PHASE": int(Phase.LOADING), "STEERING": int(GatewayAvailability.AWAITED)}
    child = begin("young_arm", EARLY if early else SUPERVISOR, **awaited)
    assert ("a robot is starting; try again" in dxlrun("list").out) == early
    waits = []

    def sleep(_: float) -> None:
        waits.append("slept")
        if ends:
            child.kill()
            child.wait(DEADLINE_S)
        else:
            listeners.append(create_listener("young_arm")[0])

    listeners: list[socket.socket] = []
    monkeypatch.setattr("dxlrun.remote.sockets.time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
    found = await_sockets("young_arm")
    assert ([*found], waits) == ([] if ends else ["young_arm"], ["slept"])
    assert caplog.messages == ["waiting for young_arm, which is starting"]
    for each in listeners:
        each.close()


def test_client_gives_up_a_start_that_hangs(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    passed = [0.0]
    clock = SimpleNamespace(sleep=lambda _: passed.append(passed[-1] + 50.0), monotonic=lambda: passed[-1])
    monkeypatch.setattr("dxlrun.remote.sockets.time", clock)
    monkeypatch.setattr("dxlrun.remote.sockets.is_awaited", lambda robot: True)
    assert await_sockets("hung_arm") == {}
    assert passed == [0.0, 50.0, 100.0, 150.0]
    assert caplog.messages == ["waiting for hung_arm, which is starting"]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("/usr/bin/python3 /home/me/bin/dxlrun arm.yaml", True),
        ("python3.12 -m dxlrun arm.yaml port:=sim", True),
        ("python3 dxlrun arm.yaml --virtual", False),
        ("python3 dxlrun check arm.yaml", False),
        ("uv run dxlrun arm.yaml", False),
        ("timeout 60 dxlrun arm.yaml", False),
        ("", False),
    ],
)
@pytest.mark.parametrize("readable", [True, False])
def test_client_waits_for_no_parent_of_a_run_and_no_process_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, *, found: bool, readable: bool
) -> None:
    """The descriptors of another user's process cannot be read, so its run would never get a plan."""
    for name in ("12", "self"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cmdline").write_text("\0".join(words.split()))
        (tmp_path / name / "stat").write_text(f"12 (python3) S{' 1' * 20}")
        (tmp_path / name / "environ").write_text("XDG_RUNTIME_DIR=/run/user/7")
        if readable:
            (tmp_path / name / "fd").mkdir()
    monkeypatch.setattr(process_table, "PROC", tmp_path)
    assert process_table.start_directories() == ({"/run/user/7"} if found and readable else set())


@pytest.mark.parametrize("role", [SUPERVISOR_ROLE, "gateway"])
def test_run_with_a_stopped_process_does_not_start(role: str) -> None:
    states = {SUPERVISOR_ROLE: "S", "gateway": "S"}
    for state, starts in (("S", True), ("T", False)):
        found = (states | {role: state}).items()
        processes = tuple(RunProcess(0, each, ProcessStat(letter, 1, 1)) for each, letter in found)
        assert is_starting(FoundRun("arm", processes, "")) == starts


@pytest.mark.parametrize("stopped", ["loop", "supervisor"])
def test_stop_continues_a_stopped_process_to_its_end(
    dxlrun: Dxlrun, begin: Begin, monkeypatch: pytest.MonkeyPatch, stopped: str
) -> None:
    monkeypatch.setattr("dxlrun.run.unsteered._END_S", 60.0)
    without = {"PHASE": int(Phase.RUNNING), "STEERING": int(GatewayAvailability.IMPOSSIBLE)}
    child = begin("held_arm") if stopped == "loop" else begin("held_arm", SUPERVISOR, **without)
    child.send_signal(signal.SIGSTOP)
    os.waitpid(child.pid, os.WUNTRACED)
    said = dxlrun("stop", "--robot", "held_arm")
    assert said.code == 0, said.err
    assert said.out.startswith("held_arm has ended; it could not be steered: ")
    assert stopped != "loop" or f"its loop (process {child.pid}) is stopped" in said.out
    assert child.wait(DEADLINE_S) == 0


def test_run_of_another_runtime_directory_is_ended_by_name_only(
    dxlrun: Dxlrun, begin: Begin, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loop = begin("far_arm")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "bin"))
    assert "no running robot found" in dxlrun("stop").err
    assert "far_arm" not in dxlrun("list").err
    assert dxlrun("stop", "--robot", "far_arm").code == 0
    assert loop.wait(DEADLINE_S) == 0


def test_several_runs_are_not_ended_without_a_name(dxlrun: Dxlrun, begin: Begin) -> None:
    loops = begin("left_arm"), begin("right_arm")
    said = dxlrun("stop")
    assert (said.code, "--robot left_arm, --robot right_arm" in said.err) == (2, True)
    assert [loop.poll() for loop in loops] == [None, None]


def test_runs_of_one_name_have_their_process_in_it(dxlrun: Dxlrun, begin: Begin) -> None:
    """Unless one of them is the only one that is left, and none listens under the name."""
    loops = begin("twin_arm"), begin("twin_arm")
    names = [f"twin_arm-{loop.pid}" for loop in loops]
    said = dxlrun("stop", "--robot", "twin_arm")
    assert (said.code, all(f"--robot {name}" in said.err for name in names)) == (2, True)
    assert [loop.poll() for loop in loops] == [None, None]
    assert dxlrun("stop", "--robot", names[0]).out.startswith(names[0])
    assert loops[0].wait(DEADLINE_S) == 0
    with create_listener("twin_arm")[0]:
        found = [one.name for one in unsteered_runs() if one.run.robot == "twin_arm"]
        assert found == names[1:]
    assert dxlrun("stop", "--robot", names[1]).out.startswith("twin_arm has ended")


def test_process_that_does_not_end_is_named_with_what_to_do(
    dxlrun: Dxlrun, begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dxlrun.run.unsteered._END_S", 0.1)
    loop = begin("deaf_arm", LOOP.replace("lambda *_: sys.exit()", "signal.SIG_IGN"))
    said = dxlrun("stop")
    assert said.code == 1
    assert f"deaf_arm: loop (process {loop.pid}) did not end within 0.1 s" in said.err
    assert "switch the servos' power off" in said.err
