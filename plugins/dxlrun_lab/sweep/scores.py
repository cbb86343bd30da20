"""Scores: what one run on virtual time was like, from its cycles in flat memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from dxlrun.channels.cycle import CycleRecord, Floats
from dxlrun.channels.events import Event, EventCode, GoalReport
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.channels.tagged import decode
from dxlrun.plan.robot_plan import Plan
from dxlrun.simulation.servo.simulated_servo import SimulatedServo
from dxlrun_analysis.joints.tracking import rests
from dxlrun_lab.desired import DesiredPath


class Scores(msgspec.Struct, frozen=True):
    """One run: how its joints followed the motion, and what that cost.

    The errors are those of positions as they were read, at the times of their cycles' reads, against the
    motion's own; None where the motion gives no positions, or none in which a joint comes to rest.
    """

    rms_rad: float | None
    """Over all joints and cycles of the motion"""
    worst_rad: float | None
    worst_joint: str
    overshoot_rad: float | None
    """The furthest that a joint went beyond a position at which it was to rest"""
    settling_s: float | None
    """The longest time from such a position's begin until the joint stayed near where it rests, within 2 % of
    the way or two ticks"""
    energy_j: float
    """What the simulated motors drew: voltage at the motor times its current, where that is positive"""
    temperature_c: float
    """The highest of the simulated servos"""
    cycles: int
    skipped: int
    """Periods"""
    clamped: int
    """Cycles in which the gate changed a command"""
    invalid: int
    """Cycles without an intact reply of a joint, summed over the joints"""
    errors: int
    """Events that were errors"""
    goals: int
    """That controllers accepted"""
    goals_reached: int


class CycleMemory:
    """Takes what the scores need of each cycle; its size is known before the run.

    `paths` are what the joints are to do.
    """

    def __init__(self, plan: Plan, paths: Sequence[DesiredPath]) -> None:
        names = [joint.name for joint in plan.loop.joints]
        self._paths = tuple(paths)
        self._rows = [names.index(joint) for joint in dict.fromkeys(path.joint for path in paths)]
        self._column = {names[row]: column for column, row in enumerate(self._rows)}
        self._tick = {
            joint: max(servo.position_per_tick for _, servo in servos)
            for joint, servos in plan.servos_by_joint.items()
        }
        end_ns = max((round(path.end_s * 1e9) for path in paths), default=0)
        size = end_ns // plan.loop.period_ns + 2  # what follows the motion is not scored
        self._times = np.full(size, np.nan)
        self._positions = np.full((size, len(self._rows)), np.nan)
        self._period_ns = plan.loop.period_ns
        self._start_ns: int | None = None
        self._read_ns = 0
        self._energy_j = 0.0
        self._temperature_c = -math.inf
        self._cycles = self._skipped = self._clamped = self._goals = self._reached = 0

    def take(self, record: CycleRecord, servos: Sequence[SimulatedServo]) -> None:
        """Take one finished cycle, and how the servos are then."""
        if self._start_ns is None:
            self._start_ns = record.scheduled_ns - record.cycle * self._period_ns
            self._read_ns = record.read_ns
        row, self._cycles = self._cycles, self._cycles + 1
        self._skipped += record.skipped
        self._clamped += bool(record.clamped.any())
        if row < len(self._times):
            states = record.states
            self._times[row] = (record.read_ns - self._start_ns) * 1e-9
            for column, joint in enumerate(self._rows):
                if states.valid.item(joint):
                    self._positions[row, column] = states.position.item(joint)
        dt_s, self._read_ns = (record.read_ns - self._read_ns) * 1e-9, record.read_ns
        for servo in servos:
            shaft = servo.shaft
            power = servo.voltage * shaft.duty * shaft.current
            if power > 0.0:
                self._energy_j += power * dt_s
            self._temperature_c = max(self._temperature_c, servo.temperature)

    def watch(self, kind: RecordKind, payload: Payload) -> None:
        """Take what happened beside the cycles: goals."""
        event = decode(payload) if kind == RecordKind.TAGGED else None
        if not isinstance(event, Event):
            return
        if event.code == EventCode.GOAL_ACCEPTED:
            self._goals += 1
        elif event.code == EventCode.GOAL_ENDED and event.data:
            self._reached += msgspec.json.decode(event.data, type=GoalReport).status == "reached"

    def scores(self, invalid: int, errors: int) -> Scores:
        """Return the scores of the run, which has ended."""
        followed = tuple(self._followed())
        errors_rad = np.concatenate([one.error for one in followed]) if followed else np.zeros(0)
        worst = max(followed, key=lambda one: one.worst, default=None)
        overshoots = [value for one in followed for value in one.overshoots]
        settlings = [value for one in followed for value in one.settlings]
        return Scores(
            rms_rad=float(np.sqrt(np.mean(errors_rad**2))) if len(errors_rad) else None,
            worst_rad=worst.worst if worst is not None else None,
            worst_joint=worst.joint if worst is not None else "",
            overshoot_rad=max(overshoots, default=None),
            settling_s=max(settlings, default=None),
            energy_j=self._energy_j,
            temperature_c=self._temperature_c,
            cycles=self._cycles,
            skipped=self._skipped,
            clamped=self._clamped,
            invalid=invalid,
            errors=errors,
            goals=self._goals,
            goals_reached=self._reached,
        )

    def _followed(self) -> Iterator[_Followed]:
        """Yield how each path was followed that was known at one cycle or more."""
        count = min(self._cycles, len(self._times))
        times = self._times[:count]
        for path in self._paths:
            position = self._positions[:count, self._column[path.joint]]
            desired = path.at(times)
            error = position - desired
            first = int(np.argmax(np.isfinite(desired))) if np.isfinite(desired).any() else count
            if not np.isfinite(error[first:]).any():
                continue
            # before its first point the joint was to be where it was: that is where a first step begins
            way = np.concatenate([position[first : first + 1], desired[first:]])
            since = np.concatenate([times[first : first + 1] - self._period_ns * 1e-9, times[first:]])
            left = np.concatenate([[np.nan], error[first:]])
            found = [rest for rest in rests(since, way, left, self._tick[path.joint]) if rest.begin > 0]
            moved = [rest for rest in found if rest.settling_s is not None]
            scored = error[np.isfinite(error)]
            yield _Followed(
                path.joint,
                scored,
                float(np.abs(scored).max()),
                [_beyond(way, left, rest.begin, rest.end) for rest in moved],
                [rest.settling_s for rest in moved if rest.settling_s is not None],
            )


class _Followed(NamedTuple):
    joint: str
    error: Floats
    """rad, the cycles without a reply left out"""
    worst: float
    overshoots: list[float]
    settlings: list[float]


def _beyond(way: Floats, error: Floats, begin: int, end: int) -> float:
    """Return how far a joint went beyond the position at which it was to rest, rad, at least 0."""
    direction = np.sign(way[begin] - way[begin - 1])
    passed = error[begin : end + 1] * direction
    return max(0.0, float(np.nanmax(passed)))
