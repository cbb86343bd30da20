"""Joints that do not do what they are told: plain comparisons of each joint with its own time before.

All by the error, position minus the trajectory that the joint could reach (see tracking.py), while the servo
has torque and controls a position, in bins of 0.1 s or more:

- *stands still*: its position changes by two ticks at most for 0.5 s while its trajectory moves by 9 deg or
  more, and it is as far behind; all times at that place count. With load it is blocked there; where not even
  the last tick changes and the load is as before, what is read can hardly be its position, or, where it comes
  back to that place from elsewhere, it goes no further.
- *far from its goal*, by 9 deg or more, more where the robot file declares a lower gain than the model's: at
  one speed in all of that time it is limited in speed, with one load, less than it can, in torque.
- *jumped*: two positions in half a second, with torque all the while, are 9 deg and a quarter further apart
  than the model turns in that time.
- *error grew*: three times the worst of any time before, and that of the other joints, and 4.6 deg, at goals
  at which it was before, and not much faster. Not at fault is a joint whose load grew as much as its error:
  it carries more. Where most joints get worse together, it is none of them.
- *shakes*: its error swings by 2 deg or more, a dozen times a second more than its trajectory does.

A joint that never followed well, or that is nowhere it was before, is compared with nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats, Torque
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.bins import Bins
from dxlrun_analysis.joints.planned import PlannedJoint

_ERROR, _WAY, _POSITION, _SPEED, _LOAD, _AWAY, _SWINGS = range(7)
"""Quantities: signed error, trajectory, position, the trajectory's speed, load, the error that counts, and
swings of the error, 1/s, less those of the trajectory."""
_STILL_RAD = 0.01
_STILL_S = 0.5
_MOVED_RAD = 0.16
"""9 deg: so far the trajectory of a joint goes that should not stand still, and so far it is behind."""
_AWAY_RAD = 0.08
"""4.6 deg: a joint that follows is nearer."""
_DOUBTFUL = 1.5
"""So much worse than before is not compared with: it may be the beginning of it."""
_WORSE = 3.0
_FASTER = 1.5
"""So much faster than ever before a joint may err by the square of that, and not be worse."""
_WINDOW_S = 0.5
_FEWEST = 4
"""Windows with torque, from which a joint has a time before."""
_BAD_S = 1.0
"""A joint that did not do what it was told for so long makes a run not good."""
_LOADED = 2.0
"""So many times its usual load is more load ..."""
_STRONG = 0.3
"""... or, where no usual one is known, so much of what the servo can."""
_WEAK = 0.6
"""Part of its torque below which one that is always the same is limited."""
_MOSTLY = 0.8
_LAG_S = 0.1
"""So late a joint may be at its goals without being far from them."""
_CATCH_UP_S = 2.0
"""After it had no torque, or was not read."""
_JUMP_S = 0.5
"""Positions that are further apart in time are not compared: it may have been moved."""
_TOO_FAST = 1.25
"""A supply at its limit and a load that pulls make a servo a little faster than its model."""
_SWING_RAD = 0.035
"""2 deg: by less between two turns a joint does not shake."""
_SHAKES_HZ = 12.0
"""Swings a second, two of them to and fro."""
_FULL_SPEED = 0.8
"""A joint that moves to its goal at this part of the greatest speed it ever had does what it can ..."""
_SLOWEST_TOP = 0.4
"""... and that is at least this part of its model's: a weak supply and a load make it slower."""


@dataclass(frozen=True, slots=True)
class _Failing:
    """A time in which one joint did not do what it was told; rad or m, and NaN what is not known."""

    code: str
    when: NDArray[np.bool_]
    """The windows in which it did not."""
    seconds: float
    """That they last."""
    usual: NDArray[np.bool_]
    """The windows with which they are compared."""


@dataclass(slots=True)
class _Jumps:
    """Positions of one joint that it cannot have gone to, and the last one that was read, with its time."""

    count: int = 0
    first_ns: int = 0
    longest: float = 0.0
    read_ns: int = 0
    position: float = math.nan

    def take(self, joint: PlannedJoint, at_ns: NDArray[np.int64], position: Floats) -> None:
        """Take positions by time; NaN is one without torque, which the next one is not compared with."""
        at_ns, position = np.append(self.read_ns, at_ns), np.append(self.position, position)
        seconds, moved = np.diff(at_ns) * 1e-9, np.abs(np.diff(position))
        top = joint.logged.top_speed
        turned: Floats | float = math.inf if top is None else _TOO_FAST * top * seconds
        jumps = (moved > np.maximum(_MOVED_RAD * joint.share, turned)) & (seconds < _JUMP_S)
        if jumps.any():
            self.first_ns = self.first_ns or int(at_ns[1:][jumps][0])
            self.longest = max(self.longest, float(moved[jumps].max()))
            self.count += int(jumps.sum())
        self.read_ns, self.position = int(at_ns[-1]), float(position[-1])


