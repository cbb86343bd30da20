"""A host of a few lines that talks to a simulated bus; its packets are put together here, by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

from tests.kit.packets import crc, packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, Load, ServoConfig, ServoTimes
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock

LineKind = TypeVar("LineKind", bound="Line")


class Answer(NamedTuple):
    servo_id: int
    error: int
    parameters: bytes


@dataclass
class Line:
    """One bus with an open port, on virtual time."""

    WORD: ClassVar[int] = 1  # bytes of an address, and of a length

    clock: VirtualClock
    bus: SimulatedBus
    ledger: Ledger
    ports: VirtualPorts

    def send(self, servo_id: int, instruction: int, *parameters: int) -> None:
        self.ports.ports[0].write_packet(packet1(servo_id, instruction, *parameters))

    def receive(self, wait_ns: int = 10_000_000) -> bytes:
        """Return everything that arrives in a time."""
        deadline = self.clock.now_ns() + wait_ns
        received = bytearray()
        buffer = memoryview(bytearray(4096))
        while self.ports.wait_for_bytes(deadline):
            received += buffer[: self.ports.ports[0].read_into(buffer)]
        return bytes(received)

    def ask(self, servo_id: int, instruction: int, *parameters: int) -> Answer | None:
        """Send an instruction; return the one status packet that answers it, None for silence."""
        self.send(servo_id, instruction, *parameters)
        received = self.receive()
        if not received:
            return None
        assert received[:2] == b"\xff\xff"
        assert received[3] == len(received) - 4
        assert sum(received[2:]) & 0xFF == 0xFF
        return Answer(received[2], received[4], received[5:-1])

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

    def item(self, name: str, servo_id: int = 1) -> Any:
        """Return what the control table has about an item."""
        return self.bus.servo(servo_id).registers.table.items[name]

    def set(self, name: str, wire: int, servo_id: int = 1) -> int:
        """Write an item by name, as the integer of the wire; return the error."""
        item = self.item(name, servo_id)
        return self.write(
            servo_id, item.address, *(wire & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")
        )

    def get(self, name: str, servo_id: int = 1) -> int:
        """Read an item by name, as the integer of the wire."""
        item = self.item(name, servo_id)
        return self.read(servo_id, item.address, item.size)

    def at(self, name: str, value: int | None = None) -> bytes:
        """Return the parameters that read an item, or write a value into it."""
        item = self.item(name)
        parts = ((item.address, self.WORD), (item.size, self.WORD) if value is None else (value, item.size))
        return b"".join(number.to_bytes(size, "little") for number, size in parts)

    def request(self, servo_id: int, instruction: int, parameters: bytes = b"") -> Answer | None:
        """Send an instruction; return the one status packet that answers it, None for silence."""
        return self.ask(servo_id, instruction, *parameters)

    def put(self, **items: int) -> None:
        """Write items of servo 1 by name, one after the other; none may be refused."""
        for name, value in items.items():
            assert not self.set(name, value) & 0x7F, name

    def wait(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now_ns() + round(seconds * 1e9))

    def notes(self) -> list[str]:
        return [entry.note for entry in self.ledger.entries if entry.direction == "note"]

    def servo(self, servo_id: int = 1) -> SimulatedServo:
        self.bus.advance_to(self.clock.now_ns())
        return self.bus.servo(servo_id)


class Line2(Line):
    """One bus of Protocol 2.0."""

    WORD = 2

    def instruct(self, servo_id: int, instruction: int, parameters: bytes = b"") -> None:
        self.ports.ports[0].write_packet(packet2(servo_id, instruction, parameters))

    def statuses(self, wait_ns: int = 10_000_000) -> list[Answer]:
        """Return the status packets that arrive in a time; nothing else may."""
        received, answers = self.receive(wait_ns), []
        while received:
            assert received[:4] == b"\xff\xff\xfd\x00"
            size = 7 + int.from_bytes(received[5:7], "little")
            status, received = received[:size], received[size:]
            assert status[7] == 0x55
            assert crc(status[:-2]) == int.from_bytes(status[-2:], "little")
            parameters = status[9:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            answers.append(Answer(status[4], status[8], parameters))
        return answers

    def request(self, servo_id: int, instruction: int, parameters: bytes = b"") -> Answer | None:
        """Send an instruction; return the one status packet that answers it, None for silence."""
        self.instruct(servo_id, instruction, parameters)
        answers = self.statuses()
        assert len(answers) < 2
        return answers[0] if answers else None

    def write_bytes(self, servo_id: int, address: int, data: bytes) -> int:
        """Write bytes and return the error of the answer."""
        answer = self.request(servo_id, 0x03, address.to_bytes(2, "little") + data)
        assert answer is not None
        return answer.error

    def read_bytes(self, servo_id: int, address: int, size: int) -> bytes:
        answer = self.request(servo_id, 0x02, address.to_bytes(2, "little") + size.to_bytes(2, "little"))
        assert answer is not None
        assert not answer.error & 0x7F
        return answer.parameters

    def set(self, name: str, value: int, servo_id: int = 1) -> int:
        """Write an item by name, in ticks; return the error."""
        item = self.item(name, servo_id)
        return self.write_bytes(servo_id, item.address, item.encode(value))

    def get(self, name: str, servo_id: int = 1) -> int:
        """Read an item by name, in ticks."""
        item = self.item(name, servo_id)
        return item.decode(self.read_bytes(servo_id, item.address, item.size))


def build_line(
    kind: type[LineKind],
    protocol: float,
    ids: tuple[int, ...],
    model: str,
    *,
    baud_rate: int = 1_000_000,
    position: float = 2.0,
    return_delay_ns: int = 500_000,
    start_ns: int = 0,
    load: Load | None = None,
    firmware: int | None = None,
    write_time_ns: int = 0,
) -> LineKind:
    clock = VirtualClock(start_ns)
    ledger = Ledger()
    servos = tuple(
        ServoConfig(
            servo_id,
            model,
            position,
            return_delay_ns,
            load or Load(),
            firmware,
            times=ServoTimes(write_time_ns=write_time_ns),
        )
        for servo_id in ids
    )
    bus = SimulatedBus(BusConfig("main", baud_rate, servos, protocol), ledger, start_ns)
    return kind(clock, bus, ledger, VirtualPorts(clock, (bus,)))
