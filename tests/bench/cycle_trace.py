"""Trace: which Python functions a steady cycle of the loop runs, and how many files they are in.

Five servos of Protocol 2.0 (robots/open_manipulator_x.yaml) on a simulated bus in a process of its own, the
loop as a run assembles it, with the exchange kernel and the rings of a log; the recorder is another process
and not part of it. A cycle begins when the one before is in the ring. The most frequent cycle is printed.

    python tests/bench/cycle_trace.py [ROBOT.yaml]
"""

from __future__ import annotations

import os
import sys
import tempfile
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType

import dxlrun
from dxlrun.clock import MonotonicClock
from dxlrun.compile.plan import Plan
from dxlrun.compile.simulated import simulated_buses
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.control.loop import StopFlag
from dxlrun.dynamixel.port.ports import SerialPort, SerialPorts
from dxlrun.run.assembly import assemble, cycle_layout
from dxlrun.run.channels.commands import NoCommands
from dxlrun.run.channels.cycle import CycleRecord
from dxlrun.run.channels.packets import PACKET_SLOT, PacketBatch
from dxlrun.run.channels.ring import RingWriter, create
from dxlrun.testing import plan_of
from exchange.simulated import SimulatedServos

ROBOT = Path(__file__).parents[2] / "robots" / "open_manipulator_x.yaml"
WARM_UP = 30
"""Cycles before the trace begins."""
SECONDS = 1.5

Calls = Counter[CodeType]


class Events:
    """Takes events and forgets them."""

    def emit(self, *event: object) -> None:
        """Forget it."""


@dataclass(slots=True)
class Traced:
    """Sinks of the loop that begin and end the trace of a cycle, and have its packets in a ring."""

    packets: PacketBatch
    cycles: RingWriter
    events: Events = field(default_factory=Events)
    commands: NoCommands = field(default_factory=NoCommands)
    traced: list[Calls] = field(default_factory=list)
    count: int = 0
    calls: Calls = field(default_factory=Counter)

    def begin(self, record: CycleRecord) -> None:
        """Commit what was exchanged at the start."""
        self.packets.commit()

    def append(self, record: CycleRecord) -> None:
        """Put a finished cycle into the rings and begin with the next."""
        self.packets.commit()
        self.cycles.append(record.raw)
        sys.setprofile(None)
        self.count += 1
        if self.count > WARM_UP:
            self.traced.append(self.calls)
            self.calls = Counter()
            sys.setprofile(self._note)

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            self.calls[frame.f_code] += 1


@contextmanager
def simulated(plan: Plan) -> Iterator[list[SerialPort]]:
    """Run the simulated servos of a plan, and open their lines."""
    with (
        tempfile.TemporaryDirectory() as folder,
        SimulatedServos(simulated_buses(plan), -1, Path(folder, "ledger.jsonl")) as servos,
    ):
        descriptors = [os.open(path, os.O_RDWR | os.O_NOCTTY) for path in servos.ports]
        for descriptor in descriptors:
            tty.setraw(descriptor)
        try:
            yield [SerialPort(one, path) for one, path in zip(descriptors, servos.ports, strict=True)]
        finally:
            for descriptor in descriptors:
                os.close(descriptor)


def steady_cycle(robot: Path = ROBOT) -> Calls:
    """Return the functions of the most frequent cycle and how often it calls each."""
    plan = plan_of(robot, duration_s=SECONDS)
    layout = cycle_layout(plan)
    rings = create("packets", PACKET_SLOT, 4096), create("cycles", layout.size, 4096)
    sinks = Traced(PacketBatch(RingWriter(rings[0])), RingWriter(rings[1]))
    with simulated(plan) as ports:
        assembled = assemble(
            plan,
            load_plugins(),
            ports=SerialPorts(ports),
            clock=MonotonicClock(),
            sinks=sinks,
            beat=int,
            stop=StopFlag(),
        )
        assembled.hardware.start()
        try:
            assembled.loop.run()
        finally:
            sys.setprofile(None)
            assembled.hardware.stop()
    for ring in rings:
        os.close(ring)
    kinds = Counter(frozenset(calls.items()) for calls in sinks.traced)
    return Counter(dict(kinds.most_common(1)[0][0]))


def main() -> None:
    """Print the functions by file."""
    calls = steady_cycle(*map(Path, sys.argv[1:2]))
    root = Path(dxlrun.__file__).parents[1]
    by_file: dict[str, list[str]] = {}
    for code, count in calls.items():
        path = Path(code.co_filename)
        name = str(path.relative_to(root) if path.is_relative_to(root) else path.name)
        by_file.setdefault(name, []).append(code.co_qualname + (f" x{count}" if count > 1 else ""))
    for name, functions in sorted(by_file.items()):
        sys.stdout.write(f"{len(functions):3}  {name}: {', '.join(sorted(functions))}\n")
    sys.stdout.write(f"{len(calls)} functions in {len(by_file)} files, {sum(calls.values())} calls\n")


if __name__ == "__main__":
    main()
