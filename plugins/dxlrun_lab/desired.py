"""Desired: where a motion wants each joint at each time, whatever controllers make of it.

A trajectory is linear between points of positions, cubic where these have velocities, quintic where they
have accelerations, as `joint_trajectory_controller` plays it; the points of a group controller hold until
the next.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from dxlrun.channels.cycle import Floats
from dxlrun.compile.motions import LEAD_NS, TRAJECTORY, samples_of
from dxlrun.compile.problems import Problems
from dxlrun.compile.robot import Compiled
from dxlrun.compile.samples import Quantity, Sample
from dxlrun.description.motion import MotionDescription
from dxlrun.plan.robot_plan import MotionPart
from dxlrun_controllers.laws.spline import solve


class DesiredPath(msgspec.Struct, frozen=True):
    """One joint's part of a motion; the points are in order of time."""

    joint: str
    held: bool
    """Each point holds until the next; else the path between them is smooth."""
    times_s: tuple[float, ...]
    """Since the loop's first deadline"""
    positions: tuple[float, ...]
    """rad"""
    velocities: tuple[float, ...] = ()
    """rad/s; empty: not given"""
    accelerations: tuple[float, ...] = ()
    """rad/s^2; empty: not given"""
    end_s: float = 0.0
    """Until then the joint stays at the last point."""

    def at(self, times_s: Floats, derivative: int = 0) -> Floats:
        """Return the desired positions, rad, at some times; NaN before the first point and after the end.

        After the last point of a trajectory that does not end at rest nothing is desired. Where velocities
        are given, also the first derivative, rad/s.
        """
        times, states = np.array(self.times_s), np.array(self._states)
        index = np.searchsorted(times, times_s, side="right") - 1
        known = (index >= 0) & (times_s <= self.end_s)
        desired = np.where(known, states[derivative, np.clip(index, 0, None)], np.nan)
        if self.held:
            return desired
        if self.velocities and self.velocities[-1] != 0:
            desired[times_s > times[-1]] = np.nan
        inside = known & (index < len(times) - 1)
        if inside.any():
            at = index[inside]
            pieces = np.empty((2 * len(states), len(at)))
            solve(len(pieces), times[at + 1] - times[at], states[:, at], states[:, at + 1], pieces)
            derived = polyder(pieces, derivative)
            desired[inside] = polyval(times_s[inside] - times[at], derived, tensor=False)
        return desired

    @property
    def _states(self) -> list[tuple[float, ...]]:
        """Positions, and the derivatives that are given."""
        return [each for each in (self.positions, self.velocities, self.accelerations) if each]


def motion_samples(motions: Sequence[MotionDescription]) -> tuple[tuple[Sample, ...], ...]:
    """Return the samples of each part of some motions, which have been compiled without a problem."""
    return tuple(
        samples_of(motion, index, Problems())
        for motion in motions
        for index in range(len(motion.motion.motions))
    )


def desired_paths(compiled: Compiled, samples: Sequence[Sequence[Sample]]) -> tuple[DesiredPath, ...]:
    """Return the paths of all joints to which a motion gives positions; `samples` of each of its parts."""
    period_ns = compiled.plan.loop.period_ns
    found = (_paths(part, own, period_ns) for part, own in zip(compiled.parts, samples, strict=True))
    return tuple(itertools.chain.from_iterable(found))


def _paths(part: MotionPart, samples: Sequence[Sample], period_ns: int) -> Iterator[DesiredPath]:
    held = part.commands[0].kind != TRAJECTORY
    lead_ns = LEAD_NS if not held and samples[0].t_ns == 0 else 0
    for joint in dict.fromkeys(joint for sample in samples for joint in sample.targets):
        own = [sample for sample in samples if _value(sample, joint, "position") is not None]
        if not own:
            continue
        if held:  # a command is taken in the first cycle that is not before its time
            times_ns = [_in_cycle(part.start_ns + sample.t_ns, period_ns) for sample in own]
        else:
            start_ns = _in_cycle(part.start_ns, period_ns) + lead_ns
            times_ns = [start_ns + sample.t_ns for sample in own]
        velocities = () if held else _all(own, joint, "velocity")
        yield DesiredPath(
            joint=joint,
            held=held,
            times_s=tuple(t_ns * 1e-9 for t_ns in times_ns),
            positions=_all(own, joint, "position"),
            velocities=velocities,
            accelerations=_all(own, joint, "acceleration") if velocities else (),
            end_s=part.end_ns * 1e-9,
        )


def _in_cycle(t_ns: int, period_ns: int) -> int:
    return -(-t_ns // period_ns) * period_ns


def _all(samples: Sequence[Sample], joint: str, quantity: Quantity) -> tuple[float, ...]:
    """Return a quantity at all samples; empty where one does not give it, as it is not used then."""
    values = [_value(sample, joint, quantity) for sample in samples]
    return tuple(value for value in values if value is not None) if None not in values else ()


def _value(sample: Sample, joint: str, quantity: Quantity) -> float | None:
    target = sample.targets.get(joint)
    return None if target is None else target.get(quantity)
