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
from dataclasses import replace

import numpy as np

from dxlrun.dynamixel.burst import Burst
from dxlrun.dynamixel.bus import Bus
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.lane import Lane, Stretch
from dxlrun.dynamixel.line import PATIENCE_NS, SHORT_PATIENCE_NS, Line
from dxlrun.dynamixel.plan import plan_line
from dxlrun.dynamixel.reads import state_read
from dxlrun.dynamixel.state_arrays import StateArrays, rows_of
from dxlrun.dynamixel.transaction import Outcome, Reply, Transaction

MOST_CHAINS = 64
"""Chains without this or that servo are kept; on a line that loses others every cycle they are made anew."""

MOST_BROKEN = 5
"""So many fast reads of a group that stay incomplete, with no complete one among them, are no accident:
somebody answers when it is asked by itself, and not in the shared status."""

CALM_CYCLES = 2
"""After so many cycles in which everybody answered, and in order, a lane is laid for them."""

MOST_LANES = 8
"""Some lanes that were laid are kept: replies change their length after a loss, and after that again."""

# to look into an Enum takes longer than the rest of a call
_OK, _TIMEOUT = Outcome.OK, Outcome.TIMEOUT


class _Request:
    """One read of servos of one group: in each length, patient and short."""

    __slots__ = ("bursts", "data", "group", "indices", "patient", "rows", "servos", "short")

    def __init__(  # noqa: PLR0917  whom it reads, and where the bytes go
        self,
        plan: BusPlan,
        line: Line,
        group: int,
        indices: tuple[int, ...],
        fast: bool,
        arrays: StateArrays,
        room: int,
    ) -> None:
        servos = [plan.servos[index] for index in indices]
        spare = min(servo.state.spare for servo in servos)
        self.group = group
        self.indices = indices
        self.patient = [state_read(line, servos, more, fast=fast) for more in range(1 + spare)]
        self.short = [
            replace(read, timeout_ns=read.timeout_ns - PATIENCE_NS + SHORT_PATIENCE_NS)
            for read in self.patient
        ]
        alike = len({servo.state for servo in servos}) == 1
        self.bursts = [Burst.of(line.dialect, read, room) if alike else None for read in self.patient]
        self.servos = rows_of(indices)
        self.data, self.rows = arrays.place(indices if alike else indices[:1])

    def stretch(self, shape: int) -> Stretch | None:
        """Return this read, patient, for a lane; None where it has no burst."""
        burst = self.bursts[shape]
        if burst is None:
            return None
        rows = tuple(np.arange(len(self.data))[self.rows].tolist())
        return Stretch(self.patient[shape], burst, self.indices, self.data, rows)


