"""The process of the simulated buses, started from a configuration, and hosts at its terminals."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels import child_processes
from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlsim.messages import SimulationJob
from dxlsim.simulation_plan import BusConfig, SimulationConfig

Buses = SimulationConfig | Sequence[BusConfig]
SimulatedLine = Callable[[BusConfig], tuple[str, Callable[[], tuple[LedgerEntry, ...]]]]


def launch(config: Buses, **options: Any) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start it; return the process and our end of the control socket, whose end ends it.

    `options`: of the SimulationJob.
    """
    whole = config if isinstance(config, SimulationConfig) else SimulationConfig(tuple(config))
    job = child_processes.memory_file("bus-process", msgspec.json.encode(SimulationJob(whole, **options)))
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-m", "dxlrun.run.simulation_process", "--job-fd", str(job)]
    command += ["--control-fd", str(theirs.fileno())]
    inherited = (job, theirs.fileno(), *options.get("sockets", ()))
    child = subprocess.Popen(command, pass_fds=inherited, stderr=subprocess.PIPE, start_new_session=True)
    theirs.close()
    os.close(job)
    return child, ours


class BusProcess:
    """The process; lines of JSON with it, and its ledger. It is killed at the end of a `with`."""

    def __init__(self, config: Buses, ledger: Path | None = None, **options: Any) -> None:
        self._ledger = ledger
        self.child, self.control = launch(config, ledger=str(ledger) if ledger else None, **options)
        self.control.settimeout(DEADLINE_S)
        self._said = self.control.makefile("rb")
        self.first = self.next()
        self.ports: dict[str, str] = self.first.get("ports", {})
        """The device file of each bus; none when the process ended at once."""

    def next(self) -> dict[str, Any]:
        """Return what it says next; nothing when it is gone."""
        said: dict[str, Any] = json.loads(self._said.readline() or b"{}")
        return said

    def ask(self, **question: object) -> dict[str, Any]:
        self.control.sendall(json.dumps(question).encode() + b"\n")
        return self.next()

    def hang_up(self, *, code: int = 0, error: bytes = b"") -> tuple[LedgerEntry, ...]:
        """End it as its starter does, judge how it ends, and return what the ledger holds."""
        self._said.close()
        self.control.close()
        said = self.child.communicate(timeout=DEADLINE_S)[1]
        assert error in said if error else not said, said.decode()
        assert self.child.returncode == code
        return read_ledger(self._ledger) if self._ledger and self._ledger.is_file() else ()

    def close(self) -> None:
        self._said.close()
        self.control.close()
        self.child.kill()
        self.child.communicate()

    def __enter__(self) -> BusProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def simulated_lines(directory: Path) -> Iterator[SimulatedLine]:
    """Give a function that serves a bus: it returns its device file, and what ends it and has its ledger."""
    with contextlib.ExitStack() as stack:

        def serve(bus: BusConfig) -> tuple[str, Callable[[], tuple[LedgerEntry, ...]]]:
            ledger = directory / f"ledger{len(list(directory.glob('ledger*.jsonl')))}.jsonl"
            process = stack.enter_context(BusProcess((bus,), ledger))
            return process.ports[bus.name], process.hang_up

        yield serve


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
