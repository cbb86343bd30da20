"""Breakdown of the excess of one late or long cycleby cause, from its times and packets and the plan.

A late wake-up is attributed to an exchange of the idle time that ended after the deadline, otherwise to the
machine. A read waits for all buses at once, so only the bus that was ready last counts. The planned time of
its exchanges consists of wire time, return delays and the adapter's latency. The excess is split into

- a write() of the instruction that returned later than the wire time requires;
- a missing reply: from the last reply, or its due time, to the next instruction or the end of the read. It
  is attributed to the first servo that did not answer, or to the bus if no reply of a chain came;
- a late reply: lateness that later replies do not make up for. It is attributed to the bus, because a
  single late reply does not show whether servo, adapter, kernel or simulation delayed it;
  `servos/reply_times.py` compares the servos;
- a retry: the whole second exchange with a servo that was already asked in the same read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.cycles.worst_cycles import CauseKind
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing, ordered
from dxlwire import TIMEOUT_MARGIN_NS, PacketKind

_NEVER = np.iinfo(np.int64).max


class CauseName(NamedTuple):
    """Key of a cause: kind and subject. `bus` is an index, -1 if the cause is not on a bus; `servo_id` is
    -1 if it is not a servo."""

    kind: CauseKind
    subject: str = ""
    bus: int = -1
    servo_id: int = -1


class _Exchange(NamedTuple):
    """One instruction that requests replies of servos, with the times of its replies, ns."""

    bus: int
    servo_ids: tuple[int, ...]
    asked: int
    blocked: int  # Time of the write() call beyond the wire time
    following: int  # Time of the next instruction on the bus
    planned_end: int
    last: int  # Time of the last reply; 0 without replies
    lacks: int | None
    """ID of the first servo whose reply is missing; -1: no reply of a chain came; None: all replies came."""

    def find_end(self, given_up: int) -> int:
        """Return the time at which the exchange ended, ns: its last reply. With a reply missing, return
        the time of the next instruction, or `given_up` if that is earlier."""
        return self.last if self.lacks is None else min(self.following, given_up)

    @property
    def unanswered(self) -> CauseName:
        """Cause `missing reply` of this exchange: its first silent servo, or the bus if no reply of a
        chain came, because then the instruction itself may be lost."""
        return CauseName("missing reply", bus=self.bus, servo_id=-1 if self.lacks is None else self.lacks)


class Account:
    """Breakdown of one cycle's excess: the time of each cause in ns, in `shares`."""

    def __init__(
        self,
        cycle: np.void,
        before: np.void | None,
        packets: PacketColumns,
        pairing: Pairing,
        controllers: Sequence[str],
    ) -> None:
        """Split the excess of a cycle by cause.

        Args:
            cycle: The cycle, a row of `causes.cycles_of`.
            before: Row of the preceding cycle; None for the first.
            packets: Packets since the read of the preceding cycle.
            pairing: Pairing of requests with replies for the log's buses.
            controllers: Names of the controllers, in the order of the log.
        """
        self._cycle = cycle
        self.shares: Counter[CauseName] = Counter()

        self._exchanges = tuple(_exchanges(pairing.alone(ordered(packets))))
        late = int(cycle["late"])
        idle = self._idle(before, late) if before is not None else 0
        self.shares[CauseName("late wake-up")] += late - idle
        if cycle["long"]:
            period, took = int(cycle["period"]), int(cycle["written"] - cycle["woken"])
            planned, exchanged = self._split_read_phase()
            self.shares[CauseName("plan")] += max(0, planned - period)
            for name, ns in zip(controllers, cycle["controllers"].tolist(), strict=False):
                self.shares[CauseName("controller", name)] += ns
            took -= exchanged + self._writes(packets) + int(cycle["controllers"].sum())
            self.shares[CauseName("own work")] += max(0, took)
        self.shares = +self.shares

    def _split_read_phase(self) -> tuple[int, int]:
        """Attribute the time that the read phase took beyond its plan; return the planned and the actual
        time of the exchanges on the slowest bus, ns."""
        woken, read = int(self._cycle["woken"]), int(self._cycle["read"])
        within = [one for one in self._exchanges if woken <= one.asked <= read]
        if not within:
            return 0, 0
        slowest = max(within, key=lambda one: min(one.find_end(read), read)).bus
        sums = [0, 0]
        asked: set[int] = set()
        for one in within:
            if one.bus != slowest:
                continue
            took = max(0, min(one.find_end(read), read) - one.asked)
            # A second request to a servo within one read is a retry.
            again = len(one.servo_ids) == 1 and one.servo_ids[0] in asked
            asked.update(one.servo_ids)
            sums[1] += took
            if again:
                self.shares[CauseName("retry", bus=one.bus, servo_id=one.servo_ids[0])] += took
                continue
            planned = min(max(one.planned_end - one.asked, 0), took)
            sums[0] += planned
            self._beyond(one, took - planned, read)
        return sums[0], sums[1]

    def _beyond(self, one: _Exchange, beyond: int, read: int) -> None:
        """Attribute the time that one exchange took beyond its plan (`beyond`, ns) to its write() call,
        its missing or its late reply. `read` is the end of the read phase."""
        blocked = min(one.blocked, beyond)
        self.shares[CauseName("write call", bus=one.bus)] += blocked
        beyond -= blocked
        if one.lacks is not None:
            end = one.find_end(read)
            heard = max(one.last, one.asked, min(one.planned_end, end))
            missed = min(max(end - heard, 0), beyond)
            self.shares[one.unanswered] += missed
            beyond -= missed
        late = min(max(one.last - one.planned_end - blocked, 0), beyond) if one.last else 0
        self.shares[CauseName("late reply", bus=one.bus)] += late
        self.shares[CauseName("unexplained")] += beyond - late

    def _writes(self, packets: PacketColumns) -> int:
        """Attribute the write() calls that send goals to their buses; return their total time, ns."""
        goals = (packets.kind == PacketKind.INSTRUCTION) & (packets.first_ns >= self._cycle["updated"])
        goals &= packets.last_ns <= self._cycle["written"]
        took = packets.last_ns - packets.first_ns
        for bus in np.unique(packets.bus[goals]).tolist():
            ns = int(took[goals & (packets.bus == bus)].sum())
            self.shares[CauseName("write call", bus=bus)] += ns
        return int(took[goals].sum())

    def _idle(self, before: np.void, late: int) -> int:
        """Attribute the lateness of the wake-up to the exchange of the idle time that ended last after the
        deadline; return the attributed time, ns. `late` is the lateness in ns."""
        due = max(int(self._cycle["scheduled"]), int(before["written"]))
        over = [
            (min(one.find_end(one.planned_end + TIMEOUT_MARGIN_NS) - due, late), one)
            for one in self._exchanges
            if before["read"] < one.asked < self._cycle["woken"]
        ]
        ns, one = max(over, default=(0, None), key=lambda pair: pair[0])
        if one is None or ns <= 0:
            return 0
        cause = CauseName("late reply", bus=one.bus)
        if one.lacks is not None:
            cause = one.unanswered
        elif one.last - one.planned_end < ns // 2:
            cause = CauseName("own work")  # The exchange itself was on time but started too late
        self.shares[cause] += ns
        return ns


def _exchanges(found: Exchanges) -> Iterator[_Exchange]:
    """Yield those paired exchanges whose instruction requests replies."""
    due, replies = found.due, found.replies
    following = np.append(found.asked_ns[1:], _NEVER)
    following[np.append(np.diff(found.bus), 1) > 0] = _NEVER
    for index in np.flatnonzero(found.requests.servos[found.request]).tolist():
        ids, bus = found.requests.kinds[found.request[index]].servo_ids, int(found.bus[index])
        reply = due.reply[due.exchange == index]
        came, missing = reply[reply >= 0], np.flatnonzero(reply < 0)
        planned_end = int(replies.due_ns[came].max(initial=found.sent_ns[index]))
        lacks = ids[missing[0]] if len(missing) else None
        yield _Exchange(
            bus,
            ids,
            int(found.asked_ns[index]),
            int(found.blocked_ns[index]),
            int(following[index]),
            planned_end + found.buses[bus].latency_ns,
            int(replies.last_ns[came].max(initial=0)),
            -1 if len(missing) == len(ids) > 1 else lacks,
        )
