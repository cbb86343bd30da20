"""Adapters: finds the serial ports of this machine, and programs and settings that may disturb them."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec

ROOT = Path("/")
USB_PORTS = ("ttyUSB*", "ttyACM*")
ONBOARD_PORTS = ("ttyAMA*", "ttyTHS*", "ttySC*", "serial0")
"""Name patterns of UARTs of a Raspberry Pi, a Jetson, an SC16IS7xx on SPI or I2C; serial0 is the Pi's own
alias."""
_BRAILLE = re.compile(r'^ENV\{PRODUCT\}=="(1a86/7523|10c4/ea60)/', re.MULTILINE)
"""Pattern of the udev rules that start brltty for each CH340 or CP210x adapter."""
_RULES = ("etc/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d")


class Disturbance(msgspec.Struct, frozen=True):
    """Program or setting on this machine that may open a port, send to it, or suspend it, as texts for a
    message."""

    what: str
    found: str
    why: str
    fix: str
    """Shell command that removes the disturbance."""


def serial_devices(root: Path = ROOT) -> tuple[str, ...]:
    """Return the device paths of the serial ports of this machine, persistent names first; `root` is for
    tests."""
    system = sys.platform
    if system != "linux":
        # Imported here because Linux has the names in its file system.
        from serial.tools.list_ports import comports

        return tuple(sorted(port.device for port in comports()))
    folders = [("serial/by-id", "*"), *(("", pattern) for pattern in (*USB_PORTS, *ONBOARD_PORTS))]
    found = (sorted((root / "dev" / folder).glob(pattern)) for folder, pattern in folders)
    return tuple(f"/{path.relative_to(root)}" for paths in found for path in paths)


def disturbances(root: Path = ROOT) -> Iterator[Disturbance]:
    """Yield the programs and settings found on this machine that may disturb its USB adapters; `root` is
    for tests."""
    ports = [path.name for pattern in USB_PORTS for path in sorted((root / "dev").glob(pattern))]
    programs = {_text(path) for path in root.glob("proc/[0-9]*/comm")}
    if ports and "ModemManager" in programs:
        yield Disturbance(
            "ModemManager",
            "it runs",
            "it may send bytes to a new port for some seconds, in search of a modem",
            "sudo systemctl disable --now ModemManager",
        )
    rules = [path for folder in _RULES for path in root.glob(f"{folder}/*brltty*.rules")]
    if "brltty" in programs or any(_BRAILLE.search(_text(path)) for path in rules):
        yield Disturbance(
            "brltty",
            "it runs" if "brltty" in programs else "it is installed",
            "it takes adapters with a CH340 or CP210x chip for Braille displays: their port disappears",
            "sudo apt remove brltty  # if nobody uses a Braille display",
        )
    for port in ports:
        control = _power_control(root / "sys/class/tty" / port / "device")
        if control is not None and _text(control) == "auto":
            yield Disturbance(
                f"autosuspend of {port}",
                "its USB device may be suspended (power/control is auto)",
                "a suspended adapter responds late, or loses the first bytes",
                f"echo on | sudo tee /{control.relative_to(root.resolve())}",
            )


def warnings_for(port: str, root: Path = ROOT) -> Iterator[str]:
    """Yield a sentence with the fix for each disturbance that concerns a port."""
    name = (root / port.lstrip("/")).resolve().name
    if any(Path(name).match(pattern) for pattern in USB_PORTS):
        for one in disturbances(root):
            if not one.what.startswith("autosuspend") or one.what.endswith(f" {name}"):
                yield f"{one.what}: {one.found}; {one.why}: `{one.fix}`"


def _power_control(device: Path) -> Path | None:
    """Return the file in sysfs that controls USB autosuspend of a port, or None if it is not on USB."""
    place = device.resolve()
    found = (folder for folder in (place, *place.parents) if (folder / "idVendor").is_file())
    usb = next(found, None)
    return None if usb is None else usb / "power/control"


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
