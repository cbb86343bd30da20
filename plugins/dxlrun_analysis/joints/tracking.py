"""How the joints followed their goals, and how fresh their states were.

No servo is at its goal in the cycle after it was sent: it goes there at the commanded speed, or at its
highest. So what a joint did is compared with its reachable trajectory: from where it stood towards the goals
that were sent, within the limits of velocity and acceleration, without delay. What is left is the servo's
lag, its settling, and the error with which it comes to rest.

Lag is the delay behind the reachable trajectory that explains most of the error by least squares, to the
first order: error = -lag * velocity. The delay behind the goals that were sent is that of delay.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun import ROTARY, Floats, JointUnit, Log
from dxlrun.tooling.records import Torque
from dxlrun_analysis.joints.delay import DelayFit
from dxlrun_analysis.joints.movement import Movement
from dxlrun_analysis.joints.planned import PlannedJoint, planned_joints

_REST_S = 0.3  # A reachable trajectory that does not change for so long is at rest: its joint is to settle
_SETTLED_PART, _SETTLED_TICKS = 0.02, 2
"""Settled: so near to where it stays, as a part of the way or in ticks, whichever is more."""
_MOVED_TICKS = 4  # Shorter ways give no lag: positions are read in ticks
_BLOCK = 1 << 16  # Cycles that are worked on at once, times joints; of eight for a robot of fewer
_LONGEST_REST_S = 20.0  # What rests longer is counted as two rests

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class JointTracking:
    """One joint over all cycles."""

    name: str
    invalid: int  # Cycles without an intact reply; those of a requested reboot do not count
    oldest_ms: float  # Greatest age of a state
    clamped: int  # Cycles in which the last gate changed the command
    rms_rad: float | None
    """Of position minus the reachable trajectory; None where there was no goal or no position.

    The servo's own lag is in it: a joint that moves is always behind.
    """
    worst_rad: float | None
    lag_ms: float | None
    """The delay with which the joint follows its reachable trajectory; None where that hardly moved."""
    settling_ms: float | None
    """The longest time from the end of a reachable trajectory until the joint stayed near where it rests,
    within 2 % of the way or two ticks; None where none ended."""
    rest_rad: float | None  # The greatest error with which it came to rest; None where it never did
    delay_ms: float | None = None
    """The delay with which the joint follows the goals as they were sent; None where none explains it."""
    unit: JointUnit = ROTARY  # Of its errors, whatever their names say
    lost_at: float | None = None
    """Where it was when its servo was lost for the first time; None: it was not, or it is not known."""


def tracking(log: Log) -> tuple[JointTracking, ...]:
    """Return freshness and tracking of each joint; rows in the order of the log."""
    collected = Tracking()
    collected.take(log)
    return collected.finish(log)


def reachable(log: Log, row: int) -> Floats:
    """Return where a joint could be in each cycle, rad, NaN where it had no goal; see the module."""
    limits = planned_joints(log)[row]
    return _reachable(_sent(log.cycles, row, limits), limits.acceleration, _Way())


# The reachable trajectory


@dataclass(slots=True)
class _Way:
    """A trajectory, as far as it was worked out: its last two points, and whether it is behind its goal."""

    last: Floats = field(default_factory=lambda: np.zeros(0))
    behind: bool = False
    velocity: float = 0.0


def _sent(cycles: NDArray[np.void], row: int, limits: PlannedJoint) -> _Sent:
    goal: Floats = cycles["goal_position"][:, row].astype(np.float64)
    # with new torque the joint holds where it is: what it did not reach before is no longer its goal
    goal[cycles["torque"][:, row] == Torque.GIVEN] = np.nan
    position = np.where(cycles["valid"][:, row], cycles["position"][:, row], np.nan)
    commanded = np.abs(cycles["goal_velocity"][:, row])
    speed = np.where(np.isfinite(commanded), np.maximum(commanded, limits.slowest), math.inf)
    times = cycles["read_ns"] * 1e-9
    steps = np.diff(times, prepend=times[:1])
    return _Sent(goal, np.minimum(speed, limits.speed), position, steps)


def _reachable(sent: _Sent, acceleration: float, begun: _Way) -> Floats:
    """A goal holds until the next cycle; where it can be reached by then, the trajectory is the goal.

    `begun` has the points of the first cycles that are known, and is carried on.
    """
    goal, speed, steps = sent.goal, sent.speed, sent.steps
    known = len(begun.last)
    way = np.full(len(goal), np.nan)
    way[1:] = goal[:-1]
    way[:known] = begun.last
    jumps = np.zeros(len(goal), dtype=bool)
    jumps[2:] = ~(np.abs(np.diff(goal[:-1])) <= speed[1:-1] * steps[2:] * (1 + 1e-9))
    jumps[:2] = True
    jumps[:known] = False
    if begun.behind and known < len(goal):
        jumps[known] = True
    if not begun.behind:
        begun.velocity = 0.0
    begun.behind = False
    done = 0
    for start in np.flatnonzero(jumps).tolist():
        if start >= done:
            done = _go(start, way, sent, acceleration, begun)
            if not begun.behind:
                begun.velocity = 0.0
    begun.last = way[-2:].copy()
    return way


@dataclass(frozen=True, slots=True)
class _Sent:
    """What was sent to a joint in each cycle, and where it was."""

    goal: Floats  # rad
    speed: Floats  # rad/s, of the way to it
    position: Floats  # rad, NaN where it was not read
    steps: Floats  # s since the cycle before


def _go(start: int, way: Floats, sent: _Sent, acceleration: float, begun: _Way) -> int:
    """Fill a way from a cycle on until it has come to its goal; return the cycle behind."""
    at = float(way[start - 1]) if start else math.nan
    velocity = begun.velocity
    cycle = start
    while cycle < len(way):
        desired = float(sent.goal[cycle - 1]) if cycle else math.nan
        if not (math.isfinite(at) and math.isfinite(desired)):
            # it begins at the joint's position when it gets a goal
            at, velocity = float(sent.position[cycle]) if math.isfinite(sent.goal[cycle]) else math.nan, 0.0
            way[cycle] = at
            cycle += 1
            continue
        left, dt = desired - at, float(sent.steps[cycle])
        fastest = math.copysign(float(sent.speed[cycle - 1]), left)
        if acceleration < math.inf:
            # from where it can still brake: v^2 / 2a and half of this step's way are what is left
            change = acceleration * dt
            braking = math.sqrt((change / 2) ** 2 + 2 * acceleration * abs(left)) - change / 2
            fastest = math.copysign(min(abs(fastest), braking), left)
            velocity += max(-change, min(change, fastest - velocity))
        else:
            velocity = fastest
        if abs(left) <= abs(velocity) * dt:
            way[cycle] = desired
            return cycle + 1
        at += velocity * dt
        way[cycle] = at
        cycle += 1
    begun.behind, begun.velocity = True, velocity
    return len(way)


# What is left of it


@dataclass(frozen=True, slots=True)
class _Rest:
    """An interval in which a joint should rest."""

    settling_s: float | None
    """From the start until the joint stayed near its rest position; None: it did not move before"""
    error_rad: float  # Measured minus desired position at rest


@dataclass(slots=True)
class _OpenRest:
    """Finds rests in slices of cycles; keeps the cycles of a rest that is not over, 20 s at most.

    A rest is an interval of 0.3 s or more in which the desired position does not change.
    """

    times: Floats = field(default_factory=lambda: np.zeros(0))
    way: Floats = field(default_factory=lambda: np.zeros(0))
    error: Floats = field(default_factory=lambda: np.zeros(0))
    lowest: float = math.inf
    highest: float = -math.inf  # Of the desired positions since the last rest, before those that are kept

    def take(self, times: Floats, way: Floats, error: Floats, tick: float, *, final: bool) -> Iterator[_Rest]:
        """Yield the rests that have ended; with `final` the last one too.

        Args:
            times: s, shape (cycles,).
            way: Desired positions, rad.
            error: Measured minus desired position, rad; NaN where either is unknown.
            tick: Resolution of the servo's position, rad.
            final: No more cycles follow.
        """
        times, way, error = (
            np.concatenate(pair) for pair in ((self.times, times), (self.way, way), (self.error, error))
        )
        still = np.zeros(len(way) + 1, dtype=bool)
        still[1:-1] = way[1:] == way[:-1]
        begins = np.flatnonzero(still[1:] & ~still[:-1]).tolist()
        ends = np.flatnonzero(still[:-1] & ~still[1:]).tolist()
        moved_from, keep = 0, max(0, len(way) - 1)
        for begin, end in zip(begins, ends, strict=True):
            lasted = times[end] - times[begin]
            if end == len(way) - 1 and not final and lasted < _LONGEST_REST_S:
                keep = begin
                break
            if lasted < _REST_S:
                continue
            before = way[moved_from : begin + 1]
            self._saw(before)
            moved = max(0.0, self.highest - self.lowest)
            moved_from, self.lowest, self.highest = end, math.inf, -math.inf
            left = error[begin : end + 1]
            known = np.flatnonzero(np.isfinite(left))
            if not len(known):
                continue
            rest_rad = float(np.median(left[known[-(len(known) // 4 + 1) :]]))
            near = max(_SETTLED_PART * moved, _SETTLED_TICKS * tick)
            outside = known[np.abs(left[known] - rest_rad) > near]
            settled = begin if not len(outside) else min(begin + int(outside[-1]) + 1, end)
            settling_s = float(times[settled] - times[begin]) if moved >= near else None
            yield _Rest(settling_s, rest_rad)
        self._saw(way[moved_from:keep])
        self.times, self.way, self.error = times[keep:], way[keep:], error[keep:]

    def _saw(self, way: Floats) -> None:
        known = way[np.isfinite(way)]
        if len(known):
            self.lowest, self.highest = min(self.lowest, known.min()), max(self.highest, known.max())


# Slice by slice


class Tracking:
    """Collects tracking slice by slice, in memory that does not grow with the log."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.void]] = []
        self._count = 0
        self._held: NDArray[np.void] | None = None
        """The last two cycles of those that are done: the next ones depend on them."""
        self._rows: list[_Row] = []
        self.movement = Movement()  # Of all that was taken, once it is finished

    def take(self, log: Log) -> None:
        """Take the cycles of the next slice."""
        if not len(log.cycles):
            return
        if not self._rows:
            joints = planned_joints(log)
            self._rows = [_Row(row, joint) for row, joint in enumerate(joints)]
            self.movement = Movement(joints, int(log.cycles["read_ns"][0]), log.header.references)
        self._parts.append(log.cycles)
        self._count += len(log.cycles)
        if self._count * max(8, len(self._rows)) >= _BLOCK:
            self._work()

    def finish(self, log: Log) -> tuple[JointTracking, ...]:
        """Return the tracking of each joint; `log` has their names."""
        self._work()
        nothing = np.zeros(0)
        for each in self._rows:
            each.rested(nothing, nothing, nothing, final=True)
        rows = self._rows or [_Row(row, joint) for row, joint in enumerate(planned_joints(log))]
        return tuple(row.result(name) for row, name in zip(rows, log.joints, strict=True))

    def _work(self) -> None:
        if not self._parts:
            return
        known = 0 if self._held is None else len(self._held)
        cycles = np.concatenate(self._parts if self._held is None else [self._held, *self._parts])
        self._parts, self._count = [], 0
        ways = [row.take(cycles, known) for row in self._rows]
        self.movement.take(cycles, np.array(ways).reshape(len(ways), len(cycles)).T, known)
        self._held = cycles[-2:].copy()


