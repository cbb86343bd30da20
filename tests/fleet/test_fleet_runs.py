"""`dxlrun fleet` beside real runs: rows of robots that run, hang and are gone; the live table."""

import os
import pty
import re
import signal
import socket
import subprocess
from contextlib import closing
from pathlib import Path
from typing import TypeVar

import pytest
from tests.kit.answers import result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.commands import Dxlrun
from tests.kit.fuzzed_http import process_of
from tests.kit.live_run import DXLRUN

from dxlrun.remote.network.network_link import NetworkLink
from dxlrun_fleet.agent import START
from dxlrun_fleet.fleet_file import read_fleet
from dxlrun_fleet.fleet_view import RobotView

pytestmark = pytest.mark.long

Closing = TypeVar("Closing", RobotView, NetworkLink, socket.socket)
TERMINAL = {"TERM": "xterm", "COLUMNS": "120", "LINES": "30"}


def looked(dxlrun: Dxlrun, lab: Path) -> list[dict[str, str]]:
    """Return the rows of one look; one is unreachable."""
    said = dxlrun("fleet", lab, "--json")
    assert said.code == 1
    found: list[dict[str, str]] = result_of(said.out)
    return found


@pytest.mark.timeout(600)
def test_a_robot_is_started_seen_killed_and_seen_again_beside_one_that_hangs(
    lab, agent, dxlrun, ends, monkeypatch
):
    monkeypatch.setattr("dxlrun_fleet.fleet._START_S", DEADLINE_S)

    def enter(one: Closing) -> Closing:
        return ends.enter_context(closing(one))

    fleet = read_fleet(lab)
    enter(socket.create_server(fleet.robots["hung"][1:], backlog=1))
    said = dxlrun("fleet", lab, "--start", "joint")
    assert (said.code, said.out) == (0, "joint is running\n"), said.err
    said = dxlrun("fleet", lab, "--start", "joint")
    assert (said.code, said.errors) == (1, ["joint: already running"])

    views = {name: enter(RobotView(name, address)) for name, address in fleet.robots.items()}
    row = until(lambda: (seen := views["joint"].seen()).voltage and seen, "a row")
    assert (row.state, row.voltage, row.hottest, row.reason) == ("running", 12.0, "joint", "")
    assert (lab.parent / str(row.log)).exists()
    (_, other) = until(lambda: (rows := looked(dxlrun, lab))[0]["state"] == "running" and rows)
    assert other["state"] == "unreachable"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d\d:\d\d", other["since"])

    os.kill(process_of(agent.pid, "dxlrun.run.loop_process"), signal.SIGKILL)
    row = until(
        lambda: (seen := views["joint"].seen()).reason.startswith("joint no longer answers: ") and seen
    )
    assert (row.state, row.voltage, row.temperature, row.hottest) == ("unreachable", None, None, "")
    link = enter(NetworkLink(fleet.agents["lab3"].address, "test"))
    until(lambda: link.exchange("GET", f"{START}joint", None)[0] == 410, "the end of the run's processes")
    assert "log: " in (lab.parent / "joint.out").read_text()
    said = dxlrun("fleet", lab, "--stop", "joint")
    assert (said.code, len(said.errors)) == (1, 1)
    assert "Connection refused" in said.errors[0]

    said = dxlrun("fleet", lab, "--start", "joint")
    assert (said.code, said.out) == (0, "joint is running\n"), said.err
    until(lambda: views["joint"].seen().state == "running", "it runs again")
    said = dxlrun("fleet", lab, "--stop", "joint", "--json")
    assert result_of(said.out) == [{"robot": "joint", "done": True, "text": "joint has ended"}]


def test_the_live_table_ends_with_q(lab):
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [DXLRUN, "fleet", lab], stdin=theirs, stdout=theirs, env=os.environ | TERMINAL
    ) as view:
        os.close(theirs)
        shown = b""
        while b"unreachable since" not in shown:
            shown += os.read(ours, 4096)
        os.write(ours, b"q")
        assert view.wait(DEADLINE_S) == 0
    os.close(ours)
