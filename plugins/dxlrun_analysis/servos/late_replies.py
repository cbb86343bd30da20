"""Replies that came after they were given up, or much later than planned: of one servo, one bus, or several
buses at the same moments.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from dxlrun.errors import counted
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.reply_times import slow_servo
from dxlrun_analysis.servos.requests import IDS, Flags, Numbers

_FEWEST = 5  # Late replies from which they are no chance
_ALONE = 0.8  # Share of a bus' late replies from which they are one servo's
_MOMENT_NS = 50_000_000  # Late replies with less between them are of one moment
_FEWEST_MOMENTS = 3
_TOGETHER = 0.6  # Share of the moments of a bus from which it is late together with others


class LateReplies:
    """Collects them, in memory that does not grow with the log."""

    def __init__(self, buses: int) -> None:
        self._given_up = np.zeros(buses * IDS, np.int64)
        self._longest_ns, self._exchanges = np.zeros((2, buses), np.int64)
        self._often = np.zeros(buses, np.int64)  # In how many twentieths of a second each bus was late
        self._moments: Counter[int] = Counter()
        """How many there were, by the buses that were late in them, a bit each."""

    def take(self, exchanges: Exchanges, rows: Numbers, at_ns: Numbers) -> None:
        """Take the late replies of some exchanges; `rows`: those that were complete, but late, at `at_ns`."""
        late, count = exchanges.late, len(self._exchanges)
        self._exchanges += np.bincount(exchanges.bus[exchanges.request > 0], minlength=count)
        came_late = ~_in_time(exchanges)
        late_bus, late_at_ns = late.servo[came_late] // IDS, late.at_ns[came_late]
        self._given_up += np.bincount(late.servo[came_late], minlength=count * IDS)
        np.maximum.at(self._longest_ns, late_bus, late.late_ns[came_late])
        # without a rate it is not known when they are due
        known = np.array([bool(bus.baud_rate) for bus in exchanges.buses])
        rows, at_ns = rows[known[exchanges.bus[rows]]], at_ns[known[exchanges.bus[rows]]]
        np.maximum.at(self._longest_ns, exchanges.bus[rows], at_ns - exchanges.sent_ns[rows])
        times = np.concatenate([late_at_ns, at_ns])
        buses = np.concatenate([late_bus, exchanges.bus[rows]])
        bins = np.unique(np.stack([buses, times // _MOMENT_NS]), axis=1)[0]
        self._often += np.bincount(bins, minlength=count)
        order = np.argsort(times, kind="stable")
        begins = np.flatnonzero(np.diff(times[order], prepend=-(1 << 62)) > _MOMENT_NS)
        if len(begins):
            masks = np.bitwise_or.reduceat(np.left_shift(1, buses[order]), begins)
            self._moments.update(masks.tolist())

    def together(self, buses: Sequence[int]) -> tuple[int, ...]:
        """Return which of some buses are late at the same moments, most of the times that they are."""
        found = tuple(
            bus
            for bus in buses
            if (shared := self._shared(bus, buses)) >= _FEWEST_MOMENTS
            and shared >= _TOGETHER * self.moments(bus)
        )
        return found if len(found) > 1 else ()

    def _shared(self, bus: int, buses: Sequence[int]) -> int:
        """Return at how many moments a bus was late together with others of these."""
        others = sum(1 << other for other in buses if other != bus)
        return sum(n for mask, n in self._moments.items() if mask >> bus & 1 and mask & others)

    def moments(self, bus: int) -> int:
        """Return at how many moments a bus was late; many that follow each other are as many."""
        return int(self._often[bus])

    def everywhere(self, indices: Sequence[int], buses: Sequence[LoggedBus]) -> Finding:
        """Name what several buses that are late `together` have in common."""
        named = [buses[index].name for index in indices]
        moments = max(self._shared(index, indices) for index in indices)
        if all(buses[index].simulated for index in indices):
            remedy = "Simulated buses share this machine: end other programs, or use --virtual."
        else:
            remedy = (
                "Connect their adapters to ports of the machine itself; if that does not help, look for what "
                "else runs there (`dxlrun doctor`)."
            )
        return cause(
            "late_replies_everywhere",
            "machine",
            f"Replies on buses {', '.join(named[:-1])} and {named[-1]} came late at the same moments, "
            f"{counted(moments, 'time', 'times')}, up to {max(map(self._ms, indices))} ms: it is "
            "what they share, a USB hub or the host.",
            remedy,
            1.2,
        )

    def findings(self, index: int, bus: LoggedBus) -> Sequence[Finding]:
        """Name the servo or the bus whose replies came after they were given up."""
        mine = self._given_up[index * IDS : (index + 1) * IDS]
        total, servo_id = int(mine.sum()), int(np.argmax(mine))
        if total < _FEWEST:
            return ()
        late = f"came after they were given up, up to {self._ms(index)} ms after the request"
        alone = servo_id in bus.names and len(bus.names) > 1 and mine[servo_id] >= _ALONE * total
        share = total / max(int(self._exchanges[index]), 1)
        if alone:
            seen = f"answers too late: {counted(int(mine[servo_id]), 'reply', 'replies')} {late}"
            fix = "Compare its firmware and Return Delay Time with those of the others, and check its supply."
            return (slow_servo(bus, servo_id, seen, share, fix),)
        what = f"Replies on bus {bus.name} come too late: {counted(total, 'reply', 'replies')} {late}."
        fix = "Check adapter, driver and USB hub, and what else runs on the machine (`dxlrun doctor`)."
        return (cause("late_replies", bus.name, what, fix, share),)

    def _ms(self, index: int) -> int:
        return round(int(self._longest_ns[index]) / 1e6)


def _in_time(exchanges: Exchanges) -> Flags:
    """Return which late replies came no later than others were awaited to the same request.

    They were given up for another reason, such as bytes that the line lost before them.
    """
    replies, late = exchanges.replies, exchanges.late
    known = late.exchange >= 0
    if not known.any():
        return known
    of = replies.exchange[replies.answers]
    longest_ns = np.zeros(len(exchanges.requests.kinds), np.int64)
    took_ns = replies.last_ns[replies.answers] - exchanges.sent_ns[of]
    np.maximum.at(longest_ns, exchanges.request[of], took_ns)
    return known & (late.late_ns <= longest_ns[exchanges.request[late.exchange]])
