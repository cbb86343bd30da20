"""Trace: which Python functions a steady cycle of the loop runs, and how many files they are in.

Five servos of Protocol 2.0 (robots/open_manipulator_x.yaml) on a simulated bus in a process of its own, the
loop as a run assembles it, with the exchange kernel and the rings of a log; the recorder is another process
and not part of it. A cycle begins when the one before is in the ring. The most frequent cycle is printed;
functions of numpy and of the standard library are not counted.

With --command the torso (robots/bioloid_torso.yaml) gets positions and speeds of its head through the mailbox
in every fifth cycle, and of those that take them the one with the fewest functions is printed.

    python bench/cycle_trace.py [ROBOT.yaml | --command]
"""

from __future__ import annotations

import os
import struct
import sys
import tempfile
import tty
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType

import dxlrun
import dxlrun_controllers
from dxlrun.channels import mailbox
from dxlrun.channels.commands import CommandMessage, CommandRing, Inbox, NoInbox
from dxlrun.channels.event_records import EventRing
from dxlrun.channels.logged_packets import LONGEST_BATCH, PacketBatch
from dxlrun.channels.mailbox import Mailbox, MailboxWriter
from dxlrun.channels.ring import RingWriter, create
from dxlrun.compile.simulation import simulation_of
from dxlrun.control.context import Unsupervised
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.assembly import LoopHost, Sinks, assemble
from dxlrun.testing import plan_of
from dxlwire.clock import MonotonicClock
from dxlwire.port.ports import SerialPort, SerialPorts
from exchange.simulated import SimulatedServos

ROBOTS = Path(__file__).parents[1] / "robots"
ROBOT = ROBOTS / "open_manipulator_x.yaml"
COMMANDED = ROBOTS / "bioloid_torso.yaml"
COMMAND_CYCLES = 5
"""After so many cycles another command is sent."""
ROOTS = tuple(str(Path(module.__file__ or "").parent) for module in (dxlrun, dxlrun_controllers))
WARM_UP = 30
"""Cycles before the trace begins."""
SECONDS = 1.5

Calls = Counter[CodeType]


class Trace:
    """Counts the functions of each cycle."""

    def __init__(self, box: MailboxWriter | None = None) -> None:
        self.cycles: list[Calls] = []
        self._calls: Calls = Counter()
        self._box = box

    def next(self, count: int, skipped: int) -> None:
        """End the trace of a cycle that is in the rings, and begin the next."""
        sys.setprofile(None)
        if count > WARM_UP:
            self.cycles.append(self._calls)
            self._calls = Counter()
            if self._box is not None and count % COMMAND_CYCLES == 0:
                data = struct.pack("<4d", 0.3 + count * 1e-3, -0.5, 1.0, 1.0)
                self._box.post_command(CommandMessage(count, "head", "posvel", data, "bench"))
            sys.setprofile(self._note)

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOTS):
            self._calls[frame.f_code] += 1


@contextmanager
def simulated(plan: Plan) -> Iterator[list[SerialPort]]:
    """Run the simulated servos of a plan, and open their lines."""
    with (
        tempfile.TemporaryDirectory() as folder,
        SimulatedServos(simulation_of(plan).buses, -1, Path(folder, "ledger.jsonl")) as servos,
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
    return _most_frequent(_cycles(robot, Trace(), NoInbox()))


def command_cycle() -> Calls:
    """Return the functions of the shortest cycle that takes a command; late replies make others longer."""
    box, answers = mailbox.create(8), create("answers", 1 << 18, mailbox.LONGEST_ANSWER)
    cycles = _cycles(COMMANDED, Trace(MailboxWriter(box)), Mailbox(box, RingWriter(answers)))
    os.close(box)
    os.close(answers)
    name = "Steering.execute_commands"
    return min((calls for calls in cycles if any(code.co_qualname == name for code in calls)), key=len)


def _most_frequent(cycles: Sequence[Calls]) -> Calls:
    """Return the most frequent of those in which the kernel came back once: late replies make it more."""
    waited = [any(code.co_name == "_finish_read" for code in calls) for calls in cycles]
    kinds = Counter(
        frozenset(calls.items())
        for calls, late in zip(cycles, waited, strict=True)
        if not late or all(waited)
    )
    return Counter(dict(kinds.most_common(1)[0][0]))


class _Uncounted(Unsupervised):
    """Beats by a function of C, which no trace has: what a process does there is not of the cycle."""

    beat = staticmethod(int)


def _cycles(robot: Path, trace: Trace, inbox: Inbox) -> list[Calls]:
    plan = plan_of(robot, duration_s=SECONDS if robot == ROBOT else 5 * SECONDS)
    rings = [create(name, 1 << 22, LONGEST_BATCH) for name in ("cycles", "packets", "events")]
    cycles, packets, happened = map(RingWriter, rings)
    events = EventRing(happened, MonotonicClock())
    sinks = Sinks(cycles, PacketBatch(packets), events, CommandRing(happened), trace.next)
    with simulated(plan) as ports:
        host = LoopHost(
            ports=SerialPorts(ports),
            clock=MonotonicClock(),
            sinks=sinks,
            supervision=_Uncounted(),
            inbox=inbox,
        )
        assembled = assemble(plan, load_plugins(), host)
        assembled.hardware.start()
        try:
            assembled.loop.run()
        finally:
            sys.setprofile(None)
            assembled.hardware.stop()
    for ring in rings:
        os.close(ring)
    return trace.cycles


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
    words = sys.argv[1:2]
    calls = command_cycle() if words == ["--command"] else steady_cycle(*map(Path, words))
    files = by_file(calls)
    for name, functions in files.items():
        sys.stdout.write(f"{len(functions):3}  {name}: {', '.join(sorted(functions))}\n")
    sys.stdout.write(f"{len(calls)} functions in {len(files)} files, {sum(calls.values())} calls\n")


if __name__ == "__main__":
    main()
