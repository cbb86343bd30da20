"""Reply times of each servo, its own part: what wire, the adapter and the servos before it do not explain.

A servo of a group read waits for the replies before its own: from the end of the reply before it (of the
instruction, for the first) until its own ended, less the time of its bytes on the wire, is its own time: its
return delay, and what adapter and host add. It is known where replies come one by one; those that were handed
over together with the one before or behind, and those behind a reply that is missing, are left out, and so
are fast status packets, which all servos of a bus share. Source of the order of replies: ROBOTIS e-Manual,
Protocol 2.0, Sync Read and Bulk Read.

What differs from servo to servo is the servos', what all have in common the adapter's: a servo is compared
with the median of the others of its bus. Only like is compared with like: replies behind others in a chain,
replies of a servo that was asked alone right behind an exchange, and those after a rest of the line, when
host and adapter take longer. The first reply of a chain, and the first of each cycle, are always those of the
same servo, and have what wakes host, adapter and kernel in them: they are compared with none.

Where a servo is late only at some angles of its joint, or only when it is hot, it is compared with itself
elsewhere, and then the latest of the other servos in the same cycles has to stay as it is elsewhere: what a
busy machine or the adapter makes late is late for them, too. Replies that were given up count there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dxlrun.errors import counted
from dxlrun.plan.transaction import BROADCAST_ID
from dxlrun_analysis.counts import Counts, has_them_alone, median, quantile
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.joint_states import ANGLES, PLACES, JointStates, Places, edge_rad
from dxlrun_analysis.servos.requests import IDS, Flags, Numbers

_KINDS = _CHAINED, _FIRST, _RESTED, _NEXT = range(4)
"""Of replies: behind others in a chain; first of a chain or of a cycle, and compared with none; asked alone
after a rest of the line, or right behind an exchange."""
_REST_NS = 1_000_000
EDGES_US = (0, 50, 100, 200, 300, 400, 500, 600, 800, 1000, 1500, 2000, 4000, 8000, 16_000, 32_000)
"""Lower edges of the bins of a histogram; what is less than nothing is in the first."""
_FEWEST = 20  # Replies from which a servo is judged
_ODD_US = 100  # A servo differs from the others by more: clocks of servos and hosts do by some 10 us [i]
_MOST = 0.75
_LATE_US = 300  # A reply that comes so much later than usual on its bus is a late one
_LONGEST_DELAY_US = 508  # Return Delay Time (5, 9) is at most 254 times 2 us
_STEADY_US = 60  # A return delay is always the same; a servo that is busy is not [i]
_GRAIN_US, _LONGEST_US = 20, 32_000  # Times by place are kept in such steps, up to this one
_FEW = 5  # Replies from which a place may be the end of such a range
_SPREADS = 3  # So many times the spread of its replies elsewhere those of a place are later
_STAYS = 0.25  # Part of that by which the others may be later with it
_LEAST_NS = 500_000_000  # So long a joint has to be there, and elsewhere
_CROSSINGS = 4  # So often it has to come there or leave: once may be a moment, and not an angle
_HOT = ANGLES + 45  # From 45 deg C on a servo may be late because it is hot: at rest most have 30 to 40 [i]


@dataclass(frozen=True, slots=True)
class ReplyTime:
    """One servo's own part of its reply times."""

    replies: int  # Those of which it is known
    median_us: float
    p99_us: float
    planned_us: float  # The return delay that the plan assumes
    histogram: tuple[int, ...]  # Replies by bins that begin at EDGES_US
    by_angle: tuple[tuple[float, float], ...] = ()
    """Lower edge of each bin of the servo's angles, deg, and the median there, us."""
    by_temperature: tuple[tuple[float, float], ...] = ()  # The same by deg C


_Values = tuple[Numbers, Numbers]
"""Own times of replies of one kind, us, ascending, and how often each was seen."""
_NOTHING: _Values = (np.zeros(0, np.int64), np.zeros(0, np.int64))


