"""The process of the simulated buses, started from a configuration, and hosts at its terminals."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from dxlrun.plan.simulation_plan import BusConfig, SimulationConfig, encode_config

PATIENCE_S = 60.0
"""How long a test waits for what must come; it decides nothing but when to give up."""


@contextlib.contextmanager
def bare(
    path: Path, config: SimulationConfig | Sequence[BusConfig], *options: str
) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """Start it from a file; give the process and our end of the control socket, whose end ends it."""
    path.write_bytes(encode_config(config))
    ours, theirs = socket.socketpair()
    with path.open("rb") as file:
        command = [sys.executable, "-m", "dxlrun.simulation", "--config-fd", str(file.fileno())]
        command += ["--control-fd", str(theirs.fileno()), *options]
        inherited = (file.fileno(), theirs.fileno())
        child = subprocess.Popen(command, pass_fds=inherited, stderr=subprocess.PIPE, start_new_session=True)
    theirs.close()
    with child, ours:
        yield child, ours


@contextlib.contextmanager
def opened(path: str) -> Iterator[int]:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield port
    finally:
        os.close(port)


def receive(port: int, size: int) -> bytes:
    received = b""
    while len(received) < size:
        assert select.select([port], [], [], PATIENCE_S)[0], f"only {received.hex(' ')} came"
        arrived = os.read(port, 256)
        assert arrived, f"the terminal is gone after {received.hex(' ')}"
        received += arrived
    return received
