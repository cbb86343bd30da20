"""A host of a few lines that talks to a simulated bus; its packets are put together here, by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import pytest

from dxlrun.clock import VirtualClock
from dxlrun.simulation import BusConfig, Ledger, ServoConfig, SimulatedBus, SimulatedServo, VirtualPorts


class Answer(NamedTuple):
    servo_id: int
    error: int
    parameters: bytes


def packet(servo_id: int, instruction: int, *parameters: int) -> bytes:
    body = bytes((servo_id, len(parameters) + 2, instruction, *parameters))
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


@dataclass
class Line:
    """One bus with an open port, on virtual time."""

    clock: VirtualClock
    bus: SimulatedBus
    ledger: Ledger
    ports: VirtualPorts

    def send(self, servo_id: int, instruction: int, *parameters: int) -> None:
        self.ports.ports[0].write(packet(servo_id, instruction, *parameters))

    def hear(self, wait_ns: int = 10_000_000) -> bytes:
        """Return everything that arrives in a time."""
        deadline = self.clock.now_ns() + wait_ns
        heard = bytearray()
        buffer = memoryview(bytearray(4096))
        while self.ports.wait(deadline):
            heard += buffer[: self.ports.ports[0].read_into(buffer)]
        return bytes(heard)

    def ask(self, servo_id: int, instruction: int, *parameters: int) -> Answer | None:
        """Send an instruction; return the one status packet that answers it, None for silence."""
        self.send(servo_id, instruction, *parameters)
        heard = self.hear()
        if not heard:
            return None
        assert heard[:2] == b"\xff\xff"
        assert heard[3] == len(heard) - 4
        assert sum(heard[2:]) & 0xFF == 0xFF
        return Answer(heard[2], heard[4], heard[5:-1])

    def write(self, servo_id: int, address: int, *data: int) -> int:
        """Write bytes and return the error byte of the answer."""
        answer = self.ask(servo_id, 0x03, address, *data)
        assert answer is not None
        return answer.error

    def read(self, servo_id: int, address: int, size: int) -> int:
        """Return an item as the integer of the wire."""
        answer = self.ask(servo_id, 0x02, address, size)
        assert answer is not None
        return int.from_bytes(answer.parameters, "little")

    def notes(self) -> list[str]:
        return [entry.note for entry in self.ledger.entries if entry.direction == "note"]

    def servo(self, servo_id: int = 1) -> SimulatedServo:
        self.bus.advance(self.clock.now_ns())
        return self.bus.servo(servo_id)


@pytest.fixture
def make_packet() -> Callable[..., bytes]:
    return packet


@pytest.fixture
def make_line() -> Callable[..., Line]:
    def make(
        ids: tuple[int, ...] = (1, 2),
        *,
        baud_rate: int = 1_000_000,
        position: float = 2.0,
        return_delay_ns: int = 500_000,
        start_ns: int = 0,
    ) -> Line:
        clock = VirtualClock(start_ns)
        ledger = Ledger()
        servos = tuple(ServoConfig(servo_id, "AX-12A", position, return_delay_ns) for servo_id in ids)
        bus = SimulatedBus(BusConfig("main", baud_rate, servos), ledger, start_ns)
        return Line(clock, bus, ledger, VirtualPorts(clock, (bus,)))

    return make


@pytest.fixture
def line(make_line: Callable[..., Line]) -> Line:
    return make_line()
