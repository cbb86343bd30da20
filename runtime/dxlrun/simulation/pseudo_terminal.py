"""A pseudo-terminal before a simulated bus, so that a host opens it as it would open an adapter."""

from __future__ import annotations

import os
import tty

from dxlrun.simulation.bus import SimulatedBus


class PseudoTerminal:
    """The master's end; a slave's descriptor stays open here, so that hosts may come and go."""

    def __init__(self, bus: SimulatedBus) -> None:
        self.bus = bus
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        """Path of the device that a host opens."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host has written."""
        return self._master

    def receive(self, now_ns: int) -> None:
        """Hand what the host has written to the bus, as if it had been written at `now_ns`."""
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:
            return
        self.bus.receive(data, now_ns)

    def deliver(self, now_ns: int) -> None:
        """Give the host what has reached it by `now_ns`; what does not fit into the terminal is lost."""
        data = self.bus.take(now_ns)
        if not data:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        if written < len(data):
            self.bus.note(f"{len(data) - written} bytes to the host are lost: it does not read")

    def close(self) -> None:
        """Take the terminal away."""
        os.close(self._master)
        os.close(self._slave)
