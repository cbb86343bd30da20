"""A whole run through all processes: what it opens, its output, and what it refuses; see also ends.txt."""

import fcntl
import os
import signal
import stat
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.live_run import LiveRuns, Start, together

READ_OF_PAN = b"\xff\xff\x03\x04\x02\x24"
"""Of its state: one a cycle; goals are sent when they change."""


def test_a_run_opens_one_socket_and_its_loop_one_line_and_keeps_its_memory(
    live_runs: LiveRuns, listening: Callable[[int], Any]
) -> None:
    """With the widest umask; nothing is on the network, and no socket is abstract, which has no mode.

    Simulated servos listen nowhere.
    """
    tell = "import gc; print('collector', gc.isenabled(), [one['collections'] for one in gc.get_stats()])"
    open_to_all = ("/bin/sh", "-c", 'umask 0; exec "$@"', "sh")
    loaded = "print('loaded for clients:', 'dxlrun_controllers.diff_drive_controller' in sys.modules)"
    run = live_runs.start_odd("--debug", configure=loaded, update=tell, gateway=True, before=open_to_all)
    until(lambda: listening(run.process.pid).unix, "the socket", check=run.lives)
    run.wait_until_moving()
    loop = Path(f"/proc/{run.child('run.loop_process')}")

    def resident_kb(cycles: int) -> int:
        until(lambda: run.sent().count(READ_OF_PAN) >= cycles, f"{cycles} cycles", pause_s=0.2)
        return int((loop / "status").read_text().split("VmRSS:")[1].split()[0])

    before = resident_kb(30)
    found = listening(run.process.pid)
    assert found.network == []
    (path,) = map(Path, found.unix)
    assert stat.S_ISSOCK(path.stat().st_mode)
    assert (path.stat().st_mode & 0o777, path.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    opened = {
        name: [os.readlink(one) for one in Path(f"/proc/{run.child(name)}/fd").iterdir()]
        for name in ("run.loop_process", "run.simulation_process", "run.guardian")
    }
    terminals = {target for targets in opened.values() for target in targets}
    assert not [one for one in terminals if one.startswith("/dev/pts/") and one != "/dev/pts/ptmx"]
    logs = [*(run.directory / "logs").iterdir()]
    assert logs
    assert not any(file.stat().st_mode & 0o007 for file in logs)
    assert len(list((loop / "task").iterdir())) == 1
    targets = opened["run.loop_process"]
    assert not [target for target in targets if target.startswith(("pipe:", "anon_inode:"))]
    assert sum(target.startswith("socket:") for target in targets) == 2  # to the guardian, and the line
    after = resident_kb(130)
    assert after - before <= 64  # a new object of 100 bytes a cycle would be 10 kB: whole pages, and a margin
    run.signal(signal.SIGTERM)
    code, _, err = run.finish()
    assert code == 130
    assert not path.exists()
    assert run.is_limp()
    assert "loaded for clients: True\n" in err
    said = {line for line in err.splitlines() if line.startswith("collector")}
    assert len(said) == 1, "it collected garbage"
    assert "False" in said.pop()


FORK = """
        def tell(path):
            open(path, "w").write(chr(10).join(os.readlink(one) for one in
                [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")] if os.path.islink(one)))
        if os.fork() == 0:
            tell("that exits")
            sys.exit(3)
        if os.fork() == 0:
            tell("that goes on")
        show = "import os; print(*[os.readlink(f'/proc/self/fd/{fd}') for fd in range(512)"
        show += " if os.path.islink(f'/proc/self/fd/{fd}')], sep=chr(10))"
        to = (os.POSIX_SPAWN_OPEN, 1, "spawned", os.O_WRONLY | os.O_CREAT, 0o600)
        os.waitpid(os.posix_spawn(sys.executable, ["python", "-c", show], os.environ, file_actions=[to]), 0)
"""


def test_a_child_process_of_a_controller_has_no_port(live_runs: LiveRuns, tmp_path: Path) -> None:
    run = live_runs.start_odd("--duration", "0.5", configure=FORK)
    code, out, err = run.finish()
    assert (code, err) == (0, ""), out
    assert "pair: done: " in out
    # a forked one has the memory that is mapped; what they print goes where the output of the loop goes
    mine = ("socket:", "/dev/pts/")
    for name, not_held in (("that exits", mine), ("that goes on", mine), ("spawned", (*mine, "/memfd:"))):
        held = [one for one in (tmp_path / name).read_text().splitlines() if "dxlrun-stderr" not in one]
        assert held
        assert not [one for one in held if one.startswith(not_held)]
    assert run.is_limp()
    assert run.log().complete


FULL = b"x" * 4096


def full_pipe() -> tuple[int, int]:
    """Return the ends of a pipe that takes nothing more."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, len(FULL))
    os.write(writer, FULL)
    return reader, writer


def stopped_terminal() -> tuple[int, int]:
    """Return the ends of a pseudo-terminal after Ctrl-S."""
    master, terminal = os.openpty()
    termios.tcflow(terminal, termios.TCOOFF)
    return master, terminal


def closed_pipe() -> tuple[int, int]:
    """Return the end of a pipe whose reader has left, and a descriptor in its place."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.open(os.devnull, os.O_RDONLY), writer


def test_no_reader_of_the_output_keeps_a_signal_from_the_robot(start: Start) -> None:
    """The supervisor has written when the signal comes: at once to a terminal, every 5 s into a pipe."""

    def check(output: Callable[[], tuple[int, int]]) -> None:
        kept, given = output()
        run = start("--no-record", output=given)
        run.wait_until_moving()
        if output is not stopped_terminal:
            begin_ns = run.ledger()[-1].t_ns
            until(lambda: run.ledger()[-1].t_ns - begin_ns > 5_500_000_000, "progress", pause_s=0.2)
        asked_ns = time.monotonic_ns()
        run.signal(signal.SIGTERM)
        assert run.process.wait(DEADLINE_S) == 130
        assert run.last_sent_ns() - asked_ns < 3_000_000_000
        assert run.is_limp()
        assert not (run.directory / "logs").exists()
        os.close(kept)
        os.close(given)

    together(check, {output.__name__: (output,) for output in (full_pipe, stopped_terminal, closed_pipe)})


def test_without_any_standard_stream_the_robot_runs(start: Start) -> None:
    run = start("--duration", "0.5", before=("/bin/sh", "-c", 'exec "$@" >&- 2>&- <&-', "sh"))
    assert run.finish() == (0, "", "")
    assert run.is_limp()
    assert len(run.log().cycles) > 0


@pytest.mark.parametrize("why", ["missing port", "busy port", "directory that takes no log"])
def test_what_cannot_be_opened_is_one_sentence(start: Start, tmp_path: Path, why: str) -> None:
    # a holder in a process of its own: this one may have the memory of a plan open, as a run has
    holding = (
        "import fcntl, os, pty\n"
        "_, slave = pty.openpty()\n"
        "fcntl.flock(slave, fcntl.LOCK_EX)\n"
        "print(os.ttyname(slave), flush=True)\n"
        "input()"
    )
    command = [sys.executable, "-c", holding]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdin
        assert holder.stdout
        busy = holder.stdout.readline().strip()
        port = {"missing port": "/dev/ttyNowhere", "busy port": busy}.get(why, "sim")
        if port == "sim":
            (tmp_path / "logs").write_text("a file where the directory should be")
        code, _, err = (run := start(f"port:={port}")).finish()
        holder.stdin.write("\n")
    assert code == (2 if port == "sim" else 1)
    assert len(err.strip().splitlines()) == 1
    assert {"sim": "logs", busy: str(holder.pid)}.get(port, port) in err
    assert "internal" not in err
    assert run.log_path() is None
