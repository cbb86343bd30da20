"""Latency timer: how long an FTDI adapter keeps the last bytes of a reply back, and how to shorten that.

Sources: FTDI AN232B-04; Linux, drivers/usb/serial/ftdi_sio.c, which has the timer in sysfs and shortens it to
1 ms for a program that sets ASYNC_LOW_LATENCY on the open line. Other adapters have no such timer.
"""

from __future__ import annotations

import os
from array import array
from contextlib import suppress
from pathlib import Path

import msgspec

SYSTEM = Path("/sys")
_TIOCGSERIAL, _TIOCSSERIAL, _FLAGS, _ASYNC_LOW_LATENCY = 0x541E, 0x541F, 4, 1 << 13
"""struct serial_struct (linux/serial.h): `flags` is the fifth integer."""
SHIPPED_NS = 16_000_000  # The timer of an FTDI adapter as it is shipped (AN232B-04)
_SEEN_LESS_NS = 4_000_000
"""It runs from the reply's first byte, or from what was heard before: so much less of it may be seen [i]."""
_SEEN_MORE_NS = 2_000_000  # A host that takes the bytes late [i]


class LatencyTimer(msgspec.Struct, frozen=True):
    """The timer of one adapter."""

    found_ms: int
    place: Path  # Where the Linux kernel shows it

    @property
    def fix(self) -> str:
        """The command that shortens it until the adapter is unplugged."""
        return fix(str(self.place))


def fix(place: str) -> str:
    """Return the command that makes a timer as short as it can be, 1 ms, until the adapter is unplugged."""
    return f"echo 1 | sudo tee {place}"


def is_simulated(port: str) -> bool:
    """Return whether a port has no real servos: those of `dxlrun sim` are on a pseudo-terminal."""
    return port == "sim" or os.path.realpath(port).startswith("/dev/pts/")


def is_timer(extra_ns: float) -> bool:
    """Return whether replies are so late that it looks like the timer of an FTDI adapter as it is shipped."""
    return SHIPPED_NS - _SEEN_LESS_NS <= extra_ns <= SHIPPED_NS + _SEEN_MORE_NS


def timer_ms(place: Path) -> int | None:
    """Return what the Linux kernel shows at a place, ms; None: no number, or it may not be read."""
    try:
        return int(place.read_text())
    except (OSError, ValueError):
        return None


def latency_timer(path: str, system: Path = SYSTEM) -> LatencyTimer | None:
    """Return the timer of the adapter whose device is `path`; None: it has none, or it may not be read."""
    place = system / "bus/usb-serial/devices" / Path(os.path.realpath(path)).name / "latency_timer"
    found = timer_ms(place)
    return None if found is None else LatencyTimer(found, place)


def shorten(descriptor: int, path: str, most_ns: int, system: Path = SYSTEM) -> tuple[str, str]:
    """Shorten the timer of an open line that is longer than `most_ns`, as far as this user may.

    Return what was done, and what is wrong still; both are empty where nothing is to be done.
    """
    before = latency_timer(path, system)
    if before is None or before.found_ms * 1_000_000 <= most_ns:
        return "", ""
    import fcntl  # not above: Windows has none, and robots run there on virtual time

    with suppress(OSError):  # also what has no such flag
        settings = array("i", bytes(128))
        fcntl.ioctl(descriptor, _TIOCGSERIAL, settings)
        settings[_FLAGS] |= _ASYNC_LOW_LATENCY
        fcntl.ioctl(descriptor, _TIOCSSERIAL, settings)
    now = latency_timer(path, system) or before
    if now.found_ms * 1_000_000 > most_ns:
        with suppress(OSError):
            now.place.write_text("1")
        now = latency_timer(path, system) or now
    if now.found_ms * 1_000_000 > most_ns:
        return "", (
            f"{path} keeps replies back for {now.found_ms} ms, and {most_ns * 1e-6:g} ms were planned: "
            f"`{now.fix}` shortens that, or write `adapter: {{latency: {now.found_ms} ms}}` at its bus"
        )
    return f"{path}: latency timer set from {before.found_ms} ms to {now.found_ms} ms", ""
