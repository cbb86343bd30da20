"""network.md, by its commands: a run, reached from another computer; the simulated bus is the judge."""

import http.client
import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.kit.fuzzed_http import Said, check_port_survives_fuzzing, process_of
from tests.kit.pages import page_text
from tests.kit.torso import Run, copy_robots, settled, written
from tests.kit.wire import commands, taken_apart

import dxlrun
from dxlrun.cli import main
from dxlrun.errors import Refused
from dxlrun.remote.network.certificates import client_context, keys_place
from dxlrun.remote.network.network_link import NetworkLink
from dxlrun.remote.requests.request_table import EXAMPLES, REQUESTS, Role
from dxlrun.remote.sockets import Address, SocketLink, sockets
from dxlsim.bus.ledger import read_ledger

authority = pytest.importorskip("dxlrun_fleet.authority", reason="needs the extra network")
pytestmark = pytest.mark.timeout(600)

DXLRUN = Path(sys.executable).with_name("dxlrun")
PAGE = page_text("network.md")
NAME = "bioloid_torso"
HEAD = b'{"positions": [0.1, 0.1], "velocities": [1.0, 1.0]}'
BODIES = {
    "/torque": b'{"joints": "all", "on": false}',
    "/switch": b'{"activate": ["whole_body_position"], "deactivate": ["head", "left_arm", "right_arm"]}',
    "/controllers/head/commands/posvel": HEAD,
    "/controllers/head/set-points/posvel": HEAD,
    "/joints/head_yaw_joint/registers/cw_compliance_slope": b'{"value": 128}',
    "/rate": b'{"rate": 25}',
}
NAMES = {"name": "head", "kind": "posvel", "item": "cw_compliance_slope", "number": "1"}


class Computers:
    """A robot's computer and a client's: each has its own settings and sockets, both are this machine."""

    def __init__(self, place, patch, capsys):
        self.place, self.patch, self.capsys = place, patch, capsys
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]

    def at(self, computer):
        home = self.place / computer
        for name, folder in (("XDG_CONFIG_HOME", "settings"), ("XDG_RUNTIME_DIR", "r")):
            (home / folder).mkdir(parents=True, exist_ok=True)
            self.patch.setenv(name, str(home / folder))
        self.patch.chdir(home)
        if not (home / "robots").exists():
            copy_robots(home)
        return home

    def typed(self, line):
        """Do a line of the page; return what it printed."""
        words = shlex.split(line.replace("lab3", "127.0.0.1").replace("7660", str(self.port)))
        code = main(words[1:])
        told = self.capsys.readouterr()
        assert (code, told.err) == (0, ""), line
        return told.out


@pytest.fixture
def computers(tmp_path, monkeypatch, capsys):
    return Computers(tmp_path, monkeypatch, capsys)


def command_of(pattern):
    (found,) = re.findall(rf"(?:^    |`)({pattern}[^\n`]*)", PAGE, re.MULTILINE)
    return found


