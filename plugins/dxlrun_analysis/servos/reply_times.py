"""Late replies: of a servo beside the others of its bus, and of a whole bus beside its plan.

A servo of a group read waits for the replies before its own: from the end of the reply before it (of the
instruction, for the first) until its own ended, less the time of its bytes on the wire, is its own time: its
return delay, and what adapter and host add. It is known where replies come one by one; those that were handed
over together with the one before or behind, and those behind a reply that is missing, are left out, and so
are fast status packets, which all servos of a bus share. Source of the order of replies: ROBOTIS e-Manual,
Protocol 2.0, Sync Read and Bulk Read.

What differs from servo to servo is the servos', what all have in common the adapter's: a servo is compared
with the others of its bus. Only like is compared with like: replies behind others in a chain, replies of a
servo that was asked alone right behind an exchange, and those after a rest of the line, when host and adapter
take longer. The first reply of a chain, and the first of each cycle, are always those of the same servo, and
have what wakes host, adapter and kernel in them: they are compared with none.

A bus is late by those late exchanges that are not of a servo that is named.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from dxlrun.tooling.output import counted, late_replies
from dxlrun_analysis.counts import Counts, median, quantile
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.losses import Losses
from dxlrun_analysis.servos.requests import IDS, Flags, Numbers
from dxlwire import BROADCAST_ID

_KINDS = _CHAINED, _FIRST, _RESTED, _NEXT = range(4)
"""Of replies: behind others in a chain; first of a chain or of a cycle, and compared with none; asked alone
after a rest of the line, or right behind an exchange."""
_REST_NS = 1_000_000
_FEWEST = 20  # Replies from which a servo or a bus is judged
_ODD_US = 100  # A servo differs from the others by more: clocks of servos and hosts do by some 10 us [i]
_MOST = 0.75
_FEWEST_LATE, _TIMES_MORE = 5, 10  # Late replies of a servo, and so many times as all others have, and
_CHANCE = 1e-3  # so seldom all late replies of a bus would be of one servo if any could be late
_LATE_US = 300  # A reply that comes so much later than usual on its bus is a late one
_LONGEST_DELAY_US = 508  # Return Delay Time (5, 9) is at most 254 times 2 us
_STEADY_US = 60  # A return delay is always the same; a servo that is busy is not [i]
_LATE_NS = 2_000_000  # An adapter that adds so much more than the plan expects is late
_LATE_SHARE = 0.1  # Of the exchanges of a bus, from which it is late

_Values = tuple[Numbers, Numbers]
"""Own times of replies of one kind, us, ascending, and how often each was seen."""


class ReplyTimes:
    """Collects the own times of replies, and late exchanges, in memory that does not grow with the log."""

    def __init__(self, buses: int) -> None:
        self._own_us = Counts()
        self._late_us = Counts()  # Of late exchanges, by the servo that was late in each
        self._given_up, self._single, self._single_late = np.zeros((3, buses * IDS), np.int64)
        """Of each servo late replies that were given up; exchanges with it alone, and late ones of these."""
        self._exchanges = np.zeros(buses, np.int64)

    def take(self, exchanges: Exchanges, losses: Losses) -> None:
        """Take the replies of some exchanges; `losses` is told which were late."""
        replies, late = exchanges.replies, exchanges.late
        count, requests = len(replies.exchange), exchanges.requests
        self._exchanges += np.bincount(
            exchanges.bus[requests.servos[exchanges.request] > 0], minlength=len(self._exchanges)
        )
        first = np.flatnonzero(np.diff(replies.exchange, prepend=-1))
        number = np.arange(count) - np.repeat(first, np.diff(np.append(first, count)))
        own_ns = replies.last_ns - replies.before_ns - replies.wire_ns
        asked = np.where(requests.fast, 0, requests.servos)[exchanges.request]
        kinds = np.where(asked == 1, np.where(_rested(exchanges), _RESTED, _NEXT), _FIRST)
        kinds[np.diff(exchanges.cycle, prepend=-2) != 0] = _FIRST
        together = (number > 0) & (own_ns < -(replies.wire_ns // 2))
        followed = np.append(together[1:], False) if count else together
        in_turn = replies.answers & (replies.place == number)
        known = np.flatnonzero(in_turn & (asked[replies.exchange] > 0) & ~together & ~followed)
        kind = np.where(number[known] == 0, kinds[replies.exchange[known]], _CHAINED)
        self._own_us.take(replies.servo[known] * len(_KINDS) + kind, own_ns[known] // 1000)
        # those that were given up count with the time of the reply before them
        rows = np.flatnonzero((late.exchange >= 0) & ~_in_time(exchanges))
        of, servo = late.exchange[rows], late.servo[rows]
        self._given_up += np.bincount(servo, minlength=len(self._given_up))
        begun_ns = exchanges.sent_ns.copy()
        np.maximum.at(begun_ns, replies.exchange[replies.answers], replies.last_ns[replies.answers])
        behind = requests.places[exchanges.request[of], servo % IDS] > 0
        alone = np.flatnonzero(servo % IDS != BROADCAST_ID)
        kind = np.where(behind, _CHAINED, kinds[of])[alone]
        own_us = (late.at_ns[rows] - begun_ns[of])[alone] // 1000
        self._own_us.take(servo[alone] * len(_KINDS) + kind, own_us)
        self._take_late(exchanges, own_ns, (of, servo, late.late_ns[rows]), losses)

    def _take_late(
        self, exchanges: Exchanges, own_ns: Numbers, given_up: tuple[Numbers, ...], losses: Losses
    ) -> None:
        """Count exchanges that were late as a whole, and the servo whose reply took longest in each."""
        replies, count = exchanges.replies, len(exchanges.request)
        due = exchanges.requests.servos[exchanges.request]
        answers = np.flatnonzero(replies.answers)
        of = replies.exchange[answers]
        order = np.lexsort((own_ns[answers], of))
        last, slowest = np.full((2, count), -1, np.int64)
        last[of], slowest[of[order]] = answers, answers[order]
        # without a rate it is not known when they are due
        whole = np.flatnonzero((np.bincount(of, minlength=count) == due) & (due > 0))
        whole = whole[np.array([bus.baud_rate > 0 for bus in exchanges.buses])[exchanges.bus[whole]]]
        extra_ns = replies.last_ns[last[whole]] - replies.due_ns[last[whole]]
        limits = np.array([bus.latency_ns + _LATE_NS for bus in exchanges.buses], np.int64)
        whole, extra_ns = (each[extra_ns >= limits[exchanges.bus[whole]]] for each in (whole, extra_ns))
        lacks, first = np.unique(given_up[0], return_index=True)
        rows = np.append(whole, lacks)
        fast = exchanges.requests.fast[exchanges.request[whole]]  # they may be of any
        of_any = exchanges.bus[whole] * IDS + BROADCAST_ID
        servo = np.append(np.where(fast, of_any, replies.servo[slowest[whole]]), given_up[1][first])
        single = due == 1
        asked = exchanges.bus * IDS + exchanges.requests.ids[exchanges.request, -1]
        for counts, at in ((self._single, np.flatnonzero(single)), (self._single_late, rows[single[rows]])):
            np.add(counts, np.bincount(asked[at], minlength=len(counts)), out=counts)
        self._late_us.take(servo, np.append(extra_ns, given_up[2][first]) // 1000)
        losses.late(servo // IDS, exchanges, rows)

    # Results

    def always_late(self) -> list[int]:
        """Return buses of which half of the exchanges are late: that is no occasion."""
        return [bus for bus in range(len(self._exchanges)) if self._share(bus, set()) >= 1 / 2]

    def longest_ms(self) -> float:
        """Return how late any reply came."""
        return max((self._late_us.of(group)[0][-1] / 1e3 for group in self._late_us.groups), default=0.0)

    def servos(self, index: int, bus: LoggedBus, *, now_and_then: bool) -> Iterator[Finding]:
        """Name servos that answer later than the others of their bus: always, or also now and then."""
        samples: dict[int, dict[int, _Values]] = {}
        for group in self._own_us.groups:
            servo, kind = divmod(group, len(_KINDS))
            if servo // IDS == index and kind != _FIRST:
                samples.setdefault(servo % IDS, {})[kind] = self._own_us.of(group)
        return _slow_servos(bus, samples, now_and_then=now_and_then)

    def line(self, index: int, bus: LoggedBus, slow: Iterable[str]) -> Iterator[Finding]:
        """Name a bus whose replies are late; `slow`: names of its servos that are named."""
        of_servos = {servo for servo, name in bus.names.items() if name in set(slow)}
        of_servos |= {BROADCAST_ID} if of_servos else set()
        ids = slice(index * IDS, (index + 1) * IDS)
        given_up = int(self._given_up[ids].sum() - sum(self._given_up[ids][servo] for servo in of_servos))
        share = self._share(index, of_servos)
        if share < _LATE_SHARE and given_up < _FEWEST_LATE:
            return
        # an adapter is late with replies of single servos, too, whichever it is
        single, late = self._single[ids], self._single_late[ids]
        others = np.arange(IDS) != np.argmax(late)
        if late[others].sum() < share * single[others].sum() / _TIMES_MORE - 1:
            return
        late_us = median(*self._late(index, of_servos))
        what, fix = late_replies(bus.name, bus.port, late_us * 1e3, float(bus.latency_ns))
        after = f", {given_up} of them after they were given up" if given_up else ""
        sentence = f"{what[0].upper()}{what[1:]}: {share:.0%} of its exchanges{after}."
        yield cause("late_replies", bus.name, sentence, f"{fix}." if fix else "", share)

    def _late(self, index: int, without: set[int]) -> _Values:
        """Return how late the exchanges of a bus were, us, ascending."""
        parts = [
            self._late_us.of(group)
            for group in self._late_us.groups
            if group // IDS == index and group % IDS not in without
        ]
        values, counts = (np.concatenate(each) for each in zip(*parts, strict=True)) if parts else _NOTHING
        order = np.argsort(values, kind="stable")
        return values[order], counts[order]

    def _share(self, index: int, without: set[int]) -> float:
        total, late = int(self._exchanges[index]), int(self._late(index, without)[1].sum())
        return late / total if total >= _FEWEST else 0.0


_NOTHING: _Values = (np.zeros(0, np.int64), np.zeros(0, np.int64))


def _rested(exchanges: Exchanges) -> Flags:
    """Return before which exchanges the line had carried nothing for a while, shape (exchanges,)."""
    found = np.ones(len(exchanges.bus), np.bool_)
    found[1:] = exchanges.asked_ns[1:] - exchanges.last_ns[:-1] > _REST_NS
    return found


def _in_time(exchanges: Exchanges) -> Flags:
    """Return which late replies came no later than others were awaited to the same request.

    They were given up for another reason, such as bytes that the line lost before them.
    """
    replies, late = exchanges.replies, exchanges.late
    of = replies.exchange[replies.answers]
    longest_ns = np.zeros(len(exchanges.requests.kinds), np.int64)
    took_ns = replies.last_ns[replies.answers] - exchanges.sent_ns[of]
    np.maximum.at(longest_ns, exchanges.request[of], took_ns)
    in_time: Flags = late.late_ns <= longest_ns[exchanges.request[late.exchange]]
    return in_time & (late.exchange >= 0)


def _slow_servos(
    bus: LoggedBus, samples: dict[int, dict[int, _Values]], *, now_and_then: bool
) -> Iterator[Finding]:
    """Name servos that answer later than the others of their bus; `samples`: by ID and kind of reply.

    One is always later, in each kind of reply that they share; or it has the late replies of the bus almost
    alone. Where neither holds, the log does not show whose they are.
    """
    for servo_id, kinds in samples.items():
        others = {
            kind: [each[kind] for of, each in samples.items() if of != servo_id and kind in each]
            for kind in kinds
        }
        shared = {kind: rest for kind, rest in others.items() if rest}
        enough = {kind: rest for kind, rest in shared.items() if kinds[kind][1].sum() >= _FEWEST}
        if enough and all(_always_later(kinds[kind], rest) for kind, rest in enough.items()):
            most = max(enough, key=lambda kind: int(kinds[kind][1].sum()))
            yield from _late_servo(bus, servo_id, kinds[most], _usual(enough[most]))
            continue
        late = {kind: _late(kinds[kind], rest) for kind, rest in shared.items()}
        theirs = sum(_late(each, rest) for rest in shared.values() for each in rest)
        asked, mine = (int(sum(each)) for each in ((kinds[kind][1].sum() for kind in shared), late.values()))
        in_all = asked + int(sum(each[1].sum() for rest in shared.values() for each in rest))
        by_chance = len(samples) * (asked / max(in_all, 1)) ** mine
        told = now_and_then and all(late[kind] for kind in enough)
        if told and mine >= max(_FEWEST_LATE, _TIMES_MORE * theirs) and by_chance < _CHANCE:
            name, named = bus.called(servo_id)
            latest = max(int(kinds[kind][0][-1]) for kind in shared) / 1e3
            seen = (
                f"{named} answers late now and then: {mine} of {asked} times, by up to {latest:.1f} ms; the "
            )
            seen += f"others of its bus {counted(theirs, 'time', 'times')}."
            yield cause("slow_servo", name, seen, share=mine / asked)


def _usual(others: list[_Values]) -> float:
    """Return the median of what some servos need, us."""
    return float(np.median([median(*each) for each in others]))


def _always_later(own: _Values, others: list[_Values]) -> bool:
    """Return whether three quarters of its replies are later than three quarters of those of the others."""
    late = float(np.median([quantile(*each, _MOST) for each in others]))
    return median(*own) - _usual(others) >= _ODD_US and quantile(*own, 1 - _MOST) > late


def _late_servo(bus: LoggedBus, servo_id: int, own: _Values, usual_us: float) -> Iterator[Finding]:
    planned_us = bus.return_delay_ns / 1e3
    # what adapter and host add to every reply is not this servo's
    delay_us = median(*own) - max(0.0, usual_us - planned_us)
    steady = quantile(*own, 0.9) - quantile(*own, 0.1) <= _STEADY_US
    if steady and delay_us - planned_us < _ODD_US:
        return  # the others answer sooner than planned
    name, named = bus.called(servo_id)
    seen, command = f"{named} answers {median(*own) - usual_us:.0f} us later than the others of its bus", ""
    if steady and delay_us <= _LONGEST_DELAY_US + _STEADY_US:
        seen += f", always: its Return Delay Time is {delay_us:.0f} us, and {planned_us:g} us were planned"
        command = f"`dxlrun servo {bus.port or 'PORT'} {servo_id} set return_delay_time {planned_us / 2:.0f}`"
        command += " corrects it."
    yield cause("slow_servo", name, f"{seen}.", command)


def _late(times: _Values, others: list[_Values]) -> int:
    values, counts = times
    return int(counts[values > _usual(others) + _LATE_US].sum())
