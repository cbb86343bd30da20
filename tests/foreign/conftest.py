"""A running simulation as a stranger meets it: device files to open, and nothing else.

Each test takes a bus of its own, so that one process serves a whole module and no test sees another one's
servos. What the servos refused is read from the ledger in the end, and must be what the tests expected.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from dynamixel_sdk import PortHandler
from tests.kit.awaited import DEADLINE_S
from tests.kit.bus_process import BusProcess


class Simulation(BusProcess):
    """The process of simulated buses, which is judged in the end."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._refusals: Counter[str] = Counter()
        self._hasty: set[str] = set()

    def expect_refusals(self, bus: str, count: int) -> None:
        """Say how many instructions the servos of a bus were made to refuse."""
        self._refusals[bus] += count

    def expect_haste(self, bus: str) -> None:
        """Say that a test asks again before an answer came, and may talk into it on a busy machine.

        What collides there is refused, too: such a bus is judged only for refusals that are missing.
        """
        self._hasty.add(bus)

    def judge(self) -> None:
        """End it, and find in the ledger what was expected and no accident."""
        notes = [(entry.bus, entry.note) for entry in self.hang_up() if entry.direction == "note"]
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
    with Simulation(request.module.BUSES, tmp_path_factory.mktemp("ledger") / "bus.jsonl") as running:
        yield running
        running.judge()


class PatientPort(PortHandler):
    """The SDK's port, which sleeps until bytes come and waits as long as a busy machine needs."""

    def __init__(self, port_name: str) -> None:
        super().__init__(port_name)
        self.wanted: int | None = None
        """So many bytes end the next wait for all that may answer, which lasts 0.8 s otherwise."""

    def setupPort(self, cflag_baud: int) -> bool:
        ready = bool(super().setupPort(cflag_baud))
        self.ser.timeout = 0.002
        return ready

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(DEADLINE_S * 1000)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(max(msec, DEADLINE_S * 1000))

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
