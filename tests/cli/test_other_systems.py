"""Windows and macOS: files are checked, logs read and replayed, robots run on virtual time; no more.

A fresh interpreter runs a command line once as it is, so that the standard library and other packages are
imported; then everything that only Linux has is taken away, dxlrun is imported again, and runs it again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
DXLRUN = str(Path(sys.executable).with_name("dxlrun"))
TORSO = str(ROOT / "robots/bioloid_torso.yaml")
LINUX = {
    "os": "memfd_create pidfd_open fdatasync posix_fallocate pread eventfd sched_setscheduler "
    "sched_getscheduler sched_getaffinity sched_setaffinity sched_param SCHED_RR SCHED_FIFO SCHED_OTHER "
    "SCHED_RESET_ON_FORK MFD_CLOEXEC MFD_ALLOW_SEALING",
    "select": "epoll",
    "signal": "pidfd_send_signal",
}
"""What macOS has not."""
POSIX = {
    "os": "fork forkpty openpty getuid geteuid getgid uname setsid killpg mkfifo O_CLOEXEC O_NONBLOCK "
    "O_NOCTTY O_DIRECTORY O_NOFOLLOW fchown getpriority setpriority sysconf getloadavg ttyname",
    "select": "poll POLLIN POLLOUT POLLHUP POLLERR",
    "signal": "SIGHUP SIGUSR1 SIGUSR2 SIGWINCH SIGCHLD SIGPIPE SIGALRM SIGTSTP SIGCONT pthread_sigmask "
    "setitimer sigwait sigtimedwait pthread_kill",
    "socket": "AF_UNIX SCM_RIGHTS SO_PEERCRED send_fds recv_fds",
    "mmap": "MAP_SHARED MAP_PRIVATE MAP_POPULATE PROT_READ PROT_WRITE",
}
"""What Windows has not, either; and these modules: """
MODULES = ("fcntl", "termios", "tty", "pty", "resource", "pwd", "grp", "_posixsubprocess", "syslog", "curses")
ELSEWHERE = """
import contextlib, importlib, io, json, sys
from dxlrun.cli import main

platform, names, modules, lines = json.loads(sys.argv[1])

def run(words):
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    return [code or 0, out.getvalue(), err.getvalue()]

for words in lines:
    run(words)
for name in [name for name in sys.modules if name.partition(".")[0].startswith("dxlrun")]:
    del sys.modules[name]
for module in modules:
    sys.modules[module] = None  # an import of it fails
for module, lacking in names.items():
    for name in lacking.split():
        vars(importlib.import_module(module)).pop(name, None)
sys.platform = platform
from dxlrun.cli import main

print(json.dumps([run(words) for words in lines]))
"""


class Ran(NamedTuple):
    """How a command line ended."""

    code: int
    out: str
    err: str


def on(platform: str, place: Path, *lines: Sequence[str]) -> list[Ran]:
    """Run command lines as if on another system."""
    windows = platform == "win32"
    names = {
        module: f"{LINUX.get(module, '')} {POSIX.get(module, '') if windows else ''}"
        for module in LINUX | POSIX
    }
    given = json.dumps([platform, names, MODULES if windows else (), lines])
    command = [sys.executable, "-c", ELSEWHERE, given]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    return [Ran(*one) for one in json.loads(ran.stdout.splitlines()[-1])]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of Linux."""
    place = tmp_path_factory.mktemp("linux")
    command = [DXLRUN, TORSO, "--virtual", "--duration", "1"]
    subprocess.run(command, cwd=place, capture_output=True, check=True)
    return next((place / "logs").iterdir())


OTHERS = {"check": "Policies", "replay": "0 differences", "analyze": "The loop kept 50 Hz"}
"""What is seen in the output of some commands."""


class Elsewhere(NamedTuple):
    """Command lines on another system, each with how it ended; they wrote logs to a place."""

    platform: str
    place: Path
    ran: dict[str, Ran]


@pytest.fixture(scope="module", params=["win32", "darwin"])
def elsewhere(
    request: pytest.FixtureRequest, log: Path, tmp_path_factory: pytest.TempPathFactory
) -> Elsewhere:
    platform: str = request.param
    place = tmp_path_factory.mktemp(platform)
    lines = {
        "check": ["check", TORSO],
        "models": ["models"],
        "schema": ["schema"],
        "analyze": ["analyze", str(log)],
        "replay": ["replay", str(log)],
        "--version": ["--version"],
        "help": ["help", "check"],
        "virtual": [TORSO, "--virtual", "--duration", "1"],
        "wrong": [TORSO, "no_such:=1", "--duration", "1"],
        "real": [str(ROOT / "robots/single_joint.yaml"), "port:=/dev/none", "--duration", "1"],
    }
    if platform == "win32":
        lines |= {"scan": ["scan", "/dev/none"], "list": ["list"], "watch": ["watch"]}
    return Elsewhere(platform, place, dict(zip(lines, on(platform, place, *lines.values()), strict=True)))


@pytest.mark.parametrize("words", ["check", "models", "schema", "analyze", "replay", "--version", "help"])
def test_what_needs_no_robot_works(elsewhere: Elsewhere, words: str) -> None:
    ran = elsewhere.ran[words]
    assert ran.code == 0, ran.err
    assert OTHERS.get(words, "\n") in ran.out


def test_a_robot_runs_on_virtual_time_and_is_replayed_by_linux(elsewhere: Elsewhere) -> None:
    ran = elsewhere.ran["virtual"]
    assert ran.code == 0, ran.err
    assert "0 of 50 periods skipped" in ran.out
    logs = sorted((elsewhere.place / "logs").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert len(logs) == 2  # of Linux and of the other system, and none of what was refused
    command = [DXLRUN, "replay", str(logs[-1])]
    replayed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (replayed.returncode, "50 cycles replayed, 0 differences" in replayed.stdout) == (0, True)


def test_a_run_in_real_time_needs_linux_and_starts_nothing(elsewhere: Elsewhere) -> None:
    ran = elsewhere.ran["wrong"]
    assert (ran.code, "no_such" in ran.err) == (2, True)  # the file is checked first
    ran = elsewhere.ran["real"]
    assert ran.code == 2
    assert ran.err.splitlines()[-1:] == [
        f"dxlrun: a run in real time needs Linux, and this is {elsewhere.platform}; "
        "give --virtual, and --duration or --play"
    ]


@pytest.mark.parametrize("elsewhere", ["win32"], indirect=True)  # macOS has what they need
@pytest.mark.parametrize("verb", ["scan", "list", "watch"])
def test_what_needs_linux_is_refused_in_one_sentence(elsewhere: Elsewhere, verb: str) -> None:
    ran = elsewhere.ran[verb]
    assert ran.code == 2
    (sentence,) = ran.err.splitlines()
    assert sentence.startswith(f"dxlrun: `dxlrun {verb}` needs Linux, and this is win32")
