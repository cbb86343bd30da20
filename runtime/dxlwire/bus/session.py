"""Session: one open line of a script, with a lock, and the log of its packets.

The compiled kernel and its engine exchange the packets. On a system without them, such as Windows, the
package `dynamixel-sdk` does, one servo after the other."""

from __future__ import annotations

import operator
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from dxlwire.bus.adjustable_port import LATENCY_NS, AdjustablePort
from dxlwire.bus_plan import Budget, BusPlan
from dxlwire.clock import Clock, MonotonicClock
from dxlwire.exceptions import NotCompiled, PortError
from dxlwire.exchange.bus_engine import BusEngine, Lines
from dxlwire.exchange.kernel import library
from dxlwire.packets import Bytes, Desk, PacketKind, PacketLog
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, Line
from dxlwire.port.latency_timer import is_simulated, latency_timer, shorten
from dxlwire.port.ports import Ports, SerialPort, SerialPorts
from dxlwire.port.reopening import lasting_name
from dxlwire.port.serial_open import open_serial, rate_remark
from dxlwire.transaction import Program, Result
from dxlwire.wire.dialect import dialect_of

STALL_NS = 100_000_000
"""Latency (ns) that is assumed of simulated servos: their process may have to wait for a processor."""
RECORDERS = "dxlwire_recorders"
"""Group of entry points; each one is a `LineRecorder`. dxlrun has one that writes MCAP."""
_NOTHING = Budget(0, 0, 0, 0, 0, 0)


class LineRecorder(Protocol):
    """Makes a log of packets in a new file; called with its path and the name of the line."""

    def __call__(self, path: Path, line: str) -> AbstractContextManager[PacketLog]:
        """Return a context manager that opens the log and closes it."""
        ...


class SessionLog(PacketLog):
    """Log of a session: forwards packets to a recording, and collects the IDs of all replies."""

    def __init__(self) -> None:
        self.answered: set[int] = set()
        self.recording: PacketLog | None = None

    def packet(  # noqa: PLR0917  the contract of PacketSink
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Bytes
    ) -> None:
        """Forward a packet, and note the ID of a reply."""
        if kind in (PacketKind.STATUS, PacketKind.LATE):
            self.answered.add(servo_id)
        if self.recording is not None:
            self.recording.packet(bus, kind, servo_id, first_ns, last_ns, data)

    @property
    def desk(self) -> Desk | None:
        """Memory in which the exchange kernel records packets; None without a recording."""
        return None if self.recording is None else self.recording.desk

    def commit_packets(self) -> object:
        """Add the packets that the kernel recorded to the recording."""
        return None if self.recording is None else self.recording.commit_packets()


class OpenLine(ABC):
    """An open line: its timing, its log, and a lock for threads. Base class of both sessions."""

    def __init__(self, plan: BusPlan, close: Callable[[], None]) -> None:
        self.name = plan.port
        self.lock = threading.RLock()
        self.log = SessionLog()
        self.plan = plan
        self.line = Line(plan.baud_rate, plan.latency_ns, plan.return_delay_ns, dialect_of(plan.protocol))
        self.cycles = 0  # Readers and writers that were made
        self._open = ExitStack()
        self._open.callback(close)
        self._closed = False

    def check_open(self) -> None:
        """Raise PortError if the line is closed or lost."""
        if self._closed:
            raise PortError(f"{self.name} is closed; use the bus inside its `with` block")

    @abstractmethod
    def reopen_line(self) -> None:
        """Open the line again after its adapter was unplugged; do nothing if it is not lost.

        Raises:
            PortError: The adapter is still missing, or the line is closed.
        """

    @abstractmethod
    def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result.

        Raises:
            PortError: The line is closed or lost.
        """

    def record(self, path: Path) -> None:
        """Record all packets from now on in a new file.

        Raises:
            ValueError: A reader or writer exists, or a recording.
            LookupError: No installed package records packets.
        """
        if self.cycles or self.log.recording is not None:
            raise ValueError("call `record` once, before the first `reader` and `writer`")
        found = next(iter(entry_points(group=RECORDERS)), None)
        if found is None:
            raise LookupError("no installed package records packets; `pip install dxlrun` does")
        recorder: LineRecorder = found.load()
        self.log.recording = self._open.enter_context(recorder(path, self.name))

    def close(self) -> None:
        """Close the recording and the line."""
        with self.lock:
            self._closed = True
            self._open.close()


class Session(OpenLine):
    """An open line on which the engine, and the kernel in readers and writers, exchange the packets."""

    def __init__(self, ports: Ports, clock: Clock, plan: BusPlan, close: Callable[[], None]) -> None:
        super().__init__(plan, close)
        self.lines = Lines([plan], ports, clock, self.log)
        self.engine: BusEngine = self.lines.buses[0]
        self.is_unfinished = False
        """True while the engine works, and after an exception such as Ctrl-C has interrupted it."""

    def check_open(self) -> None:
        """Raise PortError if the line is closed or lost."""
        if self._closed:
            super().check_open()
        if self.engine.failure is not None:
            raise self.engine.failure

    def reopen_line(self) -> None:
        """Open the line again after its adapter was unplugged, see `OpenLine.reopen_line`."""
        with self.lock:
            super().check_open()
            if (failure := self.engine.failure) is None:
                return
            if not self.lines.ports.reopen(0):
                raise failure
            self.engine.receiver.reset()
            self.engine.replace_port(self.lines.ports.ports[0])

    @contextmanager
    def uninterrupted(self) -> Iterator[None]:
        """Repair what Ctrl-C left half done in an earlier block, and note that this one has begun."""
        if self.is_unfinished:
            self.engine.receiver.reset()
        self.is_unfinished = True
        yield
        self.is_unfinished = False

    def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result. Raises PortError if the line is closed or lost."""
        with self.lock:
            self.check_open()
            with self.uninterrupted():
                (result,) = self.lines.run_programs([program])
            return self.finish_program(result)

    def finish_program(self, result: Result | None) -> Result:
        """Return the result of a program, None if it did not end.

        Raises:
            PortError: The line is closed or lost.
        """
        self.log.commit_packets()
        self.check_open()
        if result is None:
            raise PortError(f"{self.name}: an exchange did not finish")
        return result


