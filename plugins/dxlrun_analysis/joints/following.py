"""How a joint follows: how far it is off where a joint like it would be, turn by turn and place by place.

A servo with a position control is behind its trajectory by a constant time, whatever its speed. So a joint is
compared with its trajectory as late as joints of its kind are, and what is left is what weighs on it, rubs,
or gives: its own.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import Samples

STROKE_RAD = 0.1  # 6 deg: by less to and fro a joint does not turn
_LAGS_S = np.arange(0.0, 0.31, 0.01)
_MOVES_RAD_S = 0.05
_FEWEST = 20  # Samples that move, from which a lag is known
_LOST = 0.02  # Of the samples: where more are missing, goals are missing too, and the joint is not to blame
_QUICK = 0.6  # Part of the model's speed above which a servo follows as it can
_SETTLES_S = 0.3
_GONE_S = 0.16
"""So long without a position are no lost replies: it had no torque ..."""
_NEAR_AGAIN_RAD = 0.035
"""... and has to come so near to its way first."""
_PLACE_RAD = 0.05
_AGAIN_S = 0.5  # A joint that was at a place so long ago comes there again
_CREEPS_RAD_S = 0.1  # By less it is nearly at rest, and may be on either side of what rubs
_FASTER = 1.5
_MOST_BEFORE = 12  # Stays at a place that later ones are compared with: the first ones of a run
_AT_ONCE_S = 0.08
_BENDS_RAD_S = 0.6
"""A trajectory whose speed changes by so much, and by half, in 0.2 s throws its joint off by itself."""
_BENDS_S, _BENT_S = 0.1, 0.16  # So long before and behind it that is measured, and so long it is thrown off
_NEAR_RAD = 0.006
_SWING_RAD, _SWING_TICKS = 0.01, 4  # 0.6 deg, or as many ticks
_SWING_S = 0.2
_UNEVEN = 0.4  # What swings by itself does so evenly

Flags = NDArray[np.bool_]


class Turn(NamedTuple):
    """Where a joint turns: what differs between its ways there and back, over the same places."""

    at_s: float
    behind: float  # rad, more than joints of its kind, in each direction
    load: float  # More of it forth than back, halved: what the movement itself takes
    stood: float  # rad that its goal went back before it did
    speed: float  # rad/s, on the two ways


class Visit(NamedTuple):
    """A stay at a place where the joint was before, and how far it is off: now, and before at its nearest."""

    at_s: float
    seconds: float
    place: float
    off: float
    was: float
    load: float
    load_was: float
    even: bool  # Its speed stays nearly the same: more or less of it takes no load

    @property
    def change(self) -> float:
        """By how much it is off otherwise."""
        return abs(self.off - self.was)

    @property
    def load_change(self) -> float:
        """By how much its load differs; 0 where that is not read, or its speed changes."""
        change = abs(self.load - self.load_was)
        return change if self.even and math.isfinite(change) else 0.0


class _Stay(NamedTuple):
    """How a joint was at a place."""

    end_s: float
    direction: int  # 0: nearly at rest
    speed: float
    off: float
    load: float

    def is_like(self, later: _Stay) -> bool:
        """Return whether a later one may be compared with it: it goes the same way as fast."""
        if self.direction != later.direction:
            return False
        slow, fast = (self.speed, later.speed) if self.speed < later.speed else (later.speed, self.speed)
        return fast <= _FASTER * slow + _CREEPS_RAD_S


class Followed(NamedTuple):
    """One joint, in rad of its servo, sample by sample."""

    row: int
    joint: PlannedJoint
    alike: int  # Joints of its kind that moved, itself among them
    lag_s: float  # Of its kind
    step_s: float  # Between two samples
    at_s: Floats
    goal: Floats  # Where a joint like it would be
    position: Floats
    off: Floats
    """Position minus goal; NaN where it can be anything: not read, as fast as it can, or catching up"""
    load: Floats  # As a part of its torque
    speed: Floats

    def turns(self) -> list[Turn]:
        """Return how it turns, where it goes at least 6 deg there and back."""
        found = []
        edges = np.flatnonzero(np.diff(np.isfinite(self.goal), prepend=False, append=False))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            at = [begin + index for index in _turning(self.goal[begin:end], STROKE_RAD)]
            for three in zip(at, at[1:], at[2:], strict=False):
                turn = self._turn(*three)
                if turn is not None:
                    found.append(turn)
        return found

    def _turn(self, begin: int, at: int, end: int) -> Turn | None:
        there, back = slice(begin, at + 1), slice(at, end + 1)
        sign = 1.0 if self.goal[at] > self.goal[begin] else -1.0
        ends = np.sort([[self.goal[begin], self.goal[at]], [self.goal[at], self.goal[end]]], axis=1)
        low, high = ends[:, 0].max(), ends[:, 1].min()
        margin = 0.2 * (high - low)
        values = []
        for way in (there, back):
            inside = (self.goal[way] > low + margin) & (self.goal[way] < high - margin)
            known = inside & np.isfinite(self.off[way])
            if high - low < STROKE_RAD or known.sum() < max(3.0, 0.8 * inside.sum()):
                return None
            quantities = (self.off, self.load, np.abs(self.speed))
            values.append([float(np.median(each[way][known])) for each in quantities])
        (off, load, speed), (off_back, load_back, speed_back) = values
        far = sign * self.position[begin : end + 1]
        near = max(2 * self.joint.tick / self.joint.share, _NEAR_RAD)
        stays = np.flatnonzero(sign * self.position[back] >= np.nanmax(far) - near)
        stood = abs(self.goal[at + stays[-1]] - self.goal[at]) - near if len(stays) else 0.0
        return Turn(
            float(self.at_s[at]),
            sign * (off_back - off) / 2,
            sign * (load - load_back) / 2,
            max(0.0, float(stood)),
            (speed + speed_back) / 2,
        )

    def visits(self, least: float, least_load: float) -> Iterator[Visit]:
        """Yield each stay at a place where it was before, going the same way as fast, or at rest.

        Those that are off by less than `least` (rad), and whose load differs by less than `least_load`, are
        what later ones are compared with.
        """
        speed = np.nan_to_num(self.speed)
        direction = np.where(np.abs(speed) < _CREEPS_RAD_S, 0, np.sign(speed)).astype(int)
        known = np.isfinite(self.off)
        place = np.where(known, np.floor(np.nan_to_num(self.goal) / _PLACE_RAD), 0).astype(int)
        keys = np.column_stack([known, place, direction])
        starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=-1) != 0, axis=1)).tolist()
        usual: dict[int, list[_Stay]] = defaultdict(list)
        times, bends = self.at_s.tolist(), self._bends()
        values = [each.tolist() for each in (np.abs(speed), self.off, self._load_at_rest())]
        for begin, end in zip(starts, [*starts[1:], len(keys)], strict=True):
            if not known[begin]:
                continue
            here, at_s = int(place[begin]), times[begin]
            middles = (sorted(each[begin:end])[(end - begin) // 2] for each in values)
            stay = _Stay(times[end - 1], int(direction[begin]), *middles)
            before = [
                one
                for near in (here - 1, here, here + 1)
                for one in usual[near]
                if one.end_s < at_s - _AGAIN_S and one.is_like(stay)
            ]
            was = _nearest(stay.off, [one.off for one in before])
            took = _nearest(stay.load, [one.load for one in before if math.isfinite(one.load)])
            if (
                len(before) < _MOST_BEFORE
                and abs(stay.off - was) < least
                and not abs(stay.load - took) >= least_load
            ):
                usual[here].append(stay)
            if before:
                seconds, middle = stay.end_s - at_s + self.step_s, (here + 0.5) * _PLACE_RAD
                even = not bends[begin:end].any()
                yield Visit(at_s, seconds, middle, stay.off, was, stay.load, took, even)

    def _load_at_rest(self) -> Floats:
        """Return the load without what the speed takes."""
        known = np.isfinite(self.off) & np.isfinite(self.load)
        speed, load = self.speed[known], self.load[known]
        moved = float(speed @ speed)
        taken = float(speed @ (load - load.mean())) / moved if moved else 0.0
        return self.load - taken * self.speed

    def swings(self) -> Floats:
        """Return when it turned in its longest series of even swings, s; of none where its goal swings."""
        least = max(_SWING_RAD, _SWING_TICKS * self.joint.tick / self.joint.share)
        turns = self._turns_of(self.off, least)
        parts = np.split(turns, np.flatnonzero(np.diff(turns) > _SWING_S) + 1)
        series = max((part for part in parts if _even(part)), key=len, default=turns[:0])
        told = self._turns_of(self.goal, least / 4)
        if len(series) and ((told >= series[0]) & (told <= series[-1])).sum() > len(series) / 3:
            return series[:0]
        return series

    def _turns_of(self, values: Floats, least: float) -> Floats:
        """Return when values turn by so much, s, where it is known how it follows."""
        edges = np.flatnonzero(np.diff(np.isfinite(self.off), prepend=False, append=False))
        pairs = zip(edges[::2], edges[1::2], strict=True)
        turns = [begin + at for begin, end in pairs for at in _turning(values[begin:end], least)[1:-1]]
        return self.at_s[turns]

    def jerks(self) -> Floats:
        """Return by how much it is off otherwise 80 ms later.

        0 where its goal went as far; NaN where its trajectory bends.
        """
        at_once, bent = _samples(_AT_ONCE_S, self.step_s), _samples(_BENT_S, self.step_s)
        change, went = (np.abs(each[at_once:] - each[:-at_once]) for each in (self.off, self.goal))
        change = np.append(np.where(change > went, change, 0.0), np.full(at_once, np.nan))
        change[np.convolve(self._bends(), np.ones(2 * bent + 1), "same") > 0] = np.nan
        return change

    def _bends(self) -> Flags:
        """Return where the speed of its trajectory changes within 0.2 s, or is not known."""
        bends = np.zeros(len(self.off), np.bool_)
        side = _samples(_BENDS_S, self.step_s)
        least = np.maximum(_BENDS_RAD_S, np.abs(self.speed[side:-side]) / 2)
        bends[side:-side] = ~(np.abs(self.speed[2 * side :] - self.speed[: -2 * side]) < least)
        return bends


def followed(joints: Sequence[PlannedJoint], samples: Samples) -> list[Followed]:
    """Return the joints that moved with their replies nearly whole, each compared with those of its kind."""
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


def _followed(row: int, joint: PlannedJoint, alike: int, lag_s: float, samples: Samples) -> Followed:
    at_s, position = samples.at_s, samples.position[:, row] / joint.share
    goal = _late(at_s, samples.way[:, row] / joint.share, lag_s)
    speed = np.gradient(goal, at_s)
    top = math.inf if joint.logged.top_speed is None else joint.logged.top_speed / joint.share
    off = position - goal
    off[_lasting(~(np.abs(speed) < _QUICK * top), _samples(_SETTLES_S, samples.step_s))] = np.nan
    gone = _gone(position, samples.step_s)
    for begin in np.flatnonzero(gone[:-1] & ~gone[1:]).tolist():
        near = np.flatnonzero(np.abs(off[begin:]) <= _NEAR_AGAIN_RAD)
        off[begin : begin + (int(near[0]) if len(near) else len(off))] = np.nan
    load = samples.load[:, row] / joint.top_effort
    return Followed(row, joint, alike, lag_s, samples.step_s, at_s, goal, position, off, load, speed)


def _late(at_s: Floats, way: Floats, lag_s: float) -> Floats:
    """Return a trajectory some time later; NaN before its begin."""
    late: Floats = np.interp(at_s - lag_s, at_s, way, left=np.nan)
    return late


def _lag_s(at_s: Floats, way: Floats, position: Floats) -> float | None:
    """Return the delay that explains most of where a joint is while it moves; None where it hardly does."""
    moves = np.abs(np.gradient(way, at_s)) > _MOVES_RAD_S
    best, lag_s = math.inf, None
    for each in _LAGS_S.tolist():
        off = (position - _late(at_s, way, each))[moves]
        off = off[np.isfinite(off)]
        if len(off) >= _FEWEST and (rest := float(np.median(np.abs(off - np.median(off))))) < best:
            best, lag_s = rest, each
    return lag_s


def _samples(seconds: float, step_s: float) -> int:
    """Return how many samples a time has, one at least."""
    return max(1, round(seconds / step_s))


def _gone(position: Floats, step_s: float) -> Flags:
    """Return where a joint was without a position for long."""
    lost, many = np.isnan(position).astype(float), _samples(_GONE_S, step_s)
    return np.convolve(lost, np.ones(many))[: len(lost)] >= many


def _lossy(position: Floats, step_s: float) -> bool:
    """Return whether positions are missing now and then."""
    known = np.flatnonzero(np.isfinite(position))
    if not len(known):
        return True
    gaps = np.diff(known) - 1
    return float(gaps[gaps < _samples(_GONE_S, step_s)].sum()) > _LOST * len(known)


def _lasting(when: Flags, samples: int) -> Flags:
    """Return where something is, or was so many samples before."""
    return np.convolve(when.astype(float), np.ones(samples))[: len(when)] > 0


def _turning(values: Floats, least: float) -> list[int]:
    """Return where finite values turn by so much or more, from the first turn or end to the last."""
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
    """Return what is nearest to a value between the least and the greatest before; itself where none was."""
    return min(max(value, min(before)), max(before)) if before else value
