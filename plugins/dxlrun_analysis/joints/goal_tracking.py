"""Tracking error of each joint: comparison of its position with the trajectory that it could reach.

A servo does not reach its goal in one cycle: it moves at the commanded speed, or at its top speed. The
*reachable trajectory* starts at the position of the joint and moves towards the goals that were sent, within
the limits of velocity and acceleration, without delay. The error consists of the servo's lag, its settling,
and its error at rest.

Lag is the delay behind the reachable trajectory that explains most of the error by least squares, to first
order: error = -lag * velocity. delay.py determines the delay behind the goals that were sent.
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
from dxlrun_analysis.joints.joint_columns import JointColumns
from dxlrun_analysis.joints.movement import Movement
from dxlrun_analysis.joints.planned import PlannedJoint, planned_joints

# A reachable trajectory that is constant for this time is at rest, so its joint is expected to settle.
_REST_S = 0.3
_SETTLED_PART, _SETTLED_TICKS = 0.02, 2
"""Settled: within this share of the movement, or number of ticks, of the rest position; the greater."""
_MOVED_TICKS = 4  # Shorter movements give no lag, because positions are quantized in ticks
_BLOCK = 1 << 16  # Cycles times joints that are processed at once, with eight joints at least
_LONGEST_REST_S = 20.0  # A longer rest is counted as two
# Plain numbers: to compare with a member of an enumeration, NumPy converts each element to 64 bits.
_GIVEN, _REBOOTING, _LOST = map(int, (Torque.GIVEN, Torque.REBOOTING, Torque.LOST))

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class JointTracking:
    """Tracking error of one joint over a run: error, lag, settling time, invalid states; rad or m."""

    name: str
    invalid: int  # Cycles without an intact reply, except those of a requested reboot
    oldest_ms: float  # Greatest age of a state
    clamped: int  # Cycles in which the last gate changed the command
    rms_rad: float | None
    """Root mean square of position minus reachable trajectory; None without a goal or a position.

    The servo's own lag is included: a moving joint is always behind.
    """
    worst_rad: float | None
    lag_ms: float | None
    """Delay of the joint behind its reachable trajectory; None if the trajectory hardly moved."""
    settling_ms: float | None
    """Longest time from the end of a reachable trajectory until the joint stayed within 2 % of the movement,
    or two ticks, of its rest position. None if no trajectory ended."""
    rest_rad: float | None  # Greatest error at rest; None if the joint never came to rest
    delay_ms: float | None = None
    """Delay of the joint behind the goals as they were sent; None if no delay explains the position."""
    unit: JointUnit = ROTARY  # Unit of the errors, whatever the field names say
    lost_at: float | None = None
    """Position of the joint when its servo was lost for the first time; None if it was not lost, or the
    position is unknown."""


def tracking(log: Log) -> tuple[JointTracking, ...]:
    """Return the tracking error of each joint of a whole log, in the order of the log."""
    collected = TrackingCollector()
    collected.add_slice(log)
    return collected.evaluate_joints(log)


def reachable(log: Log, row: int) -> Floats:
    """Return the reachable trajectory of joint number `row` in each cycle, rad; NaN without a goal."""
    limits = planned_joints(log)[row]
    return _reachable(_sent(JointColumns(log.cycles), row, limits), limits.acceleration, _Way())


# Reachable trajectory


@dataclass(slots=True)
class _Way:
    """State of a reachable trajectory between two slices of cycles: its last two points, its velocity, and
    whether it is still behind its goal."""

    last: Floats = field(default_factory=lambda: np.zeros(0))
    behind: bool = False
    velocity: float = 0.0


def _sent(columns: JointColumns, row: int, limits: PlannedJoint) -> _SentGoals:
    goal, position, commanded = (
        columns[name][row] for name in ("goal_position", "position", "goal_velocity")
    )
    given, valid = columns["torque"][row] == _GIVEN, columns["valid"][row]
    # When torque is enabled, the servo holds its position; an earlier goal no longer applies.
    if given.any():
        goal = np.where(given, np.nan, goal)
    if not valid.all():
        position = np.where(valid, position, np.nan)
    commanded = np.abs(commanded)
    speed = np.where(np.isfinite(commanded), np.maximum(commanded, limits.slowest), math.inf)
    return _SentGoals(goal, np.minimum(speed, limits.speed), position, columns.steps)


def _reachable(sent: _SentGoals, acceleration: float, begun: _Way) -> Floats:
    """Return the reachable trajectory of a joint, one point per cycle.

    A goal holds until the next cycle. If it can be reached by then, the trajectory is the goal. `begun` has
    the points of the first cycles, and is updated.
    """
    goal, speed, steps = sent.goal, sent.speed, sent.steps
    known = len(begun.last)
    way = np.full(len(goal), np.nan)
    way[1:] = goal[:-1]
    way[:known] = begun.last
    jumps = np.zeros(len(goal), dtype=bool)
    # Step through cycles in Python only where a goal cannot be reached within one cycle.
    jumps[2:] = ~(np.abs(np.diff(goal[:-1])) <= speed[1:-1] * steps[1:] * (1 + 1e-9))
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
class _SentGoals:
    """Goals sent to one joint in some cycles, with its positions; columns of shape (cycles,)."""

    goal: Floats  # rad
    speed: Floats  # rad/s, commanded speed of the movement
    position: Floats  # rad; NaN if it was not read
    steps: Floats  # s between two cycles, shape (cycles - 1,)


def _finite(values: Floats) -> Floats:
    """Return the finite ones of some values."""
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]


def _go(start: int, way: Floats, sent: _SentGoals, acceleration: float, begun: _Way) -> int:
    """Fill the reachable trajectory `way` from cycle `start` until it reaches its goal; return the index
    of the cycle after that."""
    at = float(way[start - 1]) if start else math.nan
    velocity = begun.velocity
    cycle = start
    while cycle < len(way):
        desired = float(sent.goal[cycle - 1]) if cycle else math.nan
        if not (math.isfinite(at) and math.isfinite(desired)):
            # The trajectory begins at the joint's position when it receives a goal.
            at, velocity = float(sent.position[cycle]) if math.isfinite(sent.goal[cycle]) else math.nan, 0.0
            way[cycle] = at
            cycle += 1
            continue
        left, dt = desired - at, float(sent.steps[cycle - 1])
        fastest = math.copysign(float(sent.speed[cycle - 1]), left)
        if acceleration < math.inf:
            # Braking must stay possible: v^2 / 2a plus half of this step's distance equals the remaining
            # distance.
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


# Remaining error


@dataclass(frozen=True, slots=True)
class _Rest:
    """Interval in which a joint is expected to rest, because its trajectory is constant."""

    settling_s: float | None
    """Time from the start of the interval until the joint stayed near its rest position; None if it did
    not move before."""
    error_rad: float  # Measured minus desired position at rest


@dataclass(slots=True)
class _OpenRest:
    """Detector of rests of one joint: intervals of 0.3 s or more in which its trajectory is constant.

    It is fed with slices of cycles, and keeps the cycles of a rest that has not ended, 20 s at most.
    """

    held: list[tuple[Floats, Floats, Floats]] = field(default_factory=list)
    """Times, desired positions and errors of the kept cycles, whose desired position is constant."""
    lowest: float = math.inf
    highest: float = -math.inf  # Range of the desired positions since the last rest, before the kept cycles

    def find_rests(
        self, times: Floats, way: Floats, error: Floats, tick: float, *, final: bool
    ) -> Iterator[_Rest]:
        """Add cycles; yield the rests that end in them, and with `final` also the one that has not ended.

        A rest that is too short, or without any known error, is dropped. A long rest is yielded in pieces.

        Args:
            times: s, shape (cycles,).
            way: Desired positions, rad.
            error: Measured minus desired position, rad; NaN where either is unknown.
            tick: Resolution of the servo's position, rad.
            final: No more cycles follow.
        """
        self.held.append((times, way, error))
        if not final and self._goes_on():
            return
        times, way, error = (np.concatenate(column) for column in zip(*self.held, strict=True))
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
            # The joint has settled in the last quarter, whose median is the rest position.
            rest_rad = float(np.median(left[known[-(len(known) // 4 + 1) :]]))
            near = max(_SETTLED_PART * moved, _SETTLED_TICKS * tick)
            outside = known[np.abs(left[known] - rest_rad) > near]
            settled = begin if not len(outside) else min(begin + int(outside[-1]) + 1, end)
            settling_s = float(times[settled] - times[begin]) if moved >= near else None
            yield _Rest(settling_s, rest_rad)
        self._saw(way[moved_from:keep])
        self.held = [(times[keep:], way[keep:], error[keep:])]

    def _goes_on(self) -> bool:
        """Return whether the newest cycles continue the rest of the kept ones, which does not end yet."""
        (begun, before, _), (times, way, _) = self.held[0], self.held[-1]
        lasted = len(before) and len(way) and times[-1] - begun[0] < _LONGEST_REST_S
        return bool(lasted and (way == before[0]).all())

    def _saw(self, way: Floats) -> None:
        known = _finite(way)
        if len(known):
            self.lowest, self.highest = min(self.lowest, known.min()), max(self.highest, known.max())


# Accumulation slice by slice


class TrackingCollector:
    """Accumulator of the tracking errors of all joints, fed slice by slice in constant memory."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.void]] = []
        self._count = 0
        self._held: NDArray[np.void] | None = None
        """Last two processed cycles, from which the trajectories of the next cycles continue."""
        self._rows: list[_JointAccumulator] = []
        self.movement = Movement()  # Complete once `finish` was called

    def add_slice(self, log: Log) -> None:
        """Add the cycles of the next slice of the log."""
        if not len(log.cycles):
            return
        if not self._rows:
            joints = planned_joints(log)
            self._rows = [_JointAccumulator(row, joint) for row, joint in enumerate(joints)]
            self.movement = Movement(joints, int(log.cycles["read_ns"][0]), log.header.references)
        self._parts.append(log.cycles)
        self._count += len(log.cycles)
        if self._count * max(8, len(self._rows)) >= _BLOCK:
            self._work()

    def evaluate_joints(self, log: Log) -> tuple[JointTracking, ...]:
        """Return the tracking error of each joint; `log` has the joint names."""
        self._work()
        nothing = np.zeros(0)
        for each in self._rows:
            each.rested(nothing, nothing, nothing, final=True)
        rows = self._rows or [_JointAccumulator(row, joint) for row, joint in enumerate(planned_joints(log))]
        return tuple(row.result(name) for row, name in zip(rows, log.joints, strict=True))

    def _work(self) -> None:
        if not self._parts:
            return
        known = 0 if self._held is None else len(self._held)
        parts = self._parts if self._held is None else [self._held, *self._parts]
        self._parts, self._count = [], 0
        columns = JointColumns(*parts)
        ways = [row.track_cycles(columns, known) for row in self._rows]
        self.movement.add_cycles(columns, np.array(ways).reshape(len(ways), len(columns)), known)
        self._held = np.concatenate([part[-2:] for part in parts[-2:]])[-2:]


