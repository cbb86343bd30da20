"""Runs that cannot be steered: `dxlrun list` names them, `dxlrun stop` ends them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels.heartbeat import GatewayAvailability, Phase

Begin = Callable[..., subprocess.Popen[str]]
LOOP = """\
import os, signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
plan = os.memfd_create("dxlrun-plan")
os.pwrite(plan, b'{"robot":"%s","loop":{}}', 0)
print("ready", flush=True)
while True:
    signal.pause()
"""


@pytest.fixture
def orphan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Begin]:
    """Start what stands for the loop of a run that has lost all its other processes."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))

    def begin(robot: str, source: str = LOOP) -> subprocess.Popen[str]:
        # the last word is by what a loop's process is known
        command = [sys.executable, "-c", source.replace("%s", robot), "dxlrun.run.loop_process"]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.enter_context(child)
        stack.callback(child.kill)
        assert child.stdout
        assert child.stdout.readline() == "ready\n"
        return child

    with ExitStack() as stack:
        yield begin


def test_a_loop_without_the_rest_of_its_run_is_named_and_ended(dxlrun, orphan: Begin) -> None:
    loop = orphan("lonely_arm")
    problem = "it has no supervisor and no guardian and no gateway"
    fix = "end it by `dxlrun stop --robot lonely_arm`"
    named = f"dxlrun: lonely_arm runs but cannot be steered: {problem}; {fix}\n"
    assert dxlrun("list") == (0, "", named)
    assert dxlrun("list", "--robot", "lonely_arm") == (1, "", named)
    assert dxlrun("halt") == (1, "", named)
    assert dxlrun("halt", "--robot", "lonely_arm") == (1, "", named)
    ended = f"lonely_arm has ended; it could not be steered: {problem}\n"
    assert dxlrun("stop") == (0, ended, "")
    assert loop.wait(DEADLINE_S) == 0
    assert "no running robot found" in dxlrun("list").out


SUPERVISOR = """\
import os, signal, struct, subprocess, sys
plan = os.memfd_create("dxlrun-plan")
os.pwrite(plan, b'{"robot":"young_arm","loop":{}}', 0)
page = os.memfd_create("dxlrun-heartbeat")
os.pwrite(page, struct.pack("Q7QQ", PHASE, *[0] * 7, STEERING), 0)
loop = [sys.executable, "-c", "input()", "dxlrun.run.loop_process"]
child = subprocess.Popen(loop, stdin=subprocess.PIPE, pass_fds=[plan])  # it ends with this process
print("ready", flush=True)
while True:
    signal.pause()
"""


@pytest.mark.parametrize(
    ("phase", "steering", "said"),
    [
        (Phase.LOADING, GatewayAvailability.IMPOSSIBLE, "is starting; try again when it runs"),
        (Phase.RUNNING, GatewayAvailability.AWAITED, "is starting; try again when it runs"),
        (
            Phase.RUNNING,
            GatewayAvailability.IMPOSSIBLE,
            "runs but cannot be steered: it has no gateway; end it by `dxlrun stop",
        ),
        (Phase.DONE, GatewayAvailability.POSSIBLE, "is ending"),
    ],
)
def test_only_a_run_without_a_gateway_gets_the_advice_to_stop_it(  # noqa: PLR0917  fixtures
    dxlrun,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    phase: Phase,
    steering: GatewayAvailability,
    said: str,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    source = SUPERVISOR.replace("PHASE", str(int(phase))).replace("STEERING", str(int(steering)))
    program = tmp_path / "bin/dxlrun"  # a supervisor is known by the name of its program
    program.parent.mkdir()
    program.write_text(source)
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout
            assert child.stdout.readline() == "ready\n"
            err = dxlrun("list").err
        finally:
            child.kill()
    assert err.startswith(f"dxlrun: young_arm {said}")
    assert ("dxlrun stop" in err) == (steering is GatewayAvailability.IMPOSSIBLE and phase is Phase.RUNNING)


def test_a_stopped_loop_is_continued_to_its_end(dxlrun, orphan: Begin) -> None:
    loop = orphan("held_arm")
    loop.send_signal(signal.SIGSTOP)
    os.waitpid(loop.pid, os.WUNTRACED)
    said = dxlrun("stop", "--robot", "held_arm")
    assert said.code == 0, said.err
    assert f"its loop (process {loop.pid}) is stopped" in said.out
    assert loop.wait(DEADLINE_S) == 0


STOPPED_SUPERVISOR = """\
import os, subprocess, sys
plan = os.memfd_create("dxlrun-plan")
os.pwrite(plan, b'{"robot":"held_arm","loop":{}}', 0)
source = "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit()); "
source += "print('ready', flush=True); signal.pause()"
loop = [sys.executable, "-c", source, "dxlrun.run.loop_process"]
sys.exit(subprocess.Popen(loop, pass_fds=[plan]).wait())
"""


def test_stop_continues_a_stopped_supervisor_whose_loop_runs(
    dxlrun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("dxlrun.run.unsteered._END_S", 10.0)
    program = tmp_path / "bin/dxlrun"
    program.parent.mkdir()
    program.write_text(STOPPED_SUPERVISOR)
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True) as supervisor:
        try:
            assert supervisor.stdout
            assert supervisor.stdout.readline() == "ready\n"
            supervisor.send_signal(signal.SIGSTOP)
            os.waitpid(supervisor.pid, os.WUNTRACED)
            said = dxlrun("stop", "--robot", "held_arm")
        finally:
            supervisor.kill()
    assert said.code == 0, said.err
    assert said.out.startswith("held_arm has ended; it could not be steered: ")


def test_a_run_of_another_runtime_directory_is_ended_by_name_only(
    dxlrun, orphan: Begin, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loop = orphan("far_arm")
    other = tmp_path / "other"
    other.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(other))
    assert "no running robot found" in dxlrun("stop").err
    assert "far_arm" not in dxlrun("list").err
    assert dxlrun("stop", "--robot", "far_arm").code == 0
    assert loop.wait(DEADLINE_S) == 0


def test_several_runs_are_not_ended_without_a_name(dxlrun, orphan: Begin) -> None:
    loops = orphan("left_arm"), orphan("right_arm")
    said = dxlrun("stop")
    assert said.code == 2
    assert "--robot left_arm, --robot right_arm" in said.err
    assert [loop.poll() for loop in loops] == [None, None]


def test_a_process_that_does_not_end_is_named_with_what_to_do(
    dxlrun, orphan: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dxlrun.run.unsteered._END_S", 0.1)
    loop = orphan("deaf_arm", LOOP.replace("lambda *_: sys.exit()", "signal.SIG_IGN"))
    said = dxlrun("stop")
    assert said.code == 1
    assert f"deaf_arm: loop (process {loop.pid}) did not end within 0.1 s" in said.err
    assert "switch the servos' power off" in said.err