class CyclicReads:
    """The job that reads the state of every servo of one bus once."""

    __slots__ = (
        "_arrays",
        "_arrived",
        "_broken",
        "_bus",
        "_calm",
        "_current",
        "_erring",
        "_fresh",
        "_groups",
        "_lanes",
        "_line",
        "_lossy",
        "_made",
        "_none",
        "_patient",
        "_plan",
        "_position",
        "_queue",
        "_queue_of",
        "_replies",
        "_shape",
        "_smooth",
        "arrived_ns",
        "away",
        "burst",
        "complete",
        "counted",
        "errors",
        "fast",
        "fresh",
        "garbled",
        "given_up",
        "lane",
        "missed",
    )

    def __init__(self, plan: BusPlan, arrays: StateArrays, bus: Bus) -> None:
        count = len(plan.servos)
        self.fresh = arrays.arrivals.fresh
        """Whose reply arrived intact in this cycle."""
        self._fresh = self.fresh.view(np.uint8).data
        self._none = bytes(count)
        self.arrived_ns = arrays.arrivals.at_ns
        self.missed = [0] * count
        """How many replies in a row did not arrive."""
        self._arrived = self.arrived_ns.data
        self.errors = [0] * count
        """Error byte of the newest reply."""
        self.garbled = [False] * count
        """True when the newest loss had bytes."""
        self.away = [False] * count
        """Who is lost and not asked any more; see `leave`."""
        self.fast = list(plan.fast)
        """Which groups are read by a fast form; `plain` ends that."""
        self.given_up: list[int] = []
        """Groups whose fast reads stayed incomplete, so that they are read plainly now; to be told."""
        self._broken = [0] * len(plan.groups)  # incomplete fast reads since the last complete one
        self._plan = plan
        self._line = plan_line(plan)
        self._groups = plan.groups
        self._replies = arrays.replies
        self._arrays = arrays
        self._bus = bus
        self._calm = 0  # cycles in a row in which nothing was lost or reported
        self._smooth = False  # the newest one went through its lane
        self._lanes: dict[tuple[tuple[int, ...], ...], Lane] = {}
        self.lane: Lane | None = None
        """The quick way through this cycle, when there is one."""
        self.counted = False
        """True when the ticks of this cycle are there already, and not in the bytes of `StateArrays`."""
        self.complete = False
        """True when everybody answered as nearly always: without an error, and all was well before."""
        self._erring = False  # somebody's newest error byte is not 0
        self.burst: Burst | None = None
        self._made: dict[tuple[int, ...], _Request] = {}
        self._shape = [0] * len(self._groups)
        self._lossy = [False] * len(self._groups)  # whose reply was lost in this cycle
        self._queue: list[_Request] = []
        self._queue_of: tuple[bool, ...] | None = None
        self._current: _Request | None = None
        self._position = 0
        self._patient = True
        self.begin()

    def begin(self) -> None:
        """Prepare for the next cycle."""
        self._fresh[:] = self._none
        self.counted = self.complete = False
        if self._smooth:
            return
        for number, lost in enumerate(self._lossy):
            if lost:
                # once a cycle: if each loss counted, three silent servos of a group would ask alike for ever
                self._shape[number] += 1
                self._lossy[number] = False
            elif self._broken[number] and not self._apart(number):
                self._broken[number] = 0
        self._patient = True
        silent = tuple(map(bool, self.missed))
        if silent != self._queue_of:
            self._queue_of = silent
            self._queue = [
                self._request(number, indices)
                for number, group in enumerate(self._groups)
                for indices in _turns([index for index in group if not self.away[index]], silent)
            ]

        self.lane = self._laid(silent)

    def _laid(self, silent: Sequence[bool]) -> Lane | None:
        """Return the lane through the next cycle; None while anybody is silent, or reports an error."""
        silence = any(missed and not away for missed, away in zip(silent, self.away, strict=True))
        self._calm = 0 if silence or self._erring else self._calm + 1
        if self._calm <= CALM_CYCLES:
            return None
        shapes = [self._shape[one.group] % len(one.patient) for one in self._queue]
        key = (tuple(shapes), *(one.indices for one in self._queue))
        if key not in self._lanes:
            stretches = [one.stretch(shape) for one, shape in zip(self._queue, shapes, strict=True)]
            known = [one for one in stretches if one is not None]
            if len(known) < len(stretches) or not known:
                return None
            if len(self._lanes) >= MOST_LANES:
                self._lanes.clear()
            bus = self._bus
            self._lanes[key] = Lane(
                known, bus.index, bus.buffer, bus.byte_ns, len(self.missed), self._arrays, self._went
            )
        return self._lanes[key]

    def _went(self, lane: Lane) -> Transaction | None:
        """Take note of who was read through a lane; return the read at which it ended, None for none."""
        if lane.through:
            self._fresh[:] = lane.fresh
            self.counted = True
            self.complete = 0 not in lane.fresh
            self._smooth = not any(self._broken)
            return None
        for stretch in lane.stretches[: lane.done]:
            for servo in stretch.servos:
                self._fresh[servo] = 1
        self._position = lane.done - 1
        return self.advance(Reply(_OK, 0, b"", 0, 0, False))

    def _apart(self, number: int) -> bool:
        """Say whether somebody of a group was asked by itself in this cycle."""
        silent = self._queue_of
        return silent is None or any(silent[one] and not self.away[one] for one in self._groups[number])

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
        """Think again about who is read how, before the next cycle."""
        self._queue_of = None
        self._smooth = False

    def learn(self, return_delays: Mapping[int, int]) -> None:
        """Await replies when they are due by what the servos, by ID, were found to wait, ns."""
        self._line = replace(self._line, return_delays=dict(return_delays))
        self._made.clear()
        self._lanes.clear()
        self._anew()

    def plain(self, group: int) -> None:
        """Read a group by the form that every firmware knows from the next cycle on."""
        self.fast[group] = False
        self._made.clear()
        self._lanes.clear()
        self._anew()

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Judge what came of a read, return the next."""
        self._smooth = False
        if reply is None:
            self._position = 0
        else:
            self._position += 1
            if reply.outcome is not _OK:
                self._count_out(reply.outcome)
        if self._position == len(self._queue):
            return None
        request = self._current = self._queue[self._position]
        # the first silence of a cycle has cost its patience: the others keep their time
        reads = request.patient if self._patient and not self.missed[request.indices[0]] else request.short
        shape = self._shape[request.group] % len(reads)
        self.burst = request.bursts[shape]
        return reads[shape]

    def status(self, index: int, reply: Reply) -> None:
        """Keep the state of one servo of the current read."""
        assert self._current is not None  # noqa: S101  a status belongs to a read
        servo = self._current.indices[index]
        state = self._replies[servo]
        state[:] = reply.parameters[: len(state)]
        self.fresh[servo] = True
        self.arrived_ns[servo] = reply.last_ns
        self.errors[servo] = reply.error
        self._erring = True

    def take(self, burst: Burst, times_ns: int | list[int]) -> None:
        """Keep the states of all servos of the current read."""
        request = self._current
        assert request is not None  # noqa: S101  a burst belongs to a read
        if burst.count == 1 and isinstance(times_ns, int):
            # one by one, plain bytes are quicker than arrays
            servo = request.indices[0]
            state = self._replies[servo]
            state[:] = burst.first[: len(state)]
            self._fresh[servo] = 1
            self._arrived[servo] = times_ns
        else:
            request.data[request.rows] = burst.data[:, : request.data.shape[1]]
            self.fresh[request.servos] = True
            self.arrived_ns[request.servos] = times_ns
        errors = burst.errors
        if self._erring or errors.count(0) != burst.count:
            for servo, error in zip(request.indices, errors, strict=True):
                self.errors[servo] = error
            self._erring = any(self.errors)

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
            if not self.fresh[servo]:
                self.garbled[servo] = outcome is not _TIMEOUT

    def _request(self, group: int, indices: tuple[int, ...]) -> _Request:
        request = self._made.get(indices)
        if request is None:
            if len(self._made) >= MOST_CHAINS:
                self._made.clear()
            fast = self.fast[group] and len(indices) > 1
            request = self._made[indices] = _Request(
                self._plan, self._line, group, indices, fast, self._arrays, self._bus.room
            )
        return request


def _turns(group: Sequence[int], silent: Sequence[bool]) -> list[tuple[int, ...]]:
    """Return who is read together: all that answered last time, and then each silent one by itself."""
    together = tuple(index for index in group if not silent[index])
    alone: list[tuple[int, ...]] = [(index,) for index in group if silent[index]]
    return [together, *alone] if together else alone
