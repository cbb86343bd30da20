"""Movement of the joints over a run, and findings about joints that failed to follow their commands.

The rules are in failing.py and following.py, with one exception: two positions within half a second, with
torque throughout, are a *jump* if they are 9 deg and a quarter further apart than the model can turn in that
time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun.tooling.records import Torque
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.bins import Bins
from dxlrun_analysis.joints.failing import (
    AWAY,
    AWAY_RAD,
    MOVED_RAD,
    WORSE,
    Windows,
    distance,
    failure_of,
    joint_finding,
)
from dxlrun_analysis.joints.following import changed, followed
from dxlrun_analysis.joints.joint_columns import JointColumns
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import Trail

_NONE: Mapping[str, float] = {}
_FIELDS = (
    *("read_ns", "age_ns", "torque", "valid", "position", "velocity", "effort"),
    *("goal_position", "goal_effort"),
)
"""Fields of the cycles that are used."""
_WINDOW_S = 0.5  # Length of the long windows
_JUMP_S = 0.5  # Positions further apart are not compared: the joint may have been moved by hand
_TOO_FAST = 1.25  # A supply at its limit and a pulling load make a servo slightly faster than its model
_SWING_RAD = 0.035  # 2 deg: smallest swing that counts
_FULL_SPEED = 0.8
"""A joint moves as fast as it can from this share of its greatest speed so far on."""
_SLOWEST_TOP = 0.4
"""Share of the model's top speed that a joint reaches at least, with a weak supply and a load."""


@dataclass(slots=True)
class _Jumps:
    """Accumulator of the jumps in one joint's position: their number, first time and greatest distance."""

    count: int = 0
    first_ns: int = 0
    longest: float = 0.0
    read_ns: int = 0
    position: float = math.nan

    def add_positions(self, joint: PlannedJoint, at_ns: NDArray[np.int64], position: Floats) -> None:
        """Add positions of the joint with their times; NaN while it has no torque: not compared."""
        at_ns, position = np.append(self.read_ns, at_ns), np.append(self.position, position)
        seconds, moved = np.diff(at_ns) * 1e-9, np.abs(np.diff(position))
        top = joint.logged.top_speed
        turned: Floats | float = math.inf if top is None or joint.wraps else _TOO_FAST * top * seconds
        jumps = (moved > np.maximum(MOVED_RAD * joint.share, turned)) & (seconds < _JUMP_S)
        if jumps.any():
            self.first_ns = self.first_ns or int(at_ns[1:][jumps][0])
            self.longest = max(self.longest, float(moved[jumps].max()))
            self.count += int(jumps.sum())
        self.read_ns, self.position = int(at_ns[-1]), float(position[-1])

    def finding(self, joint: PlannedJoint, begin_ns: int) -> Finding:
        """Return the finding that the joint's position jumped; `begin_ns` is the start of the run."""
        jumps = "a position jump" if self.count == 1 else f"{self.count} position jumps"
        most, since_s = distance(joint, self.longest), (self.first_ns - begin_ns) * 1e-9
        text = f"reported {jumps} of up to {most}, faster than its servo model can turn"
        return joint_finding("position_jumped", joint, text, since_s, brief=True)


