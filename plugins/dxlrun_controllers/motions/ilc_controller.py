"""ilc_controller: plays trajectories, and follows each of them better every time that it is repeated."""

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
from dxlrun.messages import Header
from dxlrun_controllers.joints import PerJoint, Positive, clamped, row_of
from dxlrun_controllers.laws.learning import MOST_DELAY_S, Repetition
from dxlrun_controllers.motions.joint_trajectory_controller import (
    JointTrajectoryController,
    TrajectoryParameters,
)
from dxlrun_controllers.motions.learned_motions import LearnedMotion, LearnedMotions, motion_name
from dxlrun_controllers.motions.trajectory_command import TrajectoryCommand

TAIL_S: Final = 0.5
"""After the end of a motion: the servos still arrive, and the correction that made them lead has to go."""
WORSE: Final = 1.05
"""An error that is larger than without a correction by this factor is one that the correction makes."""
LEAST: Final = math.radians(0.088)
"""A tick of most servos: smaller errors are not compared."""
FADE_S: Final = 0.2
"""In which one correction passes into another where a motion gives no time for it."""
STEP_NS: Final = 15_000
SHARE: Final = 0.05
"""So much a step of learning takes (tests/bench/controllers.py), and so much of a period those of a cycle
may."""
_SAME: Final = 1e-6
"""rad, rad/s: goals so near to the commands were not clamped."""
_NOT_LEARNED: Final = ("timeout", "goal_tolerance", "path_tolerance", "goal_time_tolerance")
"""Fields of a trajectory that do not make it another motion."""
_KEY_BYTES: Final = 6
"""Of each of the two numbers of a motion's key: a float64 holds them exactly."""


class IlcParameters(TrajectoryParameters):
    """Keys of an ilc_controller in the robot file: those of a joint_trajectory_controller, and these."""

    command_interface: Literal["position", "posvel"] = "position"
    """The correction is added to the position; `posvel` commands the speed that belongs to it, too."""
    gain: Annotated[float, LIVE, Field(ge=0, le=1)] = 0.5
    """L: the part of the error that a repetition corrects; 0 plays what was learned, and learns nothing."""
    cutoff: Positive = 5.0
    """Hz, of Q: what is faster is not learned. Lower it if a servo begins to shake."""
    delay: Annotated[Duration, Field(ge=0, le=round(MOST_DELAY_S * 1e9))] | None = None
    """By how much the servos lag behind; left out: as in the first repetition, each joint's own."""
    most: PerJoint[Annotated[Angle, Field(gt=0)]] = math.radians(10)
    """The largest correction."""
    longest: Annotated[Duration, Field(gt=0)] = 40_000_000_000
    """The longest motion that is learned."""
    motions: Annotated[int, Field(ge=1, le=64)] = 4
    """How many motions are remembered; of more, the one that was not played for longest is forgotten."""
    growth: Annotated[float, Field(gt=1)] = 2.0
    """When the error is larger than the smallest one of this motion by more than this factor, or larger than
    without a correction, twice in a row, what was learned is dropped."""


@dataclass(slots=True)
class LearnedRepetition:
    """Message of the topic `repetition`: how a motion was followed that can be learned from."""

    header: Header
    motion: str
    """Which: the same for the same trajectory, joints and command interface."""
    repetition: int
    """How many were learned before this one."""
    error: float
    """Root of the mean square of desired minus measured position, rad."""
    best: float
    """The smallest one, rad."""
    correction: float
    """The largest one that was added, rad."""


