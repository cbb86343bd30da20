"""Opening of a serial line for exclusive use, with errors that name cause and fix. The guardian opens it,
and the loop inherits the descriptor."""

from __future__ import annotations

import errno
import os
import re
import struct
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from dxlwire.exceptions import PortError, help_link
from dxlwire.port.adapters import serial_devices
from dxlwire.port.latency_timer import is_simulated
from dxlwire.port.rights import command_for_access

try:
    import fcntl
    import termios
except ImportError:  # Windows checks only the parameters of sensors and opens no line
    fcntl = termios = None  # type: ignore[assignment]  # modules, or none

_RATE_TOLERANCE = 0.02
"""Tolerated relative difference of a baud rate from the requested one: an 8N1 receiver samples the tenth
bit correctly up to 5 %, both ends together [i]."""
_TCGETS2, _TCSETS2, _BOTHER = 0x802C542A, 0x402C542B, 0o010000
"""Requests and flag for terminal settings with a numeric rate (Linux, asm-generic/ioctls.h): they support
every rate."""
_SETTINGS = struct.Struct("4I20s2I")
"""Layout of struct termios2 (asm-generic/termbits.h): flags of input, output, control, local; line; both
rates."""
_TIOCSRS485 = 0x542F
_RS485 = struct.pack("8I", 0b11, *(0,) * 7)
"""Content of struct serial_rs485 (linux/serial.h): enabled, RTS high during transmission, no delays."""

DescribeProcess = Callable[[Path], str]
"""Returns a text about the process with this folder in /proc, and how to stop it; empty if it is unknown."""


