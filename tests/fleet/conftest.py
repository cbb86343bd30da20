"""Fixtures of fleets: keys and a file of a fleet, the agent that it has, and what is closed at the end."""

import os
import signal
import socket
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.fuzzed_http import children
from tests.kit.live_run import DXLRUN

from dxlrun.remote.network.certificates import keys_place
from dxlrun.remote.network.network_link import NetworkLink
from dxlrun.remote.requests.request_table import Role
from dxlrun_fleet.fleet_file import read_fleet

ROBOTS = Path(__file__).parents[2] / "robots"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """The file of a fleet of one robot that an agent starts, and one whose network hangs; with all keys."""
    for name, place in (("XDG_CONFIG_HOME", "c"), ("XDG_RUNTIME_DIR", "r")):  # a socket's path has 107 bytes
        (tmp_path / place).mkdir(mode=0o700)
        monkeypatch.setenv(name, str(tmp_path / place))
    authority = pytest.importorskip("dxlrun_fleet.authority", reason="needs the extra network")
    authority.issue("lab3", None, 30, keys_place())
    authority.issue("joint", None, 30, keys_place())
    authority.issue("me", Role.ADMIN, 30, keys_place())
    port = free_port()
    robot = (ROBOTS / "single_joint.yaml").read_text()
    for rate, late in (("320 ", "5 "), ("32 ", "5 ")):  # also on a busy machine
        robot = robot.replace(f"rate: {rate}", f"rate: {late}")
    (tmp_path / "single_joint.yaml").write_text(robot.replace("latency: 1 ms", "latency: 100 ms"))
    (tmp_path / "lab.yaml").write_text(
        f"robots:\n  joint: 127.0.0.1:{port}\n  hung: 127.0.0.1:{free_port()}\n"
        f"agents:\n  lab3:\n    address: 127.0.0.1:{free_port()}\n    starts:\n"
        f"      joint: single_joint.yaml --listen joint@127.0.0.1:{port}\n"
    )
    return tmp_path / "lab.yaml"


@pytest.fixture
def agent(lab):
    """The agent of that file, which takes connections."""
    with subprocess.Popen([DXLRUN, "fleet", lab, "--serve", "lab3"], stdout=subprocess.DEVNULL) as process:
        until(lambda: NetworkLink(read_fleet(lab).agents["lab3"].address, "test").alive, "the agent")
        yield process
        for run in children(process.pid):  # of a test that failed: a run goes on when its agent ends
            os.kill(run, signal.SIGTERM)
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0


@pytest.fixture
def ends():
    """Close what is entered, at the test's end."""
    with ExitStack() as stack:
        yield stack
