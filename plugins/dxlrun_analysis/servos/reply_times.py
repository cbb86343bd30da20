"""Late replies: of a servo compared with the others of its bus, and of a whole bus compared with its plan.

A servo of a group read waits for the replies before its own. Its own time is the time from the end of the
preceding reply (for the first, of the instruction) to the end of its reply, less the wire time of its bytes.
It consists of its return delay and the time that adapter and host add. It is known only if replies arrive one
by one. Excluded are replies that were delivered together with a neighbour, replies after a missing one, and
fast status packets, which all servos of a bus share. Source of the order of replies: ROBOTIS e-Manual,
Protocol 2.0, Sync Read and Bulk Read.

Times common to all servos are attributed to the adapter, differences to the servos, so a servo is compared
with the others of its bus. Only replies of the same kind are compared: replies after others in a chain,
replies of a servo that was asked alone right after an exchange, and those after a rest of the line, when host
and adapter take longer. The first reply of a chain, and the first of each cycle, always come from the same
servo and include the wake-up of host, adapter and kernel. They are not compared.

A bus is judged late by its late exchanges without those of servos that are reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from dxlrun.tooling.output import counted, late_replies
from dxlrun_analysis.counts import Counts, median, quantile
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, ReplyKind
from dxlrun_analysis.servos.logged_requests import IDS, Flags, Numbers
from dxlrun_analysis.servos.losses import Losses
from dxlwire import BROADCAST_ID

_KINDS = len(ReplyKind) - 1  # Without NONE
_FEWEST = 20  # Replies from which a servo or a bus is judged
_ODD_US = 100  # Threshold for a servo: clocks of servos and hosts differ by some 10 us [i]
_MOST = 0.75  # Share of the replies that must be later
_FEWEST_LATE, _TIMES_MORE = 5, 10  # Late replies of a servo, and their ratio to those of all others
_CHANCE = 1e-3  # Probability that all late replies of a bus come from one servo by chance
_LATE_US = 300  # Threshold of a late reply over the usual time on its bus
_LONGEST_DELAY_US = 508  # Return Delay Time (5, 9) is at most 254 times 2 us
_STEADY_US = 60  # A return delay is constant; the delay of a busy servo is not [i]
_NEVER_NS = 1 << 62
_LATE_NS = 2_000_000  # Threshold of a late adapter over the planned latency
_LATE_SHARE = 0.1  # Share of its exchanges from which a bus is late

_Values = tuple[Numbers, Numbers]
"""Own times (see the module docstring) of a servo's replies of one kind: distinct values in us, ascending,
and the count of each."""


class ReplyTimes:
    """Accumulator of the own reply times of servos, and of late exchanges by bus, in constant memory."""

    def __init__(self, buses: int) -> None:
        self._own_us = Counts()
        self._late_us = Counts()  # Lateness of late exchanges, by the slowest servo of each
        self._given_up, self._single, self._single_late = np.zeros((3, buses * IDS), np.int64)
        """Counts by servo: late replies that were given up; exchanges with it alone; late ones of these."""
        self._exchanges = np.zeros(buses, np.int64)

    def add_exchanges(self, exchanges: Exchanges, complete: tuple[Numbers, Numbers], losses: Losses) -> None:
        """Add the replies of some exchanges; late exchanges are also added to `losses`.

        Args:
            exchanges: The exchanges.
            complete: The complete ones among them, and their delay: `exchanges.complete()`.
            losses: Receives the late exchanges.
        """
        replies, late, requests = exchanges.replies, exchanges.late, exchanges.requests
        self._exchanges += exchanges.times[:, requests.servos > 0].sum(axis=1)
        rows = np.flatnonzero(replies.kind != ReplyKind.NONE)
        own_us = replies.own_ns[rows] // 1000
        self._own_us.count_values(replies.servo[rows] * _KINDS + replies.kind[rows], own_us)
        # Replies that were given up count from the end of the preceding reply.
        rows = np.flatnonzero((late.exchange >= 0) & ~_in_time(exchanges))
        of, servo = late.exchange[rows], late.servo[rows]
        self._given_up += np.bincount(servo, minlength=len(self._given_up))
        begun_ns = exchanges.sent_ns.copy()
        if len(rows):
            np.maximum.at(begun_ns, replies.exchange[replies.answers], replies.last_ns[replies.answers])
        behind = requests.places[exchanges.request[of], servo % IDS] > 0
        alone = np.flatnonzero(servo % IDS != BROADCAST_ID)
        kind = np.where(behind, ReplyKind.CHAINED, exchanges.kind[of])[alone]
        own_us = (late.at_ns[rows] - begun_ns[of])[alone] // 1000
        self._own_us.count_values(servo[alone] * _KINDS + kind, own_us)
        self._take_late(exchanges, complete, (of, servo, late.late_ns[rows]), losses)

    def _take_late(
        self,
        exchanges: Exchanges,
        complete: tuple[Numbers, Numbers],
        given_up: tuple[Numbers, ...],
        losses: Losses,
    ) -> None:
        """Count exchanges that were late as a whole, each for the servo whose reply took longest.

        Args:
            exchanges: The exchanges.
            complete: The complete ones among them, and their delay.
            given_up: Exchange, servo and lateness (ns) of each late reply that was given up.
            losses: Receives the late exchanges.
        """
        replies = exchanges.replies
        whole, extra_ns = complete
        # Without a rate, the due time is unknown.
        limits = [bus.latency_ns + _LATE_NS if bus.baud_rate > 0 else _NEVER_NS for bus in exchanges.buses]
        late = extra_ns >= np.array(limits, np.int64)[exchanges.bus[whole]]
        whole, extra_ns = whole[late], extra_ns[late]
        answers = np.flatnonzero(replies.answers & np.isin(replies.exchange, whole))
        # Of equal exchanges, the last counts: the one with the slowest reply.
        of = replies.exchange[answers]
        order = np.lexsort((replies.own_ns[answers], of))
        slowest = answers[order][np.searchsorted(of, whole, side="right") - 1]
        lacks, first = np.unique(given_up[0], return_index=True)
        rows = np.append(whole, lacks)
        # Any servo of a fast status packet can be late.
        fast = exchanges.requests.fast[exchanges.request[whole]]
        of_any = exchanges.bus[whole] * IDS + BROADCAST_ID
        servo = np.append(np.where(fast, of_any, replies.servo[slowest]), given_up[1][first])
        single = rows[exchanges.requests.servos[exchanges.request[rows]] == 1]
        self._single += exchanges.count_first(exchanges.times, alone=True)
        self._single_late += np.bincount(exchanges.first_servos(single), minlength=len(self._single))
        self._late_us.count_values(servo, np.append(extra_ns, given_up[2][first]) // 1000)
        losses.late(servo // IDS, exchanges, rows)

    # Results

    def always_late(self) -> list[int]:
        """Return the indices of buses with at least half of their exchanges late."""
        return [bus for bus in range(len(self._exchanges)) if self._share(bus, set()) >= 1 / 2]

    def longest_ms(self) -> float:
        """Return the greatest lateness of any exchange of the run, ms."""
        return max(
            (self._late_us.counts_of(group)[0][-1] / 1e3 for group in self._late_us.groups), default=0.0
        )

    def servos(self, index: int, bus: LoggedBus, *, now_and_then: bool) -> Iterator[Finding]:
        """Report servos of one bus that always answer later than its others; with `now_and_then`, also
        those that do so at times."""
        samples: dict[int, dict[int, _Values]] = {}
        for group in self._own_us.groups:
            servo, kind = divmod(group, _KINDS)
            if servo // IDS == index and kind != ReplyKind.FIRST:
                samples.setdefault(servo % IDS, {})[kind] = self._own_us.counts_of(group)
        return _slow_servos(bus, samples, now_and_then=now_and_then)

    def line(self, index: int, bus: LoggedBus, slow: Iterable[str]) -> Iterator[Finding]:
        """Report a bus whose exchanges are late; those of the servos named in `slow` do not count."""
        of_servos = {servo for servo, name in bus.names.items() if name in set(slow)}
        of_servos |= {BROADCAST_ID} if of_servos else set()
        ids = slice(index * IDS, (index + 1) * IDS)
        given_up = int(self._given_up[ids].sum() - sum(self._given_up[ids][servo] for servo in of_servos))
        share = self._share(index, of_servos)
        if share < _LATE_SHARE and given_up < _FEWEST_LATE:
            return
        # A late adapter delays the replies of any servo that is asked alone.
        single, late = self._single[ids], self._single_late[ids]
        others = np.arange(IDS) != np.argmax(late)
        if late[others].sum() < share * single[others].sum() / _TIMES_MORE - 1:
            return
        late_us = median(*self._late(index, of_servos))
        what, fix = late_replies(bus.name, bus.port, late_us * 1e3, float(bus.latency_ns))
        after = f", {given_up} of them after the timeout" if given_up else ""
        sentence = f"{what[0].upper()}{what[1:]}: {share:.0%} of its exchanges{after}."
        yield cause("late_replies", bus.name, sentence, f"{fix}." if fix else "", share)

    def _late(self, index: int, without: set[int]) -> _Values:
        """Return the lateness of a bus' exchanges, us, ascending, with counts."""
        parts = [
            self._late_us.counts_of(group)
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


def _in_time(exchanges: Exchanges) -> Flags:
    """Return which of the late replies took no longer than the slowest timely reply to the same request.

    They were given up for another reason, such as lost bytes before them.
    """
    replies, late = exchanges.replies, exchanges.late
    if not len(late.exchange):
        return np.zeros(0, np.bool_)
    of = replies.exchange[replies.answers]
    longest_ns = np.zeros(len(exchanges.requests.kinds), np.int64)
    took_ns = replies.last_ns[replies.answers] - exchanges.sent_ns[of]
    np.maximum.at(longest_ns, exchanges.request[of], took_ns)
    in_time: Flags = late.late_ns <= longest_ns[exchanges.request[late.exchange]]
    return in_time & (late.exchange >= 0)


def _slow_servos(
    bus: LoggedBus, samples: dict[int, dict[int, _Values]], *, now_and_then: bool
) -> Iterator[Finding]:
    """Report servos that answer later than the others of their bus.

    A servo is reported if it is always later, in each kind of reply that it shares with others, or if it has
    nearly all late replies of the bus. Otherwise the log does not show which servo is slow.

    Args:
        bus: The bus.
        samples: Own times by ID and kind of reply.
        now_and_then: Also report servos that are late at times.
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
                f"{named} sometimes answers late: {mine} of {asked} times, by up to {latest:.1f} ms; other "
                f"servos of its bus: {counted(theirs, 'time', 'times')}."
            )
            yield cause("slow_servo", name, seen, share=mine / asked)


def _usual(others: list[_Values]) -> float:
    """Return the median of the servos' median own times, us."""
    return float(np.median([median(*each) for each in others]))


def _always_later(own: _Values, others: list[_Values]) -> bool:
    """Return whether a servo's replies are later than those of the others by 100 us in the median, and
    three quarters of them later than three quarters of the others'."""
    late = float(np.median([quantile(*each, _MOST) for each in others]))
    return median(*own) - _usual(others) >= _ODD_US and quantile(*own, 1 - _MOST) > late


def _late_servo(bus: LoggedBus, servo_id: int, own: _Values, usual_us: float) -> Iterator[Finding]:
    planned_us = bus.return_delay_ns / 1e3
    # Exclude the time that adapter and host add to every reply.
    delay_us = median(*own) - max(0.0, usual_us - planned_us)
    steady = quantile(*own, 0.9) - quantile(*own, 0.1) <= _STEADY_US
    if steady and delay_us - planned_us < _ODD_US:
        return  # The others answer sooner than planned
    name, named = bus.called(servo_id)
    command = ""
    seen = f"{named} answers {median(*own) - usual_us:.0f} us later than the other servos of its bus"
    if steady and delay_us <= _LONGEST_DELAY_US + _STEADY_US:
        seen += f"; its Return Delay Time is {delay_us:.0f} us instead of {planned_us:g} us"
        command = f"`dxlrun servo {bus.port or 'PORT'} {servo_id} set return_delay_time {planned_us / 2:.0f}`"
        command += " corrects it."
    yield cause("slow_servo", name, f"{seen}.", command)


def _late(times: _Values, others: list[_Values]) -> int:
    values, counts = times
    return int(counts[values > _usual(others) + _LATE_US].sum())
