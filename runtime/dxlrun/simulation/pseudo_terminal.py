"""A pseudo-terminal before a simulated bus, so that a host opens it as it would open an adapter."""

from __future__ import annotations

import fcntl
import os
import struct
import tty

from dxlrun.simulation.bus import SimulatedBus

_TCGETS2, _TCSETS2 = 0x802C542A, 0x402C542B
"""Terminal settings with the rate as a number (Linux, asm-generic/ioctls.h): they know every rate."""
_SETTINGS = struct.Struct("4I20s2I")
"""struct termios2 (asm-generic/termbits.h): flags of input, output, control, local; line; both rates."""
_CBAUD, _BOTHER = 0o010017, 0o010000


class PseudoTerminal:
    """The master's end; a slave's descriptor stays open here, so that hosts may come and go.

    A terminal that was never told a rate has that of the bus; a host that sets another one talks at that
    rate, and servos at the old one hear nothing.
    """

    def __init__(self, bus: SimulatedBus) -> None:
        self.bus = bus
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        _set_rate(self._slave, bus.baud_rate)
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
        rate = _rate(self._slave)
        if rate not in (0, self.bus.baud_rate):
            self.bus.change_rate(rate)
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


def _rate(terminal: int) -> int:
    """Return the rate at which a terminal would send, bit/s."""
    settings = _SETTINGS.unpack(fcntl.ioctl(terminal, _TCGETS2, bytes(_SETTINGS.size)))
    return int(settings[-1])


def _set_rate(terminal: int, baud_rate: int) -> None:
    settings = list(_SETTINGS.unpack(fcntl.ioctl(terminal, _TCGETS2, bytes(_SETTINGS.size))))
    settings[2] = settings[2] & ~_CBAUD | _BOTHER
    settings[-2:] = [baud_rate, baud_rate]
    fcntl.ioctl(terminal, _TCSETS2, _SETTINGS.pack(*settings))
