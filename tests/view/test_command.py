"""`dxlrun view`: what it prints, what it refuses, how it ends; runs the commands of docs/how-to/view.md."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.pages import page_text

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = re.findall(r"^    dxlrun (view.*)$", page_text("view.md"), re.MULTILINE)
CODE = "import sys; from dxlrun.cli import main; sys.exit(main())"
View = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[View]:
    """Starts the command where no robot runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    # as if the package was installed, which would fetch what its page is made of
    installed = tmp_path / "dxlrun_view-0.1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Name: dxlrun-view\nVersion: {version('dxlrun')}\n")
    (installed / "entry_points.txt").write_text("[dxlrun]\nview = dxlrun_view\n")
    package = str(ROOT / "plugins/dxlrun_view/src")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((package, str(tmp_path))))
    started: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        pipe: Any = subprocess.PIPE
        command = [sys.executable, "-P", "-c", CODE, "view", *words]
        started.append(subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def refused(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return exit code and sentence."""
    _, said = process.communicate(timeout=DEADLINE_S)
    assert "Traceback" not in said
    return process.returncode, said


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_a_log_is_served_until_ctrl_c(view: View, log: Path, tmp_path: Path, host: str) -> None:
    (tmp_path / "logs").mkdir()
    shutil.copy(log, tmp_path / "logs/bioloid_torso.mcap")
    (command,) = [one for one in COMMANDS if one.endswith(".mcap")]
    process = view(*command.split()[1:], "--no-browser", "--listen", f"{host}:0")
    assert process.stdout is not None
    line = process.stdout.readline()
    address = re.search(rf"{re.escape(host)}:(\d+)/\?token=\S{{20}}", line)
    said = "" if address or not process.stderr else process.stderr.read()
    if host == "[::1]" and "cannot be listened on" in said:
        pytest.skip(said)  # this system has no IPv6
    assert address, line + said
    connection = http.client.HTTPConnection(host.strip("[]"), int(address[1]), timeout=20)
    connection.request("GET", "/")
    answer = connection.getresponse()
    assert answer.status == 200
    assert "default-src 'none'" in str(answer.getheader("Content-Security-Policy"))
    assert b"page.js" in answer.read()
    connection.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(DEADLINE_S) == 0


@pytest.mark.parametrize("command", [one for one in COMMANDS if not one.endswith(".mcap")])
def test_without_a_robot_it_says_how_one_starts(view: View, command: str) -> None:
    code, said = refused(view(*command.split()[1:], "--no-browser"))
    assert code == 1
    assert "dxlrun ROBOT.yaml" in said


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (("nothing",), 2, "nothing"),
        (("gone.mcap",), 2, "gone.mcap"),
        (("gone.yaml",), 2, "gone.yaml"),
        ((str(ROOT / "robots/bioloid_torso.yaml"),), 1, "start it in another terminal"),
        (("bad.mcap",), 2, "bad.mcap"),
        (("--listen", ":99999999"), 2, "HOST:PORT"),
        (("{log}", "--listen", "127.0.0.99999"), 2, "make it by `dxlrun keys robot bioloid_torso_imu`"),
        (("{log}", "--listen", "192.0.2.1"), 2, "make it by `dxlrun keys robot bioloid_torso_imu`"),
        (("{log}", "--listen", "::"), 2, "make it by `dxlrun keys robot bioloid_torso_imu`"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    view: View, log: Path, words: tuple[str, ...], code: int, part: str
) -> None:
    Path("bad.mcap").write_bytes(b"nothing")
    found, said = refused(view(*(word.format(log=log) for word in words), "--no-browser"))
    assert (found, part in said) == (code, True), said


def test_a_port_that_is_taken_is_named(view: View, log: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        code, said = refused(view(str(log), "--no-browser", "--listen", f":{port}"))
    assert (code, port in said, "--listen" in said) == (2, True, True)
