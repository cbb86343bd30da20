"""The process of the simulated buses, started from a configuration, and hosts at its terminals."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels import child_processes
from dxlsim.messages import SimulationJob
from dxlsim.simulation_plan import BusConfig, SimulationConfig

"""How long a test waits for what must come; it decides nothing but when to give up."""


def started(
    config: SimulationConfig | Sequence[BusConfig], *, errors: int | None = None, **options: Any
) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start it; return the process and our end of the control socket, whose end ends it.

    `options`: of the SimulationJob.
    """
    whole = config if isinstance(config, SimulationConfig) else SimulationConfig(tuple(config))
    job = child_processes.memory_file("bus-process", msgspec.json.encode(SimulationJob(whole, **options)))
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-m", "dxlrun.run.simulation_process", "--job-fd", str(job)]
    command += ["--control-fd", str(theirs.fileno())]
    inherited = (job, theirs.fileno())
    child = subprocess.Popen(command, pass_fds=inherited, stderr=errors, start_new_session=True)
    theirs.close()
    os.close(job)
    return child, ours


@contextlib.contextmanager
def bare(
    config: SimulationConfig | Sequence[BusConfig], **options: Any
) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """Start it, and close our end of the socket in the end."""
    child, ours = started(config, errors=subprocess.PIPE, **options)
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
        assert select.select([port], [], [], DEADLINE_S)[0], f"only {received.hex(' ')} came"
        arrived = os.read(port, 256)
        assert arrived, f"the terminal is gone after {received.hex(' ')}"
        received += arrived
    return received
