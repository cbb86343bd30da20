"""Pseudo-terminal: terminal of a simulated bus, which a host opens like the port of an adapter."""

from __future__ import annotations

import ctypes
import fcntl
import os
import struct
import tty
from contextlib import suppress
from pathlib import Path

from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.wire.compiled_line import TerminalState, line_library

_TCGETS2, _TCSETS2 = 0x802C542A, 0x402C542B
"""Requests for terminal settings with a numeric rate (Linux, asm-generic/ioctls.h): they support every
rate."""
_SETTINGS = struct.Struct("4I20s2I")
"""Layout of struct termios2 (asm-generic/termbits.h): flags of input, output, control, local; line; both
rates."""
_ROOM = bytes(_SETTINGS.size)
_CBAUD, _BOTHER = 0o010017, 0o010000


class PseudoTerminal:
    """Simulation's end (master) of a terminal whose other end (slave) hosts open and close. No slave is open
    here, because programs check for other users of a port. A host that started the simulation may hold the
    other end of a socket in place of the first terminal.

    A terminal starts with the rate of the bus. A host that sets another rate sends at that rate, and servos
    at the old rate receive nothing.

    Difference from a USB adapter [i]: a host that flushes its output right after writing
    (`tcflush(TCOFLUSH)`, pyserial's `reset_output_buffer`) loses the bytes that the kernel has not
    delivered yet. pypot 5.0 does so before each packet."""

    def __init__(
        self,
        bus: SimulatedBus,
        link: DeviceLink | None = None,
        progress: memoryview | None = None,
        socket: int | None = None,
    ) -> None:
        """Create the terminal.

        Args:
            bus: The bus.
            link: Link to the device; None: none.
            progress: Words in which the line's progress is published; None: nobody watches.
            socket: Descriptor of a socket that is used until the adapter is unplugged; None: a terminal is
                created. The Linux kernel moves the bytes of a terminal in a worker thread of ordinary
                priority (flush_to_ldisc), which waits for other programs: on busy cores for milliseconds.
        """
        self.bus = bus
        self._link = link
        self._progress = None if progress is None else (ctypes.c_char * progress.nbytes).from_buffer(progress)
        self._device, self._name = self._new_pair() if socket is None else (socket, "")
        os.set_blocking(self._device, False)
        self.state = TerminalState(
            bus=bus.address,
            progress=None if self._progress is None else ctypes.addressof(self._progress),
            served_ns=-1,
            descriptor=self._device,
            has_settings=socket is None,
            opened=bus.times_unplugged,
            plugged=1,
        )
        """State that compiled code uses: descriptor, settings, and bytes that the bus has not received."""
        self._address = ctypes.addressof(self.state)
        self._library = line_library()
        self._publish()

    @property
    def path(self) -> str:
        """Path of the device that hosts open; empty while the adapter is unplugged, and for a socket."""
        return self._name if self.plugged else ""

    @property
    def plugged(self) -> bool:
        """False: the adapter is unplugged and no device exists."""
        return bool(self.state.plugged)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host has written."""
        return int(self.state.descriptor)

    def follow_adapter(self) -> bool:
        """Unplug or plug in the terminal like the adapter of the bus; return True if the device has changed.

        The new device has another name, as with udev, because a host may still hold the old one; the link
        is updated. Bytes that the host wrote in between are lost."""
        if self.state.opened == self.bus.times_unplugged and self.plugged == self.bus.plugged:
            return False
        self.state.held_ns = self.state.ready = self.state.size = self.state.known = 0
        if self.state.opened != self.bus.times_unplugged:
            self.state.opened = self.bus.times_unplugged
            old = self._device
            # Opened before the old one is closed, to get another name
            self._device, self._name = self._new_pair()
            os.close(old)
            self.state.descriptor, self.state.has_settings = self._device, 1
            self._unpublish()
        self.state.plugged = self.bus.plugged
        if self.plugged:
            try:
                self._publish()
            except OSError as error:
                self.bus.add_note(f"the link to the port was not updated: {error}")
        return True

    def read_chunk(self) -> None:
        """Read one chunk of bytes that the host has written, and keep it for `deliver_bytes`."""
        self._library.line_read_chunk(self._address)

    def deliver_bytes(self, now_ns: int) -> int:
        """Pass the bytes that were read to the bus, as written at `now_ns`, with the host's baud rate.

        Returns:
            The number of bytes.
        """
        count: int = self._library.line_accept(self._address, now_ns)
        self.bus.raise_stored()
        return count

    def deliver(self, now_ns: int) -> None:
        """Write the bytes of the bus that are due to the host at `now_ns`; bytes that do not fit into the
        terminal are lost."""
        self._library.line_deliver(self._address, now_ns)
        self.bus.raise_stored()

    def close(self) -> None:
        """Close the terminal and remove its link."""
        os.close(self._device)
        self._unpublish()

    def _new_pair(self) -> tuple[int, str]:
        """Return the descriptor of a new terminal's master and the path of its slave, which is raw and has
        the rate of the bus."""
        master, slave = os.openpty()
        tty.setraw(slave)
        _set_rate(slave, self.bus.baud_rate)
        os.set_blocking(master, False)
        name = os.ttyname(slave)
        # No slave stays open, because programs look for other users of the port.
        os.close(slave)
        return master, name

    def _publish(self) -> None:
        if self._link is not None:
            self._link.point(self.path)

    def _unpublish(self) -> None:
        if self._link is not None:
            self._link.remove()


class DeviceLink:
    """Symbolic link that follows a device whose name changes; it never replaces anything but a link."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._target: str | None = None

    def point(self, target: str) -> None:
        """Point the link at the path `target`, atomically.

        Raises:
            FileExistsError: The path is not a link.
            OSError: The link cannot be created.
        """
        if os.path.lexists(self._path) and not self._path.is_symlink():
            raise FileExistsError(f"{self._path} exists and is not a symbolic link; choose another path")
        # A rename replaces the link atomically, so the path always leads to a terminal.
        new = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        new.symlink_to(target)
        try:
            new.replace(self._path)
        except OSError:
            new.unlink()
            raise
        self._target = target

    def remove(self) -> None:
        """Remove the link if it still has the last target."""
        with suppress(OSError):
            if self._target is not None and os.readlink(self._path) == self._target:
                self._path.unlink()
        self._target = None


def _settings(terminal: int) -> bytes:
    return fcntl.ioctl(terminal, _TCGETS2, _ROOM)


def _set_rate(terminal: int, baud_rate: int) -> None:
    settings = list(_SETTINGS.unpack(_settings(terminal)))
    settings[2] = settings[2] & ~_CBAUD | _BOTHER
    settings[-2:] = [baud_rate, baud_rate]
    fcntl.ioctl(terminal, _TCSETS2, _SETTINGS.pack(*settings))
