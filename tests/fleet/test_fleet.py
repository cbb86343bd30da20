"""`dxlrun fleet`: rows of robots; files; an agent that starts what its own file has, for an admin."""

import io
import os
import re
import shlex
import socket
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from rich.console import Console
from tests.kit.awaited import until
from tests.kit.campaigns import campaign
from tests.kit.commands import cases, play
from tests.kit.fuzzed_http import Said, check_port_survives_fuzzing
from tests.kit.pages import page_text

from dxlrun.channels.answers import Code
from dxlrun.cli import app
from dxlrun.errors import InputError, Refused
from dxlrun.output.live_view import compact
from dxlrun.remote.network.certificates import keys_place
from dxlrun.remote.network.network_link import NetworkLink
from dxlrun.remote.requests.replies import EventRow, Events, RobotInfo
from dxlrun.remote.requests.request_table import Role
from dxlrun.remote.sockets import Address
from dxlrun_fleet.agent import START, AgentApp
from dxlrun_fleet.fleet_file import Agent, read_fleet
from dxlrun_fleet.fleet_view import SILENT_S, RobotStatus, RobotView, fleet_table

authority = pytest.importorskip("dxlrun_fleet.authority", reason="needs the extra network")

INFO = RobotInfo("joint", 50.0, False, None, 0, 0, (), {}, {}, {}, {}, {}, {}, (), (), "x.yaml", None)
ADDRESS = Address("lab3", "127.0.0.1", 1)


def test_a_long_error_takes_no_room_from_the_names():
    row = RobotStatus(
        "joint_7", "running", voltage=12.0, temperature=30.0, error="a packet was lost " * 20, log="x" * 90
    )
    shown = io.StringIO()
    Console(file=shown, width=120).print(compact(fleet_table([row])))
    for words in ("joint_7", "running", "12.0 V", "30 deg C", "a packet was lost"):
        assert words in shown.getvalue()


class Polled:
    """A robot that a view asks; without states it has had no cycle yet."""

    def __init__(self, *said: tuple[str, int], states: object = None, **info: object) -> None:
        self.said, self.held, self.changed = said, states, info

    def info(self) -> object:
        return msgspec.to_builtins(INFO) | self.changed

    def events(self, after: int) -> object:
        rows = [EventRow(at, 0.0, "x", how, "loop", text) for at, (text, how) in enumerate(self.said)]
        return msgspec.to_builtins(Events(tuple(rows[after:]), len(rows)))

    def states(self) -> object:
        if self.held is None:
            raise Refused("it has had no cycle yet", code=Code.NO_CYCLE)
        return self.held


@pytest.fixture
def view(lab):
    """A view of a robot that did not answer, and is polled by the test alone."""
    with closing(RobotView("joint", ADDRESS)) as view:
        view.tried.wait()
        view.close()
        view._replied = time.monotonic() + 3600.0
        yield view


def test_the_last_error_stays_and_warnings_are_none(view):
    """Of a run that begins, and has no cycle yet."""
    assert view.seen().state == "unreachable"
    assert view.seen().reason == "joint no longer answers: [Errno 111] Connection refused"
    begins = Polled(("a motor fell off", 40), ("a packet was lost", 30))
    for last in (0, 2):
        assert view._poll_robot(begins, last) == 2
        seen = view.seen()
        assert (seen.state, seen.error, seen.voltage) == ("starting", "a motor fell off", None)
    view._replied = time.monotonic() - 1.01 * SILENT_S
    assert (view.seen().state, view.seen().reason) == ("unreachable", "no answer")


def test_a_row_has_the_lowest_voltage_and_the_hottest_joint(view):
    temperature, voltage = np.array([30.0, 41.0, np.nan]), np.array([11.5, 12.0, np.nan])
    states = SimpleNamespace(joints=("hip", "knee", "toe"), temperature=temperature, voltage=voltage)
    view._poll_robot(Polled(states=states, paused=True), 0)
    seen = view.seen()
    assert (seen.state, seen.voltage, seen.temperature, seen.hottest) == ("paused", 11.5, 41.0, "knee")


