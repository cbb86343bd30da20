"""ilc_controller: play trajectories, and reduce their tracking error with each repetition."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import LIVE, Angle, CommandModel, Context, Duration, Floats, Goal
from dxlrun.tooling.topics import messages
from dxlrun_controllers.joint_parameters import PerJoint, Positive, clamped, row_of
from dxlrun_controllers.laws.learning import MOST_DELAY_S, Repetition
from dxlrun_controllers.motions.joint_trajectory_controller import (
    JointTrajectoryController,
    TrajectoryParameters,
)
from dxlrun_controllers.motions.learned_motions import LearnedMotion, LearnedMotions, motion_name
from dxlrun_controllers.motions.trajectory_command import TrajectoryCommand

TAIL_S: Final = 0.5
"""Time after the end of a motion that is still recorded and corrected, s: servos arrive, the correction
fades.
"""
WORSE: Final = 1.05
"""Ratio of an error to that without a correction, above which the correction counts as harmful."""
LEAST: Final = math.radians(0.088)
"""Smallest error that is compared with others, rad: one tick of most servos."""
FADE_S: Final = 0.2
"""Shortest time in which one correction fades into another, s."""
STEP_NS: Final = 15_000
"""Duration of one step of learning, ns, measured by bench/controllers.py."""
SHARE: Final = 0.05
"""Fraction of a period that the steps of learning in one cycle may take."""
_SAME: Final = 1e-6
"""Largest difference between command and goal of a joint that the loop did not clamp, rad and rad/s."""
_NOT_LEARNED: Final = ("timeout", "goal_tolerance", "path_tolerance", "goal_time_tolerance")
"""Fields of a trajectory command that do not change the identity of its motion."""
_KEY_BYTES: Final = 6
"""Bytes of a hash in each of the two numbers of a motion's key; a float64 represents them exactly."""


class IlcParameters(TrajectoryParameters):
    """Keys of an ilc_controller in the robot file, in addition to those of a joint_trajectory_controller"""

    command_interface: Literal["position", "posvel"] = "position"
    """The correction is added to the position. `posvel` also commands the matching speed."""
    gain: Annotated[float, LIVE, Field(ge=0, le=1)] = 0.5
    """Learning gain L: fraction of the error that a repetition corrects. With 0, the learned correction is
    applied but does not change."""
    cutoff: Positive = 5.0
    """Cut-off frequency of Q, Hz. Faster errors are not learned. Lower it if a servo begins to shake."""
    delay: Annotated[Duration, Field(ge=0, le=round(MOST_DELAY_S * 1e9))] | None = None
    """Tracking delay of the servos; by default it is measured in the first repetition, for each joint."""
    most: PerJoint[Annotated[Angle, Field(gt=0)]] = math.radians(10)
    """Largest correction, rad."""
    longest: Annotated[Duration, Field(gt=0)] = 40_000_000_000
    """Longest motion that is learned."""
    motions: Annotated[int, Field(ge=1, le=64)] = 4
    """Number of remembered motions. A further motion replaces the one that was played least recently."""
    growth: Annotated[float, Field(gt=1)] = 2.0
    """Largest ratio of the error to the smallest error of the motion. The learned correction is dropped if
    two repetitions in a row exceed it, or are worse than without a correction."""


@dataclass(slots=True)
class LearnedRepetition:
    """Message of the topic `repetition`: tracking error of a repetition that is usable for learning."""

    header: messages.Header
    motion: str
    """Short name of the motion, which depends on trajectory, joints and command interface."""
    repetition: int
    """Number of repetitions that were learned before this one."""
    error: float
    """Root mean square of desired minus measured position, rad."""
    best: float
    """Smallest error of this motion so far, rad."""
    correction: float
    """Largest correction in this repetition, rad."""


