"""Missing replies: whose they are, at which angle of the joint, and which servos miss theirs together.

Whose: of a chain of replies only the first that is missing is a servo's own, those behind wait for it in vain
(ROBOTIS e-Manual, Protocol 2.0, Sync Read; see `Loss`). Where nothing arrived of a chain, its instruction may
be lost: that is the line's, but for the test of angles, for which it may be the first servo's.

Independent: losses are one episode until the servo has answered again, and for 0.2 s. A cable that is cut for
a second is one, however often its servo is read. At which angle or speed they begin is asked of those that
are 0.2 s behind the last loss: of a contact that flickers only the first.

At which angle: each joint has a histogram of the time it spent in bins of 5 deg, and of the angles at which
episodes began; the angle at a lost reply is taken from the states before and behind it. A range is named that
has at least 90 % of the episodes, and four times as large a share of them as of the time: six of them, or
five in a tenth of the time.

At which speed: the same with bins of 0.1 rad/s, but for all lost replies, and above a speed, where at least
90 % of them are, in four episodes, and which the joint had in at most 60 % of the time; five times as often.

Together: episodes of several servos that begin within 0.2 s, while the others of the bus answer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.errors import counted
from dxlrun_analysis.counts import has_them_alone
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Loss
from dxlrun_analysis.servos.joint_states import (
    ANGLES,
    BIN_DEG,
    SPEEDS,
    STEP_RAD_S,
    JointStates,
    Places,
    edge_rad,
)
from dxlrun_analysis.servos.requests import IDS, Numbers

_ROWS = 40
_EPISODE_NS = 200_000_000
_WIDEST = 90 // BIN_DEG  # Bins of the widest range that is tried

_FEWEST = 5  # Episodes from which a cause is named
_MANY, _NARROW = 6, 0.1  # Fewer episodes are named only in so small a part of the time
_TIMES_MORE = 4.0
"""So much more often than by the time spent there a reply is missing in a range that is named."""
_INSIDE = 0.9  # Share of the episodes in it
_SLOWEST = 3  # Bins of speeds below which a joint hardly moves
_FEWEST_FAST, _FEWEST_TIMES, _MOST_TIME, _FAST_MORE = 12, 4, 0.6, 5.0
"""Of losses at high speed: replies, episodes, share of the time, and how much more often than else."""
_EVEN = 0.6  # A servo that has more of all episodes of its bus loses them alone
_ALONE = 0.8
"""A servo that has so many of the lost replies of its bus is named for losing them when it is fast."""
_SHORTER = 0.4
_LOSSY_LINE = 10  # Episodes of a whole bus from which its line is named
_TOGETHER = 0.7
"""Share of the episodes of a bus that are of several servos at once, or of these at once that are of each."""
_MOST_EPISODES = 100_000  # Kept for each run
_NOISY_SHARE = 0.005
_FEWEST_NOISY = 10


@dataclass(frozen=True, slots=True)
class AngleRange:
    """Where a joint's replies go missing, rad; the last bins included."""

    low: float
    high: float
    episodes: int  # That began in it
    time_share: float  # Of the run that the joint was there


class Fast(NamedTuple):
    """The speed above which a joint's replies go missing."""

    rad_s: float
    lost_share: float  # Of its lost replies
    time_share: float  # Of the run that the joint was so fast


@dataclass(frozen=True, slots=True)
class ServoLosses:
    """One servo's own missing replies."""

    asked: int  # Those that it could have answered: none before them in a chain was missing
    lost: int
    episodes: int
    broken_off: int = 0  # Reads of several in which it answers first, of which nothing came
    angles: AngleRange | None = None  # The range of angles in which they are, where chance is excluded
    fast: Fast | None = None  # The speed above which they are