@dataclass(frozen=True, slots=True)
class _Windows:
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
        return min(1.0, self.reach(_POSITION, when) / max(self.reach(_WAY, when), self.joint.tick))

    def typical(self, quantity: int, when: NDArray[np.bool_]) -> float:
        """Return the mean magnitude of a quantity in some windows."""
        values = self.mean[quantity, when]
        values = values[np.isfinite(values)]
        return float(np.abs(values).mean()) if len(values) else math.nan


class Movement:
    """Collects how the joints moved, in memory that does not grow with the log."""

    def __init__(self, joints: Sequence[PlannedJoint] = (), begin_ns: int = 0) -> None:
        self._joints = joints
        self._fastest = np.zeros(len(joints))
        self._jumps = [_Jumps() for _ in joints]
        self.bins = Bins(7, len(joints), begin_ns)

    def take(self, cycles: NDArray[np.void], way: Floats, known: int) -> None:
        """Take cycles with the reachable trajectories, shape (cycles, joints); `known` were taken before."""
        speed = np.full_like(way, np.nan)
        steps = np.diff(cycles["read_ns"] * 1e-9)[:, None]
        speed[1:] = np.abs(np.diff(way, axis=0)) / steps
        moved = np.zeros_like(way)
        moved[1:] = np.abs(np.diff(cycles["position"], axis=0)) / steps
        cycles, way, speed, moved = cycles[known:], way[known:], speed[known:], moved[known:]
        if not len(cycles):
            return
        driven = (cycles["torque"] == Torque.ON) & cycles["valid"] & ~np.isfinite(cycles["goal_effort"])
        at_ns = cycles["read_ns"][:, None] - cycles["age_ns"]
        for row, joint in enumerate(self._joints):
            kept = driven[:, row] | (cycles["torque"][:, row] != Torque.ON)
            jumping = np.where(driven, cycles["position"], np.nan)[kept, row]
            self._jumps[row].take(joint, at_ns[kept, row], jumping)
        position = np.where(driven & np.isfinite(way), cycles["position"], np.nan)
        error = position - way
        velocity = np.nan_to_num(cycles["velocity"])
        fastest = np.maximum.accumulate(np.vstack([self._fastest, np.abs(velocity)]))[1:]
        self._fastest = fastest[-1]
        fastest = np.maximum(
            fastest, [_SLOWEST_TOP * (joint.logged.top_speed or 0) for joint in self._joints]
        )
        hurries = (velocity * error < 0) & (np.abs(velocity) >= _FULL_SPEED * fastest)
        hurries &= moved >= _FULL_SPEED / 2 * np.abs(velocity)
        unknown = np.isnan(error)
        values = [
            error,
            np.where(unknown, np.nan, way),
            position,
            np.where(unknown, np.nan, speed),
            np.where(unknown, np.nan, np.abs(cycles["effort"])),
            np.where(hurries, 0.0, np.abs(error)),
            np.where(unknown, np.nan, self._swings(cycles, error) - self._swings(cycles, way)),
        ]
        self.bins.take(cycles["read_ns"], np.array(values))

    def _swings(self, cycles: NDArray[np.void], values: Floats) -> Floats:
        """Return where a swing ends, as swings a second, shape (cycles, joints)."""
        found = np.zeros_like(values)
        rate = 1e9 / max(float(np.median(np.diff(cycles["read_ns"]))), 1.0) if len(cycles) > 2 else 0.0
        for row, joint in enumerate(self._joints):
            known = np.flatnonzero(np.isfinite(values[:, row]))
            mine = values[known, row]
            turns = np.flatnonzero(np.diff(mine[1:]) * np.diff(mine[:-1]) < 0) + 1
            far = np.abs(np.diff(mine[turns])) >= _SWING_RAD * joint.share
            swings = turns[1:][far & (np.diff(known[turns]) == np.diff(turns))]  # none was missed between
            found[known[swings], row] = rate
        return found

    def findings(self) -> Iterable[Finding]:
        """Name joints that stand still, are blocked or weak, or follow worse than before."""
        short, windows = self._windows(0.0), self._windows(_WINDOW_S)
        bad = [(brief.joint, *_failing(brief, each)) for brief, each in zip(short, windows, strict=True)]
        shared = [joint for joint, _, failing in bad if failing is not None and failing.code in _SHARED]
        together = len(shared) > max(1, len(bad) // 2)
        for row, (joint, one, failing) in enumerate(bad):
            if self._jumps[row].count:
                yield _jumped(joint, self._jumps[row], self.bins.begin_ns)
            if failing is None or (together and joint in shared):
                continue
            all_of_them = short if one is short[row] else windows
            peers = [each.typical(_AWAY, failing.when) for each in all_of_them if each is not one]
            usual = float(np.nanmedian(peers)) if failing.code in _SHARED and peers else math.nan
            if not one.typical(_AWAY, failing.when) < _WORSE * usual:
                yield _finding(one, failing, usual)
        if together:
            buses = {joint.bus for joint in shared}
            yield Finding(
                "error_grew",
                buses.pop() if len(buses) == 1 else "",
                f"{len(shared)} of {len(bad)} joints followed badly, or worse than before, so it is none.",
                "Look at what they share: the line, the supply, the load, the motion.",
                Rank.SERVO,
            )

    def _windows(self, seconds: float) -> list[_Windows]:
        length_s, *values = self.bins.joined(seconds)
        return [
            _Windows(joint, length_s, *(each[:, :, row] for each in values))
            for row, joint in enumerate(self._joints)
        ]


def _failing(brief: _Windows, one: _Windows) -> tuple[_Windows, _Failing | None]:
    """Return what is wrong with a joint, by the most direct evidence, in its short or long windows."""
    still, far = _still(brief), _far(brief)
    if still is not None and still.code != "error_grew":
        return brief, still
    if far is not None and far.code != "far_from_goal":
        return brief, far
    found = _shakes(one) or _worse(one)
    return (brief, still or far) if found is None else (one, found)


def _still(one: _Windows) -> _Failing | None:
    """Return the longest time in which a joint stands still although it should move."""
    near = max(_STILL_RAD * one.joint.share, 2 * one.joint.tick)
    moves = _MOVED_RAD * one.joint.share
    least, most = one.least[_POSITION], one.most[_POSITION]
    away = one.mean[_AWAY] > _AWAY_RAD * one.joint.share
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
            and one.reach(_WAY, when) >= moves
            and np.nanmax(np.abs([one.least[_ERROR, when], one.most[_ERROR, when]])) >= moves
        ):
            there = away & (least >= low - near) & (most <= high + near)
            seconds = float((there | (away & when)).sum()) * one.length_s
            all_of_it = there | when
            found = _Failing(_why_still(one, when, there & ~when), all_of_it, seconds, ~all_of_it)
        begin, low, high = at, math.inf, -math.inf
        if at < len(least) and most[at] - least[at] <= near:
            low, high = least[at], most[at]
        else:
            begin = at + 1
    return found