class SdkSession(OpenLine):
    """An open line on which `dynamixel-sdk` exchanges the packets, one transaction after the other."""

    def __init__(self, path: str, baud_rate: int, protocol: float) -> None:
        # Imported here because the SDK is not needed where the kernel is compiled.
        from dxlwire.bus.sdk_port import SdkPort

        self._port = port = AdjustablePort(path, baud_rate, boot_ns=0)
        latency_ns = STALL_NS if is_simulated(path) else port.most_latency_ns
        super().__init__(line_plan(path, baud_rate, protocol, latency_ns), self._close_port)
        self.clock = port.clock
        self._exchange = SdkPort(port, protocol, baud_rate, self.log).exchange
        self._lost = False

    def reopen_line(self) -> None:
        """Open the line again after its adapter was unplugged, see `OpenLine.reopen_line`."""
        from dxlwire.bus.sdk_port import SdkPort

        with self.lock:
            self.check_open()
            if self._lost:
                plan = self.plan
                self._close_port()
                self._port = AdjustablePort(self.name, plan.baud_rate, boot_ns=0)
                self._exchange = SdkPort(self._port, plan.protocol, plan.baud_rate, self.log).exchange
                self._lost = False

    def _close_port(self) -> None:
        with suppress(OSError):  # of an adapter that is gone
            self._port.close()

    def run_program(self, program: Program[Result]) -> Result:
        """Run a program to its end and return its result. Raises PortError if the line is closed or lost."""
        with self.lock:
            self.check_open()
            try:
                request = next(program)
                while True:
                    request = program.send(self._exchange(request))
            except StopIteration as end:
                result: Result = end.value
                return result
            except PortError:
                self._lost = True
                raise
            finally:
                self.log.commit_packets()


def line_plan(name: str, baud_rate: int, protocol: float, latency_ns: int) -> BusPlan:
    """Return the plan of a line on which nothing is read in each cycle."""
    delay_ns = LONGEST_RETURN_DELAY_NS
    return BusPlan(name, name, protocol, baud_rate, latency_ns, delay_ns, (), (), (), (), _NOTHING)


def _is_compiled() -> bool:
    try:
        library()
    except NotCompiled:
        return False
    return True


def open_session(path: str, baud_rate: int, protocol: float) -> Session | SdkSession:
    """Open a serial line for a script, exclusively: by the kernel if it is compiled, else by the SDK.

    Raises:
        PortError: The port cannot be opened, or the adapter does not support the baud rate.
        ValueError: The protocol is unknown, or the baud rate is not an integer.
    """
    if protocol not in (1.0, 2.0):
        raise ValueError(f"protocol {protocol} is unknown; use 1.0 or 2.0")
    try:
        baud_rate = operator.index(baud_rate)
    except TypeError:
        raise ValueError(f"baud rate {baud_rate!r} is not an integer; write for example 57_600") from None
    if sys.platform != "linux" or not _is_compiled():
        return SdkSession(path, baud_rate, protocol)
    serial = open_serial(path, baud_rate)
    try:
        if remark := rate_remark(serial, baud_rate):
            raise PortError(remark)
        shorten(serial.fileno(), path, LATENCY_NS)
        timer = latency_timer(path)
        found_ns = LATENCY_NS if timer is None else max(LATENCY_NS, timer.found_ms * 1_000_000)
        latency_ns = STALL_NS if is_simulated(path) else found_ns
        lasting = lasting_name(path) or path

        def reopened(_: int) -> int:
            again = open_serial(lasting, baud_rate)
            shorten(again.fileno(), lasting, LATENCY_NS)
            return again.detach()

        ports = SerialPorts([SerialPort(serial.fileno(), path)], reopened)
        plan = line_plan(path, baud_rate, protocol, latency_ns)
        return Session(ports, MonotonicClock(), plan, serial.close)
    except BaseException:
        serial.close()
        raise
