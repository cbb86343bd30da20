"""Exchange: the cyclic reads of one bus as prepared transactions, and what each servo's silence means.

Servos that can answer in turn are read by one instruction. Who misses its turn is asked by itself from the
next cycle on, until it answers: in Protocol 1.0 an absent servo ends the chain, in 2.0 it may, so it must not
stay in it.

A status carries no sequence number, so a reply that comes cycles late would look current. Replies come in the
order of their requests, though, and the length of one is known: after a lost reply, a group is asked for one
more byte (then two, then none again). A late reply then has the wrong length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from dxlrun.dynamixel.exchange.kernel import PlannedRead, Program
from dxlrun.dynamixel.exchange.samples import BusSamples
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.plan.line import PATIENCE_NS, SHORT_PATIENCE_NS
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.reads import state_read
from dxlrun.dynamixel.wire.transaction import Outcome, Reply, Transaction

MOST_CHAINS = 64
"""Chains without this or that servo are kept; on a line that loses others every cycle they are made anew."""

CALM_CYCLES = 2
"""Cycles of the parser in which every servo answered in order, before the kernel reads again."""

MOST_PROGRAMS = 8
"""Programs of the kernel are kept: the length of replies changes after a loss, and after that again."""

MOST_BROKEN = 5
"""Fast reads of a group that stay incomplete, with no complete one among them, before the group is read
plainly: a servo then answers when it is asked by itself, and not in the shared status."""


@dataclass(frozen=True, slots=True)
class Request:
    """One read of servos of one group, in each length: `patient` awaits late replies, `short` does not."""

    group: int
    indices: tuple[int, ...]
    patient: tuple[Transaction, ...]
    short: tuple[Transaction, ...]


class CyclicReads:
    """The job that reads the state of every servo of one bus once."""

    __slots__ = (
        "_broken",
        "_calm",
        "_current",
        "_groups",
        "_line",
        "_lossy",
        "_made",
        "_patient",
        "_plan",
        "_position",
        "_programs",
        "_queue",
        "_queue_of",
        "_samples",
        "_shape",
        "_start",
        "away",
        "changed",
        "errors",
        "fast",
        "garbled",
        "given_up",
        "missed",
        "program",
    )

    def __init__(self, plan: BusPlan, samples: BusSamples) -> None:
        count = len(plan.servos)
        self.missed = [0] * count
        """Replies in a row that did not arrive."""
        self.errors = [0] * count
        """Error byte of the newest reply."""
        self.garbled = [False] * count
        """True when the newest loss had bytes."""
        self.away = [False] * count
        """True for a servo that is lost and not asked any more; see `leave`."""
        self.fast = list(plan.fast)
        """The groups that are read by a fast form; `plain` ends that."""
        self.given_up: list[int] = []
        """Groups whose fast reads stayed incomplete, so that they are read plainly now; to be reported."""
        self._broken = [0] * len(plan.groups)  # incomplete fast reads since the last complete one
        self._plan = plan
        self._line = plan_line(plan)
        self._groups = plan.groups
        self._samples = samples
        self._made: dict[tuple[int, ...], Request] = {}
        self._shape = [0] * len(self._groups)
        self._lossy = [False] * len(self._groups)  # a reply was lost in this cycle
        self._queue: list[Request] = []
        self._queue_of: tuple[bool, ...] | None = None
        self._current: Request | None = None
        self._position = 0
        self._start = 0
        self._patient = True
        self.changed = True
        """True while the next cycle may differ from the one before."""
        self._calm = 0
        self._programs: dict[tuple[object, ...], Program] = {}
        self.program: Program | None = None
        """The next cycle for the kernel; None while a servo is silent, or was a moment ago."""

    def prepare(self) -> None:
        """Plan the next cycle: nothing to do after one that the kernel has read."""
        if not self.changed:
            return
        for number, lost in enumerate(self._lossy):
            if lost:
                # once a cycle: if each loss counted, three silent servos of a group would ask alike for ever
                self._shape[number] += 1
                self._lossy[number] = False
            elif self._broken[number] and not self._apart(number):
                self._broken[number] = 0
        silent = tuple(map(bool, self.missed))
        if silent != self._queue_of:
            self._queue_of = silent
            self._queue = [
                self._request(number, indices)
                for number, group in enumerate(self._groups)
                for indices in _turns([index for index in group if not self.away[index]], silent)
            ]
        silence = any(missed and not away for missed, away in zip(silent, self.away, strict=True))
        self._calm = 0 if silence or any(self._broken) else self._calm + 1
        self.program = self._laid() if self._calm > CALM_CYCLES else None
        self.changed = self.program is None

    def _laid(self) -> Program | None:
        """Return the reads of a calm cycle for the kernel; None where a servo reports more than an alert."""
        reads = [
            PlannedRead(
                one.patient[self._shape[one.group] % len(one.patient)],
                one.indices,
                tuple(self.errors[index] for index in one.indices),
            )
            for one in self._queue
        ]
        refusals = 0xFF & ~self._line.dialect.ALERT if self._line.dialect.ALERT else 0
        if any(error & refusals for read in reads for error in read.errors):
            return None
        key = tuple((read.transaction.packet, read.errors) for read in reads)
        if key not in self._programs:
            if len(self._programs) >= MOST_PROGRAMS:
                self._programs.clear()
            self._programs[key] = Program(self._plan, reads)
        return self._programs[key]

    def begin(self) -> None:
        """Begin a cycle of the parser: no reply has come yet."""
        self._samples.fresh[:] = False

    def begin_at(self, done: int) -> None:
        """Begin the parser's cycle behind so many reads, which the kernel has done."""
        self._start = done

    def resume(self, done: int) -> Transaction:
        """Return the read that the kernel has sent behind so many others, to be finished by the parser."""
        self.changed = self._patient = True
        self._position = done
        request = self._current = self._queue[done]
        return request.patient[self._shape[request.group] % len(request.patient)]

    def _apart(self, number: int) -> bool:
        """Say whether a servo of a group was asked by itself in this cycle."""
        silent = self._queue_of
        return silent is None or any(silent[one] and not self.away[one] for one in self._groups[number])

    def asks(self, servo: int) -> bool:
        """Say whether a servo is asked in this cycle: not if it joined after a split bus was asked."""
        return any(servo in request.indices for request in self._queue)

    def leave(self, servo: int) -> None:
        """Ask a servo no more: it is lost, and its silence would cost the others their time."""
        self.away[servo] = True
        self._anew()

    def join(self, servo: int) -> None:
        """Ask a servo again from the next cycle on, with the others: it was found in order."""
        self.away[servo] = False
        self.missed[servo] = 0
        self._anew()

    def _anew(self) -> None:
        """Plan the next cycle anew."""
        self._queue_of = self.program = None
        self.changed = True

    def learn(self, return_delays: Mapping[int, int]) -> None:
        """Await replies when they are due by what the servos, by ID, were found to wait, ns."""
        self._line = replace(self._line, return_delays=dict(return_delays))
        self._made.clear()
        self._programs.clear()
        self._anew()

    def plain(self, group: int) -> None:
        """Read a group by the form that every firmware knows from the next cycle on."""
        self.fast[group] = False
        self._made.clear()
        self._programs.clear()
        self._anew()

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Take what came of a read, return the next one."""
        self.changed = True
        if reply is None:
            self._position, self._start, self._patient = self._start, 0, True
        else:
            self._position += 1
            if reply.outcome is not Outcome.OK:
                self._count_out(reply.outcome)
        if self._position == len(self._queue):
            return None
        request = self._current = self._queue[self._position]
        # the first silence of a cycle has cost its patience: the others keep their time
        reads = request.patient if self._patient and not self.missed[request.indices[0]] else request.short
        return reads[self._shape[request.group] % len(reads)]

    def status(self, index: int, reply: Reply) -> None:
        """Keep the state of one servo of the current read."""
        assert self._current is not None  # noqa: S101  a status belongs to a read
        servo = self._current.indices[index]
        self._samples.take(servo, reply.parameters, reply.last_ns)
        self.errors[servo] = reply.error

    def _count_out(self, outcome: Outcome) -> None:
        assert self._current is not None  # noqa: S101  something was read
        self._patient = False
        group = self._current.group
        self._lossy[group] = True
        if self._current.patient[0].fast:
            self._broken[group] += 1
            if self._broken[group] == MOST_BROKEN:
                self.plain(group)
                self.given_up.append(group)
        for servo in self._current.indices:
            if not self._samples.fresh[servo]:
                self.garbled[servo] = outcome is not Outcome.TIMEOUT

    def _request(self, group: int, indices: tuple[int, ...]) -> Request:
        request = self._made.get(indices)
        if request is None:
            if len(self._made) >= MOST_CHAINS:
                self._made.clear()
            servos = [self._plan.servos[index] for index in indices]
            spare = min(servo.state.spare for servo in servos)
            fast = self.fast[group] and len(indices) > 1
            patient = tuple(state_read(self._line, servos, more, fast=fast) for more in range(1 + spare))
            short = tuple(
                replace(read, timeout_ns=read.timeout_ns - PATIENCE_NS + SHORT_PATIENCE_NS)
                for read in patient
            )
            request = self._made[indices] = Request(group, indices, patient, short)
        return request


def _turns(group: Sequence[int], silent: Sequence[bool]) -> list[tuple[int, ...]]:
    """Group responsive servos into one read; read each unresponsive servo separately."""
    together = tuple(index for index in group if not silent[index])
    alone: list[tuple[int, ...]] = [(index,) for index in group if silent[index]]
    return [together, *alone] if together else alone