def _why_still(one: _Windows, when: NDArray[np.bool_], again: NDArray[np.bool_]) -> str:
    at = np.nanmedian(one.least[_POSITION, when])
    same = (one.least[_POSITION] == at) & (one.most[_POSITION] == at)
    exact = same[when].mean() >= _MOSTLY  # it came to rest in the first ones
    load, usual = one.typical(_LOAD, when), one.typical(_LOAD, ~when & (one.mean[_SPEED] > 0))
    if not exact and math.isnan(load):
        return "jammed_joint"
    more = load >= _LOADED * usual or load >= _WEAK * one.joint.top_effort
    if more or (math.isnan(usual) and load >= _STRONG * one.joint.top_effort):
        return "jammed_joint"
    if again.sum() * one.length_s >= _STILL_S and same[again].mean() >= _MOSTLY:
        return "goes_no_further"
    return "frozen_position" if exact else "error_grew"


def _far(one: _Windows) -> _Failing | None:
    """Return the time in which a joint is far from its goal, and does not go there as fast as it can."""
    away, speed = one.mean[_AWAY], one.mean[_SPEED]
    if not len(away):
        return None
    after = np.ones(max(1, round(_CATCH_UP_S / one.length_s)))
    catches_up = np.convolve(np.isnan(away), after)[: len(away)]
    far = away >= _MOVED_RAD * one.joint.share * one.joint.softness + _LAG_S * np.nan_to_num(speed)
    far &= catches_up == 0
    seconds = float(far.sum()) * one.length_s
    if seconds < _BAD_S:
        return None
    speed = np.abs(np.diff(one.mean[_POSITION], prepend=np.nan))[far] / one.length_s
    code = "far_from_goal"
    strains = one.typical(_LOAD, far) > _WEAK * one.joint.top_effort
    if not strains and _at_limit(
        speed, one.joint.logged.top_speed or math.inf, one.joint.tick / one.length_s
    ):
        code = "speed_limit"
    elif one.moved(far) <= _WEAK and _at_limit(one.most[_LOAD, far], one.joint.top_effort, 0.0):
        code = "torque_limit"
    return _Failing(code, far, seconds, ~far)


