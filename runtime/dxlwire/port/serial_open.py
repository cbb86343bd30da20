"""Opening a serial line for one process alone; the guardian does it, the loop inherits the descriptor."""

from __future__ import annotations

import errno
import os
import struct
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from dxlwire.errors import PortError
from dxlwire.port.adapters import serial_devices
from dxlwire.port.latency_timer import is_simulated
from dxlwire.port.rights import command_for_access

try:
    import fcntl
    import termios
except ImportError:  # Windows, where a sensor's parameters are checked and no line is opened
    fcntl = termios = None  # type: ignore[assignment]  # modules, or none

_RATE_TOLERANCE = 0.02
"""Of 8N1: a receiver samples the tenth bit within half a bit up to 5 %, for both ends together [i]."""
_TCGETS2, _TCSETS2, _BOTHER = 0x802C542A, 0x402C542B, 0o010000
"""Terminal settings with the rate as a number (Linux, asm-generic/ioctls.h): they know every rate."""
_SETTINGS = struct.Struct("4I20s2I")
"""struct termios2 (asm-generic/termbits.h): flags of input, output, control, local; line; both rates."""
_TIOCSRS485 = 0x542F
_RS485 = struct.pack("8I", 0b11, *(0,) * 7)
"""struct serial_rs485 (linux/serial.h): enabled, RTS is high while it sends, no delays."""

DescribeProcess = Callable[[Path], str]
"""Describes a process by its folder in /proc, and how to stop it; returns an empty text if it is unknown."""


class SerialLine:
    """A serial device that no other process can open before it is closed: raw, 8N1, no flow control.

    The lock belongs to the terminal, and the Linux kernel takes it off when no process has it open any more.
    Simulated servos keep theirs open for the next program, so closing takes it off.

    Linux sets DTR when a port is opened, and boards such as an Arduino or an OpenCM reset then. It would
    clear DTR when the port is closed; that is switched off here, so a board resets once, after it was
    plugged in.
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        """Raises OSError."""
        self.path = path
        self.baud_rate = 0
        """The rate that the driver really set, bit/s."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # which pyserial programs respect
            self.set_dtr = bool(self._settings()[2] & termios.HUPCL)
            """True when DTR was not set before: the port was not opened here since it was plugged in."""
            self.set_rate(baud_rate)
            termios.tcflush(self._descriptor, termios.TCIFLUSH)
            fcntl.ioctl(self._descriptor, termios.TIOCEXCL)  # which every program meets, but for root's
        except BaseException:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> SerialLine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def set_rate(self, baud_rate: int) -> bool:
        """Set the rate, bit/s; return whether the driver did, within 2 %. Raises OSError."""
        control = termios.CS8 | termios.CREAD | termios.CLOCAL | _BOTHER
        settings = _SETTINGS.pack(0, 0, control, 0, bytes(20), baud_rate, baud_rate)
        fcntl.ioctl(self._descriptor, _TCSETS2, settings)
        self.baud_rate = self._settings()[-1]
        return is_rate(self.baud_rate, baud_rate)

    def detach(self) -> int:
        """Return the descriptor, which is the caller's from now on; `let_go` closes it."""
        descriptor, self._descriptor = self._descriptor, -1
        return descriptor

    def close(self) -> None:
        """Close the line, if it is still open here."""
        if self._descriptor >= 0:
            let_go([self.detach()])

    def _settings(self) -> tuple[int, ...]:
        found = fcntl.ioctl(self._descriptor, _TCGETS2, bytes(_SETTINGS.size))
        return _SETTINGS.unpack(found)


def let_go(descriptors: Iterable[int]) -> None:
    """Close lines that were detached, by this process or by one that is dead now."""
    for descriptor in descriptors:
        with suppress(OSError):  # the adapter is gone, and the lock with it
            fcntl.ioctl(descriptor, termios.TIOCNXCL)
        os.close(descriptor)


def describe_no_process(process: Path) -> str:
    """Return an empty description; the default of `DescribeProcess`."""
    return ""


