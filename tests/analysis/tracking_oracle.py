"""How the joints followed, over a whole log at once, as the first versions did: for test_tracking.py.

No servo is at its goal in the cycle after it was sent: it goes there at the commanded speed, or at its
highest. So what a joint did is compared with its reachable trajectory: from where it stood towards the goals
that were sent, within the limits of velocity and acceleration, without delay. What is left is the servo's
lag, its settling, and the error with which it comes to rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats, Torque
from dxlrun.dynamixel.control_table import control_table
from dxlrun.log.reader import Log
from dxlrun_analysis.plan import LoggedJoint, LoggedServo, plan_of

_REST_S = 0.3
"""A reachable trajectory that does not change for so long is at rest: its joint is to settle."""
_SETTLED_PART, _SETTLED_TICKS = 0.02, 2
"""Settled: so near to where it stays, as a part of the way or in ticks, whichever is more."""
_MOVED_TICKS = 4
"""Shorter ways give no lag: positions are read in ticks."""
_TICK_RAD = math.tau / 4096
"""Where the log's plan does not have the servo's"""
_ACCELERATIONS = ("profile_acceleration", "goal_acceleration")

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class JointTracking:
    """One joint over all cycles."""

    name: str
    invalid: int
    """Cycles without an intact reply; those of a requested reboot do not count."""
    oldest_ms: float
    """Greatest age of a state."""
    clamped: int
    """Cycles in which the last gate changed the command."""
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
    rest_rad: float | None
    """The greatest error with which it came to rest; None where it never did."""


@dataclass(frozen=True, slots=True)
class _Limits:
    """What a servo can do, by the log's plan."""

    speed: float = math.inf
    """rad/s"""
    acceleration: float = math.inf
    """rad/s^2, of the profile that the robot file declares in its `registers`"""
    tick: float = _TICK_RAD
    """rad"""
    slowest: float = 0.0
    """rad/s; a speed of 0 would be none"""