class IlcController(JointTrajectoryController):
    """A joint_trajectory_controller that adds a learned correction, and learns after each repetition.

    Learning takes as many cycles as it needs, of each a bounded time, when the motion has ended. One that
    begins meanwhile is corrected by what was learned before.
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
        """Return what a joint_trajectory_controller does, and the motion's key behind it: two numbers."""
        data = super().prepare(kind, command, parameters)
        if not isinstance(command, TrajectoryCommand):
            return data
        if command.splice:
            raise ValueError("a motion that is learned begins by itself; take splice out")
        # neither when it begins nor when it is given up is part of a motion: `dxlrun play` leads joints to it
        motion = command.model_copy(update=dict.fromkeys(_NOT_LEARNED) | {"start_in": 0.0})
        digest = hashlib.sha256(super().prepare(kind, motion, parameters).tobytes())
        digest.update(repr((parameters.joints, parameters.command_interface)).encode())
        parts = digest.digest()[: 2 * _KEY_BYTES]
        key = [int.from_bytes(parts[at : at + _KEY_BYTES], "little") for at in (0, _KEY_BYTES)]
        return np.concatenate([data, np.array(key, np.float64)])

    def on_configure(self, context: Context) -> None:
        """Make room for everything that is learned, and take what was kept.

        Raises ValueError where that is more than can be kept.
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
        """What is added now; what it fades in from; what was commanded in the last cycle."""
        self._fade_ns = self._faded_ns = 0
        self._playing: LearnedMotion | None = None
        """Whose correction is played; None: none."""
        self._frozen = True
        """The correction stays as it is."""
        self._key = (0.0, 0.0)
        self._judged = self._rows = 0
        """Rows of the motion, and those with its tail."""
        self._row_ns = -1
        """When row 0 was played."""
        self._open = False
        """This repetition can be learned from, until now."""
        self._largest = 0.0
        self._pupil: LearnedMotion | None = None
        """The motion that is being learned, by `_learning`."""
        self._learning: Iterator[None] = iter(())
        self._take_kept(context.kept)

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are, without a correction."""
        super().on_activate(time_ns)
        self._correction.fill(0.0)
        self._playing, self._frozen, self._open, self._row_ns = None, True, False, -1

    def on_deactivate(self, time_ns: int) -> None:
        """Leave the goal and its repetition."""
        super().on_deactivate(time_ns)
        self._close()

    # A repetition

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Begin a trajectory with the correction of this motion, if it is known."""
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
            self.context.say(
                f"motion {motion_name(self._key)} is not known: it is played without a correction"
            )
        else:
            self._known.touch(known)
        self._play(known, time_ns)
        if self._rows > self._repetition.most_rows:
            self._spoil("it is longer than `longest`")

    def _play(self, motion: LearnedMotion | None, time_ns: int) -> None:
        """Let the correction pass into that of a motion, until its first point if there is a way to it."""
        np.copyto(self._from, self._correction)
        self._playing, self._frozen = motion, False
        first_ns = self._start_ns + round(self._trajectory.bridge_s * 1e9)
        self._fade_ns = time_ns
        self._faded_ns = max(first_ns, time_ns + round(FADE_S * 1e9))

    def _stop_from(self, time_ns: int) -> None:
        """Let the correction stay as it is while the joints come to rest."""
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
        """Command the trajectory's state with the correction; record how it is followed; learn."""
        row = -1 if self._frozen else self._row(time_ns)
        super().update(time_ns, period_ns)
        if self._open and row >= 0:
            self._look(row, time_ns)
        self._correct(time_ns, row)
        if self._open and row >= 0:
            self._record()
        if self._pupil is not None:
            self._learn(time_ns)

    def _row(self, time_ns: int) -> int:
        """Return which row of the motion this cycle is; -1 before the first one."""
        if self._row_ns < 0:
            first_ns = self._start_ns + self._trajectory.bridge_s * 1e9
            if time_ns < first_ns - self.context.period_ns / 2:
                return -1
            self._row_ns, self._largest = time_ns, 0.0
            if self._pupil is not None:
                self._spoil("the one before is still being learned")
            else:
                self._repetition.begin()
        return round((time_ns - self._row_ns) / self.context.period_ns)

    def _look(self, row: int, time_ns: int) -> None:
        """Find what makes this repetition one that nothing can be learned from."""
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
        """Return whether the servos got other goals than those that were commanded in the last cycle."""
        goals = self.context.goals
        changed = np.abs(goals.position - self._sent)
        if self._interface == "posvel":
            changed += np.abs(goals.velocity - self._sent_speed)
        return bool(changed.max() > _SAME)

    def _correct(self, time_ns: int, row: int) -> None:
        """Add the correction of this row to what is commanded, inside of the limits."""
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
        """Command the speed that belongs to the corrected position; `added` is the correction's, rad/s."""
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
        # joints that are not of this motion count as followed
        measured = np.where(self._unmoved, desired, self.context.states.position)
        repetition.record(desired, measured, self._correction, judged)
        if judged:
            self._largest = max(self._largest, float(np.abs(self._correction).max()))
        if repetition.rows == self._rows:
            self._close()

    # Learning

    def _close(self) -> None:
        """End the repetition, and begin to learn from it."""
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
            LearnedRepetition(Header(), name, motion.repetitions, error, best, self._largest),
        )
        worse = error > max(LEAST, min(self.parameters.growth * best, WORSE * motion.first))
        motion.grown = motion.grown + 1 if worse else 0
        if motion.grown:
            self._doubt(motion, error)
        elif self.parameters.gain:
            self._pupil = motion
            self._learning = self._repetition.learn(
                self._known.table(motion),
                self._known.next_table(motion),
                self.parameters.gain,
                motion.delay_s,
                self._most,
            )

    def _doubt(self, motion: LearnedMotion, error: float) -> None:
        """Leave out a repetition that was followed much worse than another; at the second one in a row drop
        what was learned: the servo is another one."""
        times = error / max(motion.best, LEAST)
        worse = f"its error, {math.degrees(error):.3f} deg, is {times:.1f} times the smallest one"
        if motion.grown == 1:
            self.context.say(f"nothing is learned from this repetition of motion {motion.name}: {worse}")
            return
        self._known.forget(motion)
        self._stay(motion)
        self.context.keep(self._known.packed())
        self.context.say(f"what was learned of motion {motion.name} is dropped: again {worse}")

    def _stay(self, motion: LearnedMotion) -> None:
        """Let the correction stay as it is if it is that of a motion that was forgotten."""
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
            self.context.say(f"motion {forgotten.name} is forgotten: {motion.name} takes its place")
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
            self._known.clear()
            self.context.say(f"what was learned before cannot be used: {error}")
