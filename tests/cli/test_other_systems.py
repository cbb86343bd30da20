"""Windows and macOS: files are checked, logs read and replayed, robots run on virtual time; no more.

A fresh interpreter runs a command line once as it is, so that the standard library and other packages are
imported; then everything that only Linux has is taken away, dxlrun is imported again, and runs it again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

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

platform, names, modules, words = json.loads(sys.argv[1])
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    main(words)
for name in [name for name in sys.modules if name.partition(".")[0].startswith("dxlrun")]:
    del sys.modules[name]
for module in modules:
    sys.modules[module] = None  # an import of it fails
for module, lacking in names.items():
    for name in lacking.split():
        vars(importlib.import_module(module)).pop(name, None)
sys.platform = platform
from dxlrun.cli import main

sys.exit(main(words))
"""


def on(platform: str, place: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command line as if on another system."""
    windows = platform == "win32"
    names = {
        module: f"{LINUX.get(module, '')} {POSIX.get(module, '') if windows else ''}"
        for module in LINUX | POSIX
    }
    given = json.dumps([platform, names, MODULES if windows else (), words])
    command = [sys.executable, "-c", ELSEWHERE, given]
    return subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of Linux."""
    place = tmp_path_factory.mktemp("linux")
    command = [DXLRUN, TORSO, "--virtual", "--duration", "1"]
    subprocess.run(command, cwd=place, capture_output=True, check=True)
    return next((place / "logs").iterdir())


SYSTEMS = pytest.mark.parametrize("platform", ["win32", "darwin"])


@SYSTEMS
@pytest.mark.parametrize("words", ["check", "models", "schema", "analyze", "replay", "--version", "help"])
def test_what_needs_no_robot_works(platform: str, words: str, log: Path, tmp_path: Path) -> None:
    of = {"check": [TORSO], "analyze": [str(log)], "replay": [str(log)], "help": ["check"]}.get(words, [])
    ran = on(platform, tmp_path, words, *of)
    assert ran.returncode == 0, ran.stderr
    expected = {"check": "Policies", "replay": "0 differences", "analyze": "The loop kept 50 Hz"}
    assert expected.get(words, "\n") in ran.stdout


@SYSTEMS
def test_a_robot_runs_on_virtual_time_and_is_replayed_by_linux(platform: str, tmp_path: Path) -> None:
    ran = on(platform, tmp_path, TORSO, "--virtual", "--duration", "1")
    assert ran.returncode == 0, ran.stderr
    assert "0 of 50 periods skipped" in ran.stdout
    logs = sorted((tmp_path / "logs").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    command = [DXLRUN, "replay", str(logs[-1])]
    replayed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (replayed.returncode, "50 cycles replayed, 0 differences" in replayed.stdout) == (0, True)


@SYSTEMS
def test_a_run_in_real_time_needs_linux_and_starts_nothing(platform: str, tmp_path: Path) -> None:
    ran = on(platform, tmp_path, TORSO, "no_such:=1", "--duration", "1")
    assert (ran.returncode, "no_such" in ran.stderr) == (2, True)  # the file is checked first
    ran = on(platform, tmp_path, str(ROOT / "robots/single_joint.yaml"), "port:=/dev/none", "--duration", "1")
    assert ran.returncode == 2
    sentence = (
        f"a run in real time needs Linux, and this is {platform}; give --virtual, and --duration or --play"
    )
    assert ran.stderr.splitlines()[-1:] == [f"dxlrun: {sentence}"]
    assert [*tmp_path.rglob("*.mcap")] == []


@pytest.mark.parametrize("words", ["scan /dev/none", "list", "watch"])
def test_what_needs_linux_is_refused_in_one_sentence(words: str, tmp_path: Path) -> None:
    ran = on("win32", tmp_path, *words.split())
    assert ran.returncode == 2
    (sentence,) = ran.stderr.splitlines()
    assert sentence.startswith(
        f"dxlrun: `dxlrun {words.split(maxsplit=1)[0]}` needs Linux, and this is win32"
    )