def missing_states(cycles: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which states of cycles are not valid, shape (cycles, joints).

    Those of a servo that reboots because a client requested it are not missing.
    """
    missing: NDArray[np.bool_] = ~cycles["valid"] & (cycles["torque"] != Torque.REBOOTING)
    return missing


def tracking(log: Log) -> tuple[JointTracking, ...]:
    """Return freshness and tracking of each joint; rows in the order of the log."""
    limits = _limits(log)
    return tuple(_joint(log, row, name, limits.get(name, _Limits())) for row, name in enumerate(log.joints))


def reachable(log: Log, row: int) -> Floats:
    """Return where a joint could be in each cycle, rad, NaN where it had no goal; see the module."""
    return _reachable(log, row, _limits(log).get(log.joints[row], _Limits()))


def _joint(log: Log, row: int, name: str, limits: _Limits) -> JointTracking:
    cycles = log.cycles
    valid = cycles["valid"][:, row]
    ages = cycles["age_ns"][:, row]
    way = _reachable(log, row, limits)
    times = cycles["read_ns"] * 1e-9
    error = np.where(valid, cycles["position"][:, row], np.nan) - way
    error[:1] = np.nan  # the trajectory begins there
    known = error[np.isfinite(error)]
    rested = tuple(rests(times, way, error, limits.tick))
    settled = [rest.settling_s for rest in rested if rest.settling_s is not None]
    return JointTracking(
        name=name,
        invalid=int(np.count_nonzero(missing_states(cycles)[:, row])),
        oldest_ms=max(0.0, float(ages.max(initial=0)) / 1e6),
        clamped=int(np.count_nonzero(cycles["clamped"][:, row])),
        rms_rad=float(np.sqrt(np.mean(known**2))) if len(known) else None,
        worst_rad=float(np.abs(known).max()) if len(known) else None,
        lag_ms=_lag_ms(times, way, error, limits),
        settling_ms=max(settled) * 1e3 if settled else None,
        rest_rad=max((abs(rest.error_rad) for rest in rested), default=None),
    )


# The reachable trajectory


def _reachable(log: Log, row: int, limits: _Limits) -> Floats:
    """A goal holds until the next cycle; where it can be reached by then, the trajectory is the goal."""
    cycles, count = log.cycles, len(log.cycles)
    goal: Floats = cycles["goal_position"][:, row].astype(np.float64)
    position = np.where(cycles["valid"][:, row], cycles["position"][:, row], np.nan)
    commanded = np.abs(cycles["goal_velocity"][:, row])
    speed = np.where(np.isfinite(commanded), np.maximum(commanded, limits.slowest), math.inf)
    speed = np.minimum(speed, limits.speed)
    times = cycles["read_ns"] * 1e-9
    way = np.full(count, np.nan)
    way[1:] = goal[:-1]
    steps = np.diff(times, prepend=times[:1])
    sent = _Sent(goal, speed, position, steps)
    jumps = np.zeros(count, dtype=bool)
    jumps[2:] = ~(np.abs(np.diff(goal[:-1])) <= speed[1:-1] * steps[2:] * (1 + 1e-9))
    jumps[:2] = True
    done = 0
    for start in np.flatnonzero(jumps).tolist():
        if start >= done:
            done = _go(start, way, sent, limits.acceleration)
    return way


@dataclass(frozen=True, slots=True)
class _Sent:
    """What was sent to a joint in each cycle, and where it was."""

    goal: Floats
    """rad"""
    speed: Floats
    """rad/s, of the way to it"""
    position: Floats
    """rad, NaN where it was not read"""
    steps: Floats
    """s since the cycle before"""


def _go(start: int, way: Floats, sent: _Sent, acceleration: float) -> int:
    """Fill a way from a cycle on until it has come to its goal; return the cycle behind."""
    at = float(way[start - 1]) if start else math.nan
    velocity = 0.0
    for cycle in range(start, len(way)):
        desired = float(sent.goal[cycle - 1]) if cycle else math.nan
        if not (math.isfinite(at) and math.isfinite(desired)):
            # it begins at the joint's position when it gets a goal
            at, velocity = float(sent.position[cycle]) if math.isfinite(sent.goal[cycle]) else math.nan, 0.0
            way[cycle] = at
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
    return len(way)


# What is left of it


def _lag_ms(times: Floats, way: Floats, error: Floats, limits: _Limits) -> float | None:
    """Return the delay that explains most of the error, to the first order: error = -delay * velocity."""
    velocity = np.full(len(way), np.nan)
    velocity[1:-1] = (way[2:] - way[:-2]) / (times[2:] - times[:-2])
    used = np.isfinite(velocity) & np.isfinite(error)
    if not used.any() or np.ptp(way[used]) < _MOVED_TICKS * limits.tick:
        return None
    moving = velocity[used]
    if not moving.any():  # it jumps between two trajectories, and rests where both neighbours are known
        return None
    return float(-(error[used] @ moving) / (moving @ moving)) * 1e3


@dataclass(frozen=True, slots=True)
class Rest:
    """A time in which a joint was to rest."""

    begin: int
    end: int
    """Its cycles, the last one included"""
    settling_s: float | None
    """From its begin until the joint stayed near where it rests; None where nothing moved before"""
    error_rad: float
    """With which it rests"""


def rests(times: Floats, way: Floats, error: Floats, tick: float) -> Iterator[Rest]:
    """Yield each time in which a desired position does not change, for 0.3 s or more.

    `times` s, `way` the desired positions, rad, and `error` what is read minus that, NaN where either is not
    known; shape (cycles,). `tick`: of the servo's position, rad.
    """
    still = np.zeros(len(way) + 1, dtype=bool)
    still[1:-1] = way[1:] == way[:-1]
    begins, ends = np.flatnonzero(still[1:] & ~still[:-1]), np.flatnonzero(still[:-1] & ~still[1:])
    moved_from = 0
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if times[end] - times[begin] < _REST_S:
            continue
        left = error[begin : end + 1]
        known = np.flatnonzero(np.isfinite(left))
        before = way[moved_from : begin + 1]
        moved = float(np.ptp(before[np.isfinite(before)])) if np.isfinite(before).any() else 0.0
        moved_from = end
        if not len(known):
            continue
        final = float(np.median(left[known[-(len(known) // 4 + 1) :]]))
        near = max(_SETTLED_PART * moved, _SETTLED_TICKS * tick)
        outside = known[np.abs(left[known] - final) > near]
        settled = begin if not len(outside) else min(begin + int(outside[-1]) + 1, end)
        yield Rest(begin, end, float(times[settled] - times[begin]) if moved >= near else None, final)


# The limits


def _limits(log: Log) -> dict[str, _Limits]:
    """Return the limits of each joint from the plan in the log; one without a readable plan has none."""
    plan = plan_of(log)
    joints = {joint.name: joint for joint in plan.loop.joints}
    return {
        servo.joint: _Limits(
            speed=_speed(joints.get(servo.joint)),
            acceleration=_acceleration(servo, bus.protocol),
            tick=servo.rad_per_tick,
            slowest=servo.rad_s_per_tick,
        )
        for bus in plan.buses
        for servo in bus.servos
    }


def _speed(joint: LoggedJoint | None) -> float:
    if joint is None:
        return math.inf
    return min(math.inf if limit is None else limit for limit in (joint.velocity, joint.top_speed))


def _acceleration(servo: LoggedServo, protocol: float | None) -> float:
    """Return the acceleration that a servo's registers declare; 0 there is none."""
    declared = {each.name: each.value for each in servo.registers}
    for name in _ACCELERATIONS:
        if value := declared.get(name):
            try:
                return value * control_table(servo.model, protocol).items[name].scale
            except LookupError:  # a plug-in's model that is not installed here
                return math.inf
    return math.inf
