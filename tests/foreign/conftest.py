"""A running simulation as a stranger meets it: device files to open, and nothing else.

Each test takes a bus of its own, so that one process serves a whole module and no test sees another one's
servos. What the servos refused is read from the ledger in the end, and must be what the tests expected.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol1PacketHandler, Protocol2PacketHandler
from tests.kit.awaited import DEADLINE_S, until
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


class Item(NamedTuple):
    """Address and size of an item."""

    address: int
    size: int


class Host:
    """A program with the SDK's packet handler on a bus; `read` and `write` are good or fail."""

    def __init__(self, simulation: Simulation, bus: str, protocol: float) -> None:
        self.simulation, self.bus = simulation, bus
        self.port = PatientPort(simulation.ports[bus])
        assert self.port.setBaudRate(1_000_000)
        self.sdk: Any = Protocol1PacketHandler() if protocol == 1.0 else Protocol2PacketHandler()

    def get(self, servo_id: int, item: Item) -> tuple[int, int, int]:
        """Return value, result and error of a read, as the SDK has them."""
        read = getattr(self.sdk, f"read{item.size}ByteTxRx")
        found: tuple[int, int, int] = read(self.port, servo_id, item.address)
        return found

    def put(self, servo_id: int, item: Item, value: int) -> tuple[int, int]:
        """Return result and error of a write."""
        write = getattr(self.sdk, f"write{item.size}ByteTxRx")
        found: tuple[int, int] = write(self.port, servo_id, item.address, value)
        return found

    def read(self, servo_id: int, item: Item) -> int:
        value, *how = self.get(servo_id, item)
        assert how == [COMM_SUCCESS, 0]
        return value

    def write(self, servo_id: int, item: Item, value: int) -> None:
        assert self.put(servo_id, item, value) == (COMM_SUCCESS, 0)

    def refused(self, servo_id: int, item: Item, value: int) -> str:
        """Let a servo refuse a write; return the SDK's words for it."""
        self.simulation.expect_refusals(self.bus, 1)
        result, error = self.put(servo_id, item, value)
        assert result == COMM_SUCCESS
        return str(self.sdk.getRxPacketError(error))

    def near(self, servo_id: int, item: Item, value: int, by: int = 20) -> bool:
        """Wait until an item is near a value."""
        return until(lambda: abs(self.read(servo_id, item) - value) <= by)

    def ping(self, servo_id: int) -> int:
        """Return the model number."""
        model, *how = self.sdk.ping(self.port, servo_id)
        assert how == [COMM_SUCCESS, 0]
        return int(model)

    def is_silent(self, servo_id: int) -> bool:
        return self._impatiently(lambda: self.sdk.ping(self.port, servo_id)[1] != COMM_SUCCESS)

    def _impatiently(self, ask: Callable[[], bool]) -> bool:
        patience, self.port.patience_ms = self.port.patience_ms, 30.0
        try:
            return ask()
        finally:
            self.port.patience_ms = patience


@pytest.fixture
def connect(simulation: Simulation, request: pytest.FixtureRequest) -> Iterator[Callable[..., Host]]:
    """Open a bus as the SDK's examples do, in the PROTOCOL of the module or another one."""
    opened: list[Host] = []

    def connect(bus: str, protocol: float = 0.0) -> Host:
        opened.append(Host(simulation, bus, protocol or request.module.PROTOCOL))
        return opened[-1]

    yield connect
    for host in opened:
        host.port.closePort()
