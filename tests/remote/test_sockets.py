"""Where sockets are, which users may use them, and which of them are alive."""

import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from dxlrun.errors import DxlrunError
from dxlrun.remote import sockets
from dxlrun.remote.sockets import alive, create_listener, owned, running

NOBODY = 65534
CONNECT = """
import os, socket, sys
os.setgroups([])
os.setuid(65534)
try:
    socket.socket(socket.AF_UNIX).connect(sys.argv[1])
except PermissionError:
    print("forbidden")
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """The directory of this test's sockets, and no other one."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "dxlrun"


def test_only_the_same_user_may_enter(place):
    listener, path = create_listener("pair")
    with listener:
        assert path == place / "pair.sock"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
        assert running() == ("pair",)
        if os.getuid() == 0:  # only root can become another user
            for parent in (*list(place.parents)[:2], place):  # the socket's own mode is what forbids it
                parent.chmod(0o755)
            command = [sys.executable, "-c", CONNECT, str(path)]
            assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "forbidden\n"


def test_a_second_run_of_the_same_robot_gets_a_name_of_its_own():
    first, _ = create_listener("pair")
    second, path = create_listener("pair")
    with first, second:
        assert path.name == f"pair-{os.getpid()}.sock"
        assert running() == ("pair", f"pair-{os.getpid()}")


def test_the_socket_of_a_dead_run_is_removed_or_taken_over(place):
    listener, path = create_listener("pair")
    listener.close()
    assert path.exists()
    (place / "folder.sock").mkdir()
    assert running() == ()
    assert [path.name for path in place.iterdir()] == ["folder.sock"], "what is no socket is left alone"
    create_listener("pair")[0].close()
    again, path = create_listener("pair")
    with again:
        assert path == place / "pair.sock"
        assert running() == ("pair",)


def test_a_gateway_that_is_too_busy_to_listen_is_not_taken_for_dead():
    listener, path = create_listener("pair")
    listener.listen(0)
    with listener:
        waiting = []
        while True:
            client = socket.socket(socket.AF_UNIX)
            client.setblocking(False)
            waiting.append(client)
            try:
                client.connect(str(path))
            except BlockingIOError:
                break
        assert alive(path)
        assert running() == ("pair",)
        assert path.exists()
        for client in waiting:
            client.close()


def test_a_probe_of_no_socket_does_not_wait(place):
    assert running() == ()
    assert not place.exists()  # looking makes no directories
    assert not alive(place / "pair.sock")


@pytest.mark.parametrize("wrong", ["open to others", "a link", "a file"])
def test_a_directory_that_is_not_ours_alone_is_not_used(place, tmp_path, wrong):
    if wrong == "a file":
        place.write_text("")
    elif wrong == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        place.symlink_to(tmp_path / "elsewhere")
    else:
        place.mkdir()
        place.chmod(0o755)
        (place / "pair.sock").touch()
    with pytest.raises(DxlrunError, match="is not a private directory of this user; remove it"):
        create_listener("pair")
    assert running() == ()
    assert wrong != "open to others" or (place / "pair.sock").exists()


@pytest.mark.parametrize("value", ["", "relative", "/nowhere/at/all", None])
def test_without_a_runtime_directory_of_its_own_it_is_one_in_tmp(tmp_path, monkeypatch, value):
    assert sockets.sockets_directory() == tmp_path / "dxlrun"
    if value is None:  # that of another user, as after `su` that keeps the environment
        monkeypatch.setattr(os, "getuid", lambda: NOBODY)
    else:
        monkeypatch.setenv("XDG_RUNTIME_DIR", value)
    assert sockets.sockets_directory() == Path("/", "tmp", f"dxlrun-{os.getuid()}")


def test_with_a_runtime_directory_it_is_the_only_one(place, monkeypatch):
    looked_at = []
    monkeypatch.setattr(sockets, "owned", lambda directory: looked_at.append(directory) or owned(directory))
    with create_listener("pair")[0]:
        assert running() == ("pair",)
    assert set(looked_at) == {place}


def test_a_name_that_is_too_long_is_refused_in_plain_words():
    with pytest.raises(DxlrunError, match="too long for a socket; give the robot a shorter name"):
        create_listener("a" * 100)
