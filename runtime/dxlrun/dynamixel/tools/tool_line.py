"""Tool line: a port that tools use outside of a run, with one protocol and baud rate at a time."""

from __future__ import annotations

from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import PortError, help_link
from dxlwire.bus.adjustable_port import FIRST_RATE
from dxlwire.bus.sdk_port import SdkPort
from dxlwire.packets import Bytes, PacketKind, PacketSink
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, Line, listen_transaction
from dxlwire.transaction import Program, Reply, Result
from dxlwire.wire.dialect import dialect_of


class BusPacketSink(PacketSink):
    """Packet sink that forwards packets to a log under a fixed bus index."""

    def __init__(self, log: PacketSink, index: int) -> None:
        self._log = log
        self._index = index

    def packet(  # noqa: PLR0917  the contract of PacketSink
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Bytes
    ) -> None:
        """Forward a sent or received packet with the fixed bus index in place of `bus`."""
        self._log.packet(self._index, kind, servo_id, first_ns, last_ns, data)


class ToolLine:
    """Runs programs on the port of a tool, in one protocol and at one rate; call `speak` first, and again to
    change them.

    `log` receives every packet.
    """

    def __init__(self, port: TunablePort, log: PacketSink | None = None) -> None:
        self.port = port
        self.baud_rate = 0
        self.line: Line = Line(FIRST_RATE, port.most_latency_ns, LONGEST_RETURN_DELAY_NS)
        """Makes transactions for the protocol and rate that `speak` set."""
        self._log = log or PacketSink()
        self._spoken: dict[tuple[float, int], SdkPort] = {}
        """Port handlers by protocol and rate: they are kept, because a late reply may come after another rate
        was used.
        """

    def speak(self, protocol: float, baud_rate: int) -> bool:
        """Change to a protocol and a baud rate (bit/s); return False, unchanged, if the adapter does not
        support the rate.
        """
        if not self.port.tune(baud_rate):
            return False
        self.baud_rate = baud_rate
        latency_ns = self.port.most_latency_ns
        self.line = Line(baud_rate, latency_ns, LONGEST_RETURN_DELAY_NS, dialect_of(protocol))
        if (protocol, baud_rate) not in self._spoken:
            self._spoken[protocol, baud_rate] = SdkPort(self.port, protocol, baud_rate, self._log)
        return True

    @property
    def heard(self) -> SdkPort:
        """Port handler of the present protocol and rate; it has the IDs that answered, and counts noise."""
        key = self.line.dialect.PROTOCOL, self.baud_rate
        if key not in self._spoken:
            raise LookupError("choose the protocol of this line first")
        return self._spoken[key]

    def can_run_at(self, baud_rate: int) -> bool:
        """Return True if the adapter supports a baud rate (bit/s); the present rate is set again."""
        can = self.port.tune(baud_rate)
        self.port.tune(self.baud_rate)
        return can

    def run_program(self, program: Program[Result]) -> Result:
        """Run a program on the line to its end and return its result.

        Raises:
            PortError: The line is gone or not suitable for servos.
        """
        exchange = self.heard.exchange
        try:
            request = next(program)
            while True:
                request = program.send(exchange(request))
        except StopIteration as end:
            result: Result = end.value
            return result

    def wait_for_packets(self, duration_ns: int) -> None:
        """Wait this long while packets that arrive are recorded."""
        self.heard.exchange(listen_transaction(duration_ns))


def refuse_echo(name: str, reply: Reply) -> None:
    """Raise PortError if the reply shows that the adapter at `name` echoes: an echo looks like a servo's
    answer.
    """
    if reply.echoed:
        raise PortError(
            f"the adapter at {name} echoes every instruction; use an adapter without echo, such as a U2D2; "
            f"{help_link('the-adapter-echoes')}"
        )
