"""Joints that do not do what they are told: plain comparisons of each joint with its own time before.

All by the error, position minus the trajectory that the joint could reach (see tracking.py), while the servo
has torque and controls a position, in bins of 0.1 s or more:

- *stands still*: its position changes by two ticks at most for 0.5 s while its trajectory moves by 9 deg or
  more, and it is as far behind; all times at that place count. With load it is blocked there; where not even
  the last tick changes and the load is as before, what is read can hardly be its position, or, where it comes
  back to that place from elsewhere, it goes no further.
- *far from its goal*, by 9 deg or more, more where the robot file declares a lower gain than the model's: at
  one speed in all of that time it is limited in speed, with one load, less than it can, in torque.
- *error grew*: three times the worst of any time before, and that of the other joints, and 4.6 deg, at goals
  at which it was before, and not much faster. Not at fault is a joint whose load grew as much as its error:
  it carries more. Where most joints get worse together, it is none of them.
- *shakes*: its error swings by 2 deg or more, a dozen times a second more than its trajectory does; eight
  times where a controller moves it with an effort, from the position that this one is to hold.
- *goal swings*: a dozen times a second, which the joint cannot follow.

A joint that never followed well, or that is nowhere it was before, is compared with nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.joints.planned import PlannedJoint

ERROR, WAY, POSITION, SPEED, LOAD, AWAY, SWINGS, GOALS = range(8)
"""Quantities: signed error, trajectory, position, the trajectory's speed, load, the error that counts, and
swings of the error, 1/s, less those of the trajectory; and swings of the goal, 1/s."""
STILL_RAD = 0.01
_STILL_S = 0.5
MOVED_RAD = 0.16
"""9 deg: so far the trajectory of a joint goes that should not stand still, and so far it is behind."""
AWAY_RAD = 0.08  # 4.6 deg: a joint that follows is nearer
_DOUBTFUL = 1.5  # So much worse than before is not compared with: it may be the beginning of it
WORSE = 3.0
_FASTER = 1.5  # So much faster than ever before a joint may err by the square of that, and not be worse
_FEWEST = 4  # Windows with torque, from which a joint has a time before
BAD_S = 1.0  # A joint that did not do what it was told for so long makes a run not good
_LOADED = 2.0
"""So many times its usual load is more load ..."""
_STRONG = 0.3
"""... or, where no usual one is known, so much of what the servo can."""
_WEAK = 0.6  # Part of its torque below which one that is always the same is limited
_MOSTLY = 0.8
_LAG_S = 0.1  # So late a joint may be at its goals without being far from them
_CATCH_UP_S = 2.0  # After it had no torque, or was not read
_SHAKES_HZ = 12.0  # Swings a second, two of them to and fro
_SHAKES_BY_EFFORT_HZ = 8.0  # The same where a controller moves it with an effort: it is slower than a servo's


@dataclass(frozen=True, slots=True)
class Failing:
    """A time in which one joint did not do what it was told; rad or m, and NaN what is not known."""

    code: str
    when: NDArray[np.bool_]  # The windows in which it did not
    seconds: float  # That they last
    usual: NDArray[np.bool_]  # The windows with which they are compared


@dataclass(frozen=True, slots=True)
class Windows:
    """One joint in windows of time: each quantity's least, mean and most, NaN where it had no torque."""

    joint: PlannedJoint
    length_s: float
    least: Floats
    mean: Floats
    most: Floats

    def reach(self, quantity: int, when: NDArray[np.bool_]) -> float:
        """Return how far apart the values of a quantity are in some windows; 0 in none."""
        most = np.fmax.reduce(self.most[quantity, when], initial=-math.inf)
        return max(0.0, float(most - np.fmin.reduce(self.least[quantity, when], initial=math.inf)))

    def moved(self, when: NDArray[np.bool_]) -> float:
        """Return which part of the way that it was told to go the joint went."""
        return min(1.0, self.reach(POSITION, when) / max(self.reach(WAY, when), self.joint.tick))

    def typical(self, quantity: int, when: NDArray[np.bool_]) -> float:
        """Return the mean magnitude of a quantity in some windows."""
        values = self.mean[quantity, when]
        values = values[np.isfinite(values)]
        return float(np.abs(values).mean()) if len(values) else math.nan


def failure_of(brief: Windows, one: Windows) -> tuple[Windows, Failing | None]:
    """Return what is wrong with a joint, by the most direct evidence, in its short or long windows."""
    still, far = _still(brief), _far(brief)
    if still is not None and still.code != "error_grew":
        return brief, still
    if far is not None and far.code != "far_from_goal":
        return brief, far
    found = _shakes(one) or _worse(one)
    return (brief, still or far) if found is None else (one, found)


def _still(one: Windows) -> Failing | None:
    """Return the longest time in which a joint stands still although it should move."""
    near = max(STILL_RAD * one.joint.share, 2 * one.joint.tick)
    moves = MOVED_RAD * one.joint.share
    least, most = one.least[POSITION], one.most[POSITION]
    away = one.mean[AWAY] > AWAY_RAD * one.joint.share
    found = None
    begin, low, high = 0, math.inf, -math.inf
    for at in range(len(least) + 1):
        end = at == len(least) or not max(high, most[at]) - min(low, least[at]) <= near
        if not end:
            low, high = min(low, least[at]), max(high, most[at])
            continue
        when = np.zeros(len(least), np.bool_)
        when[begin:at] = True
        seconds = float((away & when).sum()) * one.length_s
        if (
            seconds >= max(_STILL_S, found.seconds if found else 0.0)
            and one.reach(WAY, when) >= moves
            and np.nanmax(np.abs([one.least[ERROR, when], one.most[ERROR, when]])) >= moves
        ):
            there = away & (least >= low - near) & (most <= high + near)
            seconds = float((there | (away & when)).sum()) * one.length_s
            all_of_it = there | when
            found = Failing(_why_still(one, when, there & ~when), all_of_it, seconds, ~all_of_it)
        begin, low, high = at, math.inf, -math.inf
        if at < len(least) and most[at] - least[at] <= near:
            low, high = least[at], most[at]
        else:
            begin = at + 1
    return found


