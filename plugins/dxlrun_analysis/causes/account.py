"""Where the time of one late or long cycle went: its record, and its packets against the plan.

The lateness of a wake-up is that of an exchange of the idle time that ended behind the deadline, else the
machine's. A read waits for all lines at once, so the bus that was ready last counts. Its exchanges are
planned to take what wire, return delays and the adapter's latency take; what they took beyond that is split:

- a write() of the instruction that returned later than the wire needs;
- a missing reply: from the last reply, or when it was due, to the next instruction or the end of the read;
  the first servo that did not answer has it, and where nothing of a chain of replies came, the bus;
- a late reply: lateness that the replies behind it do not make up for, of the bus: a single one does not tell
  whether servo, adapter, kernel or simulation kept it; `servos/reply_times.py` compares the servos;
- a retry: all of an exchange with a servo that was asked in the same read before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.cycles.worst import CauseKind
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing, ordered
from dxlwire import TIMEOUT_MARGIN_NS, PacketKind

_NEVER = np.iinfo(np.int64).max


class CauseName(NamedTuple):
    """What tells causes apart; a servo by its ID, -1 where the cause is none."""

    kind: CauseKind
    subject: str = ""
    bus: int = -1
    servo_id: int = -1


class _Exchange(NamedTuple):
    """One instruction that asks servos, and what came; times in ns."""

    bus: int
    servo_ids: tuple[int, ...]
    asked: int
    blocked: int  # How long the write() of the instruction took beyond the wire's time
    following: int  # When the next instruction of the bus was sent
    planned_end: int
    last: int  # When the last reply was there; 0: none was
    lacks: int | None
    """The servo that is waited for: the first without a reply; -1: none of several came; None: all came."""

    def end(self, given_up: int) -> int:
        """Return when it was over; one without all replies not before the next instruction."""
        return self.last if self.lacks is None else min(self.following, given_up)

    @property
    def unanswered(self) -> CauseName:
        """The cause of a missing reply; where nothing of a chain came, its instruction may be lost."""
        return CauseName("missing reply", bus=self.bus, servo_id=-1 if self.lacks is None else self.lacks)


class Account:
    """The causes of one cycle's excess, ns."""

    def __init__(
        self,
        cycle: np.void,
        before: np.void | None,
        packets: PacketColumns,
        pairing: Pairing,
        controllers: Sequence[str],
    ) -> None:
        """Split a cycle; it and the one before it are rows of `causes.cycles_of`."""
        self._cycle = cycle
        self.shares: Counter[CauseName] = Counter()

        self._exchanges = tuple(_exchanges(pairing.alone(ordered(packets))))
        late = int(cycle["late"])
        idle = self._idle(before, late) if before is not None else 0
        self.shares[CauseName("late wake-up")] += late - idle
        if cycle["long"]:
            period, took = int(cycle["period"]), int(cycle["written"] - cycle["woken"])
            planned, exchanged = self._read()
            self.shares[CauseName("plan")] += max(0, planned - period)
            for name, ns in zip(controllers, cycle["controllers"].tolist(), strict=False):
                self.shares[CauseName("controller", name)] += ns
            took -= exchanged + self._writes(packets) + int(cycle["controllers"].sum())
            self.shares[CauseName("own work")] += max(0, took)
        self.shares = +self.shares

    def _read(self) -> tuple[int, int]:
        """Split the read; return what its exchanges were planned to take, and what they took."""
        woken, read = int(self._cycle["woken"]), int(self._cycle["read"])
        within = [one for one in self._exchanges if woken <= one.asked <= read]
        if not within:
            return 0, 0
        slowest = max(within, key=lambda one: min(one.end(read), read)).bus
        sums = [0, 0]
        asked: set[int] = set()
        for one in within:
            if one.bus != slowest:
                continue
            took = max(0, min(one.end(read), read) - one.asked)
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
        """Split what an exchange took beyond its plan."""
        blocked = min(one.blocked, beyond)
        self.shares[CauseName("write call", bus=one.bus)] += blocked
        beyond -= blocked
        if one.lacks is not None:
            end = one.end(read)
            heard = max(one.last, one.asked, min(one.planned_end, end))
            missed = min(max(end - heard, 0), beyond)
            self.shares[one.unanswered] += missed
            beyond -= missed
        late = min(max(one.last - one.planned_end - blocked, 0), beyond) if one.last else 0
        self.shares[CauseName("late reply", bus=one.bus)] += late
        self.shares[CauseName("unexplained")] += beyond - late

    def _writes(self, packets: PacketColumns) -> int:
        """Add the write() calls of goals; return what they took."""
        goals = (packets.kind == PacketKind.INSTRUCTION) & (packets.first_ns >= self._cycle["updated"])
        goals &= packets.last_ns <= self._cycle["written"]
        took = packets.last_ns - packets.first_ns
        for bus in np.unique(packets.bus[goals]).tolist():
            ns = int(took[goals & (packets.bus == bus)].sum())
            self.shares[CauseName("write call", bus=bus)] += ns
        return int(took[goals].sum())

    def _idle(self, before: np.void, late: int) -> int:
        """Add the exchange of the idle time that ended last behind the deadline; return what it has."""
        due = max(int(self._cycle["scheduled"]), int(before["written"]))
        over = [
            (min(one.end(one.planned_end + TIMEOUT_MARGIN_NS) - due, late), one)
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
            cause = CauseName("own work")  # it was begun too late
        self.shares[cause] += ns
        return ns


def _exchanges(found: Exchanges) -> Iterator[_Exchange]:
    """Yield the exchanges that ask servos."""
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
