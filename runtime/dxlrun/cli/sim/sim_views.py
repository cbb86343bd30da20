"""Views of `dxlrun sim`: its output as lines in a pipe, as JSON lines, or as a live table on a terminal."""

from __future__ import annotations

import math
import os
import shlex
import signal
import sys
import termios
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import msgspec

from dxlrun.errors import counted
from dxlrun.output.terminal import fitted, out, print_error, show_json, show_parts
from dxlrun.output.text_table import Column, Sentence, Table, Tone, numbers

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console, Group

    from dxlsim.messages import ServoLook, SimulationMessage
    from dxlsim.simulation_plan import BusConfig

_LOOK_S = 0.25
_AROUND = 7
"""Lines of the screen that are not servos: head and rule of the table, lateness, prompt and events."""


class SimulationView(msgspec.Struct, frozen=True):
    """The simulated buses with the links to their ports, as text for the views."""

    title: str
    buses: tuple[BusConfig, ...]
    # Link by bus, for buses with one.
    links: Mapping[str, Path]
    # A command line that uses the simulation when the port is added.
    hint: str | None = None

    def port(self, bus: str, ports: Mapping[str, str]) -> str:
        """Return the path by which another program opens a bus: its link, else the pseudo-terminal in
        `ports`.
        """
        return str(self.links.get(bus, ports[bus]))

    def lines(self, ports: Mapping[str, str], real_time: str) -> list[str]:
        """Return the first lines of the output: simulated servos, ports, and granted real-time settings
        (`real_time`).
        """
        count = sum(len(bus.servos) for bus in self.buses)
        servos, buses = counted(count, "servo", "servos"), counted(len(self.buses), "bus", "buses")
        what = f"{servos} simulated on {buses}" if count else f"{buses}, answering as recorded"
        lines = [f"{self.title}: {what}; Ctrl-C ends it, `help` lists faults to type"]
        for bus in self.buses:
            name = self.port(bus.name, ports)
            device = f" ({ports[bus.name]})" if name != ports[bus.name] else ""
            lines.append(
                f"  {bus.name}: {name}{device}, {bus.baud_rate} bit/s, Protocol {bus.protocol:.1f}"
                f"{', ' * bool(bus.servos or bus.devices)}{_models(bus)}"
            )
        if real_time:
            lines.append(f"  in real time: {real_time}")
        if self.hint is not None and self.buses:
            port = shlex.quote(self.port(self.buses[0].name, ports))
            lines.append(f"next: {self.hint} port:={port}")
        return lines

    def moves(self, ports: Mapping[str, str]) -> list[str]:
        """Return a line for each bus in `ports`: its adapter was pulled (empty port), or came back as
        another port.
        """
        return [
            f"{bus}: the adapter is back as {port}{self._link(bus)}"
            if port
            else f"{bus}: no adapter, no port"
            for bus, port in ports.items()
        ]

    def _link(self, bus: str) -> str:
        return f", and {self.links[bus]} leads to it" if bus in self.links else ""


class PlainView:
    """View that prints lines: the ports once, then each fault as it happens."""

    look_every_s: float | None = None

    def __init__(self, shown: SimulationView) -> None:
        self._shown = shown
        self._console: Console = out()

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Print the first lines: buses, their ports, and granted real-time settings."""
        for line in self._shown.lines(ports, real_time):
            self._print(line)

    def show_message(self, message: SimulationMessage) -> None:
        """Print what a message of the simulation reports: moved ports, a fault that happened, or a typed
        line's result.
        """
        for line in self._shown.moves(message.ports or {}):
            self._print(line)
        if message.happened is not None:
            self._print(f"fault: {message.happened}", "warning")
        if message.fault is not None:
            # The fault may be planned for a later time.
            self._print(f"understood: {message.fault}")
        if message.error is not None:
            self._refuse(message.error)

    def _refuse(self, sentence: str) -> None:
        print_error(sentence)

    def help(self) -> None:
        """Print the lines that can be typed, one for each kind of fault."""
        for line in fault_lines():
            self._print(line)

    def show_snapshot(self, look: SimulationMessage, typed: str) -> None:
        """Print nothing, because a table among lines would scroll the faults away."""

    def _print(self, line: str, tone: Tone = "plain") -> None:
        show_parts(Sentence(line, tone), console=self._console)


class TableView(PlainView):
    """View with a table of the servos, redrawn four times a second, below the events and above the typed
    line.
    """

    look_every_s: float | None = _LOOK_S

    def __init__(self, shown: SimulationView, console: Console) -> None:
        from rich.live import Live

        self._shown = shown
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._newest: SimulationMessage | None = None

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Show the table while the block runs; the terminal passes on single characters without echo."""
        with _letters(), self._live:
            yield
            # Pending input is obsolete now.
            self._draw(None)

    def _refuse(self, sentence: str) -> None:
        self._print(sentence, "error")

    def show_snapshot(self, look: SimulationMessage, typed: str) -> None:
        """Redraw the table with new states of the servos and the line that is being typed."""
        self._newest = look
        self._draw(typed)

    def _draw(self, typed: str | None) -> None:
        if self._newest is not None:
            several = len(self._shown.buses) > 1
            shown = page(self._newest, typed, self._console.width, self._console.height, several=several)
            self._live.update(shown, refresh=True)

    def _print(self, line: str, tone: Tone = "plain") -> None:
        from rich.text import Text

        from dxlrun.output.terminal import STYLES

        # Wrapped, unlike in `show`: rich does not redraw the table below a line that is wider than the
        # window.
        self._console.print(Text(line, style=STYLES[tone]))


