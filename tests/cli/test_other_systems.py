"""Windows and macOS: files, logs and servos are read, servos set up, and robots run on virtual time; no more.

A fresh interpreter runs a command line once as it is, so that the standard library and other packages are
imported; then everything that only Linux has is taken away, dxlrun is imported again, and runs it again.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.kit.commands import Dxlrun, Said

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
TORSO = str(ROOT / "robots/bioloid_torso.yaml")
LINUX = {
    "os": "memfd_create pidfd_open fdatasync posix_fallocate pread eventfd sched_setscheduler "
    "sched_getscheduler sched_getaffinity sched_setaffinity sched_param SCHED_RR SCHED_FIFO SCHED_OTHER "
    "SCHED_RESET_ON_FORK MFD_CLOEXEC MFD_ALLOW_SEALING",
    "select": "epoll",
    "signal": "pidfd_send_signal",
}
"""What macOS lacks."""
POSIX = {
    "os": "fork forkpty openpty getuid geteuid getgid uname setsid killpg mkfifo O_CLOEXEC O_NONBLOCK "
    "O_NOCTTY O_DIRECTORY O_NOFOLLOW fchown getpriority setpriority sysconf getloadavg ttyname",
    "select": "poll POLLIN POLLOUT POLLHUP POLLERR",
    "signal": "SIGHUP SIGUSR1 SIGUSR2 SIGWINCH SIGCHLD SIGPIPE SIGALRM SIGTSTP SIGCONT pthread_sigmask "
    "setitimer sigwait sigtimedwait pthread_kill",
    "socket": "AF_UNIX SCM_RIGHTS SO_PEERCRED send_fds recv_fds",
    "mmap": "MAP_SHARED MAP_PRIVATE MAP_POPULATE PROT_READ PROT_WRITE",
}
"""What Windows lacks as well; and these modules: """
MODULES = ("fcntl", "termios", "tty", "pty", "resource", "pwd", "grp", "_posixsubprocess", "syslog", "curses")
ELSEWHERE = """
import contextlib, importlib, io, json, serial, sys, time
from dxlrun.cli import main
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig, ServoConfig

servo = ServoConfig(1, "MX-64", 3.0, 0)
bus = SimulatedBus(BusConfig("main", 1_000_000, (servo,)), Ledger(), time.monotonic_ns())

class Port:  # no other process, which the commands would have to wait for
    baudrate = 1_000_000
    write = lambda self, data: bus.receive_bytes(data, time.monotonic_ns())
    read = lambda self, size: bus.drain_bytes(time.monotonic_ns())
    close = lambda self: None

serial.serial_for_url = lambda *words, **named: Port()
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
PORT = "/dev/serial"
SINGLE = str(ROOT / "robots/single_joint.yaml")
WORK = {
    "check": ("check TORSO", "Policies"),
    "models": ("models", "\n"),
    "schema": ("schema", "\n"),
    "analyze": ("analyze LOG", "The loop kept 50 Hz"),
    "replay": ("replay LOG", "0 differences"),
    "--version": ("--version", "\n"),
    "help": ("help check", "\n"),
    "virtual": ("TORSO --virtual --duration 1", "0 of 50 periods skipped"),
    "scan": ("scan PORT --protocol 1 --baud 1000000 --ids 1-2 --log scan.mcap", "MX-64"),
    "servo": ("servo PORT 1 set led 1 --protocol 1 --baud 1000000", "LED (25)"),
    "online": (f"check {SINGLE} port:=PORT --online", "1 servo compared with the file, no differences"),
    "log of scan": ("analyze scan.mcap", "`dxlrun scan /dev/serial"),
}
"""Commands that work, with words of their output."""
REFUSED = {
    **{
        verb: (
            f"{verb} {SINGLE} port:=/dev/none",
            f"dxlrun: `dxlrun {verb}` needs a terminal, and nothing was done",
        )
        for verb in ("setup", "calibrate")
    },
    "wrong": ("TORSO no_such:=1 --duration 1", "no_such"),  # the file is checked first
    "real": (
        f"{ROOT}/robots/single_joint.yaml port:=/dev/none --duration 1",
        "dxlrun: a run in real time needs Linux, and this is PLATFORM; "
        "give --virtual, and --duration or --play",
    ),
}
WINDOWS = {
    verb: (verb, f"dxlrun: `dxlrun {verb}` needs Linux, and this is win32") for verb in ("list", "watch")
}
"""Refused on Windows alone: macOS has what they need."""


class Elsewhere(NamedTuple):
    """Command lines on another system, each with how it ended; they wrote logs to a place."""

    platform: str
    place: Path
    ran: dict[str, Said]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("linux")
    command = [sys.executable, "-m", "dxlrun", TORSO, "--virtual", "--duration", "1"]
    subprocess.run(command, cwd=place, capture_output=True, check=True)
    return next((place / "logs").iterdir())


@pytest.fixture(scope="module", params=["win32", "darwin"])
def elsewhere(
    request: pytest.FixtureRequest, log: Path, tmp_path_factory: pytest.TempPathFactory
) -> Elsewhere:
    """Run all commands as if on another system."""
    windows = request.param == "win32"
    place = tmp_path_factory.mktemp(request.param)
    lacking = {one: f"{LINUX.get(one, '')} {POSIX.get(one, '') if windows else ''}" for one in LINUX | POSIX}
    commands = WORK | REFUSED | (WINDOWS if windows else {})
    given_for = {"TORSO": TORSO, "LOG": str(log), "PORT": PORT}
    lines = [
        [given_for.get(word, word) for word in words.replace("=PORT", f"={PORT}").split()]
        for words, _ in commands.values()
    ]
    given = json.dumps([request.param, lacking, MODULES if windows else (), lines])
    command = [sys.executable, "-c", ELSEWHERE, given]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True)
    found = [Said(*one) for one in json.loads(ran.stdout.splitlines()[-1])]
    return Elsewhere(request.param, place, dict(zip(commands, found, strict=True)))


@pytest.mark.parametrize("name", WORK)
def test_what_needs_no_run_works(elsewhere: Elsewhere, name: str) -> None:
    ran = elsewhere.ran[name]
    assert ran.code == 0, ran.err
    assert WORK[name][1] in ran.out


def test_log_of_a_run_on_virtual_time_is_replayed_by_linux(elsewhere: Elsewhere, dxlrun: Dxlrun) -> None:
    logs = sorted((elsewhere.place / "logs").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert len(logs) == 2  # of Linux and of the other system, and none of what was refused
    replayed = dxlrun("replay", logs[-1])
    assert (replayed.code, "50 cycles replayed, 0 differences" in replayed.out) == (0, True)


@pytest.mark.parametrize("name", [*REFUSED, *WINDOWS])
def test_what_needs_linux_is_refused_in_one_sentence(elsewhere: Elsewhere, name: str) -> None:
    if name not in elsewhere.ran:
        assert (elsewhere.platform, name in WINDOWS) == ("darwin", True)
        return
    ran, (_, sentence) = elsewhere.ran[name], (REFUSED | WINDOWS)[name]
    assert ran.code == 2
    assert sentence.replace("PLATFORM", elsewhere.platform) in ran.err.splitlines()[-1]
    assert name not in WINDOWS or len(ran.err.splitlines()) == 1
