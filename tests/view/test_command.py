"""`dxlrun view`: what it prints, what it refuses, how it ends; runs the commands of docs/how-to/view.md."""

import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.commands import cases, play
from tests.kit.pages import page_commands

from dxlrun.cli import verb_registry
from dxlrun_view import dxlrun_commands

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
LOGS = [words for words in page_commands("view.md") if words[-1].endswith(".mcap")]
ROBOTS = [words for words in page_commands("view.md") if words[0] == "view" and words not in LOGS]


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A directory with a log, where no robot runs and the package counts as installed."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    found = dict(verb_registry.packaged()) | {command.name: command for command in dxlrun_commands()}
    monkeypatch.setattr(verb_registry, "packaged", lambda: found)
    return tmp_path


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_log_is_served_until_ctrl_c(log, place, monkeypatch, host):
    (place / "logs").mkdir()
    shutil.copy(log, place / "logs/bioloid_torso.mcap")
    # as if installed, which would fetch what its page is made of
    installed = place / "dxlrun_view-0.1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Name: dxlrun-view\nVersion: {version('dxlrun')}\n")
    (installed / "entry_points.txt").write_text("[dxlrun]\nview = dxlrun_view\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(ROOT / "plugins/dxlrun_view/src"), str(place))))
    (words,) = LOGS
    command = [sys.executable, "-P", "-m", "dxlrun", *words, "--no-browser", "--listen", f"{host}:0"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        address = re.search(rf"{re.escape(host)}:(\d+)/\?token=\S{{20}}", line)
        said = "" if address or not process.stderr else process.stderr.read()
        if host == "[::1]" and "cannot be listened on" in said:
            pytest.skip(said)  # this system has no IPv6
        assert address, line + said
        with closing(
            http.client.HTTPConnection(host.strip("[]"), int(address[1]), timeout=DEADLINE_S)
        ) as connection:
            connection.request("GET", "/")
            answer = connection.getresponse()
            assert answer.status == 200
            assert "default-src 'none'" in str(answer.getheader("Content-Security-Policy"))
            assert b"page.js" in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(dxlrun, log, place, case):
    (place / "log.mcap").symlink_to(log)
    play(case, dxlrun)


@pytest.mark.parametrize("words", ROBOTS)
def test_a_robot_that_does_not_run_is_refused(dxlrun, words):
    said = dxlrun(*words, "--no-browser")
    assert (said.code, "dxlrun ROBOT.yaml" in said.err) == (1, True), said


def test_port_that_is_taken_is_named(dxlrun, log):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        said = dxlrun("view", log, "--no-browser", "--listen", f":{port}")
    assert (said.code, port in said.err, "--listen" in said.err) == (2, True, True)