def test_the_page_by_its_commands_and_a_client_by_the_description(computers):
    here = computers.at("lab3")
    computers.typed(command_of("dxlrun keys robot"))
    computers.typed(command_of("dxlrun keys client anna"))
    assert "anna" in computers.typed("dxlrun keys")
    keys = computers.at("anna") / "settings/dxlrun/keys"
    shutil.copytree(here / "anna", keys)
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (keys.parent / "robots.yaml").write_text(text.replace("lab3:7660", f"127.0.0.1:{computers.port}"))
    computers.at("lab3")
    start = shlex.split(command_of("dxlrun robots/").replace("7660", str(computers.port)))
    with subprocess.Popen(
        [DXLRUN, *start[1:], "--ledger", "wire.jsonl"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        try:
            until(lambda: NAME in dxlrun.running())
            computers.at("anna")
            with dxlrun.connect(NAME) as robot:
                settled(here / "wire.jsonl", lambda: robot.info()["cycles"], 100)
            began_ns = time.monotonic_ns()
            assert NAME in computers.typed("dxlrun list")
            assert "head_yaw_joint" in computers.typed(f"{command_of('dxlrun watch')} --once")
            commanded(computers)
        finally:
            run.terminate()
            out, err = run.communicate(timeout=DEADLINE_S)
    assert b"Traceback" not in out + err
    sent = [*taken_apart(read_ledger(here / "wire.jsonl"), 1.0)]
    before, after = ([one for one in sent if (one.t_ns < began_ns) is early] for early in (True, False))
    assert commands(after, 1.0) - commands(before, 1.0)


def commanded(computers):
    """Command by the typed client, by the description and by curl, beside the robot's own computer."""
    with dxlrun.connect(NAME, "anna's program") as robot:
        robot.send("head", "posvel", {"positions": [0.2, 0.1], "velocities": [1.0, 1.0]})
        computers.at("lab3")
        with dxlrun.connect(NAME) as own:
            with pytest.raises(Refused, match="client anna commands this robot") as refused:
                own.switch(activate=["whole_body_position"], deactivate=["head"])
            assert refused.value.code == "commanded_by"
            own.take_over()
            with pytest.raises(Refused, match="this computer commands this robot"):
                robot.send("head", "posvel", {"positions": [0.0, 0.0], "velocities": [1.0, 1.0]})
            computers.at("anna")
            computers.typed(command_of("dxlrun take-over"))
            told = [one["text"] for one in own.events()["events"] if "commander" in one["text"]]
        assert [re.findall(r"commander (.*?) instead of (.*?) from ", text) for text in told] == [
            [("client anna", "this computer")],
            [("this computer", "client anna")],
            [("client anna", "this computer")],
        ]
    described(computers)
    if shutil.which("curl"):
        line = command_of("curl ").replace("lab3", "127.0.0.1").replace("7660", str(computers.port))
        keys = computers.place / "anna/settings/dxlrun/keys"
        found = subprocess.run(["/bin/bash", "-c", f"{line} -s"], cwd=keys, capture_output=True, check=True)
        assert json.loads(found.stdout)["robot"] == NAME
    computers.typed(f"dxlrun stop --robot {NAME}@127.0.0.1:{computers.port}")


def described(computers):
    """Ask what the description has, with Python's own HTTP."""

    class Connection(http.client.HTTPSConnection):
        def connect(self):
            end = socket.create_connection(("127.0.0.1", computers.port))
            self.sock = client_context().wrap_socket(end, server_hostname=NAME)

    def ask(method, path):
        with closing(Connection(NAME)) as connection:
            connection.request(method, path)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read())

    paths = ask("GET", "/openapi.json")[1]["paths"]
    for path, methods in paths.items():
        for method, one in methods.items():
            roles = {role for way in one["security"] for role in way["certificate"]}
            if method == "get" and "{" not in path and path != "/stream":
                assert "command" in roles
                assert ask("GET", path)[0] == 200, path
            elif "command" not in roles:
                assert ask(method.upper(), path.replace("{", "").replace("}", ""))[0] == 403, path


@campaign(ci=300, night=100_000, release=1_000_000)
def test_fuzzed_requests_command_nothing_and_leak_no_memory(tmp_path, monkeypatch, amount, chance):
    """An observer on TLS requests everything that is forbidden to it.

    The seeds of this user's own socket have no request that commands.
    """
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = Address(f"{NAME}_imu", *free.getsockname())
    authority.issue(address.name, None, 30, keys_place())
    authority.issue("olga", Role.OBSERVE, 30, keys_place())
    run = Run(tmp_path, "--listen", str(address))
    try:
        run.start()
        gateway = process_of(run.process.pid, "dxlrun.remote")
        with dxlrun.connect(address.name) as robot:
            before = settled(run.ledger, lambda: robot.info()["cycles"], 20)
        for link in (NetworkLink(address, ""), SocketLink(sockets()[address.name], "")):
            ways = link._connected, partial(reached, link)
            check_port_survives_fuzzing(*ways, seeds(link), gateway, frames=int(amount), draw=chance)
            assert written(run.ledger) == before
        with dxlrun.connect(address.name) as robot:
            robot.stop()
        assert written(run.ledger) > before
    finally:
        run.end()


def seeds(link):
    """Return the requests of the table but streams and long ones; of the Unix socket none that commands."""
    found = []
    for one in REQUESTS:
        path = re.sub(r"\{(\w+)(:path)?\}", lambda word: NAMES[word[1]], one.path)
        if path in {"/stream", "/frames", "/log-header", "/openapi.json"}:
            continue
        if isinstance(link, NetworkLink) or one.role is Role.OBSERVE:
            body = BODIES.get(path, EXAMPLES.get(one.body, "{}").encode())
            found.append(Said(one.method, path, body if one.method == "POST" else b""))
    return found


def reached(link):
    """Return a connection to where a link goes, and no more."""
    if isinstance(link, NetworkLink):
        return socket.create_connection(link._address[1:])
    end = socket.socket(socket.AF_UNIX)
    end.connect(str(link._path))
    return end


def test_keys_write_over_nothing_that_is_anothers(computers):
    computers.at("lab3")
    for line in ("keys robot torso", "keys client anna --role admin"):
        computers.typed(f"dxlrun {line}")
    keys = Path("settings/dxlrun/keys")
    kept = {path: path.read_bytes() for path in keys.rglob("*") if path.is_file()}
    assert {path.stat().st_mode & 0o777 for path in kept} == {0o600}
    for line in (
        "client anna",
        "client bert",
        "robot client",
        "robot ../x",
        "renew carl",
        "client bert --days 0",
        "renew carl --role admin",
        "renew anna --role admin",
        "robot arm --role admin",
        "revoke anna --days 3",
        "list anna",
        "list --output elsewhere",
    ):
        assert main(["keys", *line.split()]) == 2, line
    assert main(["keys", "client", "bert", "--output", "bert"]) == 0
    assert main(["keys", "renew", "bert"]) == 2
    assert main(["keys", "renew", "bert", "--output", "bert"]) == 0
    assert main(["keys", "revoke", "bert"]) == 0
    assert len((keys / "revoked").read_text().split()) == 2
    rows = computers.capsys.readouterr() and result_of(computers.typed("dxlrun keys --json"))
    assert [(one["name"], one["role"], one["state"]) for one in rows] == [
        ("anna", "admin", "valid"),
        ("bert", "observe", "revoked"),
        ("torso", "robot", "valid"),
    ]
    assert {path: path.read_bytes() for path in kept} == kept
    computers.at("other")
    assert main(["keys", "robot", "arm", "--output", str(computers.place / "lab3/bert")]) == 2
    assert "belongs to another authority" in computers.capsys.readouterr().err