@dataclass(slots=True)
class _Row:
    """One joint, as far as its cycles were taken."""

    row: int
    limits: PlannedJoint
    way: _Way = field(default_factory=_Way)
    invalid: int = 0
    oldest_ns: int = 0
    clamped: int = 0
    lost_at: float | None = None
    errors: int = 0
    squares: float = 0.0
    worst: float = 0.0
    lowest: float = math.inf
    highest: float = -math.inf  # Of the trajectory, where its velocity is known
    across: float = 0.0  # Sum of error times velocity
    moved: float = 0.0  # Sum of the squares of the velocity
    rest: _OpenRest = field(default_factory=_OpenRest)
    settled_s: float | None = None
    rest_rad: float | None = None
    delays: DelayFit = field(default_factory=DelayFit)

    def take(self, cycles: NDArray[np.void], known: int) -> Floats:
        """Take cycles; the first `known` of them were taken before. Return the reachable trajectory."""
        new = cycles[known:]
        missing = ~new["valid"][:, self.row] & (new["torque"][:, self.row] != Torque.REBOOTING)
        self.invalid += int(np.count_nonzero(missing))
        self.oldest_ns = max(self.oldest_ns, int(new["age_ns"][:, self.row].max(initial=0)))
        self.clamped += int(np.count_nonzero(new["clamped"][:, self.row]))
        lost = np.flatnonzero(new["torque"][:, self.row] == Torque.LOST)
        if self.lost_at is None and len(lost) and math.isfinite(at := new["position"][lost[0], self.row]):
            self.lost_at = float(at)
        sent = _sent(cycles, self.row, self.limits)
        way = _reachable(sent, self.limits.acceleration, self.way)
        times = cycles["read_ns"] * 1e-9
        error = sent.position - way
        if not known:
            error[:1] = np.nan  # the trajectory begins there
        finite = error[known:][np.isfinite(error[known:])]
        self.errors += len(finite)
        self.squares += float((finite**2).sum())
        self.worst = max(self.worst, float(np.abs(finite).max(initial=0.0)))
        self._lag(times, way, error)
        self.delays.take(times, sent.goal, sent.position, known)
        self.rested(times[known:], way[known:], error[known:], final=False)
        return way

    def rested(self, times: Floats, way: Floats, error: Floats, *, final: bool) -> None:
        """Take the rests that have ended by these cycles; `final`: the last one ends, too."""
        for rest in self.rest.take(times, way, error, self.limits.tick, final=final):
            self.rest_rad = max(abs(rest.error_rad), self.rest_rad or 0.0)
            if rest.settling_s is not None:
                self.settled_s = max(rest.settling_s, self.settled_s or 0.0)

    def _lag(self, times: Floats, way: Floats, error: Floats) -> None:
        if len(way) < 3:
            return
        velocity = (way[2:] - way[:-2]) / (times[2:] - times[:-2])
        inner = error[1:-1]
        used = np.isfinite(velocity) & np.isfinite(inner)
        if used.any():
            there = way[1:-1][used]
            self.lowest, self.highest = min(self.lowest, there.min()), max(self.highest, there.max())
            self.across += float(inner[used] @ velocity[used])
            self.moved += float(velocity[used] @ velocity[used])

    def result(self, name: str) -> JointTracking:
        """Return what was found."""
        moved = self.highest - self.lowest >= _MOVED_TICKS * self.limits.tick
        # it may jump between two trajectories, and rest where both neighbours are known
        lag_s = -self.across / self.moved if moved and self.moved else None
        delay_s = self.delays.best_s(_MOVED_TICKS * self.limits.tick)
        return JointTracking(
            name=name,
            invalid=self.invalid,
            oldest_ms=self.oldest_ns / 1e6,
            clamped=self.clamped,
            rms_rad=math.sqrt(self.squares / self.errors) if self.errors else None,
            worst_rad=self.worst if self.errors else None,
            lag_ms=None if lag_s is None else lag_s * 1e3,
            settling_ms=None if self.settled_s is None else self.settled_s * 1e3,
            rest_rad=self.rest_rad,
            delay_ms=None if delay_s is None else delay_s * 1e3,
            unit=self.limits.logged.unit,
            lost_at=self.lost_at,
        )
