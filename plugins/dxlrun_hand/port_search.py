"""The port of a bus, found by its adapter that is unplugged and plugged in again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable

from dxlrun.dynamixel.port.serial_open import serial_devices
from dxlrun.errors import PortError
from dxlrun_hand.dialogue import Dialogue

APPEARS_S = 5.0
"""How long the system may take to name an adapter that was plugged in."""
TRIES = 3
_LOOK_S = 0.1
Devices = Callable[[], Iterable[str]]


def find_port(bus: str, dialogue: Dialogue, devices: Devices = serial_devices) -> str:
    """Return the lasting name of the adapter that a person plugs in; raises PortError after three tries."""
    for _ in range(TRIES):
        dialogue.ask(f"Unplug the adapter of bus {bus}, and press Enter ")
        others = {os.path.realpath(path) for path in devices()}
        dialogue.ask("Plug it in again, and press Enter ")
        names = _new(others, devices)
        adapters = {os.path.realpath(name) for name in names}
        if len(adapters) == 1:
            dialogue.say(f"Bus {bus} is at {names[0]}.")
            return names[0]
        dialogue.say(
            f"{len(adapters)} adapters appeared ({', '.join(names)}): plug in the one of bus {bus} alone."
            if adapters
            else "No adapter appeared: was it unplugged before the first Enter, and is it plugged in now?"
        )
    raise PortError(
        f"the adapter of bus {bus} was not found; `dxlrun doctor` lists those that are plugged in"
    )


def _new(others: set[str], devices: Devices) -> list[str]:
    """Return the names of what is there beside others, lasting ones first; waits until something is."""
    until = time.monotonic() + APPEARS_S
    while True:
        found = [path for path in devices() if os.path.realpath(path) not in others]
        if found or time.monotonic() > until:
            return found
        time.sleep(_LOOK_S)
