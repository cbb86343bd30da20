"""Serving simulated buses in real time: one thread that waits for all lines together, and for nobody else."""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from dxlrun.errors import InputError
from dxlrun.simulation.bus.ledger import SOME_ENTRIES, Ledger
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.configuration import SimulationConfig
from dxlrun.simulation.control_line import ControlLine
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript
from dxlrun.simulation.motion.mechanics import Mechanics, plant_of
from dxlrun.simulation.pseudo_terminal import Link, PseudoTerminal
from dxlrun.simulation.realtime import Patience
from dxlrun.simulation.servo.memory import Memory
from dxlrun.simulation.servo.simulated_servo import SimulatedServo

_HAPPENED = "fault: "
MOST_BACKLOG_NS = 20_000_000
"""A host that hands over bytes faster than they pass the wire is not read while so much of them waits.

So it feels the rate of its line, as with an adapter."""

GATHER_NS = 250_000
"""Answers of a read in turn that follow one so closely are handed over together with it, as in two
microframes of USB: each hand-over costs the processor, and the host's, more than an answer."""

IDLE_NS = 300_000
"""So long the mechanics of a few steps and the lines of the ledger may take."""


_GOAL_MODES = (3, 4, 5)
"""Operating Mode (11): position, extended position, current-based position (e-Manual, X series)."""


class _Question(msgspec.Struct):
    """A line of the starter."""

    look: bool = False
    fault: str | None = None


class Server:
    """Pumps pseudo-terminals and buses until the control socket ends or SIGTERM comes.

    Raises InputError when a fault of the configuration could never happen, or its bodies cannot be moved,
    OSError when a terminal or a link cannot be made.
    """

    def __init__(self, config: SimulationConfig, ledger: Ledger, line: ControlLine) -> None:
        self.start_ns = time.monotonic_ns()
        self._ledger = ledger
        self._line = line
        self._mechanics = Mechanics(self.start_ns, plant_of(config.bodies))
        self._buses = tuple(SimulatedBus(bus, ledger, self.start_ns, self._mechanics) for bus in config.buses)
        self._faults = FaultScript([parse_fault(text) for text in config.faults], config.seed)
        self._faults.attach(self._buses, start_ns=self.start_ns)
        self._terminals = tuple(
            PseudoTerminal(bus, Link(Path(config.links[bus.name])) if bus.name in config.links else None)
            for bus in self._buses
        )
        self._patience = Patience(self.start_ns)
        self._stopped = False
        self._waiting = select.epoll()
        self._by_descriptor: dict[int, PseudoTerminal] = {}
        self._held: dict[int, int] = {}
        """Terminals that are not read before a time, by descriptor."""
        self._told = select.EPOLLIN
        """What is waited for on the line to the starter."""

    def run(self, granted: str = "") -> None:
        """Tell the ports and what real time was granted, then serve."""
        self._ledger.on_note = self._tell_fault
        with _wake_on_sigterm() as wake, self._waiting as waiting:
            waiting.register(wake, select.EPOLLIN)
            waiting.register(self._line, self._told)
            self._plug()
            self._line.send({"ports": self._ports(), "real_time": granted})
            while not self._stopped:
                self._turn(wake.fileno())
        for terminal in self._terminals:
            terminal.close()

    def _turn(self, wake: int) -> None:
        now_ns = time.monotonic_ns()
        soonest_ns = None
        for bus in self._buses:
            due_ns = bus.next_delivery_ns(GATHER_NS)
            if due_ns is not None and (soonest_ns is None or due_ns < soonest_ns):
                soonest_ns = due_ns
        easy_ns = None
        if soonest_ns is None or soonest_ns - now_ns > IDLE_NS:  # no reply is about to leave
            easy_ns = self._use_pause(now_ns)
            now_ns = time.monotonic_ns()
        ready = self._wait(soonest_ns, easy_ns, now_ns)
        # What was due before the host wrote goes out first: the host could have read it.
        now_ns = time.monotonic_ns()
        self._patience.woke(now_ns)
        if soonest_ns is not None and soonest_ns <= now_ns:
            for terminal in self._terminals:
                due_ns = terminal.bus.next_delivery_ns(GATHER_NS)
                if due_ns is not None and due_ns <= now_ns:
                    self._deliver(terminal, now_ns)
        for _ in self._terminals:
            if not ready:
                break
            for number, _ in ready:
                if number in self._by_descriptor:
                    self._by_descriptor[number].listen()
            now_ns = time.monotonic_ns()  # nobody is answered before it was written, though others take long
            for number, _ in ready:
                self._hear(number, wake, now_ns)
            ready = self._waiting.poll(0)  # a host that drives all buses writes to them in one go
        self._ledger.flush_if_due(now_ns)

    def _use_pause(self, now_ns: int) -> int | None:
        """Do what nobody waits for; return when there is more of it."""
        self._mechanics.advance(now_ns)
        self._ledger.encode(SOME_ENTRIES)
        times = [self._ledger.flush_due_ns(), self._mechanics.due_ns()]
        if self._held:
            for number in [each for each, until_ns in self._held.items() if until_ns <= now_ns]:
                del self._held[number]
                self._waiting.register(number, select.EPOLLIN)
            times += self._held.values()
        told = select.EPOLLIN | select.EPOLLOUT if self._line.has_unsent else select.EPOLLIN
        if told != self._told:
            self._told = told
            self._waiting.modify(self._line, told)
        return min([t_ns for t_ns in times if t_ns is not None], default=None)

    def _wait(self, due_ns: int | None, easy_ns: int | None, now_ns: int) -> list[tuple[int, int]]:
        """Wait until a reply is due, or something else is to be done, or somebody has written: return who."""
        poll, patience = self._waiting.poll, self._patience
        sleep_s = patience.until(due_ns, now_ns, easy_ns)
        if sleep_s is None or sleep_s > 0.0:
            # no longer than asked for, to the microsecond: an epoll itself counts milliseconds
            select.select((self._waiting,), (), (), sleep_s)
            if (ready := poll(0)) or due_ns is None:
                return ready
            now_ns = time.monotonic_ns()
            patience.woke(now_ns)
            if patience.until(due_ns, now_ns) != 0.0:
                return ready
        while not (ready := poll(0)) and due_ns is not None and time.monotonic_ns() < due_ns:
            pass
        return ready

    def _deliver(self, terminal: PseudoTerminal, now_ns: int) -> None:
        terminal.deliver(now_ns)
        if terminal.follow_adapter():
            self._plug()
            self._line.send({"ports": self._ports()})

    def _hear(self, number: int, wake: int, now_ns: int) -> None:
        """Take what somebody has written."""
        terminal = self._by_descriptor.get(number)
        if terminal is not None:
            self._receive(number, terminal, now_ns)
        elif number == wake:
            self._stopped = True
        elif number == self._line.fileno():
            self._line.flush()
            self._listen(now_ns)

    def _receive(self, number: int, terminal: PseudoTerminal, now_ns: int) -> None:
        bus = terminal.bus
        due_ns = bus.next_due_ns()
        if due_ns is not None and due_ns <= now_ns:
            self._deliver(terminal, now_ns)
        if not terminal.plugged or terminal.fileno() != number:
            return
        terminal.receive(now_ns)
        if bus.host_free_ns - MOST_BACKLOG_NS > now_ns:
            self._held[number] = bus.host_free_ns - MOST_BACKLOG_NS
            self._waiting.unregister(number)

    def _plug(self) -> None:
        """Wait for the terminals that are there now."""
        for number in self._by_descriptor:
            with contextlib.suppress(OSError):  # of a terminal that was unplugged, or is not read for a while
                self._waiting.unregister(number)
        self._held.clear()
        self._by_descriptor = {each.fileno(): each for each in self._terminals if each.plugged}
        for number in self._by_descriptor:
            self._waiting.register(number, select.EPOLLIN)

    def _ports(self) -> dict[str, str]:
        return {terminal.bus.name: terminal.path for terminal in self._terminals}

    def _tell_fault(self, note: str) -> None:
        if note.startswith(_HAPPENED):
            self._line.send({"happened": note.removeprefix(_HAPPENED)})

    def _listen(self, now_ns: int) -> None:
        """Do what the starter asks for; what is no question of ours is told so."""
        for text in self._line.receive():
            try:
                question = msgspec.json.decode(text, type=_Question)
            except msgspec.MsgspecError as error:
                self._line.send({"error": f"this is no question to a simulation: {error}"})
                continue
            if question.look:
                looks = [look for bus in self._buses for look in servo_looks(bus, now_ns)]
                self._line.send({"servos": looks, "lateness_us": lateness_us(self._buses)})
            if question.fault is not None:
                self._line.send(self._inject(question.fault, now_ns))
        self._stopped = self._stopped or self._line.closed

    def _inject(self, text: str, now_ns: int) -> dict[str, object]:
        """Plan a fault that was given by hand, and return what is answered."""
        try:
            fault = parse_fault(text)
            self._faults.add(fault, now_ns)
        except InputError as error:
            return {"error": str(error)}
        return {"fault": str(fault)}


