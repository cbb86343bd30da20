"""Serial lines of a robot file's buses for `dxlrun setup` and `calibrate`; no run may use them then."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from dxlrun import InputError, PortError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.robots import SIMULATED
from dxlrun.tooling.servos import ToolLine, TunablePort
from dxlrun_hand.dialogue import Dialogue
from dxlwire import lasting_name

TRIES = 3  # Attempts of the user to plug in one adapter
Opened = Callable[[str], TunablePort]
"""Function that opens a port by its path."""
Devices = Callable[[], Iterable[str]]
"""Function that returns the available serial ports, persistent names first."""


def find_port(bus: str, dialogue: Dialogue, devices: Devices) -> str:
    """Ask the user to unplug and plug in the adapter of a bus; return the path of the port that appeared.

    Raises:
        PortError: Not exactly one port appeared in each of three attempts.
    """
    for _ in range(TRIES):
        dialogue.ask_question(f"Unplug the adapter of bus {bus}, and press Enter ")
        others = {os.path.realpath(path) for path in devices()}

        def added(others: Collection[str] = others) -> list[str]:
            return [path for path in devices() if os.path.realpath(path) not in others]

        dialogue.ask_while(
            "Plug it in again, and press Enter when its port is shown",
            lambda: f"  {', '.join(added()) or 'no port yet'}",
        )
        names = added()
        adapters = {os.path.realpath(name) for name in names}
        if len(adapters) == 1:
            dialogue.print_lines(f"Bus {bus} is at {names[0]}.")
            return names[0]
        dialogue.print_lines(
            f"{len(adapters)} adapters appeared ({', '.join(names)}); plug in only the adapter of bus {bus}."
            if adapters
            else "No adapter appeared; unplug it before the first Enter, and plug it in before the second."
        )
    raise PortError(f"the adapter of bus {bus} was not found; list all adapters with `dxlrun doctor`")


class BusLines:
    """Serial lines of a robot file's buses by name, each open only while it is used.

    A board that powers its servos by USB drops out when a servo is plugged in, and its port comes back as
    another device. The persistent name stays valid, so the port is opened again by this name.
    """

    def __init__(self, ports: Mapping[str, str], opened: Opened = TunablePort) -> None:
        """Check that each port can be opened, and close it again.

        Args:
            ports: Path of the port of each bus.
            opened: Function that opens a port.

        Raises:
            PortError: A port cannot be opened.
            InputError: A bus is simulated and has no port.
        """
        for bus, port in ports.items():
            if port == SIMULATED:
                raise InputError(
                    f"bus {bus} is simulated and has no port; give a port, such as port:=/dev/ttyUSB0, or "
                    "start simulated servos with `dxlrun sim ROBOT.yaml --link line` and give port:=./line"
                )
        self._opened = opened
        self._names = {bus: lasting_name(port) or port for bus, port in ports.items()}
        for bus in ports:
            with self.open_line(bus):
                pass

    @contextmanager
    def open_line(self, bus: str) -> Iterator[ToolLine]:
        """Open the port of a bus, yield its line, and close it. Raises PortError."""
        with self._opened(self._names[bus]) as port:
            yield ToolLine(port)


def chosen_names(
    words: Sequence[str],
    known: Sequence[str],
    groups: Mapping[str, Sequence[str]],
    omitted: Sequence[str] = (),
) -> list[str]:
    """Return the known names that the words of a command line select, in the order of `known`.

    A word is a name or a group, which stands for its members. Without words, all names are returned.

    Raises:
        InputError: A word is unknown, or one of the joints that the robot file omits.
    """
    if absent := [word for word in words if word in omitted]:
        raise InputError(f"the robot file has installed: false for {', '.join(absent)}; remove it first")
    wrong = [word for word in words if word not in known and word not in groups]
    if wrong:
        every = (*known, *groups)
        raise InputError(
            "\n".join(f"the robot file has no joint {word}; {suggestion(word, every)}" for word in wrong)
        )
    meant = {name for word in words for name in groups.get(word, (word,))}
    return [name for name in known if name in meant or not words]
