"""`dxlrun fleet`: rows of robots that run, hang and are gone; an agent that starts what its own file has."""

from __future__ import annotations

import io
import os
import pty
import random
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec
import pytest
from rich.console import Console
from tests.kit.answers import result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.kit.commands import Dxlrun
from tests.kit.fuzzed_http import Said, check_port_survives_fuzzing, children, process_of
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

Closing = TypeVar("Closing", RobotView, NetworkLink, socket.socket)
INFO = RobotInfo("joint", 50.0, False, None, 0, 0, (), {}, {}, {}, {}, {}, {}, (), (), "x.yaml", None)
ADDRESS = Address("lab3", "127.0.0.1", 1)
TERMINAL = {"TERM": "xterm", "COLUMNS": "120", "LINES": "30"}
ROBOTS = Path(__file__).parents[2] / "robots"
DXLRUN = Path(sys.executable).with_name("dxlrun")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a fleet of one robot that an agent starts, and one whose network hangs; with all keys."""
    for name, place in (("XDG_CONFIG_HOME", "c"), ("XDG_RUNTIME_DIR", "r")):  # a socket's path has 107 bytes
        (tmp_path / place).mkdir(mode=0o700)
        monkeypatch.setenv(name, str(tmp_path / place))
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
def agent(lab: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The agent of that file, which takes connections."""
    with subprocess.Popen([DXLRUN, "fleet", lab, "--serve", "lab3"], stdout=subprocess.DEVNULL) as process:
        until(lambda: NetworkLink(read_fleet(lab).agents["lab3"].address, "test").alive, "the agent")
        yield process
        for run in children(process.pid):  # of a test that failed: a run goes on when its agent ends
            os.kill(run, signal.SIGTERM)
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0


@pytest.fixture
def closed() -> Iterator[Callable[[Closing], Closing]]:
    """Return what closes a thing at the test's end."""
    with ExitStack() as ends:
        yield lambda one: ends.enter_context(closing(one))