class IlcController(JointTrajectoryController):
    """joint_trajectory_controller that adds a learned correction, and updates it after each repetition.

    Learning starts when the motion has ended. It is spread over many cycles, and takes a bounded time in each
    cycle. A motion that starts before learning has finished uses the previous correction.
    """

    Parameters = IlcParameters
    parameters: IlcParameters
    Commands: ClassVar = {"trajectory": TrajectoryCommand}
    Topics: ClassVar = {"repetition": LearnedRepetition}
    keeps = True

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: TrajectoryParameters
    ) -> NDArray[np.float64]:
        """Return the flat trajectory of a command, followed by the motion's key (two numbers).

        Raises ValueError as a joint_trajectory_controller, and for a spliced trajectory.
        """
        data = super().prepare(kind, command, parameters)
        if not isinstance(command, TrajectoryCommand):
            return data
        if command.splice:
            raise ValueError("a learned motion cannot be spliced; remove splice")
        # Start time, timeout and tolerances are not part of the motion: `dxlrun play` sets a start time so
        # that the joints can move to the first point, and the key must not depend on it.
        motion = command.model_copy(update=dict.fromkeys(_NOT_LEARNED) | {"start_in": 0.0})
        digest = hashlib.sha256(super().prepare(kind, motion, parameters).tobytes())
        digest.update(repr((parameters.joints, parameters.command_interface)).encode())
        parts = digest.digest()[: 2 * _KEY_BYTES]
        key = [int.from_bytes(parts[at : at + _KEY_BYTES], "little") for at in (0, _KEY_BYTES)]
        return np.concatenate([data, np.array(key, np.float64)])

    def on_configure(self, context: Context) -> None:
        """Allocate all memory for learning, and load the corrections of earlier runs.

        Raises:
            ValueError: The corrections would exceed the size that can be kept.
        """
        super().on_configure(context)
        parameters, count = self.parameters, len(context.joints)
        self._period_s = context.period_ns * 1e-9
        self._steps = max(1, int(SHARE * context.period_ns / STEP_NS))
        self._tail = math.ceil(TAIL_S / self._period_s)
        most_rows = math.ceil(parameters.longest * 1e-9 / self._period_s) + 1 + self._tail
        most = self._most = row_of(parameters.most, context.joints)
        self._known = LearnedMotions(parameters.motions, most_rows, context.period_ns, most)
        self._repetition = Repetition(count, most_rows, self._period_s, parameters.cutoff)
        self._correction, self._from, self._sent, self._sent_speed = np.zeros((4, count))
        """Present correction; correction at the start of the fade; last commanded position and speed"""
        self._fade_ns = self._faded_ns = 0
        self._playing: LearnedMotion | None = None
        """Motion whose correction is applied; None if there is none."""
        self._frozen = True
        """True while the applied correction stays as it is."""
        self._key = (0.0, 0.0)
        self._judged = self._rows = 0
        """Number of rows (cycles) of the motion, without and with its tail."""
        self._row_ns = -1
        """Time of row 0, ns; -1 before it."""
        self._open = False
        """True while the present repetition is usable for learning."""
        self._largest = 0.0
        self._pupil: LearnedMotion | None = None
        """Motion whose correction `_learning` is computing."""
        self._learning: Iterator[None] = iter(())
        self._take_kept(context.kept)

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints where they are, without a correction."""
        super().on_activate(time_ns)
        self._correction.fill(0.0)
        self._playing, self._frozen, self._open, self._row_ns = None, True, False, -1

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime ends, and end its repetition."""
        super().on_deactivate(time_ns)
        self._close()

    # A repetition

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Start a trajectory, with the learned correction of its motion if there is one."""
        self._close()
        super().on_goal(goal, data, time_ns)
        if self._goal is not goal:
            return
        self._key = (float(data[-2]), float(data[-1]))
        trajectory = self._trajectory
        self._judged = round((trajectory.duration_s - trajectory.bridge_s) / self._period_s) + 1
        self._rows = self._judged + self._tail
        self._row_ns = -1
        self._open = True
        known = self._known.found(self._key)
        if known is None:
            self.context.say(f"motion {motion_name(self._key)} is not learned yet: no correction")
        else:
            self._known.mark_played(known)
        self._play(known, time_ns)
        if self._rows > self._repetition.most_rows:
            self._spoil("it is longer than `longest`")

    def _play(self, motion: LearnedMotion | None, time_ns: int) -> None:
        """Fade to the correction of a motion (None: to 0), until its first point or for FADE_S, whichever
        is later.
        """
        np.copyto(self._from, self._correction)
        self._playing, self._frozen = motion, False
        first_ns = self._start_ns + round(self._trajectory.bridge_s * 1e9)
        self._fade_ns = time_ns
        self._faded_ns = max(first_ns, time_ns + round(FADE_S * 1e9))

    def _stop_from(self, time_ns: int) -> None:
        """Stop the joints, with the correction frozen; the repetition is not learned."""
        super()._stop_from(time_ns)
        self._frozen = True
        self._spoil("it was not played to its end")

    def _spoil(self, why: str) -> None:
        if self._open:
            self._open = False
            self.context.say(
                f"nothing is learned from this repetition of motion {motion_name(self._key)}: {why}"
            )

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the corrected state of the trajectory, record the tracking error, and do some steps of
        learning.
        """
        row = -1 if self._frozen else self._row(time_ns)
        super().update(time_ns, period_ns)
        if self._open and row >= 0:
            self._check_repetition(row, time_ns)
        self._correct(time_ns, row)
        if self._open and row >= 0:
            self._record()
        if self._pupil is not None:
            self._learn(time_ns)

    def _row(self, time_ns: int) -> int:
        """Return the row of the motion for this cycle, or -1 before its first point; row 0 begins the
        record.
        """
        if self._row_ns < 0:
            first_ns = self._start_ns + self._trajectory.bridge_s * 1e9
            if time_ns < first_ns - self.context.period_ns / 2:
                return -1
            self._row_ns, self._largest = time_ns, 0.0
            if self._pupil is not None:
                self._spoil("the previous repetition is still being learned")
            else:
                self._repetition.start_recording()
        return round((time_ns - self._row_ns) / self.context.period_ns)

    def _check_repetition(self, row: int, time_ns: int) -> None:
        """Discard the repetition if it is not usable for learning, such as at another speed."""
        if self._rate != 1.0 or self._speed != 1.0:
            self._spoil("it is played at another speed")
            self._play(None, time_ns)
        elif row != self._repetition.rows:
            self._spoil("cycles were skipped")
        elif not self.context.states.valid[self._moved].all():
            self._spoil("a servo did not answer")
        elif row and self._to_servos and self._clamped():
            self._spoil("its goals were clamped")

    def _clamped(self) -> bool:
        """Return True if the gate changed the commands of the last cycle."""
        goals = self.context.goals
        changed = np.abs(goals.position - self._sent)
        if self._interface == "posvel":
            changed += np.abs(goals.velocity - self._sent_speed)
        return bool(changed.max() > _SAME)

    def _correct(self, time_ns: int, row: int) -> None:
        """Add the correction of this row to the command, and clamp the sum to the position limits."""
        desired, before, correction = self._desired.position, self._correction, self._correction
        if not self._frozen:
            correction = np.zeros_like(before)
            if self._playing is not None:
                correction += self._known.row(self._playing, row)
            if time_ns < self._faded_ns:
                share = (time_ns - self._fade_ns) / (self._faded_ns - self._fade_ns)
                correction = (correction - self._from) * (share * share * (3.0 - 2.0 * share)) + self._from
        self._sent = clamped(desired + correction, self._lower, self._upper)
        self._correction = self._sent - desired
        np.copyto(self.context.commands.position, self._sent)
        if self._interface == "posvel":
            self._hurry((-before + self._correction) / self._period_s)

    def _hurry(self, added: Floats) -> None:
        """Command the speed of the corrected motion; `added` is the rate of the correction, rad/s."""
        speed = self.context.commands.velocity
        if not self._to_servos:
            np.add(self._desired.velocity, added, out=speed)
            return
        if self._moving:
            wanted = np.abs(added + self._desired.velocity)
        else:
            wanted = np.maximum(np.abs(added), self._closing)
        self._sent_speed = np.minimum(wanted, self._speed_limit)
        np.copyto(speed, self._sent_speed)

    def _record(self) -> None:
        repetition, desired = self._repetition, self._desired.position
        judged = repetition.rows < self._judged
        # The error of joints that this motion does not move is 0.
        measured = np.where(self._unmoved, desired, self.context.states.position)
        repetition.record(desired, measured, self._correction, judged)
        if judged:
            self._largest = max(self._largest, float(np.abs(self._correction).max()))
        if repetition.rows == self._rows:
            self._close()

    # Learning

    def _close(self) -> None:
        """End the repetition, and start to learn from it."""
        if not self._open:
            return
        if self._row_ns < 0 or self._repetition.rows < self._judged:
            self._spoil("it was not played to its end")
            return
        self._open = False
        error = self._repetition.error(self._judged)
        motion = self._known.found(self._key)
        if motion is None:
            given, delay_s = self.parameters.delay, self._repetition.delay_s()
            if given is not None:
                delay_s.fill(given * 1e-9)
            motion = LearnedMotion(self._key, self._rows, error, error, delay_s)
        best = motion.best = min(error, motion.best)
        name = motion_name(self._key)
        self.context.publish(
            "repetition",
            LearnedRepetition(messages.Header(), name, motion.repetitions, error, best, self._largest),
        )
        worse = error > max(LEAST, min(self.parameters.growth * best, WORSE * motion.first))
        motion.grown = motion.grown + 1 if worse else 0
        if motion.grown:
            self._doubt(motion, error)
        elif self.parameters.gain:
            self._pupil = motion
            self._learning = self._repetition.learn_correction(
                self._known.table(motion),
                self._known.next_table(motion),
                self.parameters.gain,
                motion.delay_s,
                self._most,
            )

    def _doubt(self, motion: LearnedMotion, error: float) -> None:
        """Ignore a repetition with a much larger error, and forget the motion at the second one in a row.

        Two in a row mean that the servo or its load has changed.
        """
        times = error / max(motion.best, LEAST)
        worse = f"its error, {math.degrees(error):.3f} deg, is {times:.1f} times the smallest error"
        if motion.grown == 1:
            self.context.say(f"nothing is learned from this repetition of motion {motion.name}: {worse}")
            return
        self._known.forget_motion(motion)
        self._stay(motion)
        self.context.keep(self._known.packed())
        self.context.say(f"the correction of motion {motion.name} is dropped: again {worse}")

    def _stay(self, motion: LearnedMotion) -> None:
        """Freeze the applied correction if it belongs to a motion that was forgotten."""
        if motion is self._playing:
            self._frozen, self._playing = True, None

    def _learn(self, time_ns: int) -> None:
        for _ in range(self._steps):
            if next(self._learning, self) is self:
                break
        else:
            return
        motion, self._pupil = self._pupil, None
        if motion is None:
            return
        forgotten = self._known.learned(motion)
        if forgotten is not None:
            self.context.say(f"the correction of motion {forgotten.name} is dropped for motion {motion.name}")
            self._stay(forgotten)
        if self._key == motion.key and not self._frozen:
            self._play(motion, time_ns)
        self.context.keep(self._known.packed())

    # Kept between runs

    def _take_kept(self, data: bytes) -> None:
        if not data:
            return
        try:
            self._known.unpack(data)
        except (ValueError, struct.error) as error:
            self._known.clear_motions()
            self.context.say(f"the stored corrections cannot be used: {error}")
