"""Joints that fail to follow their commands: comparison of each joint with its own earlier behaviour.

All rules use the error, position minus the trajectory that the joint could reach (see tracking.py), while the
servo has torque and controls a position, in bins of 0.1 s or more:

- *stands still*: its position changes by at most two ticks for 0.5 s while its trajectory moves by 9 deg or
  more, and its error is as large; all times at that place count;
- *far from its goal*: by 9 deg or more, scaled up if the robot file declares a lower gain than the model's;
- *follows worse*: three times the worst error of any earlier time, and 4.6 deg, at goals that it had
  before, and at no much higher speed. A joint whose load grew in proportion to its error carries more;
- *oscillates*: its error swings by 2 deg or more, twelve times a second more than its trajectory does. The
  bound is eight times if a controller moves it with an effort, relative to the position that the controller
  is to hold. The rule also applies if its goal swings, which the joint cannot follow.

A joint that never followed well, or that is at places where it was not before, has no reference and is not
compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.planned import PlannedJoint

ERROR, WAY, POSITION, SPEED, LOAD, AWAY, SWINGS, GOALS = range(8)
"""Rows of `Windows` and `Bins`: signed error, reachable trajectory, position, speed of the trajectory,
load, magnitude of the error that counts as failure, swings of the error less those of the trajectory
(1/s), and swings of the goal (1/s)."""
MOVED_RAD = 0.16
"""9 deg: least movement of the trajectory, and least error, of a joint that is reported to stand still."""
AWAY_RAD = 0.08  # 4.6 deg: a joint that follows is nearer
WORSE = 3.0  # Required ratio to the worst error of any earlier time
BAD_S = 1.0  # From this duration on, a failure makes a run not good
_STILL_RAD, _STILL_S = 0.01, 0.5
_MOSTLY = 0.8  # Share of windows with an identical position that allows "to the tick"
_DOUBTFUL = 1.5  # A window this much worse than before is not a reference: it may be the start of the failure
_FASTER = 1.5  # Up to this speed ratio the error is comparable; beyond it, a larger error is expected
_FEWEST = 4  # Windows with torque that are needed as reference
_LAG_S = 0.1  # Lag that does not count as distance from the goal
_CATCH_UP_S = 2.0  # Time to catch up after missing torque or positions
_SHAKES_HZ = 12.0  # Swings a second; two make one oscillation
# Bound for effort control by a controller, which is slower than the servo's own position control.
_SHAKES_BY_EFFORT_HZ = 8.0

_COMMANDED = "Find the clients and controllers that command it (`/commands` in the log), and keep only one."

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Windows:
    """Time series of one joint in windows of equal length: minimum, mean and maximum of each quantity; NaN
    while the servo has no torque."""

    joint: PlannedJoint
    length_s: float
    least: Floats
    mean: Floats
    most: Floats

    def compute_range(self, quantity: int, when: Flags) -> float:
        """Return the greatest minus the smallest value of a quantity in the windows `when`; 0 for none."""
        most = np.fmax.reduce(self.most[quantity, when], initial=-math.inf)
        return max(0.0, float(most - np.fmin.reduce(self.least[quantity, when], initial=math.inf)))

    def typical(self, quantity: int, when: Flags) -> float:
        """Return the mean magnitude of a quantity in the windows `when`; NaN if never known."""
        values = self.mean[quantity, when]
        values = values[np.isfinite(values)]
        return float(np.abs(values).mean()) if len(values) else math.nan

    def distance(self, way: float) -> str:
        """Return a distance as text in the joint's unit, such as `3.2 deg`."""
        return distance(self.joint, way)

    def load_text(self, when: Flags, usual: Flags) -> str:
        """Return the mean load in the windows `when` as text, compared with the load in the windows
        `usual` in which the joint moved."""
        load, otherwise = self.typical(LOAD, when), self.typical(LOAD, usual & (self.mean[SPEED] > 0))
        if math.isnan(load):
            return "; its load was not read"
        top = self.joint.top_effort
        compared = "" if math.isnan(otherwise) else f", {otherwise / top:.0%} otherwise"
        return f", with {load / top:.0%} of its torque{compared}"


