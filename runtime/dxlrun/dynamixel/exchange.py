"""Exchange: the cyclic reads of one bus as a prepared list, and what each servo's silence means.

A status carries no sequence number, so a reply that comes cycles late would look current. Replies come in the
order of their requests, though, and the length of one is known: after a lost reply, a servo is asked for one
more byte (then two, then none again). A late reply then has the wrong length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.line import PATIENCE_NS, SHORT_PATIENCE_NS, Line
from dxlrun.dynamixel.plan import STATE_LENGTH
from dxlrun.dynamixel.transaction import Outcome, Reply, Transaction

SHAPES = 3


class CyclicReads:
    """The job that reads the state of every servo of one bus once."""

    __slots__ = (
        "_index",
        "_patient",
        "_patient_reads",
        "_replies",
        "_shape",
        "_short_reads",
        "arrived_ns",
        "errors",
        "fresh",
        "garbled",
        "missed",
    )

    def __init__(self, plan: BusPlan, replies: Sequence[memoryview]) -> None:
        count = len(plan.servos)
        self.fresh = np.zeros(count, dtype=np.bool_)
        """Whose reply arrived intact in this cycle."""
        self.arrived_ns = np.full(count, -1, dtype=np.int64)
        self.missed = [0] * count
        """How many replies in a row did not arrive."""
        self.errors = [0] * count
        """Error byte of the newest reply."""
        self.garbled = [False] * count
        """True when the newest loss had bytes."""
        self._replies = tuple(replies)
        self._patient_reads = [_shapes(plan, read) for read in plan.reads]
        self._short_reads = [tuple(_short(read) for read in shapes) for shapes in self._patient_reads]
        self._shape = [0] * count
        self._index = 0
        self._patient = True

    def begin(self) -> None:
        """Prepare for the next cycle."""
        self.fresh[:] = False
        self._patient = True

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Keep a reply, return the next read."""
        if reply is None:
            index = 0
        else:
            self._take(self._index, reply)
            index = self._index + 1
        if index == len(self.missed):
            return None
        self._index = index
        # the first silence of a cycle has cost its patience: the others keep their time
        reads = self._patient_reads if self._patient and not self.missed[index] else self._short_reads
        return reads[index][self._shape[index]]

    def _take(self, index: int, reply: Reply) -> None:
        if reply.outcome is Outcome.OK:
            self._replies[index][:] = reply.parameters[:STATE_LENGTH]
            self.fresh[index] = True
            self.arrived_ns[index] = reply.last_ns
            self.errors[index] = reply.error
            return
        self._patient = False
        self.garbled[index] = reply.outcome is not Outcome.TIMEOUT
        self._shape[index] = (self._shape[index] + 1) % SHAPES


def _shapes(plan: BusPlan, read: Transaction) -> tuple[Transaction, ...]:
    """Return the read and its longer forms: voltage and temperature stand behind the load."""
    line = Line(plan.baud_rate, plan.latency_ns, plan.return_delay_ns)
    address = read.packet[5]
    longer = (line.read(read.servo_id, address, STATE_LENGTH + more) for more in range(1, SHAPES))
    return (read, *longer)


def _short(read: Transaction) -> Transaction:
    return replace(read, timeout_ns=read.timeout_ns - PATIENCE_NS + SHORT_PATIENCE_NS)
