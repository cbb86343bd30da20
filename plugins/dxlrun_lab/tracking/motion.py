"""The desired motion: where a joint should be at any time, between the samples of a motion file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from dxlrun.channels.cycle import Floats
from dxlrun.compile.motions import LEAD_NS, TRAJECTORY, samples_of
from dxlrun.compile.problems import Problems
from dxlrun.compile.samples import Sample
from dxlrun.description.motion import read_motion
from dxlrun.errors import InputError
from dxlrun.plan.robot_plan import Plan


class DesiredMotion(msgspec.Struct, frozen=True):
    """One joint's motion; arrays have the shape (samples,), times count from the first of them."""

    joint: str
    file: str
    lead_ns: int
    """From the moment at which a controller takes the motion's first command to the first sample."""
    times_s: Floats
    positions: Floats
    """rad"""
    velocities: Floats
    """rad/s; where the file gives none, the slope between the neighbours."""

    @property
    def duration_ns(self) -> int:
        """From the first sample to the last."""
        return round(float(self.times_s[-1]) * 1e9)

    def at(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return position, rad, and velocity, rad/s, at any times; before and behind the motion it rests.

        Between two samples: the cubic of their positions and velocities, which is what the trajectory
        controller follows (cubic Hermite spline: Biagiotti and Melchiorri, Trajectory Planning for Automatic
        Machines and Robots, 2008, section 2.1.2).
        """
        times = np.clip(times_s, 0.0, self.times_s[-1])
        left = np.clip(np.searchsorted(self.times_s, times, side="right") - 1, 0, len(self.times_s) - 2)
        step = self.times_s[left + 1] - self.times_s[left]
        s = (times - self.times_s[left]) / step
        p0, p1 = self.positions[left], self.positions[left + 1]
        v0, v1 = self.velocities[left] * step, self.velocities[left + 1] * step
        c2, c3 = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
        position: Floats = p0 + s * (v0 + s * (c2 + s * c3))
        velocity: Floats = (v0 + s * (2 * c2 + 3 * s * c3)) / step
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
    slopes = np.gradient(positions, times)
    given = np.array([np.nan if target.velocity is None else target.velocity for target in targets])
    return DesiredMotion(
        joint=joint,
        file=str(path),
        lead_ns=(LEAD_NS if first_ns == 0 else first_ns) if lead else 0,
        times_s=times,
        positions=positions,
        velocities=np.where(np.isfinite(given), given, slopes),
    )
