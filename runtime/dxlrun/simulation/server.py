"""Serving simulated buses in real time: one thread, one select, no waiting for anybody."""

from __future__ import annotations

import select
import signal
import socket
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dxlrun.errors import InputError
from dxlrun.simulation.bus import SimulatedBus
from dxlrun.simulation.configuration import SimulationConfig
from dxlrun.simulation.control_line import ControlLine
from dxlrun.simulation.faults import FaultScript, parse_fault
from dxlrun.simulation.ledger import Ledger
from dxlrun.simulation.link import Link
from dxlrun.simulation.look import lateness_us, servo_looks
from dxlrun.simulation.mechanics import Mechanics
from dxlrun.simulation.mujoco_plant import mujoco_plant
from dxlrun.simulation.pseudo_terminal import PseudoTerminal
from dxlrun.simulation.realtime import Patience

_HAPPENED = "fault: "
MOST_BACKLOG_NS = 20_000_000
"""A host that hands over bytes faster than they pass the wire is not read while so much of them waits.

So it feels the rate of its line, as with an adapter."""

MOVE_NS = 300_000
"""So long the mechanics of a few steps may take."""


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
        plant = mujoco_plant(config.bodies) if config.bodies else None
        self._mechanics = Mechanics(self.start_ns, plant)
        self._buses = tuple(SimulatedBus(bus, ledger, self.start_ns, self._mechanics) for bus in config.buses)
        self._faults = FaultScript([parse_fault(text) for text in config.faults], config.seed)
        self._faults.attach(self._buses, start_ns=self.start_ns)
        self._terminals = tuple(
            PseudoTerminal(bus, Link(Path(config.links[bus.name])) if bus.name in config.links else None)
            for bus in self._buses
        )
        self._patience = Patience(self.start_ns)
        self._stopped = False

    def run(self, granted: str = "") -> None:
        """Tell the ports and what real time was granted, then serve."""
        self._ledger.on_note = self._tell_fault
        with _wake_on_sigterm() as wake:
            self._line.send({"ports": self._ports(), "real_time": granted})
            while not self._stopped:
                self._turn(wake)
        for terminal in self._terminals:
            terminal.close()

    def _turn(self, wake: socket.socket) -> None:
        now_ns = time.monotonic_ns()
        dues = [bus.next_due_ns() for bus in self._buses]
        patience = self._patience.until(self._next_ns(dues, now_ns), now_ns)
        sources: list[PseudoTerminal | socket.socket | ControlLine] = [
            each
            for each in self._terminals
            if each.plugged and each.bus.host_free_ns - now_ns <= MOST_BACKLOG_NS
        ]
        sources += (self._line, wake)
        writable = (self._line,) if self._line.has_unsent else ()
        readable, unsent, _ = select.select(sources, writable, (), patience)
        # What was due before the host wrote goes out first: the host could have read it.
        now_ns = time.monotonic_ns()
        for terminal, due_ns in zip(self._terminals, dues, strict=True):
            if (due_ns is not None and due_ns <= now_ns) or terminal in readable:
                terminal.deliver(now_ns)
                if terminal.follow_adapter():
                    self._line.send({"ports": self._ports()})
        for terminal in self._terminals:
            if terminal in readable and terminal.plugged:
                terminal.receive(now_ns)  # of that moment, however long the others took
        self._move(now_ns)
        if unsent:
            self._line.flush()
        if self._line in readable:
            self._listen(now_ns)
        if wake in readable:
            self._stopped = True
        self._ledger.flush_if_due(now_ns)

    def _move(self, now_ns: int) -> None:
        """Let the servos move on, unless a reply is about to leave."""
        due = (bus.next_due_ns() for bus in self._buses)
        if all(due_ns is None or due_ns - now_ns > MOVE_NS for due_ns in due):
            self._mechanics.advance(now_ns)

    def _next_ns(self, dues: Sequence[int | None], now_ns: int) -> int | None:
        """Return when something is to be done without being asked."""
        times = [due_ns for due_ns in dues if due_ns is not None]
        backlogs = (bus.host_free_ns - MOST_BACKLOG_NS for bus in self._buses)
        times += [free_ns for free_ns in backlogs if free_ns > now_ns]
        times += (
            t_ns for t_ns in (self._ledger.flush_due_ns(), self._mechanics.due_ns()) if t_ns is not None
        )
        return min(times, default=None)

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