@dataclass(frozen=True, slots=True)
class FollowingFailure:
    """Failure of one joint to follow its commands: rule, description, and windows in which it failed."""

    code: str
    text: str  # Description, continues a sentence that begins with the joint's name
    when: Flags  # Windows in which the joint failed
    seconds: float  # Total duration of these windows
    shared: bool = False
    """True for failures that healthy joints also show if load or motion cause them. They are not reported
    if many joints show them at once."""
    commanded: bool = False  # The commands are at fault, not the servo

    def finding(self, one: Windows) -> Finding:
        """Return the failure as a finding of the verdict; `one` is the time series in which it was found."""
        # The joint was possibly meant to stay there.
        away = self.when & (one.mean[AWAY] > AWAY_RAD * one.joint.share)
        since_s = float(np.flatnonzero(away if away.any() else self.when)[0]) * one.length_s
        found = joint_finding(self.code, one.joint, self.text, since_s, brief=self.seconds < BAD_S)
        if not self.commanded:
            return found
        sentence = found.sentence.replace(f" ({one.joint.servos})", "", 1)
        return replace(found, sentence=sentence, remedy=_COMMANDED, rank=Rank.CAUSE)


def joint_finding(code: str, joint: PlannedJoint, text: str, since_s: float, *, brief: bool) -> Finding:
    """Return a finding that accuses a joint, with rank SERVO, or CAUSE if the failure was brief.

    Args:
        code: Code of the rule.
        joint: The joint.
        text: Description of the failure, which continues a sentence that begins with the joint's name.
        since_s: Start of the failure, s since the start of the run.
        brief: The failure lasted less than a second.
    """
    sentence = f"{joint.name} ({joint.servos}) {text}; starting at {since_s:.1f} s of the run."
    return Finding(code, joint.name, sentence, rank=Rank.CAUSE if brief else Rank.SERVO, share=3.0)


def distance(joint: PlannedJoint, way: float) -> str:
    """Return a distance (rad, or m of a linear joint) as text in the joint's unit."""
    return joint.logged.unit.text(way, digits=1)


def failure_of(brief: Windows, one: Windows) -> tuple[Windows, FollowingFailure | None]:
    """Return the failure of one joint, if any, and the time series that shows it.

    A standstill precedes an oscillation, that a joint that follows worse, and that a joint far from its goal.

    Args:
        brief: The joint's time series in windows of 0.1 s or more.
        one: The same in windows of about 0.5 s.
    """
    if (still := _still(brief)) is not None:
        return brief, still
    if (found := _oscillates(one) or _worse(one)) is not None:
        return one, found
    return brief, _far(brief)


def _still(one: Windows) -> FollowingFailure | None:
    """Return the longest standstill of a joint whose trajectory moves, or None."""
    near, moves = max(_STILL_RAD * one.joint.share, 2 * one.joint.tick), MOVED_RAD * one.joint.share
    least, most = one.least[POSITION], one.most[POSITION]
    away = one.mean[AWAY] > AWAY_RAD * one.joint.share
    found = None
    begin, low, high = 0, math.inf, -math.inf
    lows, highs = least.tolist(), most.tolist()
    for at in range(len(least) + 1):
        if at < len(least) and max(high, highs[at]) - min(low, lows[at]) <= near:
            low, high = min(low, lows[at]), max(high, highs[at])
            continue
        seconds = float(away[begin:at].sum()) * one.length_s
        if seconds >= max(_STILL_S, found.seconds if found else 0.0):
            when = np.zeros(len(least), np.bool_)
            when[begin:at] = True
            error = [one.least[ERROR, when], one.most[ERROR, when]]
            if one.compute_range(WAY, when) >= moves and np.nanmax(np.abs(error)) >= moves:
                there = when | (away & (least >= low - near) & (most <= high + near))
                found = _stood(one, when, there, float((there & away).sum()) * one.length_s)
        begin, low, high = at, math.inf, -math.inf
        if at < len(least) and highs[at] - lows[at] <= near:
            low, high = lows[at], highs[at]
        else:
            begin = at + 1
    return found


def _stood(one: Windows, when: Flags, there: Flags, seconds: float) -> FollowingFailure:
    """Return a standstill as a failure. The joint stood still in the windows `when`; `there` are all
    windows at that position; `seconds` is their duration."""
    at = np.nanmedian(one.least[POSITION, when])
    same = (one.least[POSITION] == at) & (one.most[POSITION] == at)
    exact = ", to the tick," if same[when].mean() >= _MOSTLY else ""
    place = one.distance(float(at))
    text = f"stood still{exact} at {place} for"
    if (there & ~when).sum() * one.length_s >= _STILL_S:
        text = f"stops at {place} each time, and stood still there{exact} for"
    most = np.nanmax(np.abs([one.least[ERROR, there], one.most[ERROR, there]]))
    text += f" {seconds:.1f} s although its goal was up to {one.distance(float(most))} away"
    text += one.load_text(when, ~there)
    return FollowingFailure("stood_still", text, there, seconds)


