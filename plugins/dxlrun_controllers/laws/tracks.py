"""Tracks: what each joint of a controller follows: one of several trajectories, a stop, or nothing.

A trajectory of some joints leaves the others on theirs: positions, velocities and accelerations go on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun_controllers.laws.spline import Limits, SplineSample, Stop, Trajectory


class Track:
    """A trajectory and the joints that follow it."""

    def __init__(self, joints: int) -> None:
        self.trajectory = Trajectory(joints)
        self.joints = np.zeros(joints, dtype=np.bool_)
        self.ahead_s = 0.0
        """By how much it began before the newest one."""


class Tracks:
    """The desired state of some joints, by the trajectories and the stop that they follow.

    All memory is made at once: each track that goes on has a joint, so one more is always free.
    """

    def __init__(self, joints: int) -> None:
        self.desired = SplineSample(joints)
        self.still = np.ones(joints, dtype=np.bool_)
        """Joints that follow nothing: they are at rest."""
        self.stop = Stop(joints)
        self._stopping = np.zeros(joints, dtype=np.bool_)
        self._own = SplineSample(joints)
        self._pool = tuple(Track(joints) for _ in range(joints + 1))
        self._playing: tuple[Track, ...] = ()

    @property
    def playing(self) -> bool:
        """True while a trajectory is followed."""
        return bool(self._playing)

    def free(self) -> Track:
        """Return a track that no joint follows, for the next trajectory."""
        return next(track for track in self._pool if track not in self._playing)

    def follow(self, track: Track, moved: NDArray[np.bool_], clock_s: float) -> None:
        """Let joints leave what they follow for a track that begins now, at `clock_s` of the one before."""
        for other in self._playing:
            other.joints &= ~moved
            other.ahead_s += clock_s
        self._playing = (*(other for other in self._playing if other.joints.any()), track)
        np.copyto(track.joints, moved)
        track.ahead_s = 0.0
        self._stopping &= ~moved
        self.still &= ~moved

    def rest(self) -> None:
        """Let the joints follow nothing any more."""
        self._playing = ()
        self._stopping.fill(False)
        self.still.fill(True)

    def come_to_rest(self, limits: Limits) -> None:
        """Let all joints come to rest from the desired state, from now on."""
        self.rest()
        self.stop.load(self.desired, limits.deceleration, limits.lower, limits.upper)
        self._stopping.fill(True)
        self.still.fill(False)

    def sample(self, clock_s: float, rate: float, slope: float, stop_s: float) -> None:
        """Set the desired state: `clock_s` after the newest track began, `stop_s` after the stop did.

        The time of the tracks goes at `rate`, which changes by `slope`, 1/s. What has ended is left.
        """
        desired, own = self.desired, self._own
        if self._playing:
            for track in self._playing:
                track.trajectory.sample(clock_s + track.ahead_s, own)
                np.copyto(desired.rows, own.rows, where=track.joints)
            desired.acceleration *= rate**2
            desired.acceleration += desired.velocity * slope
            desired.velocity *= rate
            self._leave_ended(clock_s)
        if self._stopping.any():
            self.stop.sample(stop_s, own)
            np.copyto(desired.rows, own.rows, where=self._stopping)
            if stop_s >= self.stop.duration_s:
                self.still |= self._stopping
                self._stopping.fill(False)

    def _leave_ended(self, clock_s: float) -> None:
        for track in self._playing:
            if clock_s + track.ahead_s >= track.trajectory.duration_s:
                self.still |= track.joints
                self._playing = tuple(other for other in self._playing if other is not track)
