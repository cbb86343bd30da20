"""The outputs of `dxlrun sim`: lines in a pipe, one JSON object a line, or a live table on a terminal."""

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
from dxlrun.output.table import Column, Sentence, Table, Tone, numbers
from dxlrun.output.terminal import fitted, out, print_error, show, show_json

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console, Group

    from dxlsim.messages import ServoLook, SimulationMessage
    from dxlsim.simulation_plan import BusConfig

_LOOK_S = 0.25
_AROUND = 7
"""Lines of the screen that are not servos: head and rule of the table, lateness, prompt, events."""


class Shown(msgspec.Struct, frozen=True):
    """What is simulated, and the names of its ports."""

    title: str
    buses: tuple[BusConfig, ...]
    links: Mapping[str, Path]  # Link of each bus that has one
    hint: str | None = None  # A command line that uses the simulation when the port is added

    def port(self, bus: str, ports: Mapping[str, str]) -> str:
        """Return the name under which another program opens a bus: it stays when an adapter is pulled."""
        return str(self.links.get(bus, ports[bus]))

    def lines(self, ports: Mapping[str, str], real_time: str) -> list[str]:
        """Return the first lines: what is simulated, where, and how punctual it can be."""
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
        """Return a line for each adapter that was pulled, or came back under another name."""
        return [
            f"{bus}: the adapter is back as {port}{self._link(bus)}"
            if port
            else f"{bus}: no adapter, no port"
            for bus, port in ports.items()
        ]

    def _link(self, bus: str) -> str:
        return f", and {self.links[bus]} leads to it" if bus in self.links else ""


class PlainView:
    """Lines on stdout: the ports once, then each fault as it happens."""

    look_every_s: float | None = None

    def __init__(self, shown: Shown) -> None:
        self._shown = shown
        self._console: Console = out()

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Print where the buses are."""
        for line in self._shown.lines(ports, real_time):
            self._print(line)

    def take(self, message: SimulationMessage) -> None:
        """Print where buses are now, a fault that happened, or how a typed line was understood."""
        for line in self._shown.moves(message.ports or {}):
            self._print(line)
        if message.happened is not None:
            self._print(f"fault: {message.happened}", "warning")
        if message.fault is not None:
            self._print(f"understood: {message.fault}")  # it may be planned for later
        if message.error is not None:
            self._refuse(message.error)

    def _refuse(self, sentence: str) -> None:
        print_error(sentence)

    def help(self) -> None:
        """List the faults."""
        for line in fault_lines():
            self._print(line)

    def look(self, look: SimulationMessage, typed: str) -> None:
        """Print nothing: a table in lines would scroll the faults away."""

    def _print(self, line: str, tone: Tone = "plain") -> None:
        show(Sentence(line, tone), console=self._console)


class TableView(PlainView):
    """A table that is drawn again four times a second; events scroll away above it, input is below."""

    look_every_s: float | None = _LOOK_S

    def __init__(self, shown: Shown, console: Console) -> None:
        from rich.live import Live

        self._shown = shown
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._newest: SimulationMessage | None = None

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Show it; meanwhile the terminal hands letters over one by one, and does not show them itself."""
        with _letters(), self._live:
            yield
            self._draw(None)  # what was being typed is of no use any more

    def _refuse(self, sentence: str) -> None:
        self._print(sentence, "error")

    def look(self, look: SimulationMessage, typed: str) -> None:
        """Draw the servos, and what was typed so far."""
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

        # folded, not as `show` does: rich does not draw the table again below a line wider than the window
        self._console.print(Text(line, style=STYLES[tone]))


class JsonView:
    """One JSON answer a line on stdout: the ports, then each fault as it happens."""

    look_every_s: float | None = None

    def __init__(self, shown: Shown) -> None:
        self._shown = shown

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Write where the buses are."""
        named = {bus: self._shown.port(bus, ports) for bus in ports}
        show_json({"ports": named, "devices": dict(ports), "real_time": real_time})

    def take(self, message: SimulationMessage) -> None:
        """Write where buses are now, a fault that happened, or how a typed line was understood."""
        given = {
            "devices": message.ports,
            "fault": message.happened,
            "understood": message.fault,
        }
        wrong = [] if message.error is None else [message.error]
        found = {name: value for name, value in given.items() if value is not None}
        show_json(found, code=len(wrong), errors=wrong)

    def help(self) -> None:
        """Write the faults there are."""
        show_json({"faults": list(fault_lines())})

    def look(self, look: SimulationMessage, typed: str) -> None:
        """Write nothing."""


def fault_lines() -> Sequence[str]:
    """Return what can be typed: a line for each kind of fault."""
    from dxlsim.faults.fault import fault_help

    return fault_help()


def ending(title: str, elapsed_s: float, look: SimulationMessage) -> str:
    """Return the last line: how long it ran, and what passed."""
    heard = sum(servo.heard for servo in look.servos or ())
    answered = sum(servo.answered for servo in look.servos or ())
    late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
    packets = f"{counted(heard, 'packet', 'packets')} received, {answered} answered"
    later = f"; replies later than planned: {late}" if late else ""
    counts = packets if look.servos else "Instructions were answered as recorded"
    return f"{title}: ended after {elapsed_s:.1f} s. {counts}{later}"


def _models(bus: BusConfig) -> str:
    """Return the servos and devices of a bus in short: `XL430-W250 1-3; AX-12A 7; OpenCR 200`."""
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
    """Return the lower part of a screen of `height` lines; `several`: with a column for the bus.

    `typed` is None when nothing more can be typed.
    """
    from rich.console import Group
    from rich.text import Text

    room = max(1, height - _AROUND)
    servos = look.servos or ()
    table = servo_table(servos[:room], several=several)
    parts = [Text.assemble(*line) for line in (fitted(table, width) if table.rows else ())]
    if len(servos) > room:
        parts.append(Text(f"... and {len(servos) - room} more; a higher window shows them", style="dim"))
    if look.lateness_us:
        late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
        parts.append(Text(f"replies later than planned: {late}", style="dim"))
    if typed is not None:
        parts.append(Text.assemble(("fault> ", "bold"), typed, ("\N{LOWER ONE EIGHTH BLOCK}", "blink")))
    return Group(*parts)


def servo_table(servos: Sequence[ServoLook], *, several: bool) -> Table:
    """Return one row a servo; one with an error is marked."""
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
    table = Table.of("", columns, rows)
    return table.marked([bool(servo.error) for servo in servos])


@contextmanager
def _letters() -> Iterator[None]:
    """Let the terminal of stdin hand over each letter, unseen; Ctrl-C and Ctrl-Z do what they always do."""
    if not sys.stdin.isatty():
        yield
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    changed = termios.tcgetattr(descriptor)
    changed[3] &= ~(termios.ICANON | termios.ECHO)

    def set_up(mode: list[int | list[bytes | int]]) -> None:
        # a job in the background that touches its terminal would be stopped; and the terminal may be gone
        with suppress(termios.error, OSError):
            if os.tcgetpgrp(descriptor) == os.getpgrp():
                termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)

    set_up(changed)
    # after Ctrl-Z and fg the shell may have set it otherwise
    continued = signal.signal(signal.SIGCONT, lambda *_: set_up(changed))
    try:
        yield
    finally:
        signal.signal(signal.SIGCONT, continued)
        set_up(before)