@pytest.mark.timeout(600)
def test_a_robot_is_started_seen_killed_and_seen_again_beside_one_that_hangs(
    lab: Path,
    agent: subprocess.Popen[bytes],
    dxlrun: Dxlrun,
    closed: Callable[[Closing], Closing],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dxlrun_fleet.fleet._START_S", DEADLINE_S)
    fleet = read_fleet(lab)
    closed(socket.create_server(fleet.robots["hung"][1:], backlog=1))
    said = dxlrun("fleet", lab, "--start", "joint")
    assert (said.code, said.out) == (0, "joint is running\n"), said.err
    said = dxlrun("fleet", lab, "--start", "joint")
    assert (said.code, said.errors) == (1, ["joint: already running"])

    views = {name: closed(RobotView(name, address)) for name, address in fleet.robots.items()}
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
    link = closed(NetworkLink(fleet.agents["lab3"].address, "test"))
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


def test_a_long_error_takes_no_room_from_the_names() -> None:
    row = RobotStatus(
        "joint_7", "running", voltage=12.0, temperature=30.0, error="a packet was lost " * 20, log="x" * 90
    )
    shown = io.StringIO()
    Console(file=shown, width=120).print(compact(fleet_table([row])))
    for words in ("joint_7", "running", "12.0 V", "30 deg C", "a packet was lost"):
        assert words in shown.getvalue()


def looked(dxlrun: Dxlrun, lab: Path) -> list[dict[str, str]]:
    """Return the rows of one look; one is unreachable."""
    said = dxlrun("fleet", lab, "--json")
    assert said.code == 1
    found: list[dict[str, str]] = result_of(said.out)
    return found


def test_the_last_error_stays_and_warnings_are_none(lab: Path) -> None:
    """Of a run that begins, and has no cycle yet."""

    class Begins:
        rows = ("a motor fell off", 40), ("a packet was lost", 30)

        def info(self) -> object:
            return msgspec.to_builtins(INFO)

        def events(self, after: int) -> object:
            rows = [
                EventRow(number, 0.0, "x", how, "loop", text) for number, (text, how) in enumerate(self.rows)
            ]
            return msgspec.to_builtins(Events(tuple(rows[after:]), len(rows)))

        def states(self) -> object:
            raise Refused("it has had no cycle yet", code=Code.NO_CYCLE)

    with closing(RobotView("joint", ADDRESS)) as view:
        view.tried.wait()
        view.close()
        view._replied = time.monotonic() + 3600.0
        assert view.seen().state == "unreachable"
        assert view.seen().reason == "joint no longer answers: [Errno 111] Connection refused"
        for last in (0, 2):
            assert view._poll_robot(Begins(), last) == 2
            assert (view.seen().state, view.seen().error, view.seen().voltage) == (
                "starting",
                "a motor fell off",
                None,
            )
        view._replied = time.monotonic() - 1.01 * SILENT_S
        assert (view.seen().state, view.seen().reason) == ("unreachable", "no answer")


def test_what_an_agent_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts what its own file names, for an admin, once, also when another agent started it."""
    (tmp_path / "wait.py").write_text(
        "import sys\nprint(sys.argv[1:], flush=True)\nsys.stdin.read()\ninput()\n"
    )
    monkeypatch.setattr("dxlrun_fleet.agent._MAIN", (tmp_path / "wait.py").read_text())
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

    monkeypatch.setattr("dxlrun_fleet.agent._MAIN", "import time; time.sleep(20)")
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


def test_an_agent_asks_for_a_certificate_with_the_role_admin(
    lab: Path, agent: subprocess.Popen[bytes], dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority.issue("looks", Role.OBSERVE, 30, tmp_path / "other" / "dxlrun" / "keys")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "other"))
    assert "only a client with the role admin may start" in dxlrun("fleet", lab, "--start", "joint").err
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "stranger"))
    authority.issue("stranger", Role.ADMIN, 30, keys_place())
    assert "certificate verify failed" in dxlrun("fleet", lab, "--start", "joint").err
    assert not list(lab.parent.glob("*.out"))


@campaign(ci=300, night=100_000, release=1_000_000)
@pytest.mark.timeout(600)
def test_agent_starts_nothing_for_fuzzed_requests_without_the_role_admin(
    lab: Path,
    agent: subprocess.Popen[bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    amount: float,
    chance: random.Random,
) -> None:
    authority.issue("bert", Role.COMMAND, 30, tmp_path / "other" / "dxlrun" / "keys")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "other"))
    address = read_fleet(lab).agents["lab3"].address
    names = ("joint", "joint/", "../joint", "joint?robot=joint", "hung", "%6Aoint", "")
    seeds = [Said(method, START + name, b"x") for name in names for method in ("POST", "GET", "DELETE")]
    reach = partial(socket.create_connection, address[1:])
    connect = NetworkLink(address, "")._connected
    check_port_survives_fuzzing(connect, reach, seeds, agent.pid, frames=int(amount), draw=chance)
    assert not list(lab.parent.glob("*.out"))


@pytest.mark.parametrize(
    ("text", "words", "sentence"),
    [
        ("robots: {arm: lab3}", (), "lab.yaml:1:15: robots.arm: 'lab3' is not an address"),
        ("robots: {arm: lab3:7}\nagent: {}", (), "lab.yaml:2:1"),
        (
            "robots: {}\nagents: {a: {address: h:1, starts: {arm: servo /dev/ttyUSB0 1}}}",
            (),
            "does not begin with a robot file",
        ),
        ("robots: {arm: lab3:7}", ("--start", "arm"), "no agent starts arm; add it to"),
        ("robots: {arm: lab3:7}", ("--stop", "amr"), "did you mean arm?"),
        ("robots: {arm: lab3:7}", ("--serve", "lab3"), "the fleet file has no agent lab3; its agents: none"),
        (
            "robots: {}\nagents: {a: {address: h:1, starts: {arm: arm.yaml}}}",
            ("--serve", "a"),
            "robot file ",
        ),
    ],
)
def test_what_is_wrong_with_a_file_is_one_sentence(
    lab: Path, dxlrun: Dxlrun, text: str, words: tuple[str, ...], sentence: str
) -> None:
    lab.write_text(text)
    said = dxlrun("fleet", lab, *words)
    assert (said.code, len(said.errors)) == (1 if "--start" in words else 2, 1), said
    assert sentence in said.errors[0]


def test_the_live_table_ends_with_q(lab: Path) -> None:
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


def test_fleet_md_has_a_file_that_is_read_and_lines_that_can_be_typed(tmp_path: Path) -> None:
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
