"""Playback of a recorded motion on a robot: an experiment of one segment, and its tracking errors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from dxlrun.tooling.output import counted
from dxlrun_analysis.playback.rows import PlaybackRows
from dxlrun_lab.guided.experiment import APPROACH_RAD_S, Procedure, Situation
from dxlrun_lab.guided.segment import Guard, Segment, SegmentRecording

_SETTLE_S = 0.5
"""Time for which the last pose is still commanded, s"""
_OLDEST_S, _OLDEST_CYCLES = 0.1, 3
"""Age of a joint's state, s and cycles. The motion ends if both are exceeded."""


class PlayedJoint(msgspec.Struct, frozen=True):
    """Difference of measured position and goal of a joint during a playback"""

    name: str
    rms: float
    """Root mean square of the difference, rad"""
    worst: float
    """Largest difference, rad"""


class PlaybackResult(msgspec.Struct, frozen=True):
    """Result of the playback of a recorded motion"""

    seconds: float
    """Time for which the motion was played, s"""
    whole: bool
    """True if the motion was played to its last pose"""
    joints: tuple[PlayedJoint, ...]


class Playback(msgspec.Struct, frozen=True):
    """Experiment that plays a recorded motion as one segment. The joints remain at the last pose."""

    rows: PlaybackRows
    """The motion as poses of the robot's joints, one per period"""

    @property
    def expected(self) -> tuple[str, ...]:
        """Description of the motion before the positions of the joints are known, in sentences"""
        rows = self.rows
        way = rows.positions.max(axis=0) - rows.positions.min(axis=0)
        speed = np.abs(np.diff(rows.positions, axis=0)).max(axis=0, initial=0.0) / rows.period_s
        widest, fastest = int(way.argmax()), int(speed.argmax())
        return (
            f"{counted(len(rows.joints), 'joint', 'joints')} will move to the first pose at up to "
            f"{math.degrees(APPROACH_RAD_S):.0f} deg/s, and then play {rows.duration_s:.1f} s of "
            f"{rows.motion.path}; widest: {rows.joints[widest]}, {math.degrees(way[widest]):.0f} deg; "
            f"fastest: {rows.joints[fastest]}, {math.degrees(speed[fastest]):.0f} deg/s",
        )

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        """Describe the way to the first pose, and the motion."""
        rows = self.rows
        ways = {
            joint.name: abs(float(rows.positions[0, rows.joints.index(joint.name)]) - joint.start)
            for joint in situation.joints
        }
        joint = max(situation.joints, key=lambda one: ways[one.name])
        speed = min(APPROACH_RAD_S, joint.plan.highest_speed / 2)
        motion = rows.motion
        goals, states = (motion.what.count(what) for what in ("goals", "states"))
        end_s = motion.begin_s + motion.duration_s
        return (
            f"first pose: {joint.plan.label} moves farthest, {math.degrees(ways[joint.name]):.1f} deg, "
            f"at up to {math.degrees(speed):.0f} deg/s",
            f"then {motion.begin_s:.3f} s to {end_s:.3f} s of {motion.path} at speed {rows.speed:g}, "
            f"{rows.duration_s:.1f} s: {counted(goals, 'joint', 'joints')} by sent goals, "
            f"{states} by measured positions",
        )

    def procedure(self, situation: Situation) -> Procedure:
        """Yield the motion as a segment, which moves to the first pose before."""
        rows = self.rows
        yield Segment(
            "recorded motion",
            rows.period_s,
            {
                joint: np.ascontiguousarray(rows.positions[:, column])
                for column, joint in enumerate(rows.joints)
            },
            settle_s=_SETTLE_S,
            guard=Guard(age_s=max(_OLDEST_S, _OLDEST_CYCLES / situation.rate)),
        )

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> PlaybackResult:
        """Return the played duration and the tracking error of each joint."""
        played = recorded[-1]
        off = np.abs(np.where(played.valid, played.position - played.goal, np.nan))
        joints = []
        for column, name in enumerate(played.joints):
            known = off[np.isfinite(off[:, column]), column]
            rms = float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
            joints.append(PlayedJoint(name, rms, float(known.max(initial=0.0))))
        seconds = float(played.time[-1]) if len(played) else 0.0
        return PlaybackResult(seconds, played.whole, tuple(joints))
