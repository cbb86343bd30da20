"""A running simulation as a stranger meets it: device files to open, and nothing else.

Each test takes a bus of its own, so that one process serves a whole module and no test sees another one's
servos. What the servos refused is read from the ledger in the end, and must be what the tests expected.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from dynamixel_sdk import PortHandler
from tests.kit.awaited import DEADLINE_S
from tests.kit.bus_process import started

from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlsim.simulation_plan import BusConfig


class Simulation:
    """The process of simulated buses."""

    def __init__(self, buses: Sequence[BusConfig], ledger: Path) -> None:
        self._path = ledger
        self._refusals: Counter[str] = Counter()
        self._hasty: set[str] = set()
        self._child, self._control = started(buses, ledger=str(ledger))
        self._control.settimeout(DEADLINE_S)
        self._said = self._control.makefile("rb")
        first = self._said.readline()
        self.ports: dict[str, str] = json.loads(first)["ports"] if first else {}
        """The device file of each bus; none when the process ended at once."""

    def expect_refusals(self, bus: str, count: int) -> None:
        """Say how many instructions the servos of a bus were made to refuse."""
        self._refusals[bus] += count

    def expect_haste(self, bus: str) -> None:
        """Say that a test asks again before an answer came, and may talk into it on a busy machine.

        What collides there is refused, too: such a bus is judged only for refusals that are missing.
        """
        self._hasty.add(bus)

    def fault(self, line: str) -> None:
        """Break something on the running simulation; return when it took the order."""
        self._control.sendall(json.dumps({"fault": line}).encode() + b"\n")
        while "fault" not in (said := json.loads(self._said.readline())):
            assert "error" not in said, said

    def end(self) -> tuple[LedgerEntry, ...]:
        """Hang up; return what the ledger holds."""
        try:
            self._said.close()
            self._control.close()
            assert self._child.wait(DEADLINE_S) == 0
        finally:
            self._child.kill()
            self._child.wait()
        return read_ledger(self._path)

    def judge(self) -> None:
        """End it, and find in the ledger what was expected and no accident."""
        notes = [(entry.bus, entry.note) for entry in self.end() if entry.direction == "note"]
        refused = Counter(bus for bus, note in notes if " refuses " in note)
        for bus in self._hasty:
            refused[bus] = min(refused[bus], self._refusals[bus])
        accidents = [
            note
            for bus, note in notes
            if bus not in self._hasty and any(word in note for word in ("collision", "lost", "broken"))
        ]
        assert +refused == +self._refusals
        assert not accidents


@pytest.fixture(scope="module")
def simulation(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Serve the BUSES of a test's module."""
    running = Simulation(request.module.BUSES, tmp_path_factory.mktemp("ledger") / "bus.jsonl")
    try:
        yield running
    except BaseException:
        running.end()
        raise
    running.judge()


class PatientPort(PortHandler):
    """The SDK's port, which sleeps until bytes come and waits as long as a busy machine needs."""

    def __init__(self, port_name: str) -> None:
        super().__init__(port_name)
        self.patience_ms = DEADLINE_S * 1000
        """How long it waits for an answer; a test of silence makes it short."""
        self.wanted: int | None = None
        """So many bytes end the next wait for all that may answer, which lasts 0.8 s otherwise."""

    def setupPort(self, cflag_baud: int) -> bool:
        ready = bool(super().setupPort(cflag_baud))
        self.ser.timeout = 0.002
        return ready

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(self.patience_ms)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(max(msec, self.patience_ms))

    def readPort(self, length: int) -> bytes:
        data = bytes(super().readPort(length))
        if self.wanted is not None:
            self.wanted -= len(data)
        return data

    def isPacketTimeout(self) -> bool:
        if self.wanted is not None and self.wanted <= 0:
            self.wanted = None
            return True
        return bool(super().isPacketTimeout())


class Ports:
    """The SDK's ports that a test opened."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._open: list[PatientPort] = []

    def __call__(self, bus: str, rate: int = 1_000_000) -> PatientPort:
        port = PatientPort(self._simulation.ports[bus])
        assert port.setBaudRate(rate)
        self._open.append(port)
        return port

    def close(self) -> None:
        """Close them all."""
        while self._open:
            self._open.pop().closePort()


@pytest.fixture
def open_port(simulation: Simulation) -> Iterator[Ports]:
    """Open a bus as the SDK's examples do."""
    ports = Ports(simulation)
    yield ports
    ports.close()


@pytest.fixture
def patient_port() -> type[PatientPort]:
    """Put in the place of the SDK's port where a program opens it itself."""
    return PatientPort
