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
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import Trail

_NONE: Mapping[str, float] = {}
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

    def add_cycles(self, cycles: NDArray[np.void], way: Floats, known: int) -> None:
        """Add the cycles from number `known` on; the first `known` were already added, and are used for
        speeds only.

        Args:
            cycles: Cycles of the log.
            way: Reachable trajectories, rad or m; shape (cycles, joints).
            known: Number of cycles that were added before.
        """
        speed = np.full_like(way, np.nan)
        steps = np.diff(cycles["read_ns"] * 1e-9)[:, None]
        speed[1:] = np.abs(np.diff(way, axis=0)) / steps
        moved = np.zeros_like(way)
        moved[1:] = np.abs(np.diff(cycles["position"], axis=0)) / steps
        cycles, way, speed, moved = cycles[known:], way[known:], speed[known:], moved[known:]
        if not len(cycles):
            return
        # A joint with an effort goal has no reachable trajectory.
        driven = (cycles["torque"] == Torque.ON) & cycles["valid"] & ~np.isfinite(cycles["goal_effort"])
        at_ns = cycles["read_ns"][:, None] - cycles["age_ns"]
        for row, joint in enumerate(self._joints):
            kept = driven[:, row] | (cycles["torque"][:, row] != Torque.ON)
            jumping = np.where(driven, cycles["position"], np.nan)[kept, row]
            self._jumps[row].add_positions(joint, at_ns[kept, row], jumping)
        position = np.where(driven & np.isfinite(way), cycles["position"], np.nan)
        error = position - way
        velocity = np.nan_to_num(cycles["velocity"])
        fastest = np.maximum.accumulate(np.vstack([self._fastest, np.abs(velocity)]))[1:]
        self._fastest = fastest[-1]
        fastest = np.maximum(
            fastest, [_SLOWEST_TOP * (joint.logged.top_speed or 0) for joint in self._joints]
        )
        # A joint that approaches its goal at full speed is not at fault for its error.
        hurries = (velocity * error < 0) & (np.abs(velocity) >= _FULL_SPEED * fastest)
        hurries &= moved >= _FULL_SPEED / 2 * np.abs(velocity)
        unknown = np.isnan(error)
        sought = self._sought(cycles)
        off = np.where(unknown, cycles["position"] - sought, error)
        swings = self._swings(cycles, off) - self._told(cycles, np.where(unknown, sought, way))
        values = [
            error,
            np.where(unknown, np.nan, way),
            position,
            np.where(unknown, np.nan, speed),
            np.where(unknown, np.nan, np.abs(cycles["effort"])),
            np.where(hurries, 0.0, np.abs(error)),
            np.where(np.isnan(off), np.nan, swings),
            np.where(unknown, np.nan, self._swings(cycles, cycles["goal_position"])),
        ]
        self.bins.bin_cycles(cycles["read_ns"], np.array(values))
        self._trail.add_cycles(
            cycles["read_ns"], way, np.where(driven, cycles["position"], np.nan), cycles["effort"]
        )

    def _sought(self, cycles: NDArray[np.void]) -> Floats:
        """Return the reference position of each joint while a controller moves it with an effort, NaN
        otherwise; shape (cycles, joints)."""
        sought = np.full(cycles["position"].shape, np.nan)
        by_effort = (cycles["torque"] == Torque.ON) & cycles["valid"] & np.isfinite(cycles["goal_effort"])
        for row, column in self._references.items():
            sought[:, row] = np.where(by_effort[:, row], cycles["reference"][:, column], np.nan)
        return sought

    def _swings(self, cycles: NDArray[np.void], values: Floats) -> Floats:
        """Return an array (cycles, joints) that has the cycle rate in 1/s where a swing of `values` ends,
        and 0 elsewhere. Its mean is the number of swings a second."""
        found = np.zeros_like(values)
        rate = 1e9 / max(float(np.median(np.diff(cycles["read_ns"]))), 1.0) if len(cycles) > 2 else 0.0
        for row, joint in enumerate(self._joints):
            known = np.flatnonzero(np.isfinite(values[:, row]))
            mine = values[known, row]
            new = np.flatnonzero(np.diff(mine, prepend=math.nan) != 0)  # Goals are constant between commands
            steps = np.diff(mine[new])
            turns = new[np.flatnonzero(steps[1:] * steps[:-1] < 0) + 1]
            far = np.abs(np.diff(mine[turns])) >= _SWING_RAD * joint.share
            # Only swings without missing cycles in between count.
            swings = turns[1:][far & (np.diff(known[turns]) == np.diff(turns))]
            found[known[swings], row] = rate
        return found

    def _told(self, cycles: NDArray[np.void], way: Floats) -> Floats:
        """Return an array as of `_swings` for commanded swings: those of the trajectory, and steps of a
        goal that was constant before, which count as two."""
        steps = np.abs(np.diff(cycles["goal_position"], axis=0, prepend=np.nan))
        begins = steps >= _SWING_RAD * np.array([joint.share for joint in self._joints])
        begins[1:] &= steps[:-1] == 0.0
        rate = 1e9 / max(float(np.median(np.diff(cycles["read_ns"]))), 1.0) if len(cycles) > 2 else 0.0
        return np.maximum(self._swings(cycles, way), np.where(begins, 2.0 * rate, 0.0))

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
