"""The process of simulated buses that a run starts, and lines on virtual time."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.bus_process import bare

from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlsim.simulation_plan import BusConfig


@dataclass
class Running:
    child: subprocess.Popen[bytes]
    control: socket.socket
    sent: IO[bytes]
    ports: dict[str, str]
    path: Path

    def hang_up(self) -> int:
        self.sent.close()
        self.control.close()
        return self.child.wait(DEADLINE_S)

    def ledger(self) -> tuple[LedgerEntry, ...]:
        return read_ledger(self.path)


@pytest.fixture
def start_buses(tmp_path: Path) -> Iterator[Callable[[Sequence[BusConfig]], Running]]:
    """Start the process of simulated buses, as often as it is called; all are ended with the test."""
    with contextlib.ExitStack() as stack:

        def run(buses: Sequence[BusConfig]) -> Running:
            path = tmp_path / "bus.jsonl"
            child, control = stack.enter_context(bare(buses, ledger=str(path)))
            control.settimeout(DEADLINE_S)
            sent = stack.enter_context(control.makefile("rb"))
            return Running(child, control, sent, json.loads(sent.readline())["ports"], path)

        yield run
