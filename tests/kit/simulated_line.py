"""A host of a few lines that talks to a simulated bus on virtual time; its packets are made by hand."""

from typing import Any, NamedTuple

from tests.kit.packets import crc, packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.motion.mechanics import Mechanics
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import WHOLE_REPLIES, AdapterConfig, BusConfig, ServoConfig, ServoTimes
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.control_table import model_names


class Answer(NamedTuple):
    servo_id: int
    error: int
    parameters: bytes


class Line:
    """One bus with an open port; servos of a model that has both protocols use 1.0 unless told otherwise."""

    def __init__(
        self,
        model: str = "AX-12A",
        *ids: int,
        protocol: float = 0.0,
        baud_rate: int = 1_000_000,
        position: float = 2.0,
        return_delay_ns: int = 500_000,
        write_time_ns: int = 0,
        response_delay_ns: int = 0,
        start_ns: int = 0,
        adapter: AdapterConfig = WHOLE_REPLIES,
        mechanics: Mechanics | None = None,
        **servo: Any,
    ) -> None:
        self.protocol = protocol or (1.0 if model in model_names(1.0) else 2.0)
        times = ServoTimes(write_time_ns=write_time_ns, response_delay_ns=response_delay_ns)
        servos = tuple(
            ServoConfig(each, model, position, return_delay_ns, times=times, **servo)
            for each in ids or (1, 2)
        )
        self.clock, self.ledger = VirtualClock(start_ns), Ledger()
        config = BusConfig("main", baud_rate, servos, self.protocol, adapter=adapter)
        self.bus = SimulatedBus(config, self.ledger, start_ns, mechanics)
        self.ports = VirtualPorts(self.clock, (self.bus,))

    def send(self, data: bytes) -> None:
        self.ports.ports[0].write_packet(data)

    def receive(self, wait_ns: int = 10_000_000) -> bytes:
        """Return everything that arrives in a time."""
        deadline = self.clock.now_ns() + wait_ns
        received, buffer = bytearray(), memoryview(bytearray(4096))
        while self.ports.wait_for_bytes(deadline):
            received += buffer[: self.ports.ports[0].read_into(buffer)]
        return bytes(received)

    def packet(self, servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
        """Return a packet of the line's protocol."""
        if self.protocol == 1.0:
            return packet1(servo_id, instruction, *parameters)
        return packet2(servo_id, instruction, parameters)

    def instruct(self, servo_id: int, instruction: int, parameters: bytes = b"") -> None:
        self.send(self.packet(servo_id, instruction, parameters))

    def statuses(self, wait_ns: int = 10_000_000) -> list[Answer]:
        """Return the status packets that arrive in a time; nothing else may."""
        return split_statuses(self.receive(wait_ns), self.protocol)

    def request(self, servo_id: int, instruction: int, parameters: bytes = b"") -> Answer | None:
        """Send an instruction; return the one status packet that answers it, None for silence."""
        self.instruct(servo_id, instruction, parameters)
        answers = self.statuses()
        assert len(answers) < 2
        return answers[0] if answers else None

    def word(self, number: int) -> bytes:
        """Return an address or a length."""
        return number.to_bytes(1 if self.protocol == 1.0 else 2, "little")

    def read_bytes(self, address: int, size: int, servo_id: int = 1) -> bytes:
        answer = self.request(servo_id, 0x02, self.word(address) + self.word(size))
        assert answer is not None
        return answer.parameters

    def write_bytes(self, address: int, data: bytes, servo_id: int = 1) -> int:
        """Write bytes and return the error of the answer."""
        answer = self.request(servo_id, 0x03, self.word(address) + data)
        assert answer is not None
        return answer.error

    def item(self, name: str, servo_id: int = 1) -> Any:
        """Return the item of a servo's or device's control table."""
        node = next(each for each in self.bus.nodes if each.registers["id"] == servo_id)
        return node.registers.table.items[name]

    def set(self, name: str, value: int, servo_id: int = 1) -> int:
        """Write an item by name; return the error."""
        item = self.item(name, servo_id)
        data = (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")
        return self.write_bytes(item.address, data, servo_id)

    def get(self, name: str, servo_id: int = 1) -> int:
        """Read an item by name, in ticks."""
        item = self.item(name, servo_id)
        ticks: int = item.decode(self.read_bytes(item.address, item.size, servo_id))
        return ticks

    def put(self, **items: int) -> None:
        """Write items of servo 1 by name, one after the other; none may be refused."""
        for name, value in items.items():
            assert not self.set(name, value) & 0x7F, name

    def wait(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now_ns() + round(seconds * 1e9))

    def inject(self, *faults: str, seed: int = 0) -> FaultScript:
        """Let faults happen, which are given as a user types them."""
        script = FaultScript([parse_fault(text) for text in faults], seed)
        script.attach((self.bus,), start_ns=0, now_ns=self.clock.now_ns())
        return script

    @property
    def notes(self) -> list[str]:
        return [entry.note for entry in self.ledger.entries if entry.direction == "note"]

    @property
    def faults(self) -> list[str]:
        return [note.removeprefix("fault: ") for note in self.notes if note.startswith("fault: ")]

    def servo(self, servo_id: int = 1) -> SimulatedServo:
        self.bus.advance_to(self.clock.now_ns())
        return self.bus.servo(servo_id)


def split_statuses(received: bytes, protocol: float) -> list[Answer]:
    """Return the status packets of a stream, which has nothing else and none with a wrong checksum."""
    answers = []
    while received and protocol == 1.0:
        assert received[:2] == b"\xff\xff", received.hex(" ")
        packet, received = received[: 4 + received[3]], received[4 + received[3] :]
        assert sum(packet[2:]) & 0xFF == 0xFF, packet.hex(" ")
        answers.append(Answer(packet[2], packet[4], packet[5:-1]))
    while received:
        assert received[:4] == b"\xff\xff\xfd\x00", received.hex(" ")
        size = 7 + int.from_bytes(received[5:7], "little")
        packet, received = received[:size], received[size:]
        assert packet[7] == 0x55, packet.hex(" ")
        assert crc(packet[:-2]) == int.from_bytes(packet[-2:], "little"), packet.hex(" ")
        answers.append(
            Answer(packet[4], packet[8], packet[9:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))
        )
    return answers
