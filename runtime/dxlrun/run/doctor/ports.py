"""Serial ports: which there are, who may open them, and how long the adapter keeps bytes back."""

from __future__ import annotations

from pathlib import Path

from dxlrun.dynamixel.port.latency_timer import mend, timer_ms
from dxlrun.run.doctor.finding import Finding
from dxlrun.run.doctor.machine import Machine

_PATTERNS = ("dev/ttyUSB*", "dev/ttyACM*")
_TIMERS = "sys/bus/usb-serial/devices/*/latency_timer"
FAST_MS = 1
"""The shortest latency timer of an FTDI adapter (FTDI application note AN232B-04)."""


def ports(machine: Machine) -> tuple[Finding, ...]:
    """Look at every USB serial adapter that is plugged in."""
    found = [path for pattern in _PATTERNS for path in machine.glob(pattern)]
    if not found:
        return (
            Finding("ports", "good", "no USB serial adapter is plugged in", "servos hang on a serial port"),
        )
    return tuple(_port(machine, path) for path in found)


def _port(machine: Machine, path: Path) -> Finding:
    name = f"/{path.relative_to(machine.root)}"
    why = "the guardian opens the port to read and to write"
    if machine.may_write(path):
        return Finding(name, "good", f"{machine.user} may open it", why)
    group = _group(path)
    if group is None:
        return Finding(
            name,
            "missing",
            f"{machine.user} may not open it",
            why,
            f"sudo chmod a+rw {name}  # until it is unplugged",
        )
    return Finding(
        name,
        "missing",
        f"it belongs to the group {group}, and {machine.user} is not in it",
        why,
        f"sudo usermod -aG {group} {machine.user}  # then log in again",
    )


def _group(path: Path) -> str | None:
    """Return the group of a file, where being in it helps."""
    try:
        mode = path.stat().st_mode
        return path.group() if mode & 0o060 == 0o060 and path.group() != "root" else None
    except (KeyError, OSError):
        return None


def latency_timers(machine: Machine) -> tuple[Finding, ...]:
    """Look at the latency timer of each FTDI adapter; others have none."""
    return tuple(
        _timer(path.parent.name, f"/{path.relative_to(machine.root)}", path) for path in machine.glob(_TIMERS)
    )


def _timer(name: str, where: str, path: Path) -> Finding:
    what = f"latency timer of {name}"
    why = "the adapter keeps the last bytes of each reply back for so long"
    found = timer_ms(path)
    if found is None:
        return Finding(what, "worse", "it cannot be read", why, f"cat {where}")
    if found <= FAST_MS:
        return Finding(what, "good", f"{found} ms", why)
    return Finding(what, "worse", f"{found} ms where 1 ms is possible", why, mend(where))
