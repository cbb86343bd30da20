"""The process of the simulated buses: one pseudo-terminal a bus, in real time, until its starter hangs up."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dxlrun.control_table import add_control_table
from dxlrun.simulation.bus import SimulatedBus
from dxlrun.simulation.bus_config import BusConfig
from dxlrun.simulation.ledger import Ledger
from dxlrun.simulation.mechanics import Mechanics
from dxlrun.simulation.pseudo_terminal import PseudoTerminal

POLL_NS = 80_000
"""A sleep wakes some 50 us late on a stock kernel: so long before a reply is due the clock is polled."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the buses of a configuration until the control socket ends or SIGTERM comes.

    Return 0, or 1 when the ledger could not be written.
    """
    parser = argparse.ArgumentParser(
        prog="dxlrun.simulation", description="Simulated buses on pseudo-terminals."
    )
    parser.add_argument("--config-fd", type=int, required=True, help="a JSON list of buses; read to its end")
    parser.add_argument(
        "--control-fd", type=int, required=True, help="socket: told the ports, its end ends the run"
    )
    parser.add_argument(
        "--ledger", type=Path, default=None, help="JSON-lines file of every byte on the buses"
    )
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the front process takes it
    with os.fdopen(options.config_fd, "rb") as file:
        config = decode_config(file.read())
    for text in dict.fromkeys(text for bus in config.buses for text in bus.control_tables):
        add_control_table(text)
    with socket.socket(fileno=options.control_fd) as control, Ledger(options.ledger, keep=False) as ledger:
        Server(config, ledger, control).run()
    if ledger.error is None:
        return 0
    print(ledger.error, file=sys.stderr)
    return 1


@dataclass(frozen=True, slots=True)
class SimulationConfig:
    """What the process of the simulated buses is to serve."""

    buses: tuple[BusConfig, ...]
    faults: tuple[str, ...] = ()
    """Lines of faults; their times count from the start."""
    seed: int = 0
    """Of what the faults leave to chance."""
    links: dict[str, str] = field(default_factory=dict)
    """By bus: path of a symbolic link that always leads to its terminal, as udev's do."""


def encode_config(config: SimulationConfig | Sequence[BusConfig]) -> bytes:
    """Return what `--config-fd` takes; buses alone are a configuration without faults."""
    if not isinstance(config, SimulationConfig):
        config = SimulationConfig(tuple(config))
    return msgspec.json.encode(config)


def decode_config(data: bytes) -> SimulationConfig:
    """Return the configuration of `encode_config`; raises msgspec.ValidationError."""
    return msgspec.json.decode(data, type=SimulationConfig)


class Server:
    """Pumps pseudo-terminals and buses; one thread, one select."""

    def __init__(self, config: SimulationConfig, ledger: Ledger, control: socket.socket) -> None:
        start_ns = time.monotonic_ns()
        mechanics = Mechanics(start_ns)
        self._ledger = ledger
        self._control = control
        self._terminals = tuple(
            PseudoTerminal(SimulatedBus(bus, ledger, start_ns, mechanics)) for bus in config.buses
        )
        self._stopped = False

    def run(self) -> None:
        """Tell the ports, then serve until the control socket ends or SIGTERM comes."""
        with _wake_on_sigterm() as wake:
            self._tell_ports()
            while not self._stopped:
                self._turn(wake)
        for terminal in self._terminals:
            terminal.close()

    def _turn(self, wake: socket.socket) -> None:
        sources: list[PseudoTerminal | socket.socket] = [*self._terminals, self._control, wake]
        readable, _, _ = select.select(sources, [], [], self._patience())
        # What was due before the host wrote goes out first: the host could have read it.
        now_ns = time.monotonic_ns()
        for terminal in self._terminals:
            terminal.deliver(now_ns)
            if terminal in readable:
                terminal.receive(now_ns)
        if wake in readable or (self._control in readable and self._hung_up()):
            self._stopped = True
        self._ledger.flush_if_due(now_ns)

    def _tell_ports(self) -> None:
        ports = {terminal.bus.name: terminal.path for terminal in self._terminals}
        with contextlib.suppress(OSError):  # nobody listens any more: the first turn sees it
            self._control.sendall(json.dumps({"ports": ports}).encode() + b"\n")

    def _hung_up(self) -> bool:
        try:
            return not self._control.recv(4096)
        except OSError:  # the starter ended without having read the ports
            return True

    def _patience(self) -> float | None:
        """Return for how long nothing happens by itself, s: 0 shortly before a reply, None for ever."""
        times = [
            due_ns - POLL_NS for each in self._terminals if (due_ns := each.bus.next_due_ns()) is not None
        ]
        flush_ns = self._ledger.flush_due_ns()
        if flush_ns is not None:
            times.append(flush_ns)
        if not times:
            return None
        return max(0, min(times) - time.monotonic_ns()) * 1e-9


def _wake_on_sigterm() -> socket.socket:
    """Return a socket that becomes readable when SIGTERM comes."""
    wake, signalled = socket.socketpair()
    signalled.setblocking(False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    signal.set_wakeup_fd(signalled.detach())
    return wake
