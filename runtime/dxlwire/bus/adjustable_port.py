"""Adjustable port: a serial port whose baud rate can change, on every system.

On Linux it is opened and locked as for a run. On other systems pyserial opens it.
"""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Callable
from typing import Protocol, Self

from dxlwire.clock import Clock, MonotonicClock
from dxlwire.exceptions import PortError
from dxlwire.port.latency_timer import latency_timer, shorten
from dxlwire.port.ports import SerialPort, SerialPorts
from dxlwire.port.serial_open import SerialLine, describe_failure, open_serial

FIRST_RATE = 57_600  # first rate of a port, bit/s; every adapter supports it
BOOT_NS = 2_000_000_000
"""Waiting time (ns) for the boot loader of a board that resets when its port is opened [i: Optiboot of
Arduino, 1 s].
"""
LATENCY_NS = 1_000_000
"""Assumed latency (ns) of an adapter whose latency timer is not known: one frame of full-speed USB."""
MOST_LATENCY_NS = 16_000_000
"""Highest latency (ns) of an adapter whose timer is not known: the default latency timer of an FTDI chip
(FTDI AN232B-04).
"""
_MOST_BYTES = 4096  # bytes of one read
_POLL_S = 0.000_5
"""Interval (s) at which pyserial is asked for bytes: a timeout for each read would set up the port of Windows
again.
"""


class LineOpener(Protocol):
    """Opens a serial line of Linux; `dxlwire.port.serial_open.open_serial` does."""

    def __call__(self, path: str, baud_rate: int, *, rs485: bool, boot_ns: int) -> SerialLine:
        """Return the open line. Raises PortError."""
        ...


class LinuxLine:
    """Open serial line of Linux, locked against every other program."""

    def __init__(
        self, path: str, baud_rate: int, *, rs485: bool, boot_ns: int, open_line: LineOpener
    ) -> None:
        serial = open_line(path, baud_rate, rs485=rs485, boot_ns=boot_ns)
        self.set_rate, self.close = serial.set_rate, serial.close
        self._serial, self._port = serial, SerialPort(serial.fileno(), path)
        self._ports, self._buffer = SerialPorts([self._port]), memoryview(bytearray(_MOST_BYTES))
        shorten(serial.fileno(), path, LATENCY_NS)

    @property
    def baud_rate(self) -> int:
        """Rate that the driver has set, bit/s."""
        return self._serial.baud_rate

    def receive_bytes(self, until_ns: int) -> bytes:
        """Wait for bytes until a time of the monotonic clock, and return those that have arrived."""
        self._ports.wait_for_bytes(until_ns)
        return bytes(self._buffer[: self._port.read_into(self._buffer)])

    def send_bytes(self, data: bytes) -> None:
        """Write one packet to the line."""
        self._port.write_packet(data)


class PyserialLine:
    """Open serial line of another system; `path` may be any URL of pyserial."""

    def __init__(self, path: str, baud_rate: int) -> None:
        # Imported here because Linux does not need it.
        from serial import serial_for_url

        self._path, self.baud_rate = path, baud_rate
        try:
            self._serial = serial_for_url(path, baud_rate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            # On Windows, pyserial has the cause in its text alone; a port in use is not permitted there.
            named = {"FileNotFoundError": errno.ENOENT, "PermissionError": errno.EBUSY}
            known = (number for name, number in named.items() if name in str(error))
            number = next(known, getattr(error, "errno", None) or 0)
            raise PortError(describe_failure(path, baud_rate, OSError(number, str(error)))) from None
        self.close: Callable[[], None] = self._serial.close

    def set_rate(self, baud_rate: int) -> bool:
        """Set the baud rate, bit/s. Raises OSError if the adapter does not support it."""
        try:
            self._serial.baudrate = self.baud_rate = baud_rate
        except (OSError, ValueError) as error:  # a line that is gone fails the next read or write, too
            raise OSError(errno.EINVAL, str(error)) from error
        return True

    def receive_bytes(self, until_ns: int) -> bytes:
        """Wait for bytes until a time of the monotonic clock, and return those that have arrived."""
        try:
            while True:
                # Compared first: bytes may arrive while this process has no processor.
                overdue = time.monotonic_ns() >= until_ns
                if (data := bytes(self._serial.read(_MOST_BYTES))) or overdue:
                    break
                time.sleep(_POLL_S)
        except OSError as error:
            raise self._describe_loss(error) from error
        return data

    def send_bytes(self, data: bytes) -> None:
        """Write one packet to the line."""
        try:
            self._serial.write(data)
        except OSError as error:
            raise self._describe_loss(error) from error

    def _describe_loss(self, error: OSError) -> PortError:
        return PortError(f"{self._path} is gone ({error}); check that the adapter is plugged in")


class AdjustablePort:
    """A serial port whose baud rate can change, opened exclusively; a context manager that closes it.

    Args:
        path: The device, or on Windows a name such as COM3.
        baud_rate: First rate, bit/s.
        rs485: True to let the kernel switch the direction of an RS-485 transceiver.
        boot_ns: Time to wait for a board that this call has reset by opening its port.
        open_line: Opens the line on Linux.

    Raises:
        PortError: The port cannot be opened: it does not exist, or another process, which is named, has it.
    """

    def __init__(
        self,
        path: str,
        baud_rate: int = FIRST_RATE,
        *,
        rs485: bool = False,
        boot_ns: int = BOOT_NS,
        open_line: LineOpener = open_serial,
    ) -> None:
        system = sys.platform
        if rs485 and system != "linux":
            raise PortError(
                f"{path}: `adapter: {{rs485: true}}` needs Linux, and this is {system}; use an adapter with "
                "automatic direction control"
            )
        self._line: LinuxLine | PyserialLine = (
            LinuxLine(path, baud_rate, rs485=rs485, boot_ns=boot_ns, open_line=open_line)
            if system == "linux"
            else PyserialLine(path, baud_rate)
        )
        self._tuned = baud_rate
        self.other_rates: dict[int, int] = {}
        """Rates that the driver did not set as requested, with the rates that it set instead; bit/s."""
        self.name = path
        self.clock: Clock = MonotonicClock()
        self.receive_bytes: Callable[[int], bytes] = self._line.receive_bytes
        """Waits for bytes until a time of `clock`, and returns those that have arrived. Raises PortError."""
        self.send_bytes: Callable[[bytes], None] = self._line.send_bytes
        """Writes one packet to the port. Raises PortError."""
        timer = latency_timer(path)
        found_ns = 0 if timer is None else timer.found_ms * 1_000_000
        self.latency_ns = max(LATENCY_NS, found_ns)
        """Latency of the adapter, ns: that of its timer as found, at least LATENCY_NS."""
        self.most_latency_ns = found_ns or MOST_LATENCY_NS
        """Highest latency of the adapter, ns: used in timeouts for a servo that has already answered once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port."""
        self._line.close()

    def tune(self, baud_rate: int) -> bool:
        """Set the baud rate, bit/s, and discard unread bytes; return False if the adapter does not support
        the rate.

        Raises:
            PortError: The port is gone.
        """
        try:
            if self._tuned != baud_rate:
                self._tuned = 0
                if not self._line.set_rate(baud_rate):
                    self.other_rates[baud_rate] = self._line.baud_rate
                self._tuned = baud_rate
            self.receive_bytes(0)
        except OSError as error:
            if error.errno == errno.EINVAL:
                return False
            raise PortError(f"{self.name} is gone ({error}): was the adapter unplugged?") from error
        return baud_rate not in self.other_rates
