"""Cyclic reads: the transactions that read all servos and devices of one bus in each cycle, planned again
after each loss.

Servos that can answer in turn are read by one instruction. A servo that misses its turn is read separately
from the next cycle on, until it answers. In Protocol 1.0 a silent servo ends the chain, in 2.0 it may end it,
so it must not stay in the chain. A device that misses its turn leaves the chain at once: it must not cost the
servos their replies.

A reply that arrives cycles late would look current. A group is therefore read in the length for which no
reply is owed (`OwedReplies`), or whose owed replies are the oldest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec import structs
from msgspec.structs import replace

from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.kernel import KernelProgram, PlannedRead
from dxlwire.exchange.owed import OwedReplies
from dxlwire.exchange.samples import BusSamples
from dxlwire.plan.line import SHORT_TIMEOUT_MARGIN_NS, TIMEOUT_MARGIN_NS
from dxlwire.plan.planning import plan_line
from dxlwire.plan.reads import state_read
from dxlwire.transaction import Reply, Transaction, TransactionOutcome

MOST_CHAINS = 64
"""Size of the cache of requests, each for a chain that omits certain servos. On a line that loses a
different servo every cycle the cache is cleared and rebuilt."""

CALM_CYCLES = 2
"""Cycles without a loss that the parser reads before the exchange kernel reads again."""

MOST_PROGRAMS = 8
"""Size of the cache of kernel programs: the length of replies changes after a loss, and once more after
recovery."""

MOST_BROKEN = 5
"""Incomplete fast reads of a group, without a complete one between them, before the group is read by the
plain form. Some servos answer a request of their own, but not in the shared status."""


class CyclicRequest(msgspec.Struct, frozen=True):
    """One read of some servos or devices of one group, in each reply length. `patient` has the long
    timeout, `short` the short one."""

    group: int
    indices: tuple[int, ...]
    patient: tuple[Transaction, ...]
    short: tuple[Transaction, ...]


class Cycle(msgspec.Struct, frozen=True):
    """The reads of one cycle on one bus, in the order of sending."""

    silent: tuple[bool, ...]  # Servos that missed their newest read; each is read separately
    queue: tuple[CyclicRequest, ...]
    program: KernelProgram | None
    """The same reads laid out for the exchange kernel; None while a servo is silent or has just recovered."""


class CyclicReads:
    """Job of a bus that reads the state of every servo and device once a cycle, and records missed
    replies. Members are indices in `BusPlan.members`."""

    def __init__(self, plan: BusPlan, samples: BusSamples, owed: OwedReplies) -> None:
        self._members = plan.members
        count, groups = len(self._members), len(plan.groups)
        self.missed = [0] * count  # Replies in a row that did not arrive
        self.errors = [0] * count  # Error byte of the newest reply
        self.garbled = [False] * count
        """True for each member whose newest loss came with garbled bytes and was the first loss of its
        read."""
        self.away = [False] * count
        """True for a lost servo or device that is no longer read; see `stop_reading`."""
        self.apart = [False] * count
        """True for a device that is read separately because it does not answer in a chain."""
        self.fast = list(plan.fast)  # True for each group that is read by a fast form; `plain` ends that
        self.given_up: list[int] = []
        """Groups whose fast reads stayed incomplete, so the plain form is used now; the caller reports and
        removes them."""
        self.begun = False  # True from the parser's first read of a cycle until `end`
        self._plan = plan
        self.samples = samples
        self._line = plan_line(plan)
        self._owed = owed
        self._planned_at = 0  # Version of `owed` for which the cycle was planned
        self._shape = [0] * groups  # Extra bytes by which each group's read is longer than its state
        self._lossy: set[int] = set()  # Groups that lost a reply in this cycle
        self._broken = [0] * groups  # Incomplete fast reads of each group since the last complete one
        self._calm = 0  # Consecutive cycles of the parser without a loss
        self.cycle = Cycle((), (), None)
        self._stale = True  # True when the next cycle must be planned again
        self._position = 0  # Index of the current read in the queue
        self._patient = True
        self._made: dict[tuple[int, ...], CyclicRequest] = {}
        self._programs: dict[tuple[object, ...], KernelProgram] = {}

    # Planning

    @property
    def stale(self) -> bool:
        """True when the reads of the next cycle must be planned again."""
        return self._stale or self._planned_at != self._owed.version

    def plan(self) -> Cycle:
        """Return the reads of the next cycle, planned again if something has changed; call it before the
        first request."""
        if self.stale:
            self._stale, self._planned_at = False, self._owed.version
            silent = tuple(map(bool, self.missed))
            queue = tuple(
                self._request(number, indices)
                for number, group in enumerate(self._plan.groups)
                for indices in _reads(
                    [index for index in group if not self.away[index]],
                    [one or apart for one, apart in zip(silent, self.apart, strict=True)],
                )
            )
            for number in range(len(self._shape)):
                self._choose_length(number, [one for one in queue if one.group == number])
            program = self._program(queue) if self._calm >= CALM_CYCLES else None
            self.cycle = Cycle(silent, queue, program)
        return self.cycle

    def end_cycle(self) -> None:
        """End a cycle that the parser read, or in which the line was lost; count calm cycles and
        incomplete fast reads."""
        self.begun = False
        self._stale = True
        silent = self.cycle.silent
        for number, members in enumerate(self._plan.groups):
            if number not in self._lossy and not any(
                silent[index] and not self.away[index] for index in members
            ):
                self._broken[number] = 0  # its fast read was complete
        self._lossy.clear()
        for group in self.given_up:
            self.plain(group)
        silence = any(missed and not away for missed, away in zip(self.missed, self.away, strict=True))
        # Only the parser counts incomplete fast reads, so the kernel must wait until they are complete again.
        self._calm = 0 if silence or any(self._broken) else self._calm + 1

    def blamed(self, member: int) -> bool:
        """Return True if a member did not answer although every member before it in the same read did.

        A silent member may silence the members after it, so only the first one is to blame."""
        for request in self.cycle.queue:
            if member in request.indices:
                before = request.indices[: request.indices.index(member)]
                arrived = self.samples.arrived
                return not arrived(member) and all(arrived(one) for one in before)
        return False

    def stop_reading(self, servo: int) -> None:
        """Stop reading a lost servo: its timeout would cost the other servos their time."""
        self.away[servo] = True
        self._stale = True

    def join(self, servo: int) -> None:
        """Read a recovered servo again from the next cycle on, together with the others."""
        self.away[servo] = False
        self.missed[servo] = 0
        self._stale = True

    def set_return_delays(self, return_delays: Mapping[int, int]) -> None:
        """Use the measured return delays of the servos, ns by ID, for the deadlines of replies."""
        self._line = replace(self._line, return_delays=dict(return_delays))
        self._forget()

    def plain(self, group: int) -> None:
        """Read a group by the plain form instead of the fast one, from the next cycle on. Every firmware
        supports the plain form."""
        self.fast[group] = False
        self._forget()

    def _forget(self) -> None:
        self._made.clear()
        self._programs.clear()
        self._stale = True

    def _request(self, group: int, indices: tuple[int, ...]) -> CyclicRequest:
        request = self._made.get(indices)
        if request is None:
            if len(self._made) >= MOST_CHAINS:
                self._made.clear()
            members = [self._members[index] for index in indices]
            servos = [one for one in members if one.device < 0]
            spare = min(one.spare for one in servos or members)
            fast = self.fast[group] and len(indices) > 1
            patient = tuple(state_read(self._line, members, more, fast=fast) for more in range(1 + spare))
            short = patient  # A device is never waited for
            if servos:
                less_ns = TIMEOUT_MARGIN_NS - SHORT_TIMEOUT_MARGIN_NS
                short = tuple(structs.replace(read, timeout_ns=read.timeout_ns - less_ns) for read in patient)
            request = self._made[indices] = CyclicRequest(group, indices, patient, short)
        return request

    def _choose_length(self, group: int, requests: Sequence[CyclicRequest]) -> None:
        """Choose the reply length of a group's reads: one without owed replies, else the one whose owed
        replies are the oldest.

        All reads of the group have the same length. Otherwise three silent servos of a group would choose
        the same lengths forever."""
        count = max((len(one.patient) for one in requests), default=1)
        first = self._shape[group]
        self._shape[group] = min(
            ((first + step) % count for step in range(count)),
            key=lambda shape: self._owed.newest_ns(one.patient[shape % len(one.patient)] for one in requests),
        )

    def _program(self, queue: Sequence[CyclicRequest]) -> KernelProgram | None:
        """Return the reads of a cycle without losses as a program for the kernel.

        Returns None, so that the parser reads, in two cases: a servo reports more than an alert, or a late
        reply to a request of idle time may look like a state."""
        reads = [
            PlannedRead(
                self._in_length(one.patient, one.group),
                one.indices,
                tuple(self.errors[index] for index in one.indices),
            )
            for one in queue
        ]
        if any(self._owed.free_ns(one.transaction, any_age=True) for one in reads):
            return None
        # An error number is a refusal, and its reply has no data. Only the alert bit comes with a full reply.
        refusals = 0xFF & ~self._line.dialect.ALERT if self._line.dialect.ALERT else 0
        if any(error & refusals for read in reads for error in read.errors):
            return None
        key = tuple((read.transaction.packet, read.errors) for read in reads)
        if key not in self._programs:
            if len(self._programs) >= MOST_PROGRAMS:
                self._programs.clear()
            self._programs[key] = KernelProgram(self._plan, reads)
        return self._programs[key]

    def _in_length(self, reads: Sequence[Transaction], group: int) -> Transaction:
        return reads[self._shape[group] % len(reads)]

    # Reading by the parser

    def begin_cycle(self, done: int = 0) -> None:
        """Begin a cycle for the parser, after `done` reads that the kernel has completed."""
        if not done:
            self.samples.clear_fresh()
        self.begun = self._patient = True
        self._position = done

    def next_transaction(self, reply: Reply | None) -> Transaction | None:
        """Count a loss if the current read failed, and return the next read of the cycle; None at the end."""
        queue = self.cycle.queue
        if reply is not None:
            if reply.outcome is not TransactionOutcome.OK:
                self._count_loss(queue[self._position], reply.outcome)
            self._position += 1
        if self._position == len(queue):
            return None
        request = queue[self._position]
        # The first timeout of a cycle has used up the time for waiting: the later reads get the short
        # timeout.
        patient = self._patient and not self.missed[request.indices[0]]
        return self._in_length(request.patient if patient else request.short, request.group)

    def status(self, index: int, reply: Reply) -> None:
        """Store the state in the reply of one servo or device; `index` is its place in the current read."""
        servo = self.cycle.queue[self._position].indices[index]
        self.samples.store_state(servo, reply.parameters, reply.last_ns)
        self.errors[servo] = reply.error

    def _count_loss(self, request: CyclicRequest, outcome: TransactionOutcome) -> None:
        self._patient = False
        self._lossy.add(request.group)
        if request.patient[0].fast:
            self._broken[request.group] += 1
            if self._broken[request.group] == MOST_BROKEN:
                self.given_up.append(request.group)
        garbled = outcome is not TransactionOutcome.TIMEOUT
        for servo in request.indices:
            if not self.samples.arrived(servo):
                self.garbled[servo] = garbled
                # Stray bytes are those of the first missing servo. They say nothing about the servos after
                # it.
                garbled = False


def _reads(group: Sequence[int], silent: Sequence[bool]) -> list[tuple[int, ...]]:
    """Return the reads of a group: one for all members that answer, and one for each silent member."""
    together = tuple(index for index in group if not silent[index])
    alone: list[tuple[int, ...]] = [(index,) for index in group if silent[index]]
    return [together, *alone] if together else alone
