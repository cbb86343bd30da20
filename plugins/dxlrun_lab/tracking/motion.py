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
from dxlrun_lab.desired import DesiredPath


class DesiredMotion(msgspec.Struct, frozen=True):
    """One joint's motion; its times count from the first sample."""

    path: DesiredPath
    file: str
    lead_ns: int
    """From the moment at which a controller takes the motion's first command to the first sample."""

    @property
    def duration_ns(self) -> int:
        """From the first sample to the last."""
        return round(self.path.end_s * 1e9)

    def at(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return position, rad, and velocity, rad/s, at any times; before and behind the motion it rests."""
        times = np.clip(times_s, 0.0, self.path.end_s)
        velocity = self.path.at(times, 1)
        velocity[times_s != times] = 0.0
        return self.path.at(times), velocity


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
    at, position, velocity = (tuple(one.tolist()) for one in (times, positions, velocities))
    desired = DesiredPath(joint, False, at, position, velocity, end_s=at[-1])
    return DesiredMotion(desired, str(path), (LEAD_NS if first_ns == 0 else first_ns) if lead else 0)
