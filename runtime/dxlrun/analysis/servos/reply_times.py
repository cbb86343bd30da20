"""Reply times of each servo, its own part: what wire, the adapter and the servos before it do not explain.

A servo of a group read waits for the replies before its own: from the end of the reply before it (of the
instruction, for the first) until its own ended, less the time of its bytes on the wire, is its own time: its
return delay, and what adapter and host add. It is known where replies come one by one; those that were handed
over together with the one before or behind, and those behind a reply that is missing, are left out, and so
are fast status packets, which all servos of a bus share. Source of the order of replies: ROBOTIS e-Manual,
Protocol 2.0, Sync Read and Bulk Read.

What differs from servo to servo is the servos', what all have in common the adapter's: a servo is compared
with the median of the others of its bus.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dxlrun.analysis.counts import Counts, median, quantile
from dxlrun.analysis.finding import Finding, Rank
from dxlrun.analysis.plan import LoggedBus
from dxlrun.analysis.servos.exchanges import Exchanges, Numbers

_IDS = 256
_POSITIONS = 32
"""Later ones in a chain of replies count as the last."""
EDGES_US = (0, 50, 100, 200, 300, 400, 500, 600, 800, 1000, 1500, 2000, 4000, 8000, 16_000, 32_000)
"""Lower edges of the bins of a histogram; what is less than nothing is in the first."""
_FEWEST = 20
"""Replies from which a servo is judged."""
_ODD_US = 100
"""A servo differs from the others by more: clocks of servos and hosts do by some 10 us [i]."""
_LONGEST_DELAY_US = 508
"""Return Delay Time (5, 9) is at most 254 times 2 us."""
_STEADY_US = 60
"""A return delay is always the same; a servo that is busy is not [i]."""


@dataclass(frozen=True, slots=True)
class ChainPosition:
    """Replies of one servo at one position in a chain of replies."""

    position: int
    """0: the first after the instruction."""
    replies: int
    median_us: float


@dataclass(frozen=True, slots=True)
class ReplyTime:
    """One servo's own part of its reply times."""

    replies: int
    """Those of which it is known."""
    median_us: float
    p99_us: float
    p10_us: float
    p90_us: float
    """Between them is the spread: steady where it is small."""
    planned_us: float
    """The return delay that the plan assumes."""
    histogram: tuple[int, ...]
    """Replies by bins that begin at EDGES_US."""
    positions: tuple[ChainPosition, ...]