def _at_limit(values: Floats, most: float, step: float) -> bool:
    """Return whether values are mostly the same, far below the most that there can be."""
    values = values[np.isfinite(values)]
    limit = float(np.quantile(values, 0.9)) if len(values) else math.inf
    same = np.abs(values - limit) <= 0.05 * limit + step
    return 4 * step < limit <= _WEAK * most and bool(same.mean() >= _WEAK)


def _shakes(one: _Windows) -> _Failing | None:
    """Return the time in which a joint shakes around its trajectory."""
    shakes = one.mean[_SWINGS] >= _SHAKES_HZ
    seconds = float(shakes.sum()) * one.length_s
    return _Failing("joint_shakes", shakes, seconds, ~shakes) if seconds >= _BAD_S else None


def _worse(one: _Windows) -> _Failing | None:
    """Return the time in which a joint follows worse than ever before, see the module."""
    away = one.mean[_AWAY]
    bad, well, before = (np.zeros(len(away), np.bool_) for _ in range(3))
    follows = True
    for at in range(len(away)):
        if not away[at] >= 0:  # no torque: it has to catch up first
            follows = False
            continue
        follows = follows or bool(away[at] <= _AWAY_RAD * one.joint.share)
        bad[at] = follows and before.sum() >= _FEWEST and _is_worse(one, at, before)
        doubtful = before.sum() >= _FEWEST and away[at] > _DOUBTFUL * away[before].max()
        well[at] = follows and not (doubtful and away[at] > _AWAY_RAD * one.joint.share / 2)
        if at and well[at]:  # one right before a bad one may have its begin in it
            before[at - 1] = well[at - 1]
    seconds = float(bad.sum()) * one.length_s
    before &= np.cumsum(bad) == 0
    return _Failing("error_grew", bad, seconds, before) if seconds >= _BAD_S else None


def _is_worse(one: _Windows, at: int, before: NDArray[np.bool_]) -> bool:
    away, speed, load = (one.mean[row] for row in (_AWAY, _SPEED, _LOAD))
    share, worst = one.joint.share, away[before].max()
    there = _AWAY_RAD * share
    new = one.least[_WAY, at] < one.least[_WAY, before].min() - there
    new |= one.most[_WAY, at] > one.most[_WAY, before].max() + there
    if new or not speed[at] <= _FASTER * speed[before].max():
        return False
    # by more load, as much more as the error; or it is not known
    explained = not load[at] * one.typical(_AWAY, before) < away[at] * one.typical(_LOAD, before) / 2
    least = there * (2 if explained else 1)
    return bool(away[at] > max(least, _WORSE * worst))


_REMEDIES = {
    "jammed_joint": "Look for what blocks it: an obstacle, a cable in the joint, a broken gear.",
    "frozen_position": "Turn it by hand without torque: a position that does not change then is the "
    "encoder's or the servo's mistake. Else compare torque, mode and limits with the robot file "
    "(`dxlrun servo PORT ID get`): another program may have changed them.",
    "goes_no_further": "Compare Max and Min Position Limit (CW and CCW Angle Limit) with the robot file "
    "(`dxlrun servo PORT ID get`), and look for what it runs into there.",
    "speed_limit": "Compare Profile Velocity (Moving Speed), Torque Limit and Goal PWM with the model's: "
    "`dxlrun servo PORT ID get` prints them; another tool may have left them.",
    "torque_limit": "Compare Torque Limit, Goal Current, Goal PWM and gains with the model's: "
    "`dxlrun servo PORT ID get` prints them.",
    "far_from_goal": "Look for what holds it back: an obstacle, friction, too heavy a load, low gains or "
    "limits (`dxlrun servo PORT ID get`).",
    "joint_shakes": "Look for play in gears and horn; lower its gains, or its load's inertia.",
    "error_grew": "Compare its gains and limits with the model's (`dxlrun servo PORT ID get`), and turn it "
    "by hand: a horn or a gear may slip.",
}


