"""What `dxlrun sim` says where nobody looks at a table: plain lines, or one JSON object a line."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dxlrun.cli.output.terminal import out, say_error
from dxlrun.errors import counted

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from dxlrun.run.simulation_front import Look
    from dxlrun.simulation import BusConfig


@dataclass(frozen=True, slots=True)
class Shown:
    """What is the same for all views: what is simulated, and under which names."""

    title: str
    buses: tuple[BusConfig, ...]
    links: Mapping[str, Path]
    """Link of each bus that has one."""
    hint: str | None = None
    """A command line that uses the simulation when the port is added."""

    def port(self, bus: str, ports: Mapping[str, str]) -> str:
        """Return the name under which another program opens a bus: it stays when an adapter is pulled."""
        return str(self.links.get(bus, ports[bus]))

    def lines(self, ports: Mapping[str, str], real_time: str) -> list[str]:
        """Return what is said first: what is simulated, where, and how punctual it can be."""
        count = sum(len(bus.servos) for bus in self.buses)
        servos, buses = counted(count, "servo", "servos"), counted(len(self.buses), "bus", "buses")
        said = [f"{self.title}: {servos} simulated on {buses}; Ctrl-C ends it, `help` lists faults to type"]
        for bus in self.buses:
            where = self.port(bus.name, ports)
            really = f" ({ports[bus.name]})" if where != ports[bus.name] else ""
            said.append(
                f"  {bus.name}: {where}{really}, {bus.baud_rate} bit/s, Protocol {bus.protocol:.1f}, "
                f"{_models(bus)}"
            )
        if real_time:
            said.append(f"  in real time: {real_time}")
        if self.hint is not None and self.buses:
            port = shlex.quote(self.port(self.buses[0].name, ports))
            said.append(f"next: {self.hint} port:={port}")
        return said

    def moves(self, ports: Mapping[str, str]) -> list[str]:
        """Return what is said when adapters were pulled, or came back under other names."""
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
        """Say where the buses are."""
        for line in self._shown.lines(ports, real_time):
            self._say(line)

    def moved(self, ports: Mapping[str, str]) -> None:
        """Say where the buses are now."""
        for line in self._shown.moves(ports):
            self._say(line)

    def fault(self, text: str) -> None:
        """Say that a fault happened."""
        self._say(f"fault: {text}")

    def accepted(self, text: str) -> None:
        """Say how a line was understood: it may be planned for later."""
        self._say(f"understood: {text}")

    def refused(self, sentence: str) -> None:
        """Say what is wrong with a line that was typed."""
        say_error(sentence)

    def help(self) -> None:
        """List the faults."""
        for line in fault_lines():
            self._say(line)

    def look(self, look: Look, typed: str) -> None:
        """Say nothing: a table in lines would scroll the faults away."""

    def _say(self, line: str) -> None:
        self._console.print(line, markup=False, soft_wrap=True)
        self._console.file.flush()  # a reader behind a pipe waits for the port


class JsonView:
    """One JSON object a line on stdout: the ports, then each fault as it happens."""

    look_every_s: float | None = None

    def __init__(self, shown: Shown) -> None:
        self._shown = shown

    def opened(self, ports: Mapping[str, str], real_time: str) -> None:
        """Write where the buses are."""
        named = {bus: self._shown.port(bus, ports) for bus in ports}
        self._write({"ports": named, "devices": dict(ports), "real_time": real_time})

    def moved(self, ports: Mapping[str, str]) -> None:
        """Write where the buses are now."""
        self._write({"devices": dict(ports)})

    def fault(self, text: str) -> None:
        """Write that a fault happened."""
        self._write({"fault": text})

    def accepted(self, text: str) -> None:
        """Write how a line was understood: it may be planned for later."""
        self._write({"understood": text})

    def refused(self, sentence: str) -> None:
        """Write what is wrong with a line that was typed."""
        self._write({"error": sentence})

    def help(self) -> None:
        """Write the faults there are."""
        self._write({"faults": list(fault_lines())})

    def look(self, look: Look, typed: str) -> None:
        """Write nothing."""

    def _write(self, value: Mapping[str, object]) -> None:
        file = out().file
        file.write(json.dumps(value, ensure_ascii=False) + "\n")
        file.flush()


def fault_lines() -> Sequence[str]:
    """Return what can be typed: a line for each kind of fault."""
    from dxlrun.simulation.faults.fault import fault_help

    return fault_help()


def ending(title: str, elapsed_s: float, look: Look) -> str:
    """Return the last line: how long it ran, and what passed."""
    heard, answered = (sum(getattr(servo, name) for servo in look.servos) for name in ("heard", "answered"))
    late = ", ".join(f"{name} {value:.0f} us" for name, value in look.lateness_us.items())
    said = f"{title}: ended after {elapsed_s:.1f} s. "
    said += f"{counted(heard, 'packet', 'packets')} heard, {answered} answered"
    return said + (f"; replies later than planned: {late}" if late else "")


def _models(bus: BusConfig) -> str:
    """Return the servos of a bus in short: `XL430-W250 1-3, AX-12A 7`."""
    ids: dict[str, list[int]] = {}
    for servo in bus.servos:
        ids.setdefault(servo.model, []).append(servo.servo_id)
    return "; ".join(f"{model} {_ranges(sorted(each))}" for model, each in ids.items())


def _ranges(ids: Sequence[int]) -> str:
    parts: list[list[int]] = []
    for servo_id in ids:
        if parts and servo_id == parts[-1][-1] + 1:
            parts[-1].append(servo_id)
        else:
            parts.append([servo_id])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)
