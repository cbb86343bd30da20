"""Missing replies, attributed to servo, bus or machine by the other replies at the same time.

An *outage* lasts from the first missing reply of a servo until its next answer. It begins with a loss that
may be the servo's own: in a chain only the first missing reply is, because the following servos wait for it
in vain (ROBOTIS e-Manual, Protocol 2.0, Sync Read; see `Loss`). Outages that overlap, or begin in one cycle,
are one *occasion*. An occasion is attributed to

- the machine, or a part that buses share, if servos of several buses failed. It does not count against any
  servo or single bus;
- the bus, if several servos failed, and no reply came from the first loss to the last;
- otherwise the servos that failed, together: others of their bus answered.

If no reply of a chain came, its instruction or its first servo can be the cause. It is the servo if
instructions to single servos are hardly ever lost: a bad line would spoil those two fifths as often, because
they are shorter [i].
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from dxlrun.tooling.output import counted
from dxlrun.tooling.records import BEFORE_FIRST_CYCLE
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Loss
from dxlrun_analysis.servos.joint_states import ANGLE, BINS, QUANTITIES, JointStates, Places
from dxlrun_analysis.servos.logged_requests import IDS, Numbers

_APART_NS = (
    200_000_000  # Occasions of one part within this time after the first count as one: a plug can flicker
)
_UNKNOWN_NS = 10_000_000  # Resolution of moments without cycle numbers: the period of many robots
_FEWEST = 5  # Occasions from which a part is reported
_TIMES_MORE = 10  # Required ratio to the median of the other servos of the bus
_TOGETHER = 0.7  # Share of common occasions from which two servos fail together, such as by a shared cable
_MOST = 0.6  # Share of a bus' occasions from which several buses fail together
_SHORTER = 0.4  # Length of an instruction to one servo relative to one to a chain
_MOST_KEPT = 100_000  # Outages of a run, and cycles with late replies
_INSIDE = 0.9  # Share of the losses that a reported range of angles, speeds or temperatures must contain
_CHANCE = 1e-3  # Probability of this concentration if losses were independent of the quantity


@dataclass(frozen=True, slots=True)
class ServoLosses:
    """Requests to one servo, and missing replies that are its own, not due to a servo before it."""

    asked: int  # Requests that it could have answered: no reply before its own in the chain was missing
    lost: int
    broken_off: int = 0  # Chains that begin with it and of which no reply came


@dataclass(slots=True)
class _Outage:
    """Outage of one servo: from its first missing reply until it answers again. With `late`, one cycle
    with late replies instead."""

    servo: int
    at_ns: int
    cycle: int
    places: list[int]  # Bins of its joint's angle, speed and temperature
    answers: int  # Replies on its bus before the outage
    answered: int  # Replies of the servo itself before the outage
    line: bool  # At the start, the whole chain was missing
    last: int = 0  # Cycle of its last loss, within 0.2 s
    last_answers: int = 0  # Replies on its bus before the last loss
    late: bool = False  # Not a loss but a late reply


@dataclass(slots=True)
class _Count:
    """Counter of the occasions of one part that are 0.2 s or more apart."""

    apart: int = 0
    last_ns: int = -(1 << 62)
    places: list[list[int]] = field(default_factory=list)

    def add(self, at_ns: int, places: list[int]) -> None:
        if at_ns - self.last_ns > _APART_NS:
            self.apart, self.last_ns = self.apart + 1, at_ns
            self.places.append(places)


class Losses:
    """Accumulator of outages of servos, and of cycles with late replies, in constant memory."""

    def __init__(self, states: JointStates) -> None:
        self._states, servos = states, len(states.joint_of)
        self._asked, self._lost, self._answered = np.zeros((3, servos), np.int64)
        self._chains, self._broken_off, self._alone, self._lost_alone = np.zeros((4, servos), np.int64)
        """Chain reads by first servo; those without any reply; single reads; lost single reads."""
        self._answers = np.zeros(servos // IDS, np.int64)  # Replies of each bus so far
        self._open: dict[int, _Outage] = {}  # Last outage of each servo
        self._outages: list[_Outage] = []
        self._late: list[_Outage] = []  # Cycles of a bus with late replies

    # Collection

    def add_exchanges(self, exchanges: Exchanges, places: Places) -> None:
        """Add the missing replies of some exchanges; `places` has the joint states in their cycles."""
        due, ended, exchange = exchanges.due, exchanges.ended, exchanges.due.exchange
        servos, missing = exchanges.requests.servos, due.missing
        lost = missing[due.loss[missing] != Loss.LATE]
        rows = lost[ended[exchange[lost]]]
        cycles, asks = _moments(exchanges, exchange[rows]), servos[exchanges.request[exchange[rows]]]
        own = due.loss[rows] == Loss.OWN
        nothing = (due.loss[rows] == Loss.LINE) & (due.place[rows] == 0)
        # A servo could have answered if no reply before its own was missing.
        first = own | nothing
        rest = (asks - due.place[rows] - 1)[first]
        behind = np.repeat(rows[first] + 1 - np.cumsum(rest) + rest, rest) + np.arange(rest.sum())
        behind = behind[due.reply[behind] >= 0]
        closed = missing[ended[exchange[missing]]]
        everything, times = exchanges.count_due(exchanges.times), exchanges.ended_times()
        self._asked += exchanges.count_due(times)
        self._asked -= np.bincount(due.servo[np.append(closed, behind)], minlength=len(self._asked))
        self._chains += exchanges.count_first(times, alone=False)
        self._alone += exchanges.count_first(times, alone=True)
        for counts, servo in (
            (self._broken_off, due.servo[rows[nothing]]),
            (self._lost_alone, due.servo[rows[own & (asks == 1)]]),
            (self._asked, due.servo[rows[own]]),
            (self._lost, due.servo[rows[own]]),
        ):
            np.add(counts, np.bincount(servo, minlength=len(counts)), out=counts)
        answers, answered = (
            _before(rows, due.servo, width, lost, so_far)
            for width, so_far in ((IDS, self._answers), (1, self._answered))
        )
        came = everything - np.bincount(due.servo[lost], minlength=len(everything))
        self._answered += came
        self._answers += came.reshape(-1, IDS).sum(axis=1)
        joint = self._states.joint_of[due.servo[rows]]
        at = np.searchsorted(places.cycle, exchanges.cycle[exchange[rows]], side="right") - 1
        columns = (rows, cycles, own, nothing, joint, at, answers, answered)
        missed = zip(*(column.tolist() for column in columns), strict=True)
        for row, cycle, is_own, whole, of, place, seen, now in missed:
            servo, at_ns = int(due.servo[row]), int(exchanges.asked_ns[exchange[row]])
            out = self._open.get(servo)
            if out is not None and out.answered == now:
                if at_ns - out.at_ns <= _APART_NS:
                    out.last, out.last_answers = cycle, seen
            elif (is_own or whole) and len(self._outages) < _MOST_KEPT:
                known = of >= 0 and len(places.cycle)
                where = places.bins[:, max(place, 0), of].tolist() if known else [-1] * len(QUANTITIES)
                out = _Outage(servo, at_ns, cycle, where, seen, now, whole, cycle, seen)
                self._open[servo] = out
                self._outages.append(out)

    def late(self, bus: Numbers, exchanges: Exchanges, rows: Numbers) -> None:
        """Add exchanges with late replies: rows and bus of each; several in one cycle count once."""
        if len(self._answers) < 2:
            return
        cycles = _moments(exchanges, rows)
        _, first = np.unique(np.stack([bus, cycles]), axis=1, return_index=True)
        for row in first.tolist()[: _MOST_KEPT - len(self._late)]:
            cycle, at_ns = int(cycles[row]), int(exchanges.asked_ns[rows[row]])
            one = _Outage(int(bus[row]) * IDS, at_ns, cycle, [], 0, 0, line=False, last=cycle, late=True)
            self._late.append(one)

    # Results

    def count_losses(self) -> dict[tuple[int, int], ServoLosses]:
        """Return the missing replies of each servo that was asked, by index of the bus and ID."""
        return {
            divmod(servo, IDS): ServoLosses(
                int(self._asked[servo]), int(self._lost[servo]), int(self._broken_off[servo])
            )
            for servo in np.flatnonzero((self._asked > 0) | (self._lost > 0)).tolist()
        }

    def occasions(self, always_late: Iterable[int] = ()) -> Occasions:
        """Combine overlapping outages into occasions, attributed to servos, buses or the machine.

        Args:
            always_late: Indices of buses with constantly late replies, which do not count as occasions.
        """
        found = Occasions(self._states, self._heads())
        skipped = set(always_late)
        late = (one for one in self._late if one.servo // IDS not in skipped)
        outages = sorted((*self._outages, *late), key=lambda one: one.cycle)
        begin, end = 0, -(1 << 62)
        for at, one in enumerate(outages):
            # A cycle after the end of all open outages begins a new occasion.
            if one.cycle > end and at:
                found.add_occasion(outages[begin:at])
                begin = at
            end = max(end, one.last)
        if outages:
            found.add_occasion(outages[begin:])
        return found

    def _heads(self) -> set[int]:
        """Return first servos of silent chains for which lost instructions are not a plausible cause."""
        found = set()
        for servo in np.flatnonzero(self._broken_off).tolist():
            ids = slice(servo // IDS * IDS, (servo // IDS + 1) * IDS)
            others, theirs = (int(each[ids].sum() - each[servo]) for each in (self._alone, self._lost_alone))
            as_often = _SHORTER * int(self._broken_off[servo]) / max(int(self._chains[servo]), 1) * others
            if as_often >= max(_FEWEST, _TIMES_MORE * theirs):
                found.add(servo)
        return found


class Occasions:
    """Counter of the occasions attributed to each servo, each bus and the machine."""

    def __init__(self, states: JointStates, heads: set[int]) -> None:
        """Create an empty counter; `heads` are first servos that are themselves the cause if no reply of
        their chain came."""
        self._states, self._heads = states, heads
        self._all: Counter[int] = Counter()  # Occasions by bus, and below those shared with other buses
        self._shared: Counter[int] = Counter()
        self._late: Counter[int] = Counter()  # Shared occasions with late replies
        self._machine = _Count()
        self._bus: dict[int, _Count] = {}
        self._servos: dict[int, _Count] = {}
        self._pairs: Counter[tuple[int, int]] = Counter()
        """Common occasions of two servos, or all occasions of one; not only those far apart."""

    def add_occasion(self, outages: Sequence[_Outage]) -> None:
        """Attribute one occasion, given by its overlapping outages, and count it."""
        buses, begin = {one.servo // IDS for one in outages}, outages[0]
        self._all.update(buses)
        if len(buses) > 1:
            self._shared.update(buses)
            self._late.update(buses if any(one.late for one in outages) else ())
            self._machine.add(begin.at_ns, [])
            return
        lost = [one for one in outages if not one.late]
        if not lost:
            return
        own = len({one.servo for one in lost}) == 1 and (not lost[0].line or lost[0].servo in self._heads)
        # No reply came on the bus between the first and the last loss, so the bus failed.
        if not own and max(one.last_answers for one in lost) <= min(one.answers for one in lost):
            self._bus.setdefault(lost[0].servo // IDS, _Count()).add(begin.at_ns, [])
            return
        for one in {one.servo: one for one in reversed(lost)}.values():
            self._servos.setdefault(one.servo, _Count()).add(one.at_ns, one.places)
            self._pairs.update((one.servo, servo) for servo in {each.servo for each in lost})

    def together(self) -> tuple[tuple[int, ...], bool]:
        """Return the indices of the buses that lost replies, or had late ones, in the same cycles; and
        whether most of them were late, not lost."""
        found = tuple(
            bus
            for bus, shared in sorted(self._shared.items())
            if self._machine.apart >= _FEWEST and shared >= max(_FEWEST, _MOST * self._all[bus])
        )
        late = sum(self._late[bus] for bus in found) >= sum(self._shared[bus] for bus in found) / 2
        return (found if len(found) > 1 else ()), late

    def machine(self, buses: Sequence[LoggedBus], longest_ms: float) -> Iterator[Finding]:
        """Report the machine, or a part that buses share, if several buses lost replies or had late ones
        in the same cycles."""
        shared, late = self.together()
        if not shared:
            return
        *before, last = (buses[index].name for index in shared)
        came = f"came late at once, by up to {longest_ms:.0f} ms" if late else "were lost at once"
        sentence = f"Replies on buses {', '.join(before)} and {last} {came}, "
        sentence += f"{counted(self._machine.apart, 'time', 'times')}."
        yield cause("late_replies" if late else "lossy_line", "machine", sentence, share=1.2)

    def loss_findings(
        self, index: int, bus: LoggedBus, losses: dict[int, ServoLosses], explained: set[int]
    ) -> Iterator[Finding]:
        """Report servos that lose replies alone or together, and a bus that loses replies as a whole.

        Args:
            index: Index of the bus.
            bus: The bus.
            losses: Losses by ID of each servo of the bus that was asked.
            explained: IDs whose losses have another cause.
        """
        base = index * IDS
        counts = {servo % IDS: count for servo, count in self._servos.items() if servo // IDS == index}
        times = {servo: counts[servo].apart if servo in counts else 0 for servo in {*losses, *counts}}
        whole = self._bus[index].apart if index in self._bus else 0
        named = set(explained)
        for servo in sorted(times, key=lambda one: (-times[one], one)):
            group = self._group(base, servo, times)
            rest = [self._pairs[base + one, base + one] for one in times if one not in group | explained]
            enough = _TIMES_MORE * float(np.median(rest)) if rest else math.inf
            if servo in named or times[servo] < _FEWEST or self._pairs[base + servo, base + servo] < enough:
                continue
            named |= group
            yield self._servo(bus, sorted(group), times[servo], base, losses)
        left = [times[servo] for servo in times if servo not in named]
        even = sum(left) - (max(left, default=0) if len(times) > 1 else 0)
        if whole + even >= max(_FEWEST, (whole + sum(left)) / 2):
            heads = [servo for servo, one in losses.items() if one.broken_off]
            open_ = len(heads) == 1 and not any(times[one] for one in times if one not in {*named, *heads})
            chain = f" in a chain that starts with {bus.called(heads[0])[0]}" if open_ else ""
            parts = [f"{counted(whole, 'time', 'times')} no servo answered{chain}"] if whole else []
            if sum(left):
                each = "its only servo did not" if len(times) == 1 else "single servos did not, spread evenly"
                parts.append(f"{counted(sum(left), 'time', 'times')} {each}")
            asked = sum(one.asked for one in losses.values())
            sentence = f"Bus {bus.name} lost replies: {'; '.join(parts)}."
            yield cause("lossy_line", bus.name, sentence, share=(whole + sum(left)) / max(asked, 1))

    def _group(self, base: int, servo: int, times: dict[int, int]) -> set[int]:
        """Return the IDs of a servo and of those that lose replies on mostly the same occasions; `times`
        has the occasions by ID."""
        own = self._pairs[base + servo, base + servo]
        return {servo} | {
            other
            for other in times
            if own
            and self._pairs[base + servo, base + other]
            >= _TOGETHER * max(own, self._pairs[base + other, base + other])
        }

    def _servo(
        self, bus: LoggedBus, group: list[int], times: int, base: int, losses: dict[int, ServoLosses]
    ) -> Finding:
        if len(group) > 1:
            *before, last = (bus.names.get(servo) or f"servo {servo}" for servo in group)
            who = f"{', '.join(before)} and {last} on bus {bus.name} were lost together"
            sentence = f"{who}, {counted(times, 'time', 'times')}, while the other servos answered."
            return cause("lossy_servo", bus.name, sentence, share=0.5)
        (servo,) = group
        name, named = bus.called(servo)
        mine = losses.get(servo, ServoLosses(0, 0))
        where = self._where(base + servo)
        chains = counted(mine.broken_off, "chain", "chains")
        silent = f" and all replies of {chains} that it starts" if mine.broken_off else ""
        sentence = f"{named} lost {mine.lost} of {mine.asked} replies{silent}, in "
        sentence += f"{counted(times, 'episode', 'episodes')}{where}; "
        sentence += "other servos of its bus answered at these times."
        share = (mine.lost + mine.broken_off) / max(mine.asked + mine.broken_off, 1)
        return cause("lossy_servo", name, sentence, share=share)

    def _where(self, servo: int) -> str:
        """Return the range of angles, speeds or temperatures of the joint in which nearly all losses of
        its servo began, as text; empty if there is none."""
        joint = int(self._states.joint_of[servo])
        if joint < 0:
            return ""
        found = []
        at = np.array(self._servos[servo].places)
        for quantity in QUANTITIES:
            begun = np.bincount(at[:, quantity][at[:, quantity] >= 0], minlength=BINS)
            time_ns = self._states.time_ns[joint, quantity]
            if (part := narrowest(time_ns, begun, open_above=quantity != ANGLE)) is not None:
                low, high, inside, share = part
                text = self._states.range_text(joint, quantity, low, high)
                found.append((share, f", {inside} of them {text} ({share:.0%} of the time)"))
        return min(found, default=(0.0, ""))[1]


def narrowest(time: Numbers, begun: Numbers, *, open_above: bool) -> tuple[int, int, int, float] | None:
    """Return the narrowest range of bins in which nearly all (90 %) losses began.

    Args:
        time: Time spent in each bin.
        begun: Occasions that began in each bin.
        open_above: The range has no upper end.

    Returns:
        First and last bin, number of occasions inside, and share of the time there. None if the
            concentration is plausible by chance, with probability 1 in 1000.
    """
    total, spent = int(begun.sum()), int(time.sum())
    at = np.flatnonzero(begun)
    if total < _FEWEST or not spent:
        return None
    ends, times = np.append(0, np.cumsum(begun)), np.append(0, np.cumsum(time)) / spent
    lasts = np.array([len(begun) - 1]) if open_above else at
    low, high = (each.ravel() for each in np.meshgrid(at, lasts, indexing="ij"))
    inside, share = ends[high + 1] - ends[low], times[high + 1] - times[low]
    enough = np.flatnonzero((inside >= _INSIDE * total) & (high >= low))
    best = min(enough.tolist(), key=lambda row: (share[row], -inside[row]))
    count, part = int(inside[best]), float(share[best])
    # Probability of this count in any window of that width (Naus 1965, to first order).
    chance = math.log(count * math.comb(total, count)) + (count - 1) * math.log(max(part, 1e-9))
    if chance > math.log(_CHANCE) or part > 1 / 2:
        return None
    return int(low[best]), int(high[best]), count, part


def _moments(exchanges: Exchanges, rows: Numbers) -> Numbers:
    """Return the cycle of some exchanges; before the first cycle, a distinct number for each 10 ms."""
    cycle, before = exchanges.cycle[rows], exchanges.asked_ns[rows] // _UNKNOWN_NS - (1 << 60)
    return np.where(cycle > BEFORE_FIRST_CYCLE, cycle, before)


def _before(rows: Numbers, servo: Numbers, width: int, lost: Numbers, so_far: Numbers) -> Numbers:
    """Return, for some due replies, how many replies of the same group (bus or servo) came before them.

    Args:
        rows: Indices of these due replies.
        servo: Servo of all due replies.
        width: Number of servos in a group: 256 for a bus, or 1.
        lost: Indices of the due replies that did not come.
        so_far: Number of replies of each group before.
    """
    group = servo[rows] // width
    before: Numbers = so_far[group]
    for number in np.unique(group).tolist():
        came = servo // width == number
        came[lost] = False
        mine = np.flatnonzero(group == number)
        before[mine] += np.cumsum(came)[rows[mine]]
    return before
