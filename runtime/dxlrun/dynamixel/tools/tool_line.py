"""Tool line: a port that tools use outside of a run, with one protocol and baud rate at a time."""

from __future__ import annotations

import errno
import termios

from dxlrun.channels.ring import Payload
from dxlrun.contract.serial_line import open_serial
from dxlrun.errors import PortError, help_link
from dxlwire.bus_plan import Budget, BusPlan
from dxlwire.clock import Clock, MonotonicClock
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketKind, PacketSink
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, Line, listen_transaction
from dxlwire.port.latency_timer import latency_timer, shorten
from dxlwire.port.ports import Ports, SerialPort, SerialPorts
from dxlwire.transaction import Program, Reply, Result
from dxlwire.wire.dialect import dialect_of

FIRST_RATE = 57_600  # first rate of a port, bit/s; every adapter supports it
BOOT_NS = 2_000_000_000
"""Waiting time (ns) for the boot loader of a board that resets when its port is opened [i: Optiboot of
Arduino, 1 s].
"""
LATENCY_NS = 1_000_000
"""Assumed latency (ns) of an adapter whose latency timer is not known: one frame of full-speed USB."""
MOST_LATENCY_NS = 16_000_000
"""Highest latency (ns) of an adapter whose timer is not known: the default latency timer of an FTDI chip
(FTDI AN232B-04).
"""
_NOTHING = Budget(0, 0, 0, 0, 0, 0)


class TunablePort:
    """A serial port whose baud rate tools can change, opened exclusively; a context manager that closes it.

    Raises:
        PortError: The port cannot be opened: it does not exist, or another process, which is named, has it.
    """

    def __init__(self, path: str) -> None:
        self._serial = open_serial(path, FIRST_RATE, boot_ns=BOOT_NS)
        self._tuned = FIRST_RATE
        self.other_rates: dict[int, int] = {}
        """Rates that the driver did not set as requested, with the rates that it set instead; bit/s."""
        self.name = path
        self.clock: Clock = MonotonicClock()
        self.ports: Ports = SerialPorts([SerialPort(self._serial.fileno(), path)])
        shorten(self._serial.fileno(), path, LATENCY_NS)
        timer = latency_timer(path)
        found_ns = 0 if timer is None else timer.found_ms * 1_000_000
        self.latency_ns = max(LATENCY_NS, found_ns)
        """Latency of the adapter, ns: that of its timer as found, at least LATENCY_NS."""
        self.most_latency_ns = found_ns or MOST_LATENCY_NS
        """Highest latency of the adapter, ns: used in timeouts for a servo that has already answered once."""

    def __enter__(self) -> TunablePort:
        return self

    def __exit__(self, *_: object) -> None:
        self._serial.close()

    def tune(self, baud_rate: int) -> bool:
        """Set the baud rate, bit/s, and discard unread bytes; return False if the adapter does not support
        the rate.

        Raises:
            PortError: The port is gone.
        """
        try:
            if self._tuned != baud_rate:
                self._tuned = baud_rate
                if not self._serial.set_rate(baud_rate):
                    self.other_rates[baud_rate] = self._serial.baud_rate
            termios.tcflush(self._serial.fileno(), termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            if error.args and error.args[0] == errno.EINVAL:
                return False
            raise PortError(f"{self.name} is gone ({error}): was the adapter unplugged?") from error
        return baud_rate not in self.other_rates


class RespondingIdSink(PacketSink):
    """Packet sink that records the IDs which answered on a line, expected or not, and counts noise; forwards
    packets to a log.
    """

    def __init__(self, log: PacketSink | None = None) -> None:
        self._log = log
        self.ids: set[int] = set()  # IDs in the intact status packets
        self.noise = 0  # bytes outside of intact packets

    def clear_records(self) -> None:
        """Forget the recorded IDs and the noise."""
        self.ids.clear()
        self.noise = 0

    def packet(  # noqa: PLR0917  the contract of PacketSink
        self, bus: int, kind: int, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Forward a packet to the log, and record the ID of a reply or the bytes of noise."""
        if self._log is not None:
            self._log.packet(bus, PacketKind(kind), servo_id, first_ns, last_ns, data)
        if kind in (PacketKind.STATUS, PacketKind.LATE):
            self.ids.add(servo_id)
        elif kind == PacketKind.NOISE:
            self.noise += len(data)


class BusPacketSink(PacketSink):
    """Packet sink that forwards packets to a log under a fixed bus index."""

    def __init__(self, log: PacketSink, index: int) -> None:
        self._log = log
        self._index = index

    def packet(  # noqa: PLR0917  the contract of PacketSink
        self, bus: int, kind: int, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Forward a sent or received packet with the fixed bus index in place of `bus`."""
        self._log.packet(self._index, PacketKind(kind), servo_id, first_ns, last_ns, data)


class ToolLine:
    """Runs programs on the port of a tool, in one protocol and at one rate; call `speak` first, and again to
    change them.

    `log` receives every packet.
    """

    def __init__(self, port: TunablePort, log: PacketSink | None = None) -> None:
        self.port = port
        self.heard = RespondingIdSink(log)
        self.protocol = 0.0
        self.baud_rate = 0
        self.line: Line = Line(FIRST_RATE, port.most_latency_ns, LONGEST_RETURN_DELAY_NS)
        """Makes transactions for the protocol and rate that `speak` set."""
        self._lines: Lines | None = None
        self._spoken: dict[tuple[float, int], Lines] = {}
        """Lines by protocol and rate: they are kept, because a late reply may come after another rate was
        used.
        """

    def speak(self, protocol: float, baud_rate: int) -> bool:
        """Change to a protocol and a baud rate (bit/s); return False, unchanged, if the adapter does not
        support the rate.
        """
        if not self.port.tune(baud_rate):
            return False
        port, latency_ns = self.port, self.port.most_latency_ns
        delay_ns = LONGEST_RETURN_DELAY_NS
        plan = BusPlan(
            port.name, port.name, protocol, baud_rate, latency_ns, delay_ns, (), (), (), (), _NOTHING
        )
        self.protocol, self.baud_rate = protocol, baud_rate
        self.line = Line(baud_rate, latency_ns, delay_ns, dialect_of(protocol))
        key = protocol, baud_rate
        if key not in self._spoken:
            self._spoken[key] = Lines([plan], port.ports, port.clock, self.heard)
        self._lines = self._spoken[key]
        return True

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
        if self._lines is None:
            raise LookupError("choose the protocol of this line first")
        (result,) = self._lines.run_programs([program])
        if result is None:
            raise self._lines.failure or PortError(f"{self.port.name}: an exchange did not finish")
        return result

    def wait_for_packets(self, duration_ns: int) -> None:
        """Wait this long while packets that arrive are recorded."""
        self.run_program(_wait(duration_ns))


def refuse_echo(name: str, reply: Reply) -> None:
    """Raise PortError if the reply shows that the adapter at `name` echoes: an echo looks like a servo's
    answer.
    """
    if reply.echoed:
        raise PortError(
            f"the adapter at {name} echoes every instruction; use an adapter without echo, such as a U2D2; "
            f"{help_link('the-adapter-echoes')}"
        )


def _wait(duration_ns: int) -> Program[bool]:
    yield listen_transaction(duration_ns)
    return True
