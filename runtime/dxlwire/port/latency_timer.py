"""Latency timer: the time for which an FTDI adapter holds back the last bytes of a reply, and ways to shorten
it.

Sources: FTDI AN232B-04; Linux, drivers/usb/serial/ftdi_sio.c. The driver shows the timer in sysfs and
shortens it to 1 ms for a program that sets ASYNC_LOW_LATENCY on the open line. Other adapters have no such
timer."""

from __future__ import annotations

import os
from array import array
from contextlib import suppress
from pathlib import Path

import msgspec

SYSTEM = Path("/sys")
_TIOCGSERIAL, _TIOCSSERIAL, _FLAGS, _ASYNC_LOW_LATENCY = 0x541E, 0x541F, 4, 1 << 13
"""Index of `flags` in struct serial_struct (linux/serial.h): the fifth integer."""
SHIPPED_NS = 16_000_000  # Factory setting of an FTDI adapter's timer (AN232B-04)
_SEEN_LESS_NS = 4_000_000
"""Tolerance (ns) below the timer [i]: it starts with the reply's first byte or with earlier bytes, so the
host may observe only the rest of its period."""
_SEEN_MORE_NS = 2_000_000  # Tolerance above the timer [i], for a host that reads the bytes late


class LatencyTimer(msgspec.Struct, frozen=True):
    """Latency timer of one adapter, as found in sysfs."""

    found_ms: int
    place: Path  # File of the timer in sysfs

    @property
    def fix(self) -> str:
        """Shell command that sets the timer to 1 ms until the adapter is unplugged."""
        return fix(str(self.place))


def fix(place: str) -> str:
    """Return the shell command that sets the timer in this file to its minimum, 1 ms, until the adapter is
    unplugged."""
    return f"echo 1 | sudo tee {place}"


def is_simulated(port: str) -> bool:
    """Return True if a port has simulated servos: it is `sim`, or a pseudo-terminal, as served by `dxlrun
    sim`."""
    return port == "sim" or os.path.realpath(port).startswith("/dev/pts/")


def is_timer(extra_ns: float) -> bool:
    """Return True if replies that come this much late suggest an FTDI timer at its factory setting, 16 ms."""
    return SHIPPED_NS - _SEEN_LESS_NS <= extra_ns <= SHIPPED_NS + _SEEN_MORE_NS


def timer_ms(place: Path) -> int | None:
    """Return the latency in a timer file, ms, or None if the file is unreadable or contains no number."""
    try:
        return int(place.read_text())
    except (OSError, ValueError):
        return None


def latency_timer(path: str, system: Path = SYSTEM) -> LatencyTimer | None:
    """Return the latency timer of the adapter at the device `path`, or None if it has none or the file may
    not be read."""
    place = system / "bus/usb-serial/devices" / Path(os.path.realpath(path)).name / "latency_timer"
    found = timer_ms(place)
    return None if found is None else LatencyTimer(found, place)


def shorten(descriptor: int, path: str, most_ns: int, system: Path = SYSTEM) -> tuple[str, str]:
    """Shorten the latency timer of an open line's adapter if it is longer than `most_ns` and this user may
    change it.

    Args:
        descriptor: The open line.
        path: Its device.
        most_ns: Longest acceptable timer, ns.
        system: Root of sysfs, for tests.

    Returns:
        A sentence about the change, and a sentence about a timer that is still too long; empty if not
            applicable.
    """
    before = latency_timer(path, system)
    if before is None or before.found_ms * 1_000_000 <= most_ns:
        return "", ""
    import fcntl  # Imported here because Windows has no fcntl; robots run there on virtual time

    with suppress(OSError):  # Some drivers have no such flag
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
            f"{path} delays replies by {now.found_ms} ms instead of the planned {most_ns * 1e-6:g} ms; "
            f"run `{now.fix}`, or write `adapter: {{latency: {now.found_ms} ms}}` at its bus"
        )
    return f"{path}: latency timer set from {before.found_ms} ms to {now.found_ms} ms", ""