@dataclass(slots=True)
class _JointAccumulator:
    """Accumulator of the tracking error of one joint: column `row` of the log's cycles."""

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
    highest: float = -math.inf  # Range of the trajectory while its velocity is known
    across: float = 0.0  # Sum of error times velocity
    moved: float = 0.0  # Sum of squared velocities
    rest: _OpenRest = field(default_factory=_OpenRest)
    settled_s: float | None = None
    rest_rad: float | None = None
    delays: DelayFit = field(default_factory=DelayFit)

    def track_cycles(self, columns: JointColumns, known: int) -> Floats:
        """Add the cycles from number `known` on; the first `known` were already added. Return the
        reachable trajectory of all, rad."""
        new = {name: columns[name][self.row, known:] for name in ("valid", "torque", "age_ns", "clamped")}
        missing = ~new["valid"] & (new["torque"] != _REBOOTING)
        self.invalid += int(np.count_nonzero(missing))
        self.oldest_ns = max(self.oldest_ns, int(new["age_ns"].max(initial=0)))
        self.clamped += int(np.count_nonzero(new["clamped"]))
        if self.lost_at is None and len(lost := np.flatnonzero(new["torque"] == _LOST)):
            at = columns["position"][self.row, known + lost[0]]
            self.lost_at = float(at) if math.isfinite(at) else None
        sent = _sent(columns, self.row, self.limits)
        way = _reachable(sent, self.limits.acceleration, self.way)
        times = columns.times
        error = sent.position - way
        if not known:
            error[:1] = np.nan  # The trajectory begins at this position, so its error is 0 by definition
        finite = _finite(error[known:])
        self.errors += len(finite)
        self.squares += float((finite**2).sum())
        self.worst = max(self.worst, float(np.abs(finite).max(initial=0.0)))
        self._lag(times, way, error)
        self.delays.add_cycles(times, sent.goal, sent.position, known)
        self.rested(times[known:], way[known:], error[known:], final=False)
        return way

    def rested(self, times: Floats, way: Floats, error: Floats, *, final: bool) -> None:
        """Add the settling times and errors of the rests that end in these cycles; `final` also ends the
        current one."""
        for rest in self.rest.find_rests(times, way, error, self.limits.tick, final=final):
            self.rest_rad = max(abs(rest.error_rad), self.rest_rad or 0.0)
            if rest.settling_s is not None:
                self.settled_s = max(rest.settling_s, self.settled_s or 0.0)

    def _lag(self, times: Floats, way: Floats, error: Floats) -> None:
        if len(way) < 3:
            return
        velocity = (way[2:] - way[:-2]) / (times[2:] - times[:-2])
        inner = error[1:-1]
        used, there = np.isfinite(velocity) & np.isfinite(inner), way[1:-1]
        if not used.all():
            there, inner, velocity = there[used], inner[used], velocity[used]
        if len(there):
            self.lowest, self.highest = min(self.lowest, there.min()), max(self.highest, there.max())
            self.across += float(inner @ velocity)
            self.moved += float(velocity @ velocity)

    def result(self, name: str) -> JointTracking:
        moved = self.highest - self.lowest >= _MOVED_TICKS * self.limits.tick
        # The range can come from a jump between two trajectories at rest, so the velocity counts as well.
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
