"""What is between the simulated buses and their users: the control socket, and links to the terminals."""

from __future__ import annotations

import os
import socket

import pytest

from dxlrun.simulation.messages import SimulationMessage
from dxlrun.simulation.pseudo_terminal import DeviceLink
from dxlrun.simulation.server import ControlLine


def test_what_is_not_read_from_the_control_socket_is_dropped():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        line = ControlLine(theirs)
        for _ in range(20_000):
            line.send(SimulationMessage(fault="x" * 100))
        assert line.has_unsent
        ours.sendall(b"one\ntw")
        assert line.receive() == [b"one"]
        ours.sendall(b"o\n" + bytes(70_000))
        sent = [each for _ in range(3) for each in line.receive()]
        assert sent == [b"two"]
        ours.close()
        line.receive()
        line.flush()
        assert line.closed


def test_a_link_never_replaces_a_file_and_is_removed_only_where_it_was_put(tmp_path):
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="is no link"):
        DeviceLink(file).point("/dev/null")
    one, other = DeviceLink(link), DeviceLink(link)
    one.point("/dev/null")
    other.point("/dev/zero")
    one.remove()
    assert os.readlink(link) == "/dev/zero"
    other.remove()
    assert os.listdir(tmp_path) == ["file"]
