"""Joints that follow differently than before: comparison place by place, separately in each direction.

A servo with position control lags behind its trajectory by a constant time at any speed. Each joint is
therefore compared with its trajectory, delayed by the lag that is typical of its kind. The remainder is
caused by load, friction or play of the joint itself. A *visit* is a stay at a place where the joint was
before, in the same direction and at a similar speed, or at rest; it is compared with the earlier stays. A
joint *follows worse* if its error differs by 2 deg, or its load by an eighth of its torque, at three visits
and for half a second. The difference must be three times that of any other joint that moved, or any but one:
if others show it too, the cause is the motion, the ground or the supply. A joint *oscillates* if it swings
evenly around its goal, by 0.6 deg, ten times in a row, while the goal does not.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.failing import joint_finding
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import TrailSamples

STROKE_RAD = 0.1  # 6 deg: least amplitude of a reversal
_LAGS_S = np.arange(0.0, 0.31, 0.01)
_MOVES_RAD_S = 0.05  # Slower samples say little about a lag
_FEWEST = 20  # Moving samples that are needed for a lag
# Skip joints with a greater share of missing samples: goals are missing too, so the error says nothing about
# the joint.
_LOST = 0.02
_QUICK = 0.6  # Share of the model's top speed above which a servo cannot follow closely
_SETTLES_S = 0.3  # Time after fast movement in which the error does not count
_GONE_S = 0.16
"""A gap in the positions longer than this is not due to lost replies: the joint had no torque."""
_NEAR_AGAIN_RAD = 0.035
"""Distance from the trajectory at which a joint has caught up after a time without torque."""
_PLACE_RAD = 0.05  # Width of a place: about 3 deg
_AGAIN_S = 0.5  # Least time between a stay and a visit
_CREEPS_RAD_S = 0.1  # Below this speed friction can act in either direction
_FASTER = 1.5  # Speeds within this ratio are similar
_MOST_BEFORE = 12  # Stays kept as reference per place, the first of the run
_BENDS_RAD_S = 0.6
"""Least change of speed within 0.2 s (and half of the speed) that causes an error in a healthy joint."""
_BENDS_S = 0.1  # Interval before and after, over which the change is measured
_SWING_RAD, _SWING_TICKS = 0.01, 4  # 0.6 deg, or this number of ticks
_SWING_S = 0.2  # Longest time between reversals of a series
_UNEVEN = 0.4  # Self-excited swings are even: bound for the relative deviation of their periods
_OTHERS = 3.0  # Required ratio to any other joint
_FEWEST_OTHERS = 4  # With fewer joints, the greatest value is not skipped
_SIDE = re.compile("left|right|(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_OFF_RAD = 0.035  # 2 deg
_LOAD = 0.12  # Share of its torque
_FEWEST_VISITS, _LASTS_S = 3, 0.5
_SWINGS = 10  # Reversals in a row; two make one oscillation
_WAYS = ((1, "upwards"), (-1, "downwards"), (0, "at rest"))

Flags = NDArray[np.bool_]


class Visit(NamedTuple):
    """Stay of a joint at a place where it was before: error (rad) and load now, and the nearest error and
    load of the earlier stays."""

    at_s: float
    seconds: float
    place: float
    off: float
    was: float
    load: float
    load_was: float
    even: bool  # The speed is nearly constant, so acceleration does not contribute to the load
    direction: int  # 0: nearly at rest

    @property
    def change(self) -> float:
        """Magnitude of the difference between the error now and in the earlier stays, rad."""
        return abs(self.off - self.was)

    @property
    def load_change(self) -> float:
        """Magnitude of the difference between the load now and in the earlier stays, as share of its
        torque; 0 if the load is not read, or the speed changes."""
        change = abs(self.load - self.load_was)
        return change if self.even and math.isfinite(change) else 0.0


class FollowedJoint(NamedTuple):
    """Samples of one joint, and its trajectory after the lag typical of its kind; rad of its servo."""

    row: int
    joint: PlannedJoint
    alike: int  # Number of joints of its kind that moved, including this one
    lag_s: float  # Lag that is typical of its kind
    step_s: float  # Time between samples
    at_s: Floats
    goal: Floats  # Expected position of a joint of its kind
    position: Floats
    off: Floats
    """Position minus `goal`; NaN without a position, near top speed, or while catching up."""
    load: Floats  # Share of its torque
    speed: Floats

    def visits(self, least: float, least_load: float) -> Iterator[Visit]:
        """Yield each stay at a place where the joint was before, in the same direction at a similar speed.

        Stays whose error differs by less than `least` (rad) and whose load differs by less than `least_load`
        (share of torque) become the reference of later ones.
        """
        speed = np.nan_to_num(self.speed)
        direction = np.where(np.abs(speed) < _CREEPS_RAD_S, 0, np.sign(speed)).astype(int)
        known = np.isfinite(self.off)
        place = np.where(known, np.floor(np.nan_to_num(self.goal) / _PLACE_RAD), 0).astype(int)
        keys = np.column_stack([known, place, direction])
        starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=-1) != 0, axis=1))
        lengths = np.diff(starts, append=len(keys))
        stay = np.repeat(np.arange(len(starts)), lengths)
        speeds, offs, loads = (
            each[np.lexsort((each, stay))[starts + lengths // 2]].tolist()
            for each in (np.abs(speed), self.off, self._load_at_rest())
        )
        begins, ends = self.at_s[starts].tolist(), self.at_s[starts + lengths - 1].tolist()
        uneven = np.logical_or.reduceat(self._bends(), starts).tolist()
        # Stays by place and direction: end (s), speed, highest similar speed, error, and load if known.
        usual: dict[tuple[int, int], list[tuple[float, float, float, float, float | None]]] = defaultdict(
            list
        )
        stays = zip(place[starts].tolist(), direction[starts].tolist(), strict=True)
        for row, ((here, way), is_known) in enumerate(zip(stays, known[starts].tolist(), strict=True)):
            if not is_known:
                continue
            at_s, end_s, quick, off, load = begins[row], ends[row], speeds[row], offs[row], loads[row]
            quickest = _FASTER * quick + _CREEPS_RAD_S
            before = [
                (one_off, one_load)
                for near in (here - 1, here, here + 1)
                for until_s, one, its_quickest, one_off, one_load in usual[near, way]
                if until_s < at_s - _AGAIN_S and one <= quickest and quick <= its_quickest
            ]
            was = _nearest(off, [each for each, _ in before])
            took = _nearest(load, [each for _, each in before if each is not None])
            if len(before) < _MOST_BEFORE and abs(off - was) < least and not abs(load - took) >= least_load:
                usual[here, way].append((end_s, quick, quickest, off, load if math.isfinite(load) else None))
            if before:
                seconds, middle = end_s - at_s + self.step_s, (here + 0.5) * _PLACE_RAD
                yield Visit(at_s, seconds, middle, off, was, load, took, not uneven[row], way)

    def _load_at_rest(self) -> Floats:
        """Return the load of each sample without the part that is proportional to speed."""
        known = np.isfinite(self.off) & np.isfinite(self.load)
        speed, load = self.speed[known], self.load[known]
        moved = float(speed @ speed)
        taken = float(speed @ (load - load.mean())) / moved if moved else 0.0
        return self.load - taken * self.speed

    def swings(self) -> Floats:
        """Return the times (s) at which the error reverses, in the longest series of even swings; empty if
        the goal swings in that time as well."""
        least = max(_SWING_RAD, _SWING_TICKS * self.joint.tick / self.joint.share)
        turns = self._turns_of(self.off, least)
        parts = np.split(turns, np.flatnonzero(np.diff(turns) > _SWING_S) + 1)
        series = max((part for part in parts if _even(part)), key=len, default=turns[:0])
        told = self._turns_of(self.goal, least / 4)
        if len(series) and ((told >= series[0]) & (told <= series[-1])).sum() > len(series) / 3:
            return series[:0]
        return series

    def _turns_of(self, values: Floats, least: float) -> Floats:
        """Return the times (s) at which `values` reverse by `least` or more, where the error is known."""
        edges = np.flatnonzero(np.diff(np.isfinite(self.off), prepend=False, append=False))
        pairs = zip(edges[::2], edges[1::2], strict=True)
        turns = [begin + at for begin, end in pairs for at in _turning(values[begin:end], least)[1:-1]]
        return self.at_s[turns]

    def _bends(self) -> Flags:
        """Return the samples at which the trajectory's speed changes much in 0.2 s, or is unknown."""
        bends = np.zeros(len(self.off), np.bool_)
        side = _samples(_BENDS_S, self.step_s)
        least = np.maximum(_BENDS_RAD_S, np.abs(self.speed[side:-side]) / 2)
        bends[side:-side] = ~(np.abs(self.speed[2 * side :] - self.speed[: -2 * side]) < least)
        return bends