class Losses:
    """Collects missing replies and noise, in memory that does not grow with the log."""

    def __init__(self, states: JointStates) -> None:
        self._states = states
        servos = len(states.joint_of)
        self._asked, self._lost, self._episodes = (np.zeros(servos, np.int64) for _ in range(3))
        self._last_ns, self._begun_ns = np.full((2, servos), -(1 << 62), np.int64)
        """When each servo's last reply was lost, and when its last episode began."""
        self._exchanges, self._noisy, self._line_episodes = np.zeros((3, servos // IDS), np.int64)
        self._chains, self._broken_off, self._alone, self._lost_alone = np.zeros((4, servos), np.int64)
        """Reads of several servos, by the first; those of which nothing came; reads of one; lost ones."""
        self._answered = np.zeros(servos, np.int64)
        self._answered_before = np.full(servos, -1, np.int64)  # The same before the last loss
        self._begun, self._lost_at = np.zeros((2, len(states.share), ANGLES), np.int64)
        self._fast, self._begun_fast = np.zeros((2, len(states.share), SPEEDS), np.int64)
        """Lost replies, and episodes, by the joint's speed."""
        self._episodes_at: list[tuple[int, int, int]] = []  # Bus, time in ns and ID of each servo's own

    def take(self, exchanges: Exchanges, places: Places) -> None:
        """Count the missing replies of some exchanges; `places`: of the joints in their cycles."""
        due, ended = exchanges.due, exchanges.ended[exchanges.due.exchange]
        # those that are a servo's own, and chains of which nothing came: they may be the first servo's
        may_be = (due.loss == Loss.OWN) | ((due.loss == Loss.LINE) & (due.place == 0))
        rows = np.flatnonzero(ended & may_be)
        exchange, servo, own = due.exchange[rows], due.servo[rows], due.loss[rows] == Loss.OWN
        bus, count = servo // IDS, exchanges.requests.servos[exchanges.request]
        several, asked = count > 1, exchanges.ended & (count > 0)
        head = np.zeros(len(count), np.int64)
        head[due.exchange[due.place == 0]] = due.servo[due.place == 0]
        # those up to the first missing one could have answered
        first = np.full(len(count), IDS, np.int64)
        first[exchange] = due.place[rows]
        could = ended & (due.reply >= 0) & (due.place < first[due.exchange])
        episodes, begins = self._begins(exchanges, servo, exchange)
        for counts, servos in (
            (self._chains, head[asked & several]),
            (self._broken_off, head[exchange[~own]]),
            (self._alone, head[asked & ~several]),
            (self._lost_alone, head[exchange[own & ~several[exchange]]]),
            (self._asked, np.append(due.servo[could], servo[own])),
            (self._lost, servo[own]),
            (self._episodes, servo[episodes & own]),
            (self._line_episodes, bus[episodes]),
            (self._exchanges, exchanges.bus[exchanges.request > 0]),
            (self._noisy, exchanges.bus[_noisy(exchanges)]),
        ):
            np.add(counts, np.bincount(servos, minlength=len(counts)), out=counts)
        begun = begins & own & (self._states.joint_of[servo] >= 0)
        columns = (bus[begun], exchanges.asked_ns[exchange[begun]], servo[begun] % IDS)
        at = list(zip(*(column.tolist() for column in columns), strict=True))
        self._episodes_at += at[: _MOST_EPISODES - len(self._episodes_at)]
        self._count_places(servo, exchanges.cycle[exchange], begins, places)

    def _begins(self, exchanges: Exchanges, servo: Numbers, exchange: Numbers) -> NDArray[np.bool_]:
        """Return which losses begin an episode: its servo has answered since the last loss, and the last
        episode began a while ago; and of which the last loss was so long ago. Shape (2, losses)."""
        due = exchanges.due
        answered, answers = due.servo[due.reply >= 0], due.exchange[due.reply >= 0]
        keys = np.sort((answered << _ROWS) + answers) if len(servo) else answers
        before = np.searchsorted(keys, (servo << _ROWS) + exchange) - np.searchsorted(keys, servo << _ROWS)
        before += self._answered[servo]
        self._answered += np.bincount(answered, minlength=len(self._answered))
        begins = np.zeros((2, len(servo)), np.bool_)
        for at in np.argsort(exchange, kind="stable").tolist():
            one, at_ns = servo[at], exchanges.asked_ns[exchange[at]]
            since = before[at] - self._answered_before[one]
            past_ns = at_ns - np.array([self._begun_ns[one], self._last_ns[one]])
            begins[:, at] = (since > 0) & (past_ns > _EPISODE_NS)
            if begins[0, at]:
                self._begun_ns[one] = at_ns
            self._answered_before[one], self._last_ns[one] = before[at], at_ns
        return begins

    def _count_places(
        self, servo: Numbers, cycle: Numbers, begins: NDArray[np.bool_], places: Places
    ) -> None:
        joint = self._states.joint_of[servo]
        row = np.searchsorted(places.cycle, cycle)
        usable = (joint >= 0) & (row < len(places.cycle))
        joint, begins = joint[usable], begins[usable]
        angle = places.angle[row[usable], joint]
        speed = places.speed[row[usable], joint]
        for places_of, all_of_them, those_that_begin in (
            (angle, self._lost_at, self._begun),
            (speed, self._fast, self._begun_fast),
        ):
            known = places_of >= 0
            for counts, which in ((all_of_them, known), (those_that_begin, known & begins)):
                np.add.at(counts, (joint[which], places_of[which]), 1)

    # Results

    def finish(self) -> dict[tuple[int, int], ServoLosses]:
        """Return the losses of each servo that was asked, by index of the bus and ID."""
        found = {}
        for servo in np.flatnonzero((self._asked > 0) | (self._lost > 0)).tolist():
            row = int(self._states.joint_of[servo])
            angles = fast = None
            if row >= 0:
                fast = when_fast(self._states.speed_ns[row], self._fast[row], self._begun_fast[row])
                angles = concentration(
                    self._states.time_ns[row, :ANGLES], self._begun[row], self._lost_at[row]
                )
            found[divmod(servo, IDS)] = ServoLosses(
                int(self._asked[servo]),
                int(self._lost[servo]),
                int(self._episodes[servo]),
                int(self._broken_off[servo]),
                angles,
                fast,
            )
        return found

    def findings(self, index: int, bus: LoggedBus, losses: dict[int, ServoLosses]) -> Iterable[Finding]:
        """Name loose cables, servos that lose replies alone or together, and a lossy or noisy line."""
        names = bus.names
        together, times = self._group(index)
        if together:
            *before, last = (names.get(servo_id) or str(servo_id) for servo_id in together)
            yield cause(
                "shared_cable",
                bus.name,
                f"{', '.join(before)} and {last} on bus {bus.name} were lost together {times} times while "
                "the other servos answered: the cable that leads to them, or a plug there.",
                "Check the cable and the plug through which they are connected, and their supply.",
                0.5,
            )
            losses = {servo_id: each for servo_id, each in losses.items() if servo_id not in together}
        loose = set()
        all_lost = sum(each.lost for each in losses.values())
        for servo_id, each in losses.items():
            name, named = bus.called(servo_id)
            if (angles := each.angles) is not None:
                where = self._states.range_text(index * IDS + servo_id, angles.low, angles.high)
                seen = f"{where}: {counted(angles.episodes, 'time', 'times')} there, where it spent "
                seen += f"{angles.time_share:.0%} of the time."
                fix = "Move the joint there by hand, and check its cable and plugs,"
            elif (fast := each.fast) is not None and each.lost >= _ALONE * all_lost:
                share = self._states.share[self._states.joint_of[index * IDS + servo_id]]
                factor, unit = (math.degrees(1.0), "deg/s") if share == 1.0 else (share * 1e3, "mm/s")
                above = f"{fast.rad_s * factor:.0f} {unit}"
                seen = (
                    f"when it is fast: {fast.lost_share:.0%} of {each.lost} above {above}, where it was for "
                )
                seen += f"{fast.time_share:.0%} of the time: a contact that shakes."
                fix = "Shake its plugs and its cable while it is read,"
            else:
                continue
            loose.add(servo_id)
            sentence = f"{named} loses its replies {seen}"
            yield cause("loose_cable", name, sentence, f"{fix} and those on the way to it.")
        rest = {servo_id: each for servo_id, each in losses.items() if servo_id not in loose}
        noisy, exchanges = int(self._noisy[index]), int(self._exchanges[index])
        if noisy >= max(_FEWEST_NOISY, _NOISY_SHARE * exchanges):
            yield cause(
                "noise",
                bus.name,
                f"Noise disturbs bus {bus.name}: bytes that belong to no packet came after "
                f"{counted(noisy, 'instruction', 'instructions')} of {exchanges}.",
                "Check its shield, ground and termination; unplug one servo after the other to find one that "
                "sends unasked.",
                noisy / exchanges if exchanges else 0.0,
            )
            return
        if not (loose or together):
            yield from self._line(index, bus, rest, names)

    def _line(
        self, index: int, bus: LoggedBus, losses: dict[int, ServoLosses], names: dict[int, str]
    ) -> Iterable[Finding]:
        total = sum(each.episodes for each in losses.values())
        worst = max(losses.items(), key=lambda item: item[1].episodes, default=None)
        asked = sum(each.asked for each in losses.values())
        if worst is not None and len(losses) > 1:
            servo_id, each = worst
            if has_them_alone(each.episodes, total - each.episodes):
                seen = f"lost {each.lost} of {each.asked} replies, in "
                seen += f"{counted(each.episodes, 'episode', 'episodes')}; the other servos of its bus had "
                seen += f"{total - each.episodes}"
                yield _lossy(bus, servo_id, seen, each.lost / max(each.asked, 1))
                return
        if head := tuple(self._head(index, bus)):
            yield from head
            return
        line = int(self._line_episodes[index])
        if line >= _LOSSY_LINE and (len(losses) == 1 or worst is None or worst[1].episodes < _EVEN * line):
            lost = sum(each.lost for each in losses.values())
            single = counted(lost, "reply", "replies")
            most = max(losses.items(), key=lambda item: item[1].lost)
            if len(losses) == 1:
                how = f"replies of its only servo: {lost}, in {line} episodes"
            elif most[1].lost >= _EVEN * lost:
                # of a chain of which nothing came it is open whether it is the first servo's or the line's
                name = names.get(most[0]) or f"servo {most[0]}"
                heads = np.flatnonzero(self._broken_off[index * IDS : (index + 1) * IDS])
                first = f", {names.get(int(heads[0]), heads[0])}," if len(heads) == 1 else ""
                how = f"replies, in {line} episodes, mostly a whole chain: either its first servo{first} is "
                how += "silent, or the instruction is lost"
                how += f"; of {single} of single servos {most[1].lost} are of {name}" if lost else ""
            else:
                how = f"replies of its servos evenly: {lost} replies of single servos, in {line} episodes"
            yield cause(
                "lossy_line",
                bus.name,
                f"Bus {bus.name} loses {how}.",
                "Check adapter, plugs, termination, ground and the cable's length, or lower baud_rate.",
                lost / max(asked, 1),
            )

    def _head(self, index: int, bus: LoggedBus) -> Iterable[Finding]:
        """Name the first servo of a chain of which nothing comes, where lost instructions cannot be why.

        The line would spoil instructions to single servos, too, two fifths as often as they are shorter [i].
        """
        ids = slice(index * IDS, (index + 1) * IDS)
        chains, broken_off, alone, lost = (
            each[ids] for each in (self._chains, self._broken_off, self._alone, self._lost_alone)
        )
        servo_id = int(np.argmax(broken_off))
        silent, asked = int(broken_off[servo_id]), int(chains[servo_id])
        others, theirs = (int(each.sum() - each[servo_id]) for each in (alone, lost))
        as_often = _SHORTER * silent / max(asked, 1) * others
        if as_often < max(_FEWEST, 10 * theirs):
            return
        seen = (
            f"is silent now and then: nothing came of {silent} of {asked} reads in which it answers first, "
        )
        seen += f"while {others} instructions to single servos behind it lost {theirs} replies"
        yield _lossy(bus, servo_id, seen, silent / asked)

    def _group(self, index: int) -> tuple[tuple[int, ...], int]:
        """Return the servos of a bus that are lost together, most of the time that any is, and how often."""
        clusters: list[set[int]] = []
        last_ns = -_EPISODE_NS
        for _, at_ns, servo_id in sorted(one for one in self._episodes_at if one[0] == index):
            if at_ns - last_ns >= _EPISODE_NS:
                clusters.append(set())
                last_ns = at_ns
            clusters[-1].add(servo_id)
        several = [cluster for cluster in clusters if len(cluster) > 1]
        if len(several) < max(_FEWEST, _TOGETHER * len(clusters)):
            return (), 0
        found = Counter(servo_id for cluster in several for servo_id in cluster)
        members = {servo_id for servo_id, count in found.items() if count >= _TOGETHER * len(several)}
        others = sum(count for servo_id, count in found.items() if servo_id not in members)
        all_of_bus = np.count_nonzero(self._states.joint_of[index * IDS : (index + 1) * IDS] >= 0)
        named = 1 < len(members) < all_of_bus and has_them_alone(sum(found.values()) - others, others)
        return (tuple(sorted(members)), len(several)) if named else ((), 0)


def _lossy(bus: LoggedBus, servo_id: int, seen: str, share: float) -> Finding:
    name, named = bus.called(servo_id)
    fix = "Check its plugs and its cable; exchange the servo where a new cable does not help."
    return cause("lossy_servo", name, f"{named} {seen}.", fix, share)


def _noisy(exchanges: Exchanges) -> NDArray[np.bool_]:
    """Return exchanges with bytes that are no packet; in an incomplete fast status they are cut blocks."""
    complete = np.ones(len(exchanges.request), np.bool_)
    complete[exchanges.due.exchange[exchanges.due.reply < 0]] = False
    noisy: NDArray[np.bool_] = complete | ~exchanges.requests.fast[exchanges.request]
    return noisy & (exchanges.noise > 0)


def concentration(time: Numbers, begun: Numbers, lost: Numbers) -> AngleRange | None:
    """Return the range of angles in which a joint's episodes are; None where they may be anywhere.

    Of each bin: how long the joint was there, episodes that began there, lost replies. See the module
    for the rule.
    """
    total, spent_in_all = int(begun.sum()), int(time.sum())
    if total < _FEWEST or not spent_in_all:
        return None
    spent, ends = np.append(0, np.cumsum(time)), np.append(0, np.cumsum(begun))
    at = np.flatnonzero(begun)
    low, high = (each.ravel() for each in np.meshgrid(at, at + 1, indexing="ij"))
    inside, share = ends[high] - ends[low], (spent[high] - spent[low]) / spent_in_all
    enough = (inside >= max(_FEWEST, _INSIDE * total)) & (high - low <= _WIDEST) & (high > low)
    enough &= (share <= inside / total / _TIMES_MORE) & ((inside >= _MANY) | (share <= _NARROW))
    if not enough.any():
        return None
    best = max(np.flatnonzero(enough).tolist(), key=lambda row: (inside[row], -share[row]))
    bins = np.flatnonzero(lost[low[best] : high[best]]) + low[best]
    first, last = (int(bins[0]), int(bins[-1]) + 1) if len(bins) else (int(low[best]), int(high[best]))
    return AngleRange(edge_rad(first), edge_rad(last), int(inside[best]), float(share[best]))


def when_fast(time: Numbers, lost: Numbers, begun: Numbers) -> Fast | None:
    """Return the speed above which a joint's replies go missing; None where it does not depend on it.

    Of each bin: how long the joint was so fast, lost replies, episodes that began. The module has the rule.
    """
    total, in_all = int(lost.sum()), int(time.sum())
    if total < _FEWEST_FAST or not in_all:
        return None
    above, times, share = (np.cumsum(each[::-1])[::-1] for each in (lost, begun, time / in_all))
    slow_rate = (total - above) / np.maximum(1.0 - share, 1e-9)
    enough = (above >= _INSIDE * total) & (times >= _FEWEST_TIMES) & (share <= _MOST_TIME) & (share > 0)
    enough &= above >= _FAST_MORE * slow_rate * share
    enough[:_SLOWEST] = False
    if not enough.any():
        return None
    at = int(np.flatnonzero(enough)[-1])
    return Fast(at * STEP_RAD_S, float(above[at] / total), float(share[at]))
