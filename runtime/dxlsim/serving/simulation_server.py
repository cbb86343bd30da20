"""Server: serves simulated buses to hosts in real time, in one thread that waits for all lines together."""

from __future__ import annotations

import contextlib
import ctypes
import select
import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from dxlsim.bus.ledger import FAULT, FLUSH_NS, Ledger
from dxlsim.bus.recorded_bus import RecordedBus
from dxlsim.bus.recording import RecordedPackets
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.on_links import fix_to_links
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.messages import ServoLook, SimulationMessage
from dxlsim.motion.body import ShaftPublisher, ShaftSink
from dxlsim.motion.compiled_mechanics import function_address
from dxlsim.motion.mechanics import Mechanics, plant_of
from dxlsim.registers.memory import Memory
from dxlsim.serving.host import ServerProgressReceiver, Starter
from dxlsim.serving.pseudo_terminal import DeviceLink, PseudoTerminal
from dxlsim.simulation_plan import SimulationConfig
from dxlsim.wire.compiled_line import NEVER_NS, STALLED, ServerState, line_library
from dxlwire.exceptions import InputError

_ADAPTER, _ASKED, _RAISED = 1, 2, 4  # Bits of what Python has to do after `line_serve`

_GOAL_MODES = (3, 4, 5)
"""Values of Operating Mode (11) with a goal position: position, extended position, current-based position
(e-Manual, X series)."""


class Server:
    """Serves simulated buses on pseudo-terminals until its starter closes, or until the `stop` of
    `serve_ports` is readable.

    Raises:
        InputError: A fault of the configuration can never happen, or its bodies cannot be moved.
        OSError: A terminal or a link cannot be created.
    """

    def __init__(
        self,
        config: SimulationConfig,
        ledger: Ledger,
        starter: Starter,
        *,
        shafts: ShaftSink | None = None,
        progress: ServerProgressReceiver | None = None,
        recordings: Mapping[str, RecordedPackets] = MappingProxyType({}),
        sockets: Sequence[int] = (),
    ) -> None:
        """Create the buses and their terminals.

        Args:
            config: Buses, faults, links and bodies.
            ledger: Records every byte that passes the wire.
            starter: Sends requests; receives ports, faults that happen, and answers.
            shafts: Receives the motion of the shafts, for sensors in other processes.
            progress: Receives the time up to which each line was served, for a host that waits for this
                process.
            recordings: Packets of each bus that is `recorded`, by the name of the bus.
            sockets: As in `SimulationJob`.
        """
        self.start_ns = time.monotonic_ns()
        self._ledger = ledger
        self._starter = starter
        self._mechanics = Mechanics(self.start_ns, plant_of(config))
        self._buses = tuple(
            RecordedBus(bus, ledger, self.start_ns, recordings[bus.name], self._mechanics)
            if bus.recorded
            else SimulatedBus(bus, ledger, self.start_ns, self._mechanics)
            for bus in config.buses
        )
        if config.sensed is not None:
            fix_to_links((one for bus in self._buses for one in bus.devices), self._mechanics, config.sensed)
        self._faults = FaultScript([parse_fault(text) for text in config.faults], config.seed)
        self._faults.attach(self._buses, start_ns=self.start_ns)
        links = {name: DeviceLink(Path(path)) for name, path in config.links.items()}
        self._terminals = tuple(
            PseudoTerminal(
                bus,
                links.get(bus.name),
                None if progress is None else progress.line(index).words,
                sockets[index] if sockets else None,
            )
            for index, bus in enumerate(self._buses)
        )
        self._shafts = None if shafts is None else ShaftPublisher(self._mechanics, shafts)
        self._progress = progress
        self._stopped = False
        self._waiting = select.epoll()
        self._stalled = STALLED(self._note_stall)
        terminals = [ctypes.addressof(terminal.state) for terminal in self._terminals]
        self._addresses = (ctypes.c_void_p * max(len(terminals), 1))(*terminals)
        self._state = ServerState(
            terminals=ctypes.addressof(self._addresses),
            stalled=ctypes.cast(self._stalled, ctypes.c_void_p),
            release=ctypes.cast(ctypes.pythonapi.PyEval_SaveThread, ctypes.c_void_p),
            acquire=ctypes.cast(ctypes.pythonapi.PyEval_RestoreThread, ctypes.c_void_p),
            next_step=function_address("next_step"),
            ledger=ctypes.addressof(ledger.state),
            flush_ns=FLUSH_NS,
            looked_ns=self.start_ns,
            count=len(terminals),
            waiting=self._waiting.fileno(),
            watched=progress is not None,
            single=shafts is not None,
        )
        self._address = ctypes.addressof(self._state)
        self._library = line_library()

    def serve_ports(self, granted: str = "", stop: int = -1) -> None:
        """Report the ports and the granted real-time properties to the starter, then serve until the end.

        Args:
            granted: Description of the granted real-time properties.
            stop: Descriptor that ends the server when it becomes readable; -1: none.
        """
        self._ledger.on_note = self._report_fault
        with self._waiting:
            for other in (stop, self._starter.fileno()):
                if other >= 0:
                    self._library.line_watch(self._address, other)
            for index in range(len(self._terminals)):
                self._library.line_plug(self._address, index)
            self._tell(SimulationMessage(self._ports(), granted))
            while not self._stopped:
                self._serve_once(stop)
                if self._shafts is not None:
                    self._shafts.write_shafts()
        for terminal in self._terminals:
            terminal.close()

    def _note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish an interval in which the process had no core, and exclude it from the servos' watchdogs."""
        if self._progress is not None:
            self._progress.note_stall(begin_ns, end_ns)
        for bus in self._buses:
            bus.excuse(end_ns - begin_ns)

    def _serve_once(self, stop: int) -> None:
        flush_ns = self._ledger.flush_due_ns()
        self._state.python_ns = NEVER_NS if flush_ns is None else flush_ns
        self._state.alone = threading.active_count() == 1
        news = self._library.line_serve(self._address)
        if news & _RAISED:
            for bus in self._buses:
                bus.raise_stored()
        if news & _ADAPTER:
            for index, terminal in enumerate(self._terminals):
                if terminal.follow_adapter():
                    self._library.line_plug(self._address, index)
            self._tell(SimulationMessage(self._ports()))
        if news & _ASKED:
            self._answer_requests(stop)
        self._ledger.flush_if_due(time.monotonic_ns())

    def _ports(self) -> dict[str, str]:
        return {terminal.bus.name: terminal.path for terminal in self._terminals}

    def _report_fault(self, note: str) -> None:
        if note.startswith(FAULT):
            self._tell(SimulationMessage(happened=note.removeprefix(FAULT)))

    def _tell(self, message: SimulationMessage) -> None:
        """Send a message to the starter; drop it if the starter does not read. Never blocks."""
        if select.select((), (self._starter,), (), 0)[1]:  # Writable means room for 100 KB or more
            self._starter.send_message(message)

    def _answer_requests(self, stop: int) -> None:
        """Answer the new requests of the starter: states of servos, and faults to plan."""
        starter = self._starter.fileno()
        others = [each for each in (starter, stop) if each >= 0]
        ready, now_ns = select.select(others, (), (), 0)[0], time.monotonic_ns()
        self._stopped = stop in ready
        if starter not in ready:
            return
        for request in self._starter.receive_messages():
            if request.look:
                looks = tuple(look for bus in self._buses for look in servo_looks(bus, now_ns))
                self._tell(SimulationMessage(servos=looks, lateness_us=lateness_us(self._buses)))
            if request.fault is not None:
                self._tell(self._inject(request.fault, now_ns))
        self._stopped = self._stopped or self._starter.closed

    def _inject(self, text: str, now_ns: int) -> SimulationMessage:
        try:
            fault = parse_fault(text)
            self._faults.add(fault, now_ns)
        except InputError as error:
            return SimulationMessage(error=str(error))
        return SimulationMessage(fault=str(fault))


