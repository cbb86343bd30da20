"""A pseudo-terminal before a simulated bus, so that a host opens it as it would open an adapter."""

from __future__ import annotations

import fcntl
import os
import struct
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from dxlsim.bus.simulated_bus import SimulatedBus

_TCGETS2, _TCSETS2 = 0x802C542A, 0x402C542B
"""Terminal settings with the rate as a number (Linux, asm-generic/ioctls.h): they know every rate."""
_SETTINGS = struct.Struct("4I20s2I")
"""struct termios2 (asm-generic/termbits.h): flags of input, output, control, local; line; both rates."""
_ROOM = bytes(_SETTINGS.size)
_CBAUD, _BOTHER = 0o010017, 0o010000
_CHUNK = 4096
"""Bytes of one read; fewer are all that there are."""


class PseudoTerminal:
    """The master's end. Hosts may come and go; no slave is open here, as programs look for who else has it.

    A terminal without a rate of its own has that of the bus; a host that sets another one sends at that rate,
    and servos at the old one receive nothing.

    What a USB adapter would not do [i]: a host that throws its output away (`tcflush(TCOFLUSH)`, pyserial's
    `reset_output_buffer`) right after writing loses what the kernel has not handed over yet; pypot 5.0 does
    so before each packet.
    """

    def __init__(self, bus: SimulatedBus, link: DeviceLink | None = None) -> None:
        self.bus = bus
        self._link = link
        self._master, self._name = self._new_pair()
        self._settings = b""  # Settings of the terminal when the host last wrote
        self._taken = b""  # What the host wrote and the bus was not handed yet
        self.may_have_more = False  # The newest chunk was full
        self._times_unplugged = bus.times_unplugged
        self.plugged = True  # False: the host saw it go, and no device is there
        self._publish()

    @property
    def path(self) -> str:
        """Path of the device that a host opens, empty while the adapter is unplugged."""
        return self._name if self.plugged else ""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host has written."""
        return self._master

    def follow_adapter(self) -> bool:
        """Go and come back with the adapter of the bus; return whether the device is another one now.

        It comes back under another name, because a host may still hold the old one, as udev would have it;
        the link follows. What the host wrote meanwhile is lost.
        """
        if self._times_unplugged == self.bus.times_unplugged and self.plugged == self.bus.plugged:
            return False
        self._taken = b""
        if self._times_unplugged != self.bus.times_unplugged:
            self._times_unplugged = self.bus.times_unplugged
            old = self._master
            self._master, self._name = self._new_pair()  # while the old name is still taken
            os.close(old)
            self._unpublish()
        self.plugged = self.bus.plugged
        if self.plugged:
            try:
                self._publish()
            except OSError as error:
                self.bus.note(f"the link does not follow the adapter: {error}")
        return True

    def read(self) -> None:
        """Take what the host has written, a chunk at most."""
        data = b""
        with suppress(OSError):  # there is nothing, or no host
            data = os.read(self._master, _CHUNK)
        self._taken += data
        self.may_have_more = len(data) == _CHUNK

    def receive(self, now_ns: int) -> int:
        """Hand what was taken to the bus, as if it had been written at `now_ns`, which is no earlier.

        Return the number of bytes.
        """
        data, self._taken = self._taken, b""
        if not data:
            return 0
        settings = _settings(self._master)
        if settings != self._settings:  # the host's rate can only be another one then
            self._settings = settings
            rate = _rate(settings)
            if rate not in (0, self.bus.baud_rate):
                self.bus.change_rate(rate)
        self.bus.receive(data, now_ns)
        return len(data)

    def deliver(self, now_ns: int, announce: Callable[[int], None] | None = None) -> None:
        """Give the host what has reached it by `now_ns`; what does not fit into the terminal is lost.

        `announce` is called before, with the time, where there are any bytes.
        """
        handed_ns = time.monotonic_ns()
        data = self.bus.take(now_ns, handed_ns=handed_ns)
        if not data:
            return
        if announce is not None:
            announce(handed_ns)
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        if written < len(data):
            self.bus.note(f"{len(data) - written} bytes to the host are lost: it does not read")

    def close(self) -> None:
        """Take the terminal and its link away."""
        os.close(self._master)
        self._unpublish()

    def _new_pair(self) -> tuple[int, str]:
        """Return the descriptor of the master and the path of the slave, whose settings stay."""
        master, slave = os.openpty()
        tty.setraw(slave)
        _set_rate(slave, self.bus.baud_rate)
        os.set_blocking(master, False)
        name = os.ttyname(slave)
        os.close(slave)
        return master, name

    def _publish(self) -> None:
        if self._link is not None:
            self._link.point(self.path)

    def _unpublish(self) -> None:
        if self._link is not None:
            self._link.remove()


class DeviceLink:
    """Points at one path after the other; never replaces anything that is not a link."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._target: str | None = None

    def point(self, target: str) -> None:
        """Lead to `target`, in one step; raises OSError when it cannot, FileExistsError for another file."""
        if os.path.lexists(self._path) and not self._path.is_symlink():
            raise FileExistsError(f"{self._path} is no link; it is not replaced")
        new = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        new.symlink_to(target)
        try:
            new.replace(self._path)
        except OSError:
            new.unlink()
            raise
        self._target = target

    def remove(self) -> None:
        """Take the link away, if it still leads where it was pointed."""
        with suppress(OSError):
            if self._target is not None and os.readlink(self._path) == self._target:
                self._path.unlink()
        self._target = None


def _settings(terminal: int) -> bytes:
    return fcntl.ioctl(terminal, _TCGETS2, _ROOM)


def _rate(settings: bytes) -> int:
    return int(_SETTINGS.unpack(settings)[-1])


def _set_rate(terminal: int, baud_rate: int) -> None:
    settings = list(_SETTINGS.unpack(_settings(terminal)))
    settings[2] = settings[2] & ~_CBAUD | _BOTHER
    settings[-2:] = [baud_rate, baud_rate]
    fcntl.ioctl(terminal, _TCSETS2, _SETTINGS.pack(*settings))