class Movement:
    """Accumulator of the movement of all joints, which then reports failures to follow. Its memory does
    not grow with the log."""

    def __init__(
        self, joints: Sequence[PlannedJoint] = (), begin_ns: int = 0, references: Sequence[str] = ()
    ) -> None:
        self._joints = joints
        found = {name.partition("/")[2]: column for column, name in enumerate(references)}
        columns = [found.get(f"{joint.name}/position", -1) for joint in joints]
        self._references = {row: column for row, column in enumerate(columns) if column >= 0}
        """Column of the reference position of each joint that a controller moves with an effort."""
        self._fastest = np.zeros(len(joints))
        self._jumps = [_Jumps() for _ in joints]
        self.bins = Bins(8, len(joints), begin_ns)
        self._trail = Trail(len(joints), begin_ns)

    def add_cycles(self, columns: JointColumns, way: Floats, known: int) -> None:
        """Add the cycles from number `known` on; the first `known` were already added, and are used for
        speeds only.

        Args:
            columns: Cycles of the log.
            way: Reachable trajectories, rad or m; shape (joints, cycles).
            known: Number of cycles that were added before.
        """
        if known >= len(columns):
            return
        speed, moved = np.full_like(way, np.nan), np.zeros_like(way)
        np.divide(np.abs(np.diff(way)), columns.steps, out=speed[:, 1:])
        np.divide(np.abs(np.diff(columns["position"])), columns.steps, out=moved[:, 1:])
        new = {name: columns[name][..., known:] for name in _FIELDS}
        way, speed, moved, position = way[:, known:], speed[:, known:], moved[:, known:], new["position"]
        has_torque = new["torque"] == int(Torque.ON)
        moves = has_torque & new["valid"]
        # A joint with an effort goal has no reachable trajectory.
        by_effort = np.isfinite(new["goal_effort"])
        driven = moves & ~by_effort
        free = position if driven.all() else np.where(driven, position, np.nan)
        self._add_positions(new["read_ns"] - new["age_ns"], free, driven | ~has_torque)
        error = np.where(np.isfinite(way), free, np.nan) - way
        unknown = np.isnan(error)
        hurries = self._hurries(np.nan_to_num(new["velocity"]), error, moved)
        away = np.abs(error)
        if hurries is not None:
            away[hurries] = 0.0
        off, led = error, way
        if unknown.any():
            sought = self._sought(columns, moves & by_effort, known)
            off, led = np.where(unknown, position - sought, error), np.where(unknown, sought, way)
        rate = 1e9 / max(float(np.median(np.diff(new["read_ns"]))), 1.0) if position.shape[1] > 2 else 0.0
        swings = self._swings(off, rate) - self._told(new["goal_position"], led, rate)
        values = [
            error,
            way,
            free,
            speed,
            np.abs(new["effort"]),
            away,
            swings,
            self._swings(new["goal_position"], rate),
        ]
        for row, of in enumerate((unknown,) * 6 + (np.isnan(off), unknown)):
            if of.any():
                values[row] = np.where(of, np.nan, values[row])
        self.bins.bin_cycles(new["read_ns"], values)
        self._trail.add_cycles(new["read_ns"], way.T, free.T, new["effort"].T)

    def _add_positions(self, at_ns: NDArray[np.int64], position: Floats, kept: NDArray[np.bool_]) -> None:
        """Add positions of all joints with their times, without those that are not `kept`: shape (joints,
        cycles)."""
        for row, joint in enumerate(self._joints):
            mine = slice(None) if kept[row].all() else kept[row]
            self._jumps[row].add_positions(joint, at_ns[row, mine], position[row, mine])

    def _hurries(self, velocity: Floats, error: Floats, moved: Floats) -> NDArray[np.bool_] | None:
        """Return where a joint approaches its goal at full speed, and is thus not at fault for its error;
        None if nowhere."""
        quick, before = np.abs(velocity), self._fastest[:, None]
        self._fastest = np.maximum(self._fastest, quick.max(axis=1))
        top = np.array([[_SLOWEST_TOP * (joint.logged.top_speed or 0)] for joint in self._joints])
        if not (quick >= _FULL_SPEED * np.maximum(before, top)).any():
            return None
        fastest = np.maximum(np.maximum.accumulate(np.hstack([before, quick]), axis=1)[:, 1:], top)
        hurries: NDArray[np.bool_] = (velocity * error < 0) & (quick >= _FULL_SPEED * fastest)
        hurries &= moved >= _FULL_SPEED / 2 * quick
        return hurries

    def _sought(self, columns: JointColumns, by_effort: NDArray[np.bool_], known: int) -> Floats:
        """Return the reference position of each joint while a controller moves it with an effort, NaN
        otherwise; shape (joints, cycles)."""
        sought = np.full(by_effort.shape, np.nan)
        for row, column in self._references.items():
            sought[row] = np.where(by_effort[row], columns["reference"][column, known:], np.nan)
        return sought

    def _swings(self, values: Floats, rate: float) -> Floats:
        """Return an array (joints, cycles) that has the cycle rate in 1/s where a swing of `values` ends,
        and 0 elsewhere. Its mean is the number of swings a second."""
        found = np.zeros_like(values)
        least = np.array([_SWING_RAD * joint.share for joint in self._joints])
        # Most joints move less than the smallest swing in a slice
        extent = np.fmax.reduce(values, axis=1) - np.fmin.reduce(values, axis=1)
        for row in np.flatnonzero(~(extent < least)).tolist():
            known = np.flatnonzero(np.isfinite(values[row]))
            mine = values[row] if len(known) == values.shape[1] else values[row, known]
            steps = np.diff(mine)
            moves = np.flatnonzero(steps)  # Goals are constant between commands
            steps = steps[moves]
            turns = moves[np.flatnonzero(steps[1:] * steps[:-1] < 0)] + 1
            far = np.abs(np.diff(mine[turns])) >= least[row]
            # Only swings without missing cycles in between count.
            swings = turns[1:][far & (np.diff(known[turns]) == np.diff(turns))]
            found[row, known[swings]] = rate
        return found

    def _told(self, goal: Floats, way: Floats, rate: float) -> Floats:
        """Return an array as of `_swings` for commanded swings: those of the trajectory, and steps of a
        goal that was constant before, which count as two."""
        found = self._swings(way, rate)
        steps = np.abs(np.diff(goal, prepend=np.nan))
        begins = steps >= np.array([[_SWING_RAD * joint.share] for joint in self._joints])
        if begins.any():
            begins[:, 1:] &= steps[:, :-1] == 0.0
            found = np.maximum(found, np.where(begins, 2.0 * rate, 0.0))
        return found

    def findings(self, reached_off: Mapping[str, float] = _NONE) -> Iterable[Finding]:
        """Report joints that stand still, oscillate, or follow worse than before, and positions that jumped.

        Args:
            reached_off: Largest distance from the target at the end of a reached goal, rad or m, by joint
                name. Errors up to this distance or up to the joint's tolerance in the robot file, whichever
                is larger, do not count.
        """
        allowed = [max(reached_off.get(one.name, 0.0), one.logged.tolerance or 0.0) for one in self._joints]
        short, windows = self._windows(0.0, allowed), self._windows(_WINDOW_S, allowed)
        found = [failure_of(brief, each) for brief, each in zip(short, windows, strict=True)]
        shared = sum(failing is not None and failing.shared for _, failing in found)
        # The cause is then the line, the supply, the load or the motion.
        together = shared > max(1, len(found) // 2)
        named: set[int] = set()
        for row, (one, failing) in enumerate(found):
            if self._jumps[row].count:
                yield self._jumps[row].finding(one.joint, self.bins.begin_ns)
            if self._jumps[row].count or failing is not None:
                named.add(row)
            if failing is None or (failing.shared and together):
                continue
            peers = [each for each in (short if one is short[row] else windows) if each is not one]
            usual = [each.typical(AWAY, failing.when) for each in peers] if failing.shared else []
            if not (usual and one.typical(AWAY, failing.when) < WORSE * float(np.nanmedian(usual))):
                yield failing.finding(one)
        if together:
            buses = {one.joint.bus for one, failing in found if failing is not None and failing.shared}
            yield Finding(
                "follows_worse",
                buses.pop() if len(buses) == 1 else "",
                f"{shared} of {len(found)} joints followed badly at once, or worse than before: the cause "
                "is common, such as line, supply, load or motion.",
                rank=Rank.SERVO,
            )
        else:
            yield from changed(followed(self._joints, self._trail.samples()), named)

    def _windows(self, seconds: float, allowed: Sequence[float]) -> list[Windows]:
        length_s, *values = self.bins.joined(seconds)
        away = values[1][AWAY]
        wide = np.where(
            [off > AWAY_RAD * one.share for off, one in zip(allowed, self._joints, strict=True)], allowed, 0.0
        )
        away[away <= wide] = 0.0
        return [
            Windows(joint, length_s, *(each[:, :, row] for each in values))
            for row, joint in enumerate(self._joints)
        ]