def followed(joints: Sequence[PlannedJoint], samples: TrailSamples) -> list[FollowedJoint]:
    """Return the joints that moved and lost few replies, each compared with its trajectory after the
    median lag of the joints of its kind."""
    lags: dict[str, dict[int, float]] = defaultdict(dict)
    for row, joint in enumerate(joints):
        way, position = samples.way[:, row] / joint.share, samples.position[:, row] / joint.share
        known = way[np.isfinite(way)]
        if len(known) < _FEWEST or np.ptp(known) < STROKE_RAD or _lossy(position, samples.step_s):
            continue
        lag_s = _lag_s(samples.at_s, way, position)
        if lag_s is not None:
            lags[joint.alike][row] = lag_s
    found = []
    for of_kind in lags.values():
        lag_s = sorted(of_kind.values())[(len(of_kind) - 1) // 2]
        found += [_followed(row, joints[row], len(of_kind), lag_s, samples) for row in of_kind]
    return sorted(found, key=lambda one: one.row)


def _followed(
    row: int, joint: PlannedJoint, alike: int, lag_s: float, samples: TrailSamples
) -> FollowedJoint:
    at_s, position = samples.at_s, samples.position[:, row] / joint.share
    goal = _late(at_s, samples.way[:, row] / joint.share, lag_s)
    speed = np.gradient(goal, at_s)
    top = math.inf if joint.logged.top_speed is None else joint.logged.top_speed / joint.share
    off = position - goal
    # Near top speed, and shortly afterwards, the error says nothing about load or friction.
    off[_lasting(~(np.abs(speed) < _QUICK * top), _samples(_SETTLES_S, samples.step_s))] = np.nan
    gone = _gone(position, samples.step_s)
    for begin in np.flatnonzero(gone[:-1] & ~gone[1:]).tolist():
        near = np.flatnonzero(np.abs(off[begin:]) <= _NEAR_AGAIN_RAD)
        off[begin : begin + (int(near[0]) if len(near) else len(off))] = np.nan
    load = samples.load[:, row] / joint.top_effort
    return FollowedJoint(row, joint, alike, lag_s, samples.step_s, at_s, goal, position, off, load, speed)


def _late(at_s: Floats, way: Floats, lag_s: float) -> Floats:
    """Return a trajectory delayed by `lag_s`; NaN before its begin."""
    late: Floats = np.interp(at_s - lag_s, at_s, way, left=np.nan)
    return late


def _lag_s(at_s: Floats, way: Floats, position: Floats) -> float | None:
    """Return the delay (s) of the trajectory that best explains the position while the joint moves; None
    if it hardly moves."""
    moves = np.abs(np.gradient(way, at_s)) > _MOVES_RAD_S
    best, lag_s = math.inf, None
    for each in _LAGS_S.tolist():
        off = (position - _late(at_s, way, each))[moves]
        off = off[np.isfinite(off)]
        if len(off) >= _FEWEST and (rest := float(np.median(np.abs(off - np.median(off))))) < best:
            best, lag_s = rest, each
    return lag_s


def _samples(seconds: float, step_s: float) -> int:
    """Return the number of samples in `seconds`, at least one."""
    return max(1, round(seconds / step_s))


def _gone(position: Floats, step_s: float) -> Flags:
    """Return the samples at which a joint had no position for 0.16 s or more."""
    lost, many = np.isnan(position).astype(float), _samples(_GONE_S, step_s)
    return np.convolve(lost, np.ones(many))[: len(lost)] >= many


def _lossy(position: Floats, step_s: float) -> bool:
    """Return whether more than 2 % of the positions are missing, without gaps of 0.16 s or more."""
    known = np.flatnonzero(np.isfinite(position))
    if not len(known):
        return True
    gaps = np.diff(known) - 1
    return float(gaps[gaps < _samples(_GONE_S, step_s)].sum()) > _LOST * len(known)


def _lasting(when: Flags, samples: int) -> Flags:
    """Return the samples at which a condition holds, or held less than `samples` samples before."""
    return np.convolve(when.astype(float), np.ones(samples))[: len(when)] > 0


def _turning(values: Floats, least: float) -> list[int]:
    """Return the indices at which finite values reverse by `least` or more, and both ends of the movement."""
    step = np.sign(np.diff(values))
    moved = np.flatnonzero(step)
    turns = moved[1:][step[moved[1:]] != step[moved[:-1]]]
    found: list[int] = []
    direction, lowest, highest = 0, 0, 0
    for at in (*turns.tolist(), len(values) - 1):
        lowest = at if values[at] < values[lowest] else lowest
        highest = at if values[at] > values[highest] else highest
        if direction <= 0 and values[at] - values[lowest] >= least:
            found.append(lowest)
            direction, highest = 1, at
        elif direction >= 0 and values[highest] - values[at] >= least:
            found.append(highest)
            direction, lowest = -1, at
    return [*found, highest if direction > 0 else lowest] if direction else []


def _even(at_s: Floats) -> bool:
    gaps = np.diff(at_s)
    return len(gaps) > 0 and bool(gaps.std() < _UNEVEN * gaps.mean())


def _nearest(value: float, before: Sequence[float]) -> float:
    """Return `value` clamped to the range of `before`; `value` itself if `before` is empty."""
    return min(max(value, min(before)), max(before)) if before else value


# Rules


class _FollowingEvidence(NamedTuple):
    """Evidence about one joint for the rules below: its visits and swings, and the greatest changes."""

    one: FollowedJoint
    visits: list[Visit]
    swings: Floats
    off: float
    load: float

    @classmethod
    def of_joint(cls, one: FollowedJoint) -> _FollowingEvidence:
        """Collect the evidence about a joint."""
        visits = list(one.visits(_OFF_RAD / 2, _LOAD / 2))
        off = max((visit.change for visit in visits), default=0.0)
        return cls(one, visits, one.swings(), off, max((visit.load_change for visit in visits), default=0.0))


def changed(joints: Sequence[FollowedJoint], named: Set[int]) -> Iterator[Finding]:
    """Report each joint that follows worse or oscillates, by far more than any other joint does.

    Args:
        joints: The joints that moved.
        named: Rows of joints that other rules report; they are omitted.
    """
    seen = [_FollowingEvidence.of_joint(one) for one in joints if one.row not in named]
    for mine in seen:
        others = [each for each in seen if each is not mine]
        found = _swings(mine, others) or _follows_worse(mine, others)
        if found is not None:
            yield found


def _most(values: Iterable[tuple[float, str]], name: str) -> float:
    """Return the greatest of some values of other joints, 0.0 at least, to compare the joint `name` with;
    `values` are pairs of value and joint name.

    Among four or more joints the greatest value is skipped, because it may come from a second faulty joint.
    It is kept if it comes from the mirror image of this joint (left and right), to which the same can happen.
    """
    ordered = sorted((value, _SIDE.sub("", other) == _SIDE.sub("", name)) for value, other in values)
    alone = len(ordered) >= _FEWEST_OTHERS and not ordered[-1][1]
    return max(0.0, ordered[-2 if alone else -1][0]) if ordered else 0.0


def _follows_worse(mine: _FollowingEvidence, others: Sequence[_FollowingEvidence]) -> Finding | None:
    joint = mine.one.joint
    least = max(_OFF_RAD, _OTHERS * _most(((one.off, one.one.joint.name) for one in others), joint.name))
    heavy = max(_LOAD, _OTHERS * _most(((one.load, one.one.joint.name) for one in others), joint.name))
    off = [one for one in mine.visits if one.change > least]
    bad = off if _lasts(off) else [one for one in mine.visits if one.load_change > heavy]
    if not _lasts(bad):
        return None
    parts = [text for way, name in _WAYS if (text := _compared(mine.one, name, bad, way))]
    text = f"follows differently than before at the same places: {'; '.join(parts)}"
    found = joint_finding("follows_worse", joint, text, bad[0].at_s, brief=True)
    return found if bad is off else replace(found, rank=Rank.REMARK)


def _lasts(visits: Sequence[Visit]) -> bool:
    return len(visits) >= _FEWEST_VISITS and sum(each.seconds for each in visits) >= _LASTS_S


def _compared(one: FollowedJoint, name: str, visits: Iterable[Visit], way: int) -> str:
    """Return error and load at those visits with the direction `way`, next to those of the earlier stays,
    as text. `name` is the direction in words; empty without such visits."""
    mine = [visit for visit in visits if visit.direction == way]
    if not mine:
        return ""
    off, was = (float(np.median([visit[at] for visit in mine])) for at in (3, 4))
    loads = np.array([(each.load, each.load_was) for each in mine if math.isfinite(each.load_was)])
    text = f"{name} {math.degrees(off):.1f} deg off instead of {math.degrees(was):.1f}"
    if len(loads):
        load, load_was = np.median(np.abs(loads), axis=0).tolist()
        text += f", with {load:.0%} of its torque instead of {load_was:.0%}"
    return text


def _swings(mine: _FollowingEvidence, others: Sequence[_FollowingEvidence]) -> Finding | None:
    at_s, joint = mine.swings, mine.one.joint
    theirs = _most(((float(len(one.swings)), one.one.joint.name) for one in others), joint.name)
    if len(at_s) < max(_SWINGS, _OTHERS * theirs):
        return None
    hertz = (len(at_s) - 1) / float(at_s[-1] - at_s[0]) / 2
    text = f"oscillates around its goal {hertz:.0f} times a second, {len(at_s) // 2} oscillations in a row"
    return replace(joint_finding("oscillates", joint, text, float(at_s[0]), brief=True), rank=Rank.REMARK)
