"""Trace: which Python functions a steady cycle of the loop runs, and how many files they are in.

Five servos of Protocol 2.0 (robots/open_manipulator_x.yaml) on a simulated bus in a process of its own, the
loop as a run assembles it, with the exchange kernel and the rings of a log; the recorder is another process
and not part of it. A cycle begins when the one before is in the ring. The most frequent cycle is printed;
functions of numpy and of the standard library are not counted.

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
from pathlib import Path
from types import CodeType, FrameType

import dxlrun
import dxlrun_controllers
from dxlrun.channels.commands import NoCommands
from dxlrun.channels.packets import LONGEST_BATCH, PacketBatch
from dxlrun.channels.ring import RingWriter, create
from dxlrun.clock import MonotonicClock
from dxlrun.compile.simulation import simulated_buses
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.control.loop import StopFlag
from dxlrun.dynamixel.port.ports import SerialPort, SerialPorts
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.assembly import Sinks, assemble
from dxlrun.testing import plan_of
from exchange.simulated import SimulatedServos

ROBOT = Path(__file__).parents[2] / "robots" / "open_manipulator_x.yaml"
ROOTS = tuple(str(Path(module.__file__ or "").parent) for module in (dxlrun, dxlrun_controllers))
WARM_UP = 30
"""Cycles before the trace begins."""
SECONDS = 1.5

Calls = Counter[CodeType]


class Events:
    """Takes events and forgets them."""

    def emit(self, *event: object) -> None:
        """Forget it."""


class Trace:
    """Counts the functions of each cycle."""

    def __init__(self) -> None:
        self.cycles: list[Calls] = []
        self._calls: Calls = Counter()

    def next(self, count: int, skipped: int) -> None:
        """End the trace of a cycle that is in the rings, and begin the next."""
        sys.setprofile(None)
        if count > WARM_UP:
            self.cycles.append(self._calls)
            self._calls = Counter()
            sys.setprofile(self._note)

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOTS):
            self._calls[frame.f_code] += 1


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
    trace = Trace()
    rings = [create(name, 1 << 22, LONGEST_BATCH) for name in ("cycles", "packets")]
    cycles, packets = map(RingWriter, rings)
    sinks = Sinks(cycles, PacketBatch(packets), Events(), NoCommands(), trace.next)
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
    kinds = Counter(frozenset(calls.items()) for calls in trace.cycles)
    return Counter(dict(kinds.most_common(1)[0][0]))


def by_file(calls: Calls) -> dict[str, list[str]]:
    """Return the names of the functions, by file."""
    found: dict[str, list[str]] = {}
    for code, count in calls.items():
        path = Path(code.co_filename)
        name = str(path.relative_to(next(Path(root).parent for root in ROOTS if str(path).startswith(root))))
        found.setdefault(name, []).append(code.co_qualname + (f" x{count}" if count > 1 else ""))
    return dict(sorted(found.items()))


def main() -> None:
    """Print the functions by file."""
    calls = steady_cycle(*map(Path, sys.argv[1:2]))
    files = by_file(calls)
    for name, functions in files.items():
        sys.stdout.write(f"{len(functions):3}  {name}: {', '.join(sorted(functions))}\n")
    sys.stdout.write(f"{len(calls)} functions in {len(files)} files, {sum(calls.values())} calls\n")


if __name__ == "__main__":
    main()
