"""Tracks: the trajectories, and the stop, that the joints of a controller follow at the same time.

A new trajectory only moves its own joints. All other joints continue on their tracks without a jump in
position, velocity or acceleration.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun_controllers.laws.spline import SplineLimits, SplineSample, StopTrajectory, Trajectory


class Track:
    """A trajectory with the joints that follow it."""

    def __init__(self, joints: int) -> None:
        self.trajectory = Trajectory(joints)
        self.joints = np.zeros(joints, dtype=np.bool_)
        self.ahead_s = 0.0
        """Time by which this track started before the newest one, s."""


class Tracks:
    """Desired state of joints, from the trajectories and the stop that they follow.

    All memory is allocated by the constructor. Each playing track has a joint, so a pool of one track more
    than
    joints always has a free one.
    """

    def __init__(self, joints: int) -> None:
        self.desired = SplineSample(joints)
        self.still = np.ones(joints, dtype=np.bool_)
        """True for each joint at rest: it follows neither a trajectory nor a stop."""
        self.all_still = True
        """True while all joints are at rest."""
        self.stop = StopTrajectory(joints)
        self._stopping = np.zeros(joints, dtype=np.bool_)
        self._own = SplineSample(joints)
        self._pool = tuple(Track(joints) for _ in range(joints + 1))
        self._playing: tuple[Track, ...] = ()

    @property
    def playing(self) -> bool:
        """True while a joint follows a trajectory; a stop does not count."""
        return bool(self._playing)

    def free(self) -> Track:
        """Return a track that no joint follows, for the next trajectory."""
        return next(track for track in self._pool if track not in self._playing)

    def start_track(self, track: Track, moved: NDArray[np.bool_], clock_s: float) -> None:
        """Move joints to a track that starts now.

        Args:
            track: Free track with a loaded trajectory.
            moved: True for each joint that moves to it.
            clock_s: Time since the newest track started, s.
        """
        for other in self._playing:
            other.joints &= ~moved
            other.ahead_s += clock_s
        self._playing = (*(other for other in self._playing if other.joints.any()), track)
        np.copyto(track.joints, moved)
        track.ahead_s = 0.0
        self._stopping &= ~moved
        self.still &= ~moved
        self.all_still = bool(self.still.all())

    def end_tracks(self) -> None:
        """End all tracks and the stop at once: all joints count as at rest."""
        self._playing = ()
        self._stopping.fill(False)
        self.still.fill(True)
        self.all_still = True

    def come_to_rest(self, limits: SplineLimits) -> None:
        """End all tracks, and decelerate all joints to rest from the desired state."""
        self.end_tracks()
        self.stop.load(self.desired, limits.deceleration, limits.lower, limits.upper)
        self._stopping.fill(True)
        self.still.fill(False)
        self.all_still = False

    def sample(self, clock_s: float, rate: float, slope: float, stop_s: float) -> None:
        """Compute the desired state of this cycle, and remove tracks that have ended.

        Args:
            clock_s: Time since the newest track started, s.
            rate: Speed of the tracks' clock relative to real time.
            slope: Rate of change of `rate`, 1/s.
            stop_s: Time since the stop started, s.
        """
        desired, own = self.desired, self._own
        if self._playing:
            for track in self._playing:
                track.trajectory.sample(clock_s + track.ahead_s, own)
                np.copyto(desired.rows, own.rows, where=track.joints)
            if rate != 1.0 or slope:  # else the own time is that of the run
                desired.acceleration *= rate**2
                desired.acceleration += desired.velocity * slope
                desired.velocity *= rate
            self._leave_ended(clock_s)
        if 1 in self._stopping.tobytes():
            self.stop.sample(stop_s, own)
            np.copyto(desired.rows, own.rows, where=self._stopping)
            if stop_s >= self.stop.duration_s:
                self.still |= self._stopping
                self.all_still = bool(self.still.all())
                self._stopping.fill(False)

    def _leave_ended(self, clock_s: float) -> None:
        for track in self._playing:
            if clock_s + track.ahead_s >= track.trajectory.duration_s:
                self.still |= track.joints
                self.all_still = bool(self.still.all())
                self._playing = tuple(other for other in self._playing if other is not track)
