"""How the joints moved, collected over the run, and what is said of those that did not do as they were told.

See failing.py for the rules. Besides, two positions in half a second, with torque all the while, are a *jump*
where they are 9 deg and a quarter further apart than the model turns in that time.
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
from dxlrun_analysis.joints.failing import (
    AWAY,
    AWAY_RAD,
    BAD_S,
    ERROR,
    GOALS,
    LOAD,
    MOVED_RAD,
    POSITION,
    SPEED,
    STILL_RAD,
    SWINGS,
    WORSE,
    Failing,
    Windows,
    failure_of,
)
from dxlrun_analysis.joints.planned import PlannedJoint

_WINDOW_S = 0.5
_JUMP_S = 0.5
"""Positions that are further apart in time are not compared: it may have been moved."""
_TOO_FAST = 1.25
"""A supply at its limit and a load that pulls make a servo a little faster than its model."""
_SWING_RAD = 0.035
"""2 deg: by less between two turns a joint does not shake."""
_FULL_SPEED = 0.8
"""A joint that moves to its goal at this part of the greatest speed it ever had does what it can ..."""
_SLOWEST_TOP = 0.4
"""... and that is at least this part of its model's: a weak supply and a load make it slower."""


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
        jumps = (moved > np.maximum(MOVED_RAD * joint.share, turned)) & (seconds < _JUMP_S)
        if jumps.any():
            self.first_ns = self.first_ns or int(at_ns[1:][jumps][0])
            self.longest = max(self.longest, float(moved[jumps].max()))
            self.count += int(jumps.sum())
        self.read_ns, self.position = int(at_ns[-1]), float(position[-1])


class Movement:
    """Collects how the joints moved, in memory that does not grow with the log."""

    def __init__(self, joints: Sequence[PlannedJoint] = (), begin_ns: int = 0) -> None:
        self._joints = joints
        self._fastest = np.zeros(len(joints))
        self._jumps = [_Jumps() for _ in joints]
        self.bins = Bins(8, len(joints), begin_ns)

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
            np.where(unknown, np.nan, self._swings(cycles, error) - self._told(cycles, way)),
            np.where(unknown, np.nan, self._swings(cycles, cycles["goal_position"])),
        ]
        self.bins.take(cycles["read_ns"], np.array(values))

    def _swings(self, cycles: NDArray[np.void], values: Floats) -> Floats:
        """Return where a swing ends, as swings a second, shape (cycles, joints)."""
        found = np.zeros_like(values)
        rate = 1e9 / max(float(np.median(np.diff(cycles["read_ns"]))), 1.0) if len(cycles) > 2 else 0.0
        for row, joint in enumerate(self._joints):
            known = np.flatnonzero(np.isfinite(values[:, row]))
            mine = values[known, row]
            new = np.flatnonzero(np.diff(mine, prepend=math.nan) != 0)  # goals are held between commands
            steps = np.diff(mine[new])
            turns = new[np.flatnonzero(steps[1:] * steps[:-1] < 0) + 1]
            far = np.abs(np.diff(mine[turns])) >= _SWING_RAD * joint.share
            swings = turns[1:][far & (np.diff(known[turns]) == np.diff(turns))]  # none was missed between
            found[known[swings], row] = rate
        return found

    def _told(self, cycles: NDArray[np.void], way: Floats) -> Floats:
        """Return where the error swings as it is told: the way does, or a goal steps after it was held."""
        steps = np.abs(np.diff(cycles["goal_position"], axis=0, prepend=np.nan))
        begins = steps >= _SWING_RAD * np.array([joint.share for joint in self._joints])
        begins[1:] &= steps[:-1] == 0.0
        rate = 1e9 / max(float(np.median(np.diff(cycles["read_ns"]))), 1.0) if len(cycles) > 2 else 0.0
        return np.maximum(self._swings(cycles, way), np.where(begins, 2.0 * rate, 0.0))

    def findings(self) -> Iterable[Finding]:
        """Name joints that stand still, are blocked or weak, or follow worse than before."""
        short, windows = self._windows(0.0), self._windows(_WINDOW_S)
        bad = [(brief.joint, *failure_of(brief, each)) for brief, each in zip(short, windows, strict=True)]
        shared = [joint for joint, _, failing in bad if failing is not None and failing.code in _SHARED]
        together = len(shared) > max(1, len(bad) // 2)
        for row, (joint, one, failing) in enumerate(bad):
            if self._jumps[row].count:
                yield _jumped(joint, self._jumps[row], self.bins.begin_ns)
            if failing is None or (together and joint in shared):
                continue
            all_of_them = short if one is short[row] else windows
            peers = [each.typical(AWAY, failing.when) for each in all_of_them if each is not one]
            usual = float(np.nanmedian(peers)) if failing.code in _SHARED and peers else math.nan
            if not one.typical(AWAY, failing.when) < WORSE * usual:
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

    def _windows(self, seconds: float) -> list[Windows]:
        length_s, *values = self.bins.joined(seconds)
        return [
            Windows(joint, length_s, *(each[:, :, row] for each in values))
            for row, joint in enumerate(self._joints)
        ]


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
    "goal_swings": "See which clients and controllers command it (`/commands` in the log), and let only one.",
    "error_grew": "Compare its gains and limits with the model's (`dxlrun servo PORT ID get`), and turn it "
    "by hand: a horn or a gear may slip.",
}