class JsonView:
    """View that prints one JSON object per line: the ports, then each fault as it happens."""

    look_every_s: float | None = None

    def __init__(self, shown: SimulationView) -> None:
        self._shown = shown

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Print the ports of the buses as JSON."""
        named = {bus: self._shown.port(bus, ports) for bus in ports}
        show_json({"ports": named, "devices": dict(ports), "real_time": real_time})

    def show_message(self, message: SimulationMessage) -> None:
        """Print what a message of the simulation reports as JSON."""
        given = {
            "devices": message.ports,
            "fault": message.happened,
            "understood": message.fault,
        }
        wrong = [] if message.error is None else [message.error]
        found = {name: value for name, value in given.items() if value is not None}
        show_json(found, code=len(wrong), errors=wrong)

    def help(self) -> None:
        """Print the lines that can be typed, one for each kind of fault, as JSON."""
        show_json({"faults": list(fault_lines())})

    def show_snapshot(self, look: SimulationMessage, typed: str) -> None:
        """Print nothing: states of servos are not part of this output."""


def fault_lines() -> Sequence[str]:
    """Return the lines that can be typed, one for each kind of fault."""
    from dxlsim.faults.fault import fault_help

    return fault_help()


def ending(title: str, elapsed_s: float, look: SimulationMessage) -> str:
    """Return the last line of the output: duration, numbers of packets, and delays of replies."""
    heard = sum(servo.heard for servo in look.servos or ())
    answered = sum(servo.answered for servo in look.servos or ())
    late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
    packets = f"{counted(heard, 'packet', 'packets')} received, {answered} answered"
    later = f"; replies later than planned: {late}" if late else ""
    counts = packets if look.servos else "Instructions were answered as recorded"
    return f"{title}: ended after {elapsed_s:.1f} s. {counts}{later}"


def _models(bus: BusConfig) -> str:
    """Return the servos and devices of a bus by model with their IDs: `XL430-W250 1-3; AX-12A 7; OpenCR
    200`.
    """
    ids: dict[str, list[int]] = {}
    named = [(each.model, each.servo_id) for each in bus.servos]
    for model, servo_id in named + [(each.model, each.servo_id) for each in bus.devices]:
        ids.setdefault(model, []).append(servo_id)
    return "; ".join(f"{model} {_ranges(sorted(numbers))}" for model, numbers in ids.items())


def _ranges(ids: Sequence[int]) -> str:
    parts: list[list[int]] = []
    for servo_id in ids:
        if parts and servo_id == parts[-1][-1] + 1:
            parts[-1].append(servo_id)
        else:
            parts.append([servo_id])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)


# The live table


def page(look: SimulationMessage, typed: str | None, width: int, height: int, *, several: bool) -> Group:
    """Return the table of servos and the prompt for a screen of `height` lines; `several` adds a column for
    the bus.

    `typed` is None after the end of the input.
    """
    from rich.console import Group
    from rich.text import Text

    room = max(1, height - _AROUND)
    servos = look.servos or ()
    table = servo_table(servos[:room], several=several)
    parts = [Text.assemble(*line) for line in (fitted(table, width) if table.rows else ())]
    if len(servos) > room:
        parts.append(Text(f"... and {len(servos) - room} more; enlarge the window to see them", style="dim"))
    if look.lateness_us:
        late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
        parts.append(Text(f"replies later than planned: {late}", style="dim"))
    if typed is not None:
        parts.append(Text.assemble(("fault> ", "bold"), typed, ("\N{LOWER ONE EIGHTH BLOCK}", "blink")))
    return Group(*parts)


def servo_table(servos: Sequence[ServoLook], *, several: bool) -> Table:
    """Return a table of simulated servos; rows of servos with a hardware error are marked."""
    columns = [
        *[Column("bus", "name")] * several,
        Column("ID"),
        Column("model", "name"),
        Column("torque", "name"),
        Column("goal deg", form="{:.1f}", missing="-"),
        Column("present deg", form="{:.1f}"),
        Column("degC", form="{:.0f}"),
        Column("V", form="{:.1f}"),
        Column("errors", "name"),
        *numbers("asked", "replies"),
    ]
    rows = [
        (
            *[servo.bus] * several,
            servo.id,
            servo.model,
            "on" if servo.torque else "limp",
            None if servo.goal is None else math.degrees(servo.goal),
            math.degrees(servo.present),
            servo.temperature,
            servo.voltage,
            f"{servo.error:#04x}" if servo.error else "-",
            servo.heard,
            servo.answered,
        )
        for servo in servos
    ]
    table = Table.from_rows("", columns, rows)
    return table.marked([bool(servo.error) for servo in servos])


@contextmanager
def _letters() -> Iterator[None]:
    """In the block, let the terminal of stdin pass on each character without echo; Ctrl-C and Ctrl-Z keep
    working.
    """
    if not sys.stdin.isatty():
        yield
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    changed = termios.tcgetattr(descriptor)
    changed[3] &= ~(termios.ICANON | termios.ECHO)

    def set_up(mode: list[int | list[bytes | int]]) -> None:
        # A background job that changes its terminal would be stopped, and the terminal may be gone.
        with suppress(termios.error, OSError):
            if os.tcgetpgrp(descriptor) == os.getpgrp():
                termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)

    set_up(changed)
    # After Ctrl-Z and fg, the shell may have changed the mode.
    continued = signal.signal(signal.SIGCONT, lambda *_: set_up(changed))
    try:
        yield
    finally:
        signal.signal(signal.SIGCONT, continued)
        set_up(before)