@contextlib.contextmanager
def wake_on_signals(*numbers: signal.Signals) -> Iterator[socket.socket]:
    """Context with a socket that becomes readable after one of these signals, which have no other effect."""
    wake, signalled = socket.socketpair()
    with wake, signalled:
        signalled.setblocking(False)
        handlers = {number: signal.signal(number, lambda number, frame: None) for number in numbers}
        woken = signal.set_wakeup_fd(signalled.fileno())
        try:
            yield wake
        finally:
            signal.set_wakeup_fd(woken)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def servo_looks(bus: SimulatedBus, now_ns: int) -> list[ServoLook]:
    """Return the present state of each servo of a bus, for a `look` request."""
    bus.advance_to(now_ns)
    return [
        ServoLook(
            bus=bus.name,
            id=servo.servo_id,
            model=servo.registers.table.model,
            torque=servo.torque_on,
            goal=_goal(servo.registers),
            present=servo.shaft_angle,
            temperature=servo.temperature,
            voltage=servo.voltage,
            error=servo.registers.get(servo.registers.table.errors.item, servo.counts.last_error),
            heard=servo.counts.received,
            answered=servo.counts.replied,
        )
        for servo in bus.servos
    ]


def _goal(registers: Memory) -> float | None:
    if "goal_position" not in registers or registers.get("operating_mode", 3) not in _GOAL_MODES:
        return None
    if registers.get("cw_angle_limit", 1) == registers.get("ccw_angle_limit", 1) == 0:
        return None  # wheel mode (e-Manual, AX-12A, CW/CCW Angle Limit)
    return registers.ticks("goal_position") * registers.table.rad_per_tick


def lateness_us(buses: Sequence[SimulatedBus]) -> dict[str, float]:
    """Return statistics of the lateness of recent deliveries to hosts, us: median, p99, maximum; empty before
    the first delivery.

    Quantiles by nearest rank: the smallest value that at least this share does not exceed."""
    ordered = sorted(late_ns for bus in buses for late_ns in bus.lateness_ns)
    if not ordered:
        return {}
    picked = {
        "median": (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2,
        "p99": ordered[-(-len(ordered) * 99 // 100) - 1],
        "maximum": ordered[-1],
    }
    return {name: late_ns / 1000 for name, late_ns in picked.items()}
