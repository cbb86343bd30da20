"""A line with servos of both protocols: two simulated buses, which also receive what the other one sends."""

from collections.abc import Sequence

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import model_names


class MixedBus:
    """Bus of two kinds of servos; bus `1` of the ledger has Protocol 1.0, bus `2` Protocol 2.0.

    Not modelled: collisions of servos of different kinds.
    """

    plugged, times_unplugged = True, 0

    def __init__(self, servos: Sequence[ServoConfig], ledger: Ledger, baud_rate: int = 1_000_000) -> None:
        first = [servo for servo in servos if servo.model in model_names(1.0)]
        second = [servo for servo in servos if servo not in first]
        self.kinds = tuple(
            SimulatedBus(BusConfig(f"{protocol:.0f}", baud_rate, tuple(some), protocol), ledger, 0)
            for protocol, some in ((1.0, first), (2.0, second))
        )

    def servo(self, servo_id: int) -> SimulatedServo:
        return next(each for kind in self.kinds for each in kind.servos if each.servo_id == servo_id)

    def receive_bytes(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        for kind in self.kinds:
            kind.receive_bytes(data, at_ns)

    def next_due_ns(self) -> int | None:
        return min(
            (due_ns for kind in self.kinds if (due_ns := kind.next_due_ns()) is not None), default=None
        )

    def drain_bytes(self, now_ns: int) -> bytes:
        """Return what both kinds have sent by now; each receives it from the other."""
        sent = [kind.drain_bytes(now_ns) for kind in self.kinds]
        for kind, data in zip(reversed(self.kinds), sent, strict=True):
            if data:
                kind.receive_bytes(data, now_ns)
        return b"".join(sent)

    def change_rate(self, baud_rate: int) -> None:
        for kind in self.kinds:
            kind.change_rate(baud_rate)