def open_serial(
    path: str,
    baud_rate: int,
    *,
    rs485: bool = False,
    boot_ns: int = 0,
    describe_holder: DescribeProcess = describe_no_process,
) -> SerialLine:
    """Open a serial device for this process alone: raw, 8N1; also a pseudo-terminal.

    Args:
        path: The device.
        baud_rate: bit/s; `SerialLine.baud_rate` is what the driver made of it.
        rs485: Let the kernel switch the direction of an RS-485 transceiver by RTS.
        boot_ns: How long to wait for a board that resets when its port is opened; only where this did that.
        describe_holder: Describes a process that has the port open, for the message of the error.

    Raises:
        PortError: There is no such device, this user may not open it, another process has it, or it cannot do
            the baud rate or RS-485.
    """
    try:
        line = SerialLine(path, baud_rate)
    except OSError as error:
        raise PortError(_sentence(path, baud_rate, error, describe_holder)) from error
    if rs485 and not is_simulated(path):
        try:
            fcntl.ioctl(line.fileno(), _TIOCSRS485, _RS485)
        except OSError as error:
            line.close()
            raise PortError(
                f"the driver of {path} has no RS-485 mode ({error.strerror}): leave out `adapter: {{rs485: "
                "true}`, and use an adapter that switches the direction itself"
            ) from error
    if line.set_dtr and boot_ns:
        time.sleep(boot_ns * 1e-9)
    return line


def is_rate(found: int, asked: int) -> bool:
    """Return whether a rate is near enough to another one, within 2 %."""
    return abs(found - asked) <= _RATE_TOLERANCE * asked


def rate_remark(line: SerialLine, baud_rate: int) -> str:
    """Return a sentence for a rate that a driver did not set as asked; empty: it did."""
    if is_rate(line.baud_rate, baud_rate):
        return ""
    error = line.baud_rate / baud_rate - 1.0
    return (
        f"{line.path} was asked for {baud_rate} bit/s, and its driver set {line.baud_rate} ({error:+.1%}): "
        "servos may not receive what is sent; choose a rate that the adapter has"
    )


def _sentence(path: str, baud_rate: int, error: OSError, describe_holder: DescribeProcess) -> str:
    number = error.errno
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"there is no {path}; {_what_exists()}"
    if number in (errno.EACCES, errno.EPERM) and not os.access(path, os.R_OK | os.W_OK):
        return (
            f"this user may not open {path}: "
            f"`{command_for_access(Path(os.path.realpath(path)), os.path.realpath(path), '$USER')}`"
        )
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return f"{path} is in use by {_holder(path, describe_holder)}"
    if number == errno.ENOTTY:
        return f"{path} is no serial line"
    if number == errno.EINVAL:
        return f"{path} cannot run at {baud_rate} bit/s: {error.strerror}"
    return f"{path} cannot be opened: {error}"


def _what_exists() -> str:
    devices = serial_devices()
    if not devices:
        return "this machine has no serial adapter now: is it plugged in?"
    return f"there are: {', '.join(devices)}"


def _holder(path: str, describe: DescribeProcess) -> str:
    """Name the processes that have the device open, and how to stop them.

    The first description counts; without one each process is named by its command.

    Only what this user may see is named.
    """
    device = os.path.realpath(path)
    found = [
        process for process in _processes() if process.name != str(os.getpid()) and _has_open(process, device)
    ]
    if described := next(filter(None, map(describe, found)), ""):
        return described
    named = [f"{_command(process)} (process {process.name})" for process in found]
    return f"{' and '.join(named) or 'another process, which this user may not see'}; stop that first"


def _processes() -> Iterable[Path]:
    return (path for path in sorted(Path("/proc").iterdir()) if path.name.isdigit())


def _has_open(process: Path, device: str) -> bool:
    try:
        return any(os.readlink(descriptor) == device for descriptor in (process / "fd").iterdir())
    except OSError:
        return False


def _command(process: Path) -> str:
    try:
        words = (process / "cmdline").read_bytes().split(b"\0")
        # enough to read `python -P -m dxlsim`
        # one line, whatever its words are
        return " ".join(b" ".join(words[:5]).decode(errors="replace").split())[:100] or "a process"
    except OSError:
        return "a process"