def _why_still(one: Windows, when: NDArray[np.bool_], again: NDArray[np.bool_]) -> str:
    at = np.nanmedian(one.least[POSITION, when])
    same = (one.least[POSITION] == at) & (one.most[POSITION] == at)
    exact = same[when].mean() >= _MOSTLY  # it came to rest in the first ones
    load, usual = one.typical(LOAD, when), one.typical(LOAD, ~when & (one.mean[SPEED] > 0))
    if not exact and math.isnan(load):
        return "jammed_joint"
    more = load >= _LOADED * usual or load >= _WEAK * one.joint.top_effort
    if more or (math.isnan(usual) and load >= _STRONG * one.joint.top_effort):
        return "jammed_joint"
    if again.sum() * one.length_s >= _STILL_S and same[again].mean() >= _MOSTLY:
        return "goes_no_further"
    return "frozen_position" if exact else "error_grew"


def _far(one: Windows) -> Failing | None:
    """Return the time in which a joint is far from its goal, and does not go there as fast as it can."""
    away, speed = one.mean[AWAY], one.mean[SPEED]
    if not len(away):
        return None
    after = np.ones(max(1, round(_CATCH_UP_S / one.length_s)))
    catches_up = np.convolve(np.isnan(away), after)[: len(away)]
    far = away >= MOVED_RAD * one.joint.share * one.joint.softness + _LAG_S * np.nan_to_num(speed)
    far &= catches_up == 0
    seconds = float(far.sum()) * one.length_s
    if seconds < BAD_S:
        return None
    speed = np.abs(np.diff(one.mean[POSITION], prepend=np.nan))[far] / one.length_s
    code = "far_from_goal"
    strains = one.typical(LOAD, far) > _WEAK * one.joint.top_effort
    if not strains and _at_limit(
        speed, one.joint.logged.top_speed or math.inf, one.joint.tick / one.length_s
    ):
        code = "speed_limit"
    elif one.moved(far) <= _WEAK and _at_limit(one.most[LOAD, far], one.joint.top_effort, 0.0):
        code = "torque_limit"
    return Failing(code, far, seconds, ~far)


def _at_limit(values: Floats, most: float, step: float) -> bool:
    """Return whether values are mostly the same, far below the most that there can be."""
    values = values[np.isfinite(values)]
    limit = float(np.quantile(values, 0.9)) if len(values) else math.inf
    same = np.abs(values - limit) <= 0.05 * limit + step
    return 4 * step < limit <= _WEAK * most and bool(same.mean() >= _WEAK)


def _shakes(one: Windows) -> Failing | None:
    """Return the time in which a joint shakes around its trajectory, or is sent to and fro."""
    by_effort = np.isnan(one.mean[AWAY])
    shakes = one.mean[SWINGS] >= np.where(by_effort, _SHAKES_BY_EFFORT_HZ, _SHAKES_HZ)
    seconds = float(shakes.sum()) * one.length_s
    if seconds >= BAD_S:
        return Failing("joint_shakes", shakes, seconds, ~shakes)
    told = one.mean[GOALS] >= _SHAKES_HZ
    seconds = float(told.sum()) * one.length_s
    if seconds < BAD_S or not one.typical(AWAY, told) >= AWAY_RAD * one.joint.share:
        return None
    return Failing("goal_swings", told, seconds, ~told)


def _worse(one: Windows) -> Failing | None:
    """Return the time in which a joint follows worse than ever before, see the module."""
    away = one.mean[AWAY]
    bad, well, before = (np.zeros(len(away), np.bool_) for _ in range(3))
    follows = True
    for at in range(len(away)):
        if not away[at] >= 0:  # no torque: it has to catch up first
            follows = False
            continue
        follows = follows or bool(away[at] <= AWAY_RAD * one.joint.share)
        bad[at] = follows and before.sum() >= _FEWEST and _is_worse(one, at, before)
        doubtful = before.sum() >= _FEWEST and away[at] > _DOUBTFUL * away[before].max()
        well[at] = follows and not (doubtful and away[at] > AWAY_RAD * one.joint.share / 2)
        if at and well[at]:  # one right before a bad one may have its begin in it
            before[at - 1] = well[at - 1]
    seconds = float(bad.sum()) * one.length_s
    before &= np.cumsum(bad) == 0
    return Failing("error_grew", bad, seconds, before) if seconds >= BAD_S else None


def _is_worse(one: Windows, at: int, before: NDArray[np.bool_]) -> bool:
    away, speed, load = (one.mean[row] for row in (AWAY, SPEED, LOAD))
    share, worst = one.joint.share, away[before].max()
    there = AWAY_RAD * share
    new = one.least[WAY, at] < one.least[WAY, before].min() - there
    new |= one.most[WAY, at] > one.most[WAY, before].max() + there
    if new or not speed[at] <= _FASTER * speed[before].max():
        return False
    # by more load, as much more as the error; or it is not known
    explained = not load[at] * one.typical(AWAY, before) < away[at] * one.typical(LOAD, before) / 2
    least = there * (2 if explained else 1)
    return bool(away[at] > max(least, WORSE * worst))