class ReplyTimes:
    """Collects the own times of replies, in memory that does not grow with the log."""

    def __init__(self, states: JointStates) -> None:
        self._own_us, self._own_at_us, self._others_at_us = Counts(), Counts(), Counts()
        """The last two by place of the servo's joint: its own, and the latest of the others then."""
        self._states = states

    def take(self, exchanges: Exchanges, places: Places) -> None:
        """Take the replies of some exchanges; `places`: of the joints in their cycles."""
        replies = exchanges.replies
        count = len(replies.exchange)
        if not count:
            return
        requests = exchanges.requests
        asked = np.where(requests.fast, 0, requests.servos)[exchanges.request]
        first = np.flatnonzero(np.diff(replies.exchange, prepend=-1))
        number = np.arange(count) - np.repeat(first, np.diff(np.append(first, count)))
        own_ns = replies.last_ns - replies.before_ns - replies.wire_ns
        together = (number > 0) & (own_ns < -(replies.wire_ns // 2))
        followed = np.append(together[1:], False)
        in_turn = replies.answers & (replies.place == number)
        known = np.flatnonzero(in_turn & (asked[replies.exchange] > 0) & ~together & ~followed)
        of, servo = replies.exchange[known], replies.servo[known]
        kinds = np.where(asked == 1, np.where(rested(exchanges), _RESTED, _NEXT), _FIRST)
        kinds[_first_of_cycle(exchanges)] = _FIRST
        kind = np.where(number[known] == 0, kinds[of], _CHAINED)
        self._own_us.take(servo * len(_KINDS) + kind, own_ns[known] // 1000)
        late = exchanges.late
        given_up = np.flatnonzero((late.exchange >= 0) & (late.servo % IDS != BROADCAST_ID))
        lacks, by = late.exchange[given_up], late.servo[given_up]
        begun_ns = exchanges.sent_ns
        if len(lacks):
            begun_ns = begun_ns.copy()
            np.maximum.at(begun_ns, replies.exchange[replies.answers], replies.last_ns[replies.answers])
        behind = requests.places[exchanges.request[lacks], by % IDS] > 0
        self._take_places(
            exchanges.cycle[np.append(of, lacks)],
            np.append(servo, by),
            np.append(kind, np.where(behind, _CHAINED, kinds[lacks])),
            np.append(own_ns[known], late.at_ns[given_up] - begun_ns[lacks]) // 1000,
            places,
        )

    def _take_places(
        self, cycle: Numbers, servo: Numbers, kind: Numbers, own_us: Numbers, places: Places
    ) -> None:
        """Count the replies of some cycles, and the latest of the others, where their joints were."""
        compared = np.flatnonzero(kind != _FIRST)
        cycle, servo, kind, own_us = (each[compared] for each in (cycle, servo, kind, own_us))
        like = (cycle * len(self._states.joint_of) + servo // IDS) * len(_KINDS) + kind
        order = np.lexsort((own_us, like))
        ends = np.searchsorted(like[order], like, side="right") - 1
        last, second = order[ends], order[ends - 1]
        latest = np.where(last == np.arange(len(like)), second, last)
        row = np.minimum(np.searchsorted(places.cycle, cycle), max(0, len(places.cycle) - 1))
        joint = self._states.joint_of[servo] if len(places.cycle) else np.full(len(servo), -1)
        usable = (like[latest] == like) & (latest != np.arange(len(like))) & (joint >= 0)
        usable[usable] = places.cycle[row[usable]] == cycle[usable]
        for column in (places.angle, places.temperature):
            at = np.full(len(servo), -1, np.int64)
            at[usable] = column[row[usable], joint[usable]]
            rows = np.flatnonzero(at >= 0)
            group = (servo[rows] * len(_KINDS) + kind[rows]) * PLACES + at[rows]
            for counts, times in ((self._own_at_us, own_us), (self._others_at_us, own_us[latest])):
                grained = np.clip(times[rows], 0, _LONGEST_US) // _GRAIN_US * _GRAIN_US
                counts.take(group, grained)

    def finish(self, buses: tuple[LoggedBus, ...]) -> dict[tuple[int, int], ReplyTime]:
        """Return the times of each servo by index of the bus and ID."""
        places = self._places()
        servos = sorted({group // len(_KINDS) for group in self._own_us.groups})
        return {
            divmod(each, IDS): self._time(each, buses[each // IDS], *places.get(each, (0, [])))
            for each in servos
        }

    def findings(self, index: int, bus: LoggedBus) -> Iterable[Finding]:
        """Name servos that answer later than the others of their bus and than the plan assumes."""
        samples: dict[int, dict[int, _Values]] = {}
        for group in self._own_us.groups:
            servo, kind = divmod(group, len(_KINDS))
            values = self._own_us.of(group)
            if servo // IDS == index and kind != _FIRST and values[1].sum() >= _FEWEST:
                samples.setdefault(servo % IDS, {})[kind] = values
        yield from _slow_servos(bus, samples)

    def somewhere(self, index: int, bus: LoggedBus) -> Iterable[Finding]:
        """Name servos that answer later at some angles of their joint, or when hot, than elsewhere."""
        for servo, (kind, places) in self._places().items():
            if servo // IDS != index:
                continue
            angles = self._later(servo, kind, [at for at in places if at < ANGLES])
            heat = self._later(servo, kind, [at for at in places if at >= ANGLES])
            causes = []
            if angles is not None:
                first, last, _, _ = angles
                causes.append(self._states.range_text(servo, edge_rad(first), edge_rad(last + 1)))
            if heat is not None:
                causes.append(f"from {heat[0] - ANGLES} deg C on")
            later = angles or heat
            if later is None:
                continue
            doubt = "; the log does not show which of the two it is" if len(causes) > 1 else ""
            seen = f"answers {later[2]:.0f} us later {' or '.join(causes)} than elsewhere, while the other "
            seen += f"servos of its bus do not{doubt}"
            fix = f"Check its cable, its supply and its load there{', and let it cool' if heat else ''}."
            yield slow_servo(bus, servo % IDS, seen, later[3], fix)

    def _places(self) -> dict[int, tuple[int, list[int]]]:
        """Return of which kind most of a servo's replies are, and at which places it had such."""
        found: dict[int, dict[int, list[int]]] = {}
        for group in self._own_at_us.groups:
            of, place = divmod(group, PLACES)
            servo, kind = divmod(of, len(_KINDS))
            found.setdefault(servo, {}).setdefault(kind, []).append(place)
        return {
            servo: max(kinds.items(), key=lambda one: int(self._at(servo, *one)[1].sum()))
            for servo, kinds in found.items()
        }

    def _at(self, servo: int, kind: int, places: Iterable[int], *, others: bool = False) -> _Values:
        """Return a servo's own times at some places, ascending, or the latest of the others then."""
        counts = self._others_at_us if others else self._own_at_us
        return _joined(counts.of((servo * len(_KINDS) + kind) * PLACES + place) for place in places)

    def _later(self, servo: int, kind: int, places: list[int]) -> tuple[int, int, float, float] | None:
        """Return the first and last place where a servo is later than elsewhere, by how much, us, and the
        share of its replies there; None: there is none.
        """
        if not places:
            return None
        usual_us = quantile(*self._at(servo, kind, places), 1 - _MOST)
        each = {at: self._at(servo, kind, [at]) for at in places}
        late = [
            at
            for at, (times, counts) in each.items()
            if counts.sum() >= _FEW and median(times, counts) > usual_us + _LATE_US
        ]
        if not late:
            return None
        first, last = late[0], late[-1]
        hot = first >= ANGLES
        last = places[-1] if hot else last
        inside = [at for at in places if first <= at <= last]
        outside = [at for at in places if not first <= at <= last]
        joint = self._states.joint_of[servo]
        time_ns, crossed = self._states.time_ns[joint], self._states.crossed[joint]
        moments = first >= _HOT if hot else crossed[first] + crossed[last + 1] >= _CROSSINGS
        spent = min(int(time_ns[part].sum()) for part in (inside, outside))
        own, elsewhere = self._at(servo, kind, inside), self._at(servo, kind, outside)
        if not moments or spent < _LEAST_NS or min(own[1].sum(), elsewhere[1].sum()) < _FEWEST:
            return None
        later_us = median(*own) - median(*elsewhere)
        spread = quantile(*elsewhere, _MOST) - quantile(*elsewhere, 1 - _MOST)
        theirs, usual = (self._at(servo, kind, part, others=True) for part in (inside, outside))
        stay = median(*theirs) - median(*usual) <= _STAYS * later_us
        if later_us <= max(_LATE_US, _SPREADS * spread) or not stay:
            return None
        return first, last, later_us, float(own[1].sum() / (own[1].sum() + elsewhere[1].sum()))

    def _time(self, servo: int, plan: LoggedBus, kind: int, places: list[int]) -> ReplyTime:
        medians = [(at, median(*self._at(servo, kind, [at]))) for at in places]
        values, counts = _joined(self._own_us.of(servo * len(_KINDS) + each) for each in _KINDS)
        bins = np.searchsorted(EDGES_US, np.maximum(values, 0), side="right") - 1
        return ReplyTime(
            replies=int(counts.sum()),
            median_us=median(values, counts),
            p99_us=quantile(values, counts, 0.99),
            planned_us=plan.return_delay_ns / 1e3,
            histogram=tuple(np.bincount(bins, counts, len(EDGES_US)).astype(int).tolist()),
            by_angle=tuple((math.degrees(edge_rad(at)), us) for at, us in medians if at < ANGLES),
            by_temperature=tuple((float(at - ANGLES), us) for at, us in medians if at >= ANGLES),
        )


def _joined(parts: Iterable[_Values]) -> _Values:
    """Return the values of several groups, ascending, and how often each was seen."""
    values, counts = (np.concatenate(column) for column in zip(_NOTHING, *parts, strict=True))
    order = np.argsort(values, kind="stable")
    return values[order], counts[order]


def rested(exchanges: Exchanges) -> Flags:
    """Return before which exchanges the line had carried nothing for a while, shape (exchanges,)."""
    found = np.ones(len(exchanges.bus), np.bool_)
    found[1:] = exchanges.asked_ns[1:] - exchanges.last_ns[:-1] > _REST_NS
    return found


def _first_of_cycle(exchanges: Exchanges) -> Flags:
    """Return which exchanges are the first of their bus in a cycle."""
    first = np.ones(len(exchanges.cycle), np.bool_)
    first[1:] = exchanges.cycle[1:] != exchanges.cycle[:-1]
    return first


def _slow_servos(bus: LoggedBus, samples: dict[int, dict[int, _Values]]) -> Iterable[Finding]:
    """Name servos that answer later than the others of their bus; `samples`: by ID and kind of reply.

    One that is always later in each kind of reply that they share: up to what Return Delay Time can be, and
    always the same, it is taken for that. One that has the late replies of the
    bus almost alone is late now and then. Where neither holds, the log does not show whose they are.
    """
    for servo_id, kinds in samples.items():
        rest = {
            kind: [each[kind] for of, each in samples.items() if of != servo_id and kind in each]
            for kind in kinds
        }
        shared = {kind: others for kind, others in rest.items() if others}
        found = [_always_later(kinds[kind], others) for kind, others in shared.items()]
        if shared and all(found):
            most = max(shared, key=lambda kind: int(kinds[kind][1].sum()))
            yield from _late_servo(bus, servo_id, kinds[most], _usual(shared[most]))
        elif shared:
            yield from _now_and_then(bus, servo_id, kinds, shared)


def slow_servo(
    bus: LoggedBus,
    servo_id: int,
    seen: str,
    share: float = 1.0,
    remedy: str = "Check its supply, its firmware and what else it does; exchange it where nothing helps.",
) -> Finding:
    """Return the finding about a servo whose replies are late; `seen`: what it does, behind its name."""
    name, named = bus.called(servo_id)
    return cause("slow_servo", name, f"{named} {seen}.", remedy, share)


def _usual(others: list[_Values]) -> float:
    """Return the median of what some servos need, us."""
    return float(np.median([median(*each) for each in others]))


def _always_later(own: _Values, others: list[_Values]) -> bool:
    """Return whether three quarters of its replies are later than three quarters of those of the others."""
    late = float(np.median([quantile(*each, _MOST) for each in others]))
    return median(*own) - _usual(others) >= _ODD_US and quantile(*own, 1 - _MOST) > late


def _late_servo(bus: LoggedBus, servo_id: int, own: _Values, usual_us: float) -> Iterable[Finding]:
    planned_us = bus.return_delay_ns / 1e3
    # what adapter and host add to every reply is not this servo's
    delay_us = median(*own) - max(0.0, usual_us - planned_us)
    steady = quantile(*own, 0.9) - quantile(*own, 0.1) <= _STEADY_US
    if steady and delay_us - planned_us < _ODD_US:
        return  # the others answer sooner than planned
    if steady and delay_us <= _LONGEST_DELAY_US + _STEADY_US:
        name, named = bus.called(servo_id)
        command = (
            f"`dxlrun servo {bus.port or 'PORT'} {servo_id} set return_delay_time {round(planned_us / 2)}`"
        )
        yield cause(
            "return_delay",
            name,
            f"{named} answers after {delay_us:.0f} us, and {planned_us:g} us were planned: its Return Delay "
            "Time is another.",
            f"{command} corrects it.",
        )
        return
    seen = f"answers {median(*own) - usual_us:.0f} us later than the other servos of its bus, which need "
    yield slow_servo(bus, servo_id, f"{seen}{usual_us:.0f} us beside their bytes")


def _now_and_then(
    bus: LoggedBus, servo_id: int, kinds: dict[int, _Values], shared: dict[int, list[_Values]]
) -> Iterable[Finding]:
    own = {kind: _late(kinds[kind], others) for kind, others in shared.items()}
    rest = {kind: sum(_late(each, others) for each in others) for kind, others in shared.items()}
    mine, theirs = sum(own.values()), sum(rest.values())
    if has_them_alone(mine, theirs) and all(own[kind] > rest[kind] for kind in shared):
        servos = counted(max(len(others) for others in shared.values()), "servo", "servos")
        seen = f"answers late now and then: {mine} of {mine + theirs} late replies of its bus are its, the "
        share = mine / int(sum(kinds[kind][1].sum() for kind in shared))
        yield slow_servo(bus, servo_id, f"{seen}other {servos} have {theirs}", share)


def _late(times: _Values, others: list[_Values]) -> int:
    values, counts = times
    return int(counts[values > _usual(others) + _LATE_US].sum())
