"""The desired motion: where a joint should be at any time, between the samples of a motion file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from dxlrun import Floats, InputError
from dxlrun.compile.motions import LEAD_NS, TRAJECTORY, samples_of
from dxlrun.compile.problems import Problems
from dxlrun.compile.samples import Sample
from dxlrun.tooling.plans import Plan
from dxlrun.tooling.robots import read_motion
from dxlrun_controllers.laws.spline import CUBIC, solve


class DesiredMotion(msgspec.Struct, frozen=True):
    """Motion of one joint: cubic between its samples, as `joint_trajectory_controller` plays it."""

    joint: str
    file: str
    times_s: tuple[float, ...]  # since the first sample
    positions: tuple[float, ...]  # rad
    velocities: tuple[float, ...]  # rad/s
    lead_ns: int
    """From the moment at which a controller takes the motion's first command to the first sample."""

    @property
    def duration_ns(self) -> int:
        """From the first sample to the last."""
        return round(self.times_s[-1] * 1e9)

    def at(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return position, rad, and velocity, rad/s; before and after the motion the joint rests."""
        times, samples = np.clip(times_s, 0.0, self.times_s[-1]), np.array(self.times_s)
        states = np.array([self.positions, self.velocities])
        index = np.clip(np.searchsorted(samples, times, side="right") - 1, 0, len(samples) - 2)
        pieces = np.empty((CUBIC, len(times)))
        solve(CUBIC, np.diff(samples)[index], states[:, index], states[:, index + 1], pieces)
        elapsed = times - samples[index]
        position: Floats = polyval(elapsed, pieces, tensor=False)
        velocity: Floats = polyval(elapsed, polyder(pieces), tensor=False)
        velocity[times_s != times] = 0.0
        return position, velocity


def desired_motion(path: Path, plan: Plan) -> DesiredMotion:
    """Return the motion of a file that the plan plays. Raises InputError where it is not one of one joint."""
    motion = read_motion(path, plan.groups)
    samples = samples_of(motion, 0, Problems())
    joints = sorted({joint for sample in samples for joint in sample.targets})
    parts = len(motion.motion.motions)
    if parts != 1 or len(joints) != 1:
        what = f"{parts} parts" if parts != 1 else f"one of {len(joints)} joints"
        raise InputError(
            f"the experiment compares how one joint follows one motion, and {path} has {what}; "
            "give a motion file with one part that moves one joint"
        )
    if len(samples) < 2 or samples[0].targets[joints[0]].position is None:
        raise InputError(
            f"the experiment compares positions, and {path} has not two of them; give --play another motion"
        )
    lead = plan.loop.commands[0].kind == TRAJECTORY
    return _desired(joints[0], path, samples, lead=lead)


def _desired(joint: str, path: Path, samples: Sequence[Sample], *, lead: bool) -> DesiredMotion:
    targets = [sample.targets[joint] for sample in samples]
    first_ns = samples[0].t_ns
    times = np.array([sample.t_ns - first_ns for sample in samples]) * 1e-9
    positions = np.array([target.position for target in targets], np.float64)
    given = np.array([np.nan if target.velocity is None else target.velocity for target in targets])
    # where the file gives no velocity, the slope between the neighbours
    velocities = np.where(np.isfinite(given), given, np.gradient(positions, times))
    lead_ns = (LEAD_NS if first_ns == 0 else first_ns) if lead else 0
    at, position, velocity = (tuple(one.tolist()) for one in (times, positions, velocities))
    return DesiredMotion(joint, str(path), at, position, velocity, lead_ns)
