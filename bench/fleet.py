"""Fleet: how long after the death of one of ten robots `dxlrun fleet` shows it.

An agent starts simulated joints at 32 Hz, each a run with processes of its own that listens by mutual TLS;
`dxlrun fleet` shows them on a terminal. One after the other is killed: of every other one the loop alone, of
those between all processes at once, as where power or network fails. The time ends when a frame of the
table has its row as unreachable.

    python bench/fleet.py [--robots 10]
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from dxlrun.remote.network.certificates import keys_place
from dxlrun.remote.network.network_link import NetworkLink
from dxlrun.remote.requests.request_table import Role
from dxlrun_fleet import authority
from dxlrun_fleet.fleet_file import read_fleet

ROBOT = Path(__file__).parents[1] / "robots" / "single_joint.yaml"
DXLRUN = Path(sys.executable).with_name("dxlrun")
TERMINAL = {"TERM": "xterm", "COLUMNS": "160", "LINES": "60"}


def main() -> None:
    """Start robots, kill them, and print how long each death was not seen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robots", type=int, default=10)
    count = parser.parse_args().robots
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # the robots end, too
    with tempfile.TemporaryDirectory() as folder, ExitStack() as ends:
        file = lab(Path(folder), names := [f"joint_{number}" for number in range(count)])
        agent = subprocess.Popen([DXLRUN, "fleet", file, "--serve", "here"], stdout=subprocess.DEVNULL)
        ends.callback(agent.wait)
        ends.callback(agent.terminate)
        ends.callback(lambda: [os.kill(one, signal.SIGKILL) for one in below(agent.pid)])
        while not NetworkLink(read_fleet(file).agents["here"].address, "bench").alive:
            time.sleep(0.1)
        for name in names:
            subprocess.run([DXLRUN, "fleet", file, "--start", name], check=True, stdout=subprocess.DEVNULL)
        runs = {name: run for run in children(agent.pid) for name in names if f"{name}.yaml" in words_of(run)}
        with Shown(file) as shown:
            for killed, (name, run) in enumerate(sorted(runs.items()), 1):
                every = [run, *below(run)]
                dying = every if killed % 2 else [one for one in every if "loop_process" in words_of(one)]
                shown.until(re.compile(rf"{name}\b[^\n]*running".encode()).search)
                began = time.monotonic()
                for one in dying:
                    os.kill(one, signal.SIGKILL)
                shown.until(re.compile(rf"{name}\b[^\n]*unreachable".encode()).search)
                what = "all processes" if killed % 2 else "its loop"
                sys.stdout.write(f"{name}, {what} killed: shown after {time.monotonic() - began:.2f} s\n")


def lab(place: Path, names: list[str]) -> Path:
    """Make settings, keys and the file of a fleet in a directory."""
    for variable in ("XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        (place / variable).mkdir(mode=0o700)
        os.environ[variable] = str(place / variable)
    free = [socket.create_server(("127.0.0.1", 0)) for _ in range(len(names) + 1)]
    ports = [one.getsockname()[1] for one in free]
    for one in free:
        one.close()
    authority.issue("me", Role.ADMIN, 1, keys_place())
    robots, starts = "", ""
    for name, port in zip(names, ports, strict=False):
        authority.issue(name, None, 1, keys_place())
        text = (
            ROBOT.read_text().replace("name: single_joint", f"name: {name}").replace("rate: 320", "rate: 32")
        )
        (place / f"{name}.yaml").write_text(text)
        robots += f"  {name}: 127.0.0.1:{port}\n"
        starts += f"      {name}: {name}.yaml --listen 127.0.0.1:{port}\n"
    authority.issue("here", None, 1, keys_place())
    agents = f"agents:\n  here:\n    address: 127.0.0.1:{ports[-1]}\n    starts:\n{starts}"
    (place / "lab.yaml").write_text(f"robots:\n{robots}{agents}")
    return place / "lab.yaml"


class Shown:
    """The table on a terminal of its own."""

    def __init__(self, file: Path) -> None:
        self._end, theirs = pty.openpty()
        command = [DXLRUN, "fleet", file]
        self._view = subprocess.Popen(command, stdin=theirs, stdout=theirs, env=os.environ | TERMINAL)
        os.close(theirs)

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *error: object) -> None:
        self._view.kill()
        self._view.wait()
        os.close(self._end)

    def until(self, shows: Callable[[bytes], object]) -> None:
        """Read frames until one shows something."""
        frame = b""
        while True:
            *whole, frame = (frame + os.read(self._end, 1 << 16)).split(b"\x1b[H")
            if any(map(shows, whole)):
                return


def words_of(process: int) -> str:
    """Return the command line of a process."""
    return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode()


def children(process: int) -> list[int]:
    """Return the processes that another one started."""
    return [int(one) for one in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def below(process: int) -> list[int]:
    """Return all processes below another one."""
    return [one for child in children(process) for one in (child, *below(child))]


if __name__ == "__main__":
    main()