def _wake_on_sigterm() -> socket.socket:
    """Return a socket that becomes readable when SIGTERM comes."""
    wake, signalled = socket.socketpair()
    signalled.setblocking(False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    signal.set_wakeup_fd(signalled.detach())
    return wake


def servo_looks(bus: SimulatedBus, now_ns: int) -> list[Mapping[str, object]]:
    """Return each servo of a bus as it is now: angles in rad from raw 0, degrees C, V."""
    bus.advance(now_ns)
    return [_look(bus, servo) for servo in bus.servos]


def _look(bus: SimulatedBus, servo: SimulatedServo) -> Mapping[str, object]:
    counts = servo.counts
    registers = servo.registers
    return {
        "bus": bus.name,
        "id": servo.servo_id,
        "model": registers.table.model,
        "torque": servo.torque_on,
        "goal": _goal(registers),
        "present": servo.position,
        "temperature": servo.temperature,
        "voltage": servo.voltage,
        "error": registers.get("hardware_error_status", counts.last_error),
        "heard": counts.received,
        "answered": counts.replied,
    }


def _goal(registers: Memory) -> float | None:
    """Return the goal, rad from raw 0; None in a mode that has none."""
    if "goal_position" not in registers or registers.get("operating_mode", 3) not in _GOAL_MODES:
        return None
    if registers.get("cw_angle_limit", 1) == registers.get("ccw_angle_limit", 1) == 0:
        return None  # wheel mode (e-Manual, AX-12A, CW/CCW Angle Limit)
    return registers.ticks("goal_position") * registers.table.rad_per_tick


def lateness_us(buses: Sequence[SimulatedBus]) -> Mapping[str, float]:
    """Return how late hosts got their last bytes, us: median, p99, maximum; nothing before the first."""
    ordered = sorted(late_ns for bus in buses for late_ns in bus.lateness_ns)
    if not ordered:
        return {}
    picked = {
        "median": ordered[len(ordered) // 2],
        "p99": ordered[len(ordered) * 99 // 100],
        "maximum": ordered[-1],
    }
    return {name: late_ns / 1000 for name, late_ns in picked.items()}