class ReplyTimes:
    """Collects the own times of replies, in memory that does not grow with the log."""

    __slots__ = ("_own_us",)

    def __init__(self) -> None:
        self._own_us = Counts()

    def take(self, exchanges: Exchanges) -> None:
        """Take the replies of some exchanges."""
        replies = exchanges.replies
        count = len(replies.exchange)
        if not count:
            return
        asked = np.array([0 if one.fast else len(one.servo_ids) for one in exchanges.requests], np.int64)
        place = _places(exchanges)
        request = exchanges.request[replies.exchange]
        first = np.flatnonzero(np.diff(replies.exchange, prepend=-1))
        number = np.arange(count) - np.repeat(first, np.diff(np.append(first, count)))
        own_ns = replies.last_ns - replies.before_ns - replies.wire_ns
        together = (number > 0) & (own_ns < -(replies.wire_ns // 2))
        followed = np.append(together[1:], False)
        in_turn = replies.answers & (place[request, replies.servo_id] == number)
        known = np.flatnonzero(in_turn & (asked[request] > 0) & ~together & ~followed)
        bus = exchanges.bus[replies.exchange[known]]
        position = np.minimum(number[known], _POSITIONS - 1)
        group = (bus * _IDS + replies.servo_id[known]) * _POSITIONS + position
        self._own_us.take(group, own_ns[known] // 1000)

    def finish(self, buses: tuple[LoggedBus, ...]) -> dict[tuple[int, int], ReplyTime]:
        """Return the times of each servo by index of the bus and ID."""
        groups: dict[tuple[int, int], list[int]] = {}
        for group in self._own_us.groups:
            servo, position = divmod(group, _POSITIONS)
            groups.setdefault(divmod(servo, _IDS), []).append(position)
        return {
            (bus, servo_id): self._time(bus, servo_id, positions, buses[bus])
            for (bus, servo_id), positions in groups.items()
        }

    def _time(self, bus: int, servo_id: int, positions: list[int], plan: LoggedBus) -> ReplyTime:
        parts = [self._own_us.of((bus * _IDS + servo_id) * _POSITIONS + position) for position in positions]
        values = np.concatenate([part[0] for part in parts])
        order = np.argsort(values, kind="stable")
        values, counts = values[order], np.concatenate([part[1] for part in parts])[order]
        bins = np.searchsorted(EDGES_US, np.maximum(values, 0), side="right") - 1
        return ReplyTime(
            replies=int(counts.sum()),
            median_us=median(values, counts),
            p99_us=quantile(values, counts, 0.99),
            p10_us=quantile(values, counts, 0.1),
            p90_us=quantile(values, counts, 0.9),
            planned_us=plan.return_delay_ns / 1e3,
            histogram=tuple(np.bincount(bins, counts, len(EDGES_US)).astype(int).tolist()),
            positions=tuple(
                ChainPosition(position, int(part[1].sum()), median(*part))
                for position, part in zip(positions, parts, strict=True)
            ),
        )


def _places(exchanges: Exchanges) -> Numbers:
    """Return each servo's position in the replies to each request, -1: it has none; (requests, 256)."""
    place = np.full((len(exchanges.requests), _IDS), -1, np.int64)
    for index, request in enumerate(exchanges.requests):
        for position, servo_id in reversed(list(enumerate(request.servo_ids))):
            place[index, servo_id] = position
    return place


def slow_servos(bus: LoggedBus, times: dict[int, ReplyTime]) -> Iterable[Finding]:
    """Name servos that answer later than the others of their bus and than the plan assumes.

    A delay that Return Delay Time can have, and that is always the same, is taken for it.
    """
    joints = {servo.servo_id: servo.joint for servo in bus.servos}
    judged = {servo_id: time for servo_id, time in times.items() if time.replies >= _FEWEST}
    for servo_id, time in judged.items():
        others = [other for each, other in judged.items() if each != servo_id]
        if not others:
            continue
        usual_us, odd_us = _usual([other.median_us for other in others])
        slow_us, odd_slow_us = _usual([other.p90_us for other in others])
        steady = time.p90_us - time.p10_us <= _STEADY_US
        # what adapter and host add to every reply is not this servo's
        delay_us = time.median_us - max(0.0, usual_us - time.planned_us)
        late_us = time.median_us - usual_us if steady else time.p90_us - slow_us
        if late_us < max(_ODD_US, odd_us if steady else odd_slow_us):
            continue
        if steady and delay_us - time.planned_us < _ODD_US:
            continue  # the others answer sooner than the plan assumes
        name = joints.get(servo_id, "") or f"servo {servo_id}"
        where = f"servo {servo_id} on bus {bus.name}"
        if steady and delay_us <= _LONGEST_DELAY_US + _STEADY_US:
            yield Finding(
                "return_delay",
                name,
                f"{name} ({where}) answers after {delay_us:.0f} us, and the robot file says "
                f"return_delay_time: {time.planned_us:g} us: its Return Delay Time is another.",
                f"`dxlrun servo {bus.port or 'PORT'} {servo_id} set return_delay_time "
                f"{round(time.planned_us / 2)}` corrects it.",
                Rank.CAUSE,
                late_us / 1e6,
            )
        else:
            often = "" if steady else " now and then"
            yield Finding(
                "slow_servo",
                name,
                f"{name} ({where}) answers{often} {late_us:.0f} us later than the other servos of its bus, "
                f"which need {usual_us:.0f} us beside their bytes.",
                "Check its supply, its firmware and what else it does; exchange it where nothing helps.",
                Rank.CAUSE,
                late_us / 1e6,
            )


def _usual(values: list[float]) -> tuple[float, float]:
    """Return the median of some servos, and how much a servo has to differ from it: three times as much as
    half of them do.
    """
    usual = float(np.median(values))
    return usual, 3 * float(np.median(np.abs(np.array(values) - usual)))
