"""Server: serves simulated buses to hosts in real time, in one thread that waits for all lines together."""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from dxlsim.bus.ledger import FAULT, Ledger
from dxlsim.bus.recorded_bus import RecordedBus
from dxlsim.bus.recording import RecordedPackets
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.on_links import fix_to_links
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.messages import ServoLook, SimulationMessage
from dxlsim.motion.body import ShaftPublisher, ShaftSink
from dxlsim.motion.mechanics import Mechanics, plant_of
from dxlsim.registers.memory import Memory
from dxlsim.serving.host import ENDLESS_NS, LineProgressReceiver, ServerProgressReceiver, Starter
from dxlsim.serving.pseudo_terminal import DeviceLink, PseudoTerminal
from dxlsim.serving.realtime_serving import PollBudget
from dxlsim.simulation_plan import SimulationConfig
from dxlwire.exceptions import InputError

MOST_BACKLOG_NS = 20_000_000
"""Limit of the host's bytes that wait for the simulated wire, as wire time in ns; beyond it the host is not
read.

The host is thus slowed down to the rate of its line, as with an adapter."""

GATHER_NS = 250_000
"""Replies that end within this time, ns, are delivered together, as in two microframes of USB. Each
delivery costs more processor time here and in the host than a reply."""

_WRITTEN = select.EPOLLIN | select.EPOLLET
"""Events of epoll for a terminal. Edge-triggered, to report each write of a host once: a terminal without
a host is at end of file all the time."""

LONGEST_SLEEP_NS = 10_000_000
"""Longest sleep (ns) while a host watches the server's progress, so that a longer pause is recognized as a
stall."""
STALL_NS = 20_000_000
"""Pause between two readings of the clock, ns, from which it counts as a stall, in which the process had
no core."""

IDLE_NS = 300_000  # Time reserved for a few steps of the mechanics

