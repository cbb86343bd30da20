"""Opening a serial line for one process alone; the guardian does it, the loop inherits the descriptor."""

from __future__ import annotations

import errno
import fcntl
import os
import termios
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import serial

from dxlrun.dynamixel.port.rights import command_for_access
from dxlrun.errors import PortError
from dxlrun.process_table import robot_of


class ExclusiveSerial(serial.Serial):
    """A line that no other process can open before it is closed.

    The lock belongs to the terminal, and the Linux kernel takes it off when no process has it open any more.
    Simulated servos keep theirs open for the next program, so closing takes it off.
    """

    def close(self) -> None:
        """Let go of the line."""
        if self.is_open:
            _unlock(self.fileno())
        super().close()


def let_go(descriptors: Iterable[int]) -> None:
    """Close lines that are `kept`, by this process or by one that is dead now."""
    for descriptor in descriptors:
        _unlock(descriptor)
        os.close(descriptor)


def _unlock(descriptor: int) -> None:
    with suppress(OSError):  # the adapter is gone, and the lock with it
        fcntl.ioctl(descriptor, termios.TIOCNXCL)


def open_serial(path: str, baud_rate: int) -> serial.Serial:
    """Open a device at `baud_rate`, 8N1, exclusively (flock and TIOCEXCL); also a pseudo-terminal.

    Keep what is returned: closing it lets go of the line. Raises PortError with one sentence: there is no
    such device, this user may not open it, another process has it, or it cannot do the baud rate.
    """
    try:
        # exclusive=True: pyserial takes the lock that other pyserial programs respect
        port = ExclusiveSerial(path, baud_rate, timeout=0, write_timeout=0, exclusive=True)
    except ValueError as error:
        raise PortError(f"{path} cannot run at {baud_rate} bit/s: {error}") from error
    except (OSError, termios.error) as error:  # serial.SerialException is an OSError
        raise PortError(_sentence(path, baud_rate, error)) from error
    # and the lock that every program meets, but for root's
    fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    return port


def kept(port: serial.Serial) -> int:
    """Return the descriptor of a line of `open_serial`, alone; `let_go` lets go of it."""
    descriptor = os.dup(port.fileno())
    serial.Serial.close(port)  # the locks stay with the descriptor
    return descriptor


def _sentence(path: str, baud_rate: int, error: Exception) -> str:
    number = _number(error)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"there is no {path}; {_what_exists()}"
    if number in (errno.EACCES, errno.EPERM) and not os.access(path, os.R_OK | os.W_OK):
        return (
            f"this user may not open {path}: "
            f"`{command_for_access(Path(os.path.realpath(path)), os.path.realpath(path), '$USER')}`"
        )
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return f"{path} is in use by {_holder(path)}"
    if number == errno.ENOTTY:
        return f"{path} is no serial line"
    if number == errno.EINVAL:
        return f"{path} cannot run at {baud_rate} bit/s: {error}"
    return f"{path} cannot be opened: {error}"


def _number(error: BaseException | None) -> int | None:
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error.errno
        if isinstance(error, termios.error) and error.args:
            return int(error.args[0])
        error = error.__context__
    return None


def serial_devices() -> tuple[str, ...]:
    """Return the paths of the serial adapters that this machine has, the lasting names first."""
    names: list[str] = []
    for folder, pattern in (("/dev/serial/by-id", "*"), ("/dev", "ttyUSB*"), ("/dev", "ttyACM*")):
        names += sorted(str(path) for path in Path(folder).glob(pattern))
    return tuple(names)


def _what_exists() -> str:
    devices = serial_devices()
    if not devices:
        return "this machine has no serial adapter now: is it plugged in?"
    return f"there are: {', '.join(devices)}"


def _holder(path: str) -> str:
    """Name the run, or else the processes that have the device open, and how to stop them.

    Only what this user may see is named.
    """
    device = os.path.realpath(path)
    found = [
        process for process in _processes() if process.name != str(os.getpid()) and _has_open(process, device)
    ]
    robot = next((name for name in map(robot_of, found) if name), None)
    if robot is not None:
        return f"a run of {robot}; `dxlrun stop --robot {robot}` ends it, or Ctrl-C in its terminal"
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
        # enough to read `python -P -m dxlrun.simulation`
        # one line, whatever its words are
        return " ".join(b" ".join(words[:5]).decode(errors="replace").split())[:100] or "a process"
    except OSError:
        return "a process"