class SerialLine:
    """Serial device that this process has opened and locked for exclusive use: raw, 8N1, no flow control.

    The lock belongs to the terminal, and the Linux kernel releases it when the last process closes the
    device. Simulated servos keep their device open for the next program, so `close` releases the lock
    explicitly.

    Linux sets DTR when a port is opened, which resets boards such as an Arduino or an OpenCM. By default
    it also clears DTR when the port is closed. That is switched off here, so a board resets only once, at
    the first opening after it was plugged in."""

    def __init__(self, path: str, baud_rate: int) -> None:
        """Open and lock the device, and set its rate. Raises OSError."""
        self.path = path
        self.baud_rate = 0
        """Baud rate that the driver actually set, bit/s."""
        # O_NONBLOCK: opening does not wait for a carrier. O_NOCTTY: the line does not become the controlling
        # terminal.
        self._descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            # An advisory lock, which pyserial programs respect
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.set_dtr = bool(self._settings()[2] & termios.HUPCL)
            """True if opening the port has set DTR: the first opening on this machine since it was plugged
            in."""
            self.set_rate(baud_rate)
            termios.tcflush(self._descriptor, termios.TCIFLUSH)
            # Blocks every other program, except those of root
            fcntl.ioctl(self._descriptor, termios.TIOCEXCL)
        except BaseException:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> SerialLine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the file descriptor of the open device."""
        return self._descriptor

    def set_rate(self, baud_rate: int) -> bool:
        """Set the baud rate, bit/s; return False if the rate that the driver set differs by more than 2 %.
        Raises OSError."""
        # CLOCAL ignores modem lines. Without HUPCL the kernel leaves DTR unchanged on close.
        control = termios.CS8 | termios.CREAD | termios.CLOCAL | _BOTHER
        settings = _SETTINGS.pack(0, 0, control, 0, bytes(20), baud_rate, baud_rate)
        fcntl.ioctl(self._descriptor, _TCSETS2, settings)
        self.baud_rate = self._settings()[-1]
        return is_rate(self.baud_rate, baud_rate)

    def detach(self) -> int:
        """Return the descriptor and give up its ownership; the caller closes it with `let_go`."""
        descriptor, self._descriptor = self._descriptor, -1
        return descriptor

    def close(self) -> None:
        """Unlock and close the device unless it is closed or detached."""
        if self._descriptor >= 0:
            let_go([self.detach()])

    def _settings(self) -> tuple[int, ...]:
        found = fcntl.ioctl(self._descriptor, _TCGETS2, bytes(_SETTINGS.size))
        return _SETTINGS.unpack(found)


def let_go(descriptors: Iterable[int]) -> None:
    """Unlock and close descriptors of lines that were detached, by this process or by one that has exited."""
    for descriptor in descriptors:
        with suppress(OSError):  # The adapter is gone, and the lock with it
            fcntl.ioctl(descriptor, termios.TIOCNXCL)
        os.close(descriptor)


def describe_no_process(process: Path) -> str:
    """Default of `DescribeProcess`: return an empty text."""
    return ""


def open_serial(
    path: str,
    baud_rate: int,
    *,
    rs485: bool = False,
    boot_ns: int = 0,
    describe_holder: DescribeProcess = describe_no_process,
) -> SerialLine:
    """Open and lock a serial device for exclusive use: raw, 8N1. A pseudo-terminal works as well.

    Args:
        path: The device.
        baud_rate: bit/s; `SerialLine.baud_rate` is the rate that the driver actually set.
        rs485: Let the kernel switch the direction of an RS-485 transceiver by RTS.
        boot_ns: Wait for a board that resets when its port is opened, ns; skipped if this opening did not
            reset it.
        describe_holder: Describes a process that has the port open, for the message of the error.

    Raises:
        PortError: The device does not exist, this user may not open it, another process has it open, or
            it does not support the baud rate or RS-485.
    """
    try:
        line = SerialLine(path, baud_rate)
    except OSError as error:
        raise PortError(describe_failure(path, baud_rate, error, describe_holder)) from None
    if rs485 and not is_simulated(path):
        try:
            fcntl.ioctl(line.fileno(), _TIOCSRS485, _RS485)
        except OSError as error:
            line.close()
            raise PortError(
                f"the driver of {path} has no RS-485 mode ({error.strerror}); omit `adapter: {{rs485: "
                "true}`, and use an adapter with automatic direction control"
            ) from None
    if line.set_dtr and boot_ns:
        time.sleep(boot_ns * 1e-9)
    return line


def is_rate(found: int, asked: int) -> bool:
    """Return True if the baud rate `found` is within 2 % of `asked`."""
    return abs(found - asked) <= _RATE_TOLERANCE * asked


def rate_remark(line: SerialLine, baud_rate: int) -> str:
    """Return a sentence about a baud rate that the driver did not set as requested; empty if it did."""
    if is_rate(line.baud_rate, baud_rate):
        return ""
    error = line.baud_rate / baud_rate - 1.0
    return (
        f"{line.path} runs at {line.baud_rate} bit/s instead of {baud_rate} ({error:+.1%}), so servos may "
        "miss packets; choose a baud rate of the adapter"
    )


def describe_failure(
    path: str, baud_rate: int, error: OSError, describe_holder: DescribeProcess = describe_no_process
) -> str:
    """Return a sentence with the reason why a device could not be opened, and the remedy."""
    number = error.errno
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"port {path} not found; {_what_exists(path)}"
    if number in (errno.EACCES, errno.EPERM) and not os.access(path, os.R_OK | os.W_OK):
        return (
            f"this user may not open {path}; run "
            f"`{command_for_access(Path(os.path.realpath(path)), os.path.realpath(path), '$USER')}`; "
            f"{help_link('the-port-may-not-be-opened')}"
        )
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return f"{path} is in use by {_holder(path, describe_holder)}; {help_link('the-port-is-in-use')}"
    if number == errno.ENOTTY:
        return f"{path} is not a serial line"
    if number == errno.EINVAL:
        return f"{path} cannot run at {baud_rate} bit/s: {error.strerror}"
    return f"{path} cannot be opened: {error}"


def _what_exists(path: str) -> str:
    if "/" not in path and os.path.exists(f"/dev/{path}"):
        return f"write /dev/{path}"
    if path == "sim":  # in robot files this is a simulated bus
        return "start simulated servos by `dxlrun sim --servo XM430-W350:1-3 --link ./bus`, and open ./bus"
    if re.fullmatch(r"COM\d+", path):
        return f"that is a port of Windows; {_devices()}"
    if "/" in path and not os.path.abspath(path).startswith("/dev/"):
        return f"check the path, or start the program that makes it, such as `dxlrun sim --link {path}`"
    return _devices()


def _devices() -> str:
    devices = serial_devices()
    if not devices:
        return f"plug in a serial adapter; {help_link('there-is-no-port')}"
    return f"choose from {', '.join(devices)}"


def _holder(path: str, describe: DescribeProcess) -> str:
    """Return a text that names the processes which have the device open, and how to stop them.

    The first non-empty description is used. Without one, each process is named by its command. Processes
    of other users may be invisible."""
    device = os.path.realpath(path)
    processes = sorted(Path("/proc").glob("[0-9]*"))  # none on systems other than Linux
    found = [process for process in processes if _has_open(process, device)]
    own = str(os.getpid())
    if [process.name for process in found] == [own]:
        return "this program itself; close the other one first"
    found = [process for process in found if process.name != own]
    if described := next(filter(None, map(describe, found)), ""):
        return described
    named = [f"{_command(process)} (process {process.name})" for process in found]
    them = "them" if len(named) > 1 else "it"
    return f"{' and '.join(named) or 'a process of another user'}; stop {them} first"


def _has_open(process: Path, device: str) -> bool:
    try:
        return any(os.readlink(descriptor) == device for descriptor in (process / "fd").iterdir())
    except OSError:
        return False


def _command(process: Path) -> str:
    try:
        words = (process / "cmdline").read_bytes().split(b"\0")
        # Five words are enough to read `python -P -m dxlsim`; whitespace is joined into one line.
        return " ".join(b" ".join(words[:5]).decode(errors="replace").split())[:100] or "a process"
    except OSError:
        return "a process"