_BITS_PER_BYTE = 10  # 8N1

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
        self._terminals = tuple(PseudoTerminal(bus, links.get(bus.name)) for bus in self._buses)
        self._shafts = None if shafts is None else ShaftPublisher(self._mechanics, shafts)
        self._progress = progress
        self._lines = {
            terminal: _ServedLine(progress.line(index), terminal.bus)
            for index, terminal in enumerate(self._terminals)
            if progress is not None
        }
        self._looked_ns = self.start_ns
        self._polling = PollBudget(self.start_ns)
        self._stopped = False
        self._waiting = select.epoll()
        self._by_descriptor: dict[int, PseudoTerminal] = {}
        self._held: dict[int, int] = {}
        """Times (ns) until which terminals are not read because their hosts are too fast, by descriptor."""

    def serve_ports(self, granted: str = "", stop: int = -1) -> None:
        """Report the ports and the granted real-time properties to the starter, then serve until the end.

        Args:
            granted: Description of the granted real-time properties.
            stop: Descriptor that ends the server when it becomes readable; -1: none.
        """
        self._ledger.on_note = self._report_fault
        with self._waiting as waiting:
            if stop >= 0:
                waiting.register(stop, select.EPOLLIN)
            waiting.register(self._starter, select.EPOLLIN)
            self._plug()
            self._tell(SimulationMessage(self._ports(), granted))
            while not self._stopped:
                self._serve_once(stop)
                if self._shafts is not None:
                    self._shafts.write_shafts()
        for terminal in self._terminals:
            terminal.close()

    def _look_at_clock(self) -> int:
        """Return the time, ns. If the process was stalled before, publish the stall and exclude it from
        the servos' watchdogs."""
        now_ns = time.monotonic_ns()
        if self._progress is not None:
            since_ns, self._looked_ns = self._looked_ns, now_ns
            if now_ns - since_ns > STALL_NS:
                self._progress.note_stall(since_ns, now_ns)
                for bus in self._buses:
                    bus.excuse(now_ns - since_ns)
        return now_ns

    def _serve_once(self, stop: int) -> None:
        now_ns = self._look_at_clock()
        soonest_ns = self._find_next_delivery()
        easy_ns = None
        if soonest_ns is None or soonest_ns - now_ns > IDLE_NS:  # No reply is about to be sent
            easy_ns = self._work_in_idle_time(now_ns)
            now_ns = self._look_at_clock()
        if self._lines:
            easy_ns = min(easy_ns or ENDLESS_NS, now_ns + LONGEST_SLEEP_NS)
        ready = self._wait(soonest_ns, easy_ns, now_ns)
        # Replies that were due before the host wrote go out first, because the host could have read them.
        now_ns = self._look_at_clock()
        self._polling.woke(now_ns)
        if soonest_ns is not None and soonest_ns <= now_ns:
            for terminal in self._terminals:
                due_ns = terminal.bus.next_delivery_ns(GATHER_NS)
                if due_ns is not None and due_ns <= now_ns:
                    self._deliver(terminal, now_ns)
        rounds = len(self._terminals)  # A host that drives all buses writes to them in one go
        while ready:
            for number, _ in ready:
                if number in self._by_descriptor:
                    self._by_descriptor[number].read_chunk()
            now_ns = (
                self._look_at_clock()
                # Read after the bytes, so that no host gets a reply before it wrote, even if other lines take
                # long
            )
            for number, _ in ready:
                self._read_ready(number, stop, now_ns)
            rounds -= 1
            # Edge-triggered: each event is reported only once
            ready = self._waiting.poll(0) if rounds else []
        self._ledger.flush_if_due(now_ns)

    def _find_next_delivery(self) -> int | None:
        """Return the time (ns) of the next delivery to any host, None without one; publish it for each
        line."""
        soonest_ns = None
        for terminal in self._terminals:
            due_ns = terminal.bus.next_delivery_ns(GATHER_NS)
            if self._lines:
                self._lines[terminal].publish_next_delivery(due_ns)
            if due_ns is not None and (soonest_ns is None or due_ns < soonest_ns):
                soonest_ns = due_ns
        return soonest_ns

    def _work_in_idle_time(self, now_ns: int) -> int | None:
        """Step the mechanics and resume reading slowed hosts; return the time (ns) at which more such work
        is due, None: nothing is."""
        self._mechanics.step_to(now_ns)
        times = [self._ledger.flush_due_ns(), self._mechanics.due_ns()]
        if self._held:
            for number in [each for each, until_ns in self._held.items() if until_ns <= now_ns]:
                del self._held[number]
                self._waiting.register(number, _WRITTEN)
            times += self._held.values()
        return min([t_ns for t_ns in times if t_ns is not None], default=None)

    def _wait(self, due_ns: int | None, easy_ns: int | None, now_ns: int) -> list[tuple[int, int]]:
        poll, polling = self._waiting.poll, self._polling
        sleep_s = polling.sleep_s(due_ns, now_ns, easy_ns)
        if sleep_s is None or sleep_s > 0.0:
            # select has microsecond resolution, epoll alone only milliseconds
            select.select((self._waiting,), (), (), sleep_s)
            if (ready := poll(0)) or due_ns is None:
                return ready
            now_ns = time.monotonic_ns()
            polling.woke(now_ns)
            if polling.sleep_s(due_ns, now_ns) != 0.0:
                return ready
        while not (ready := poll(0)) and due_ns is not None and time.monotonic_ns() < due_ns:
            pass
        return ready

    def _deliver(self, terminal: PseudoTerminal, now_ns: int) -> None:
        terminal.deliver(now_ns, self._lines[terminal].publish_delivery if self._lines else None)
        if terminal.follow_adapter():
            self._plug()
            self._tell(SimulationMessage(self._ports()))

    def _read_ready(self, number: int, stop: int, now_ns: int) -> None:
        terminal = self._by_descriptor.get(number)
        if terminal is not None:
            self._receive(number, terminal, now_ns)
        elif number == stop:
            self._stopped = True
        elif number == self._starter.fileno():
            self._answer_requests(now_ns)

    def _receive(self, number: int, terminal: PseudoTerminal, now_ns: int) -> None:
        bus = terminal.bus
        due_ns = bus.next_due_ns()
        if due_ns is not None and due_ns <= now_ns:
            self._deliver(terminal, now_ns)
        if not terminal.plugged or terminal.fileno() != number:
            return
        count = terminal.deliver_bytes(now_ns)
        if count and self._lines:
            self._lines[terminal].publish_next_delivery(bus.next_delivery_ns(GATHER_NS))
            self._lines[terminal].publish_received(count, now_ns)
        if bus.host_free_ns - MOST_BACKLOG_NS > now_ns:
            self._held[number] = bus.host_free_ns - MOST_BACKLOG_NS
            self._waiting.unregister(number)
        elif terminal.may_have_more:
            self._waiting.modify(number, _WRITTEN)  # Makes epoll report the waiting bytes once more

    def _plug(self) -> None:
        """Wait for the terminals that exist now, after an adapter was unplugged or plugged in."""
        for number in self._by_descriptor:
            # Terminals that were unplugged or are on hold are not registered
            with contextlib.suppress(OSError):
                self._waiting.unregister(number)
        self._held.clear()
        self._by_descriptor = {each.fileno(): each for each in self._terminals if each.plugged}
        for number in self._by_descriptor:
            self._waiting.register(number, _WRITTEN)

    def _ports(self) -> dict[str, str]:
        return {terminal.bus.name: terminal.path for terminal in self._terminals}

    def _report_fault(self, note: str) -> None:
        if note.startswith(FAULT):
            self._tell(SimulationMessage(happened=note.removeprefix(FAULT)))

    def _tell(self, message: SimulationMessage) -> None:
        """Send a message to the starter; drop it if the starter does not read. Never blocks."""
        if select.select((), (self._starter,), (), 0)[1]:  # Writable means room for 100 KB or more
            self._starter.send_message(message)

    def _answer_requests(self, now_ns: int) -> None:
        """Answer the new requests of the starter: states of servos, and faults to plan."""
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


class _ServedLine:
    """Publishes the server's progress on one line, for hosts that distinguish a late server from a silent
    servo."""

    __slots__ = ("_bus", "_progress", "_served_ns", "_taken_ns")

    def __init__(self, progress: LineProgressReceiver, bus: SimulatedBus) -> None:
        self._progress = progress
        self._bus = bus
        self._taken_ns = 0
        self._served_ns = -1

    def publish_next_delivery(self, due_ns: int | None) -> None:
        """Publish that the line is served up to its next delivery to the host, at `due_ns`; None: nothing
        is due."""
        until_ns = ENDLESS_NS if due_ns is None else due_ns
        if until_ns != self._served_ns:
            self._progress.publish_served(until_ns)
            self._served_ns = until_ns

    def publish_received(self, count: int, now_ns: int) -> None:
        """Publish that `count` bytes of the host were received, even if a fault keeps them from the servos.

        Call this after `publish_next_delivery`: a host that sees the bytes as received relies on the due time
        of the reply."""
        duration_ns = count * _BITS_PER_BYTE * 1_000_000_000 // self._bus.baud_rate
        self._taken_ns = max(self._taken_ns, now_ns) + duration_ns
        self._progress.publish_received(self._taken_ns)

    def publish_delivery(self, now_ns: int) -> None:
        """Publish that bytes are delivered to the host now, with the time at which they were due."""
        self._progress.publish_delivery(now_ns - self._bus.newest_lateness_ns, now_ns)


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