def test_what_an_agent_answers(tmp_path, monkeypatch):
    """It starts what its own file names, for an admin, once, also when another agent started it."""
    (tmp_path / "wait.py").write_text(
        "import sys\nprint(sys.argv[1:], flush=True)\nsys.stdin.read()\ninput()\n"
    )
    monkeypatch.setattr("dxlrun_fleet.agent._MAIN", ("-c", (tmp_path / "wait.py").read_text()))
    first, second = (AgentApp(Agent(ADDRESS, {"arm": ("arm.yaml", "port:=x")}), tmp_path) for _ in range(2))
    for method, path, role, status in (
        ("POST", START + "arm", Role.COMMAND, 403),
        ("GET", START + "arm", Role.OBSERVE, 403),
        ("POST", START + "arm ledger:=x", Role.ADMIN, 404),
        ("POST", START + "../arm", Role.ADMIN, 404),
        ("POST", START, Role.ADMIN, 404),
        ("POST", "/stop", Role.ADMIN, 404),
        ("DELETE", START + "arm", Role.ADMIN, 404),
    ):
        assert first.answer_request(method, path, role)[0] == status, (method, path)
    assert [path.name for path in tmp_path.iterdir()] == ["wait.py"]
    assert first.answer_request("POST", START + "arm", Role.ADMIN) == (200, "started")
    out = tmp_path / "arm.out"
    until(lambda: "EOFError" in out.read_text(), "its end")
    status, text = until(
        lambda: (one := second.answer_request("GET", START + "arm", Role.ADMIN))[0] == 410 and one
    )
    head, *_, last = text.split("\n  ")
    assert (head, last) == (f"not running; {out} ends with:", "EOFError: EOF when reading a line")
    assert out.read_text().startswith("['arm.yaml', 'port:=x']\n")

    monkeypatch.setattr("dxlrun_fleet.agent._MAIN", ("-c", "import time; time.sleep(3600)"))
    assert first.answer_request("POST", START + "arm", Role.ADMIN)[0] == 200
    assert out.read_text() == ""
    for starter in (first, second):
        assert starter.answer_request("GET", START + "arm", Role.ADMIN) == (200, "running")
        assert starter.answer_request("POST", START + "arm", Role.ADMIN) == (409, "already running")
    (run,) = first._runs
    assert os.getsid(run.pid) == run.pid
    run.kill()
    run.wait()
    assert until(lambda: second.answer_request("GET", START + "arm", Role.ADMIN)[0] == 410)


@campaign(ci=300, night=100_000, release=1_000_000)
@pytest.mark.timeout(600)
def test_agent_starts_nothing_without_the_role_admin_for_fuzzed_requests_either(
    lab, agent, dxlrun, tmp_path, monkeypatch, *, amount, chance
):
    authority.issue("bert", Role.COMMAND, 30, tmp_path / "bert" / "dxlrun" / "keys")
    authority.issue("looks", Role.OBSERVE, 30, tmp_path / "other" / "dxlrun" / "keys")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "other"))
    assert "only a client with the role admin may start" in dxlrun("fleet", lab, "--start", "joint").err
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "stranger"))
    authority.issue("stranger", Role.ADMIN, 30, keys_place())
    assert "certificate verify failed" in dxlrun("fleet", lab, "--start", "joint").err
    assert not list(lab.parent.glob("*.out"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "bert"))
    address = read_fleet(lab).agents["lab3"].address
    names = ("joint", "joint/", "../joint", "joint?robot=joint", "hung", "%6Aoint", "")
    seeds = [Said(method, START + name, b"x") for name in names for method in ("POST", "GET", "DELETE")]
    reach = partial(socket.create_connection, address[1:])
    connect = NetworkLink(address, "")._connected
    check_port_survives_fuzzing(connect, reach, seeds, agent.pid, frames=int(amount), draw=chance)
    assert not list(lab.parent.glob("*.out"))


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(lab, tmp_path, monkeypatch, dxlrun, case):
    monkeypatch.chdir(tmp_path)
    play(case, dxlrun)


def test_a_quoted_argument_of_a_robot_keeps_its_space(tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text("robots: {}\nagents: {a: {address: h:1, starts: {arm: arm.yaml 'logs:=my logs'}}}\n")
    assert read_fleet(file).agents["a"].starts == {"arm": ("arm.yaml", "logs:=my logs")}


def test_fleet_md_has_a_file_that_is_read_and_lines_that_can_be_typed(tmp_path):
    page = page_text("fleet.md")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "lab.yaml").write_text(text)
    fleet = read_fleet(tmp_path / "lab.yaml")
    lines = [shlex.split(line)[1:] for line in re.findall(r"^    (dxlrun fleet .*)$", page, re.MULTILINE)]
    assert len(lines) >= 4
    for line in lines:
        _, bound, _ = app.build("fleet").parse_args(line, print_error=False, exit_on_error=False)
        assert bound.arguments["file"] == Path("lab.yaml")
        fleet.require_robots((*bound.arguments.get("start", ()), *bound.arguments.get("stop", ())))
        assert bound.arguments.get("serve") in (None, *fleet.agents)
    for agent in fleet.agents.values():
        assert set(agent.starts) <= set(fleet.robots)
        assert [(words[1], words[-2]) for words in agent.starts.values()] == [
            ("port:=/dev/ttyUSB0", "--listen")
        ]
    with pytest.raises(InputError, match="no agent"):
        fleet.agent_of("bioloid_torso_2")
