"""A simulated bus in a process of its own."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import pytest

from dxlrun.simulation import encode_config, read_ledger


@pytest.fixture
def simulated_line(tmp_path):
    """Run a simulated bus as a run does; gives its pseudo-terminal, and what ends it and has the ledger."""
    children = []

    def start(bus):
        ours, theirs = socket.socketpair()
        reader, writer = os.pipe()
        os.write(writer, encode_config((bus,)))
        os.close(writer)
        ledger = tmp_path / f"ledger{len(children)}.jsonl"
        command = [sys.executable, "-m", "dxlrun.simulation", "--config-fd", str(reader)]
        command += ["--control-fd", str(theirs.fileno()), "--ledger", str(ledger)]
        child = subprocess.Popen(command, pass_fds=(reader, theirs.fileno()), start_new_session=True)
        children.append((child, ours))
        os.close(reader)
        theirs.close()
        ours.settimeout(60)

        def finish():
            ours.close()
            assert child.wait(60) == 0
            return read_ledger(ledger)

        return json.loads(ours.recv(4096))["ports"][bus.name], finish

    yield start
    for child, ours in children:
        child.kill()
        child.wait()
        ours.close()