def _far(one: Windows) -> FollowingFailure | None:
    """Return the windows in which a joint is far from its goal and approaches it slowly, as a failure."""
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
    moved = min(1.0, one.compute_range(POSITION, far) / max(one.compute_range(WAY, far), one.joint.tick))
    steps = np.abs(np.diff(one.mean[POSITION], prepend=np.nan))[far]
    fastest = (
        one.distance(float(np.nanquantile(steps, 0.9)) / one.length_s) if np.isfinite(steps).any() else ""
    )
    text = f"was {one.distance(one.typical(AWAY, far))} from its goal for {seconds:.1f} s, and covered "
    text += f"{moved:.0%} of the commanded distance, at up to {fastest}/s{one.load_text(far, ~far)}"
    return FollowingFailure("follows_worse", text, far, seconds, shared=True)


def _oscillates(one: Windows) -> FollowingFailure | None:
    """Return the windows in which the joint's error or its goal swings, as a failure; None if too short."""
    by_effort = np.isnan(one.mean[AWAY])
    shakes = one.mean[SWINGS] >= np.where(by_effort, _SHAKES_BY_EFFORT_HZ, _SHAKES_HZ)
    told = one.mean[GOALS] >= _SHAKES_HZ
    for when, quantity in ((shakes, SWINGS), (told, GOALS)):
        seconds, off = float(when.sum()) * one.length_s, one.typical(AWAY, when)
        if seconds < BAD_S or (when is told and not off >= AWAY_RAD * one.joint.share):
            continue
        text = f"oscillates {one.typical(quantity, when) / 2:.0f} times a second"
        if math.isnan(off):
            text += " around its goal under effort control"
            return FollowingFailure("oscillates", text, when, seconds)
        text += ", like its commands" if when is told else " around its goal"
        text += f", {one.distance(off)} away on average{one.load_text(when, ~when)}"
        return FollowingFailure("oscillates", text, when, seconds, commanded=when is told)
    return None


def _worse(one: Windows) -> FollowingFailure | None:
    """Return the windows in which a joint follows worse than ever before, as a failure; None if too short."""
    away = one.mean[AWAY]
    bad, well, before = (np.zeros(len(away), np.bool_) for _ in range(3))
    follows, count, worst = True, 0, 0.0  # Number of windows `before`, and the worst error in them
    for at in range(len(away)):
        if not away[at] >= 0:  # Without torque: the joint must catch up first
            follows = False
            continue
        follows = follows or bool(away[at] <= AWAY_RAD * one.joint.share)
        bad[at] = follows and count >= _FEWEST and _is_worse(one, at, before, worst)
        doubtful = count >= _FEWEST and away[at] > _DOUBTFUL * worst
        well[at] = follows and not (doubtful and away[at] > AWAY_RAD * one.joint.share / 2)
        if at and well[at]:  # The window before a bad one can contain its start
            before[at - 1] = well[at - 1]
            if well[at - 1]:
                count, worst = count + 1, max(worst, away[at - 1])
    seconds = float(bad.sum()) * one.length_s
    if seconds < BAD_S:
        return None
    before &= np.cumsum(bad) == 0
    error, usual = one.typical(AWAY, bad), one.typical(AWAY, before)
    text = (
        f"follows worse than before: with an error of {one.distance(error)} instead of {one.distance(usual)}"
    )
    return FollowingFailure("follows_worse", text + one.load_text(bad, before), bad, seconds, shared=True)


def _is_worse(one: Windows, at: int, before: Flags, worst: float) -> bool:
    away, speed, load = (one.mean[row] for row in (AWAY, SPEED, LOAD))
    there = AWAY_RAD * one.joint.share
    if not away[at] > max(there, WORSE * worst):
        return False
    new = one.least[WAY, at] < one.least[WAY, before].min() - there
    new |= one.most[WAY, at] > one.most[WAY, before].max() + there
    if new or not speed[at] <= _FASTER * speed[before].max():
        return False
    # The error is explained if the load grew in proportion, or is unknown.
    explained = not load[at] * one.typical(AWAY, before) < away[at] * one.typical(LOAD, before) / 2
    least = there * (2 if explained else 1)
    return bool(away[at] > max(least, WORSE * worst))