_MAY_BE = {
    "frozen_position": ": what it reads is not its position, or it does not try: without torque, in another "
    "mode or at a limit of its own"
}
_SHARED = ("error_grew", "far_from_goal", "speed_limit", "torque_limit")
"""What a joint that is not at fault may show too, where others do."""
_RANKS = {"jammed_joint": Rank.SERVO_CAUSE, "goal_swings": Rank.CAUSE}
"""A blocked one may pull down the supply, or shut itself down; commands are the matter of their sender."""


def _finding(one: Windows, failing: Failing, peers: float) -> Finding:
    joint, code, when = one.joint, failing.code, failing.when
    error, before = one.typical(AWAY, when), one.typical(AWAY, failing.usual)
    load, usual = one.typical(LOAD, when), one.typical(LOAD, failing.usual & (one.mean[SPEED] > 0))
    part = f"and went {one.moved(when):.0%} of its way"
    exerted = "; its load is not read"
    if not math.isnan(load):
        otherwise = "" if math.isnan(usual) else f", {usual / joint.top_effort:.0%} otherwise"
        exerted = f" ({load / joint.top_effort:.0%} of its torque{otherwise})"
    if code == "torque_limit":
        most = np.nanquantile(one.most[LOAD, when], 0.9) / joint.top_effort
        what = f"exerted no more than {most:.0%} of its torque, {_text(joint, error)} from its goal, {part}"
        exerted = ": its torque is limited, or its gain is low"
    elif code == "speed_limit":
        speed = np.nanquantile(np.abs(np.diff(one.mean[POSITION], prepend=np.nan))[when], 0.9) / one.length_s
        what = f"moved at no more than {_text(joint, speed)}/s, {_text(joint, error)} from its goal, {part}"
        exerted += ": its speed or its torque is limited, or it is stiff"
    elif code == "far_from_goal":
        what = f"was {_text(joint, error)} from its goal for {failing.seconds:.1f} s, {part}"
    elif code == "error_grew" and one.reach(POSITION, when) > STILL_RAD * joint.share:
        worse = f"{error / before:.0f} times worse" if before > joint.tick else "worse"
        rest = "" if math.isnan(peers) else f"; other joints: {_text(joint, peers)}"
        what = (
            f"followed {worse} than before: {_text(joint, error)} away (before: {_text(joint, before)}{rest})"
        )
        what += f", {part}"
    elif code == "goal_swings":
        hertz = one.typical(GOALS, when) / 2
        what = f"is sent to and fro {hertz:.0f} times a second by its commands, and is {_text(joint, error)}"
        what, exerted = f"{what} from them on average", ""
    elif code == "joint_shakes":
        hertz = one.typical(SWINGS, when) / 2
        what = f"shakes {hertz:.0f} times a second around its goal, {_text(joint, error)} on average"
    else:
        place = _text(joint, float(np.nanmedian(one.mean[POSITION, when])))
        did = "stood still, to the tick," if code == "frozen_position" else "stood still"
        did += {
            "jammed_joint": f" at {place}, as if blocked,",
            "goes_no_further": f" at {place} each time,",
        }.get(code, "")
        most = np.nanmax(np.abs([one.least[ERROR, when], one.most[ERROR, when]]))
        what = f"{did} for {failing.seconds:.1f} s although its goal was up to {_text(joint, most)} away"
    name = joint.name if code == "goal_swings" else f"{joint.name} ({joint.servos})"
    away = when & (one.mean[AWAY] > AWAY_RAD * joint.share)  # it may have stood where it was to stand
    since_s = float(np.flatnonzero(away if away.any() else when)[0]) * one.length_s
    return Finding(
        code,
        joint.name,
        f"{name} {what}{exerted}; from {since_s:.1f} s of the run on{_MAY_BE.get(code, '')}.",
        _REMEDIES[code],
        Rank.CAUSE if failing.seconds < BAD_S else _RANKS.get(code, Rank.SERVO),
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