_MAY_BE = {
    "frozen_position": ": what it reads is not its position, or it does not try: without torque, in another "
    "mode or at a limit of its own"
}
_SHARED = ("error_grew", "far_from_goal", "speed_limit", "torque_limit")
"""What a joint that is not at fault may show too, where others do."""
_RANKS = {"jammed_joint": Rank.SERVO_CAUSE}
"""It may pull down the supply, or shut itself down."""


def _finding(one: _Windows, failing: _Failing, peers: float) -> Finding:
    joint, code, when = one.joint, failing.code, failing.when
    error, before = one.typical(_AWAY, when), one.typical(_AWAY, failing.usual)
    load, usual = one.typical(_LOAD, when), one.typical(_LOAD, failing.usual & (one.mean[_SPEED] > 0))
    part = f"and went {one.moved(when):.0%} of its way"
    exerted = "; its load is not read"
    if not math.isnan(load):
        otherwise = "" if math.isnan(usual) else f", {usual / joint.top_effort:.0%} otherwise"
        exerted = f" ({load / joint.top_effort:.0%} of its torque{otherwise})"
    if code == "torque_limit":
        most = np.nanquantile(one.most[_LOAD, when], 0.9) / joint.top_effort
        what = f"exerted no more than {most:.0%} of its torque, {_text(joint, error)} from its goal, {part}"
        exerted = ": its torque is limited, or its gain is low"
    elif code == "speed_limit":
        speed = np.nanquantile(np.abs(np.diff(one.mean[_POSITION], prepend=np.nan))[when], 0.9) / one.length_s
        what = f"moved at no more than {_text(joint, speed)}/s, {_text(joint, error)} from its goal, {part}"
        exerted += ": its speed or its torque is limited, or it is stiff"
    elif code == "far_from_goal":
        what = f"was {_text(joint, error)} from its goal for {failing.seconds:.1f} s, {part}"
    elif code == "error_grew" and one.reach(_POSITION, when) > _STILL_RAD * joint.share:
        worse = f"{error / before:.0f} times worse" if before > joint.tick else "worse"
        rest = "" if math.isnan(peers) else f"; other joints: {_text(joint, peers)}"
        what = (
            f"followed {worse} than before: {_text(joint, error)} away (before: {_text(joint, before)}{rest})"
        )
        what += f", {part}"
    elif code == "joint_shakes":
        hertz = one.typical(_SWINGS, when) / 2
        what = f"shakes {hertz:.0f} times a second around its goal, {_text(joint, error)} on average"
    else:
        place = _text(joint, float(np.nanmedian(one.mean[_POSITION, when])))
        did = "stood still, to the tick," if code == "frozen_position" else "stood still"
        did += {
            "jammed_joint": f" at {place}, as if blocked,",
            "goes_no_further": f" at {place} each time,",
        }.get(code, "")
        most = np.nanmax(np.abs([one.least[_ERROR, when], one.most[_ERROR, when]]))
        what = f"{did} for {failing.seconds:.1f} s although its goal was up to {_text(joint, most)} away"
    away = when & (one.mean[_AWAY] > _AWAY_RAD * joint.share)  # it may have stood where it was to stand
    since_s = float(np.flatnonzero(away if away.any() else when)[0]) * one.length_s
    return Finding(
        code,
        joint.name,
        f"{joint.name} ({joint.servos}) {what}{exerted}; from {since_s:.1f} s of the run on"
        f"{_MAY_BE.get(code, '')}.",
        _REMEDIES[code],
        Rank.CAUSE if failing.seconds < _BAD_S else _RANKS.get(code, Rank.SERVO),
        3.0,
    )


def _jumped(joint: PlannedJoint, jumps: _Jumps, begin_ns: int) -> Finding:
    times = "" if jumps.count == 1 else f" {jumps.count} times"
    most, since_s = _text(joint, jumps.longest), (jumps.first_ns - begin_ns) * 1e-9
    return Finding(
        "position_jumped",
        joint.name,
        f"The position of {joint.name} ({joint.servos}) jumped{times}, by up to {most}, faster than its "
        f"model turns, from {since_s:.1f} s of the run on: a gear or horn slips, its encoder is loose, or "
        "another tool changed its offset or direction.",
        "Turn it by hand without torque and watch its position; compare Homing Offset and Drive Mode with "
        "the robot file (`dxlrun servo PORT ID get`).",
        Rank.CAUSE,
        4.0,
    )


def _text(joint: PlannedJoint, distance: float) -> str:
    return f"{distance * 1e3:.1f} mm" if joint.logged.linear else f"{math.degrees(distance):.1f} deg"
