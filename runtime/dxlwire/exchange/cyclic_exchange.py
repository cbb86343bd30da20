"""Cyclic exchange: reads all members of all lines once per cycle, by the compiled kernel or by the parser."""

from __future__ import annotations

from collections.abc import Sequence

from dxlwire.exchange.bus_engine import Lines
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.kernel import AWAITING, Kernel


class CyclicExchange:
    """Hands the reads of a cycle to the exchange kernel, and after a deviation from the plan to the parser.

    The caller ends each cycle that the parser reads: it fills the states, and calls
    `CyclicReads.end_cycle`."""

    def __init__(self, lines: Lines, reads: Sequence[CyclicReads], kernel: Kernel) -> None:
        self._lines = lines
        self._pairs = tuple(zip(lines.buses, reads, strict=True))
        self._kernel = kernel

    def plan_reads(self) -> bool:
        """Plan the reads of the next cycle, before any of them is sent.

        Returns:
            True if the kernel can do the reads: every open line has a program for it.
        """
        kernel, ready = self._kernel, True
        for index, (bus, reads) in enumerate(self._pairs):
            program = (reads.plan() if reads.stale else reads.cycle).program
            if bus.failure is None:
                known = program is not None and program is kernel.programs[index]
                ready &= known or (program is not None and kernel.plan(index, program))
                # Leave the beginning of an unfinished packet to the parser.
                ready &= not bus.receiver.pending
        return ready

    def interrupt_kernel(self) -> None:
        """Pass the cycle that the kernel has begun to the parser, with the bytes received so far."""
        for index, (bus, reads) in enumerate(self._pairs):
            line, failure = self._kernel.line(index)
            if bus.failure is not None:
                continue
            if failure is not None:
                bus.mark_lost(failure)
            if line.done or line.state or failure is not None:
                reads.begin_cycle(line.done)
                bus.load_job(reads, cyclic=True)
            if line.state == AWAITING:
                bus.await_replies(line.at_ns, line.sent_ns, line.deadline_ns)
            for data, at_ns in self._kernel.pieces(index):
                bus.parse_bytes(data, at_ns)
        self._kernel.abandon()

    def load_reads(self) -> None:
        """Load the reads of this cycle on the lines that were not read yet; `Lines.pump` then executes them,
        packet by packet."""
        waiting = [(bus, reads) for bus, reads in self._pairs if not reads.begun]
        self._lines.discard_input([bus for bus, _ in waiting])
        for bus, reads in waiting:
            reads.begin_cycle()
            bus.load_job(reads, cyclic=True)
