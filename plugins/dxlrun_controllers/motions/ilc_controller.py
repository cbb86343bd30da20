"""ilc_controller: plays trajectories, and follows each of them better every time that it is repeated."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import LIVE, Angle, CommandModel, Context, Duration, Floats, Goal
from dxlrun.messages import Header
from dxlrun_controllers.joints import PerJoint, Positive, row_of
from dxlrun_controllers.laws.learning import MOST_DELAY_S, Repetition
from dxlrun_controllers.motions.joint_trajectory_controller import (
    JointTrajectoryController,
    TrajectoryParameters,
)
from dxlrun_controllers.motions.trajectory_command import TrajectoryCommand

TAIL_S: Final = 0.5
"""After the end of a motion: the servos still arrive, and the correction that made them lead has to go."""
WORSE: Final = 1.05
"""An error that is larger than without a correction by this factor is one that the correction makes."""
FADE_S: Final = 0.2
"""In which one correction passes into another where a motion gives no time for it."""
STEP_NS: Final = 15_000
SHARE: Final = 0.05
"""So much a step of learning takes (tests/bench/controllers.py), and so much of a period those of a cycle
may."""
MOST_KEPT: Final = 1 << 20
"""Bytes, of `Context.keep`."""
_SAME: Final = 1e-6
"""rad, rad/s: goals so near to the commands were not clamped."""
_FORM: Final = 1
_HEAD: Final = struct.Struct("<IqII")
"""Form, period (ns), joints, motions; of each motion:"""
_ENTRY: Final = struct.Struct("<ddIIdd")
"""Key, rows, repetitions, first and smallest error; its delays as float64 and its table as float32 follow."""
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


@dataclass(slots=True)
class _Motion:
    """A motion that is remembered."""

    key: tuple[float, float]
    rows: int
    place: int
    """Of its table."""
    repetitions: int
    first: float
    """Error without a correction, rad."""
    best: float
    """The smallest one, rad."""
    delay_s: Floats
    grown: int = 0
    """How many times in a row the error was too large."""

    @property
    def name(self) -> str:
        """A short name for people."""
        return _name(self.key)


def _name(key: tuple[float, float]) -> str:
    return f"{int(key[0]):012x}"[:8]


class IlcController(JointTrajectoryController):
    """A joint_trajectory_controller that adds a learned correction, and learns after each repetition.

    Learning takes as many cycles as it needs, of each a bounded time, when the motion has ended. One that
    begins meanwhile is corrected by what was learned before.
    """

    Parameters = IlcParameters
    parameters: IlcParameters
    Topics: ClassVar[Mapping[str, type]] = {"repetition": LearnedRepetition}
    keeps = True

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: TrajectoryParameters
    ) -> NDArray[np.float64]:
        """Return what a joint_trajectory_controller does, and the motion's key behind it: two numbers."""
        data = super().prepare(kind, command, parameters)
        if not isinstance(command, TrajectoryCommand):
            return data
        # neither when it begins nor when it is given up is part of a motion: `dxlrun play` leads joints to it
        motion = command.model_copy(update={"start_in": 0.0, "timeout": None})
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
        size = _HEAD.size + parameters.motions * (_ENTRY.size + count * (8 + 4 * most_rows))
        if size > MOST_KEPT:
            raise ValueError(
                f"{parameters.motions} motions of {parameters.longest * 1e-9:g} s are {size} bytes, and "
                f"{MOST_KEPT} can be kept; lower motions or longest"
            )
        self._repetition = Repetition(count, most_rows, self._period_s, parameters.cutoff)
        self._tables: NDArray[np.float32] = np.zeros((parameters.motions + 1, count, most_rows), np.float32)
        """One more than there are motions: the next one is written while the one before is played."""
        self._free = list(range(parameters.motions + 1))
        """Places of tables that are no motion's."""
        self._known: list[_Motion] = []
        """The one that was played last is the last one."""
        self._most = row_of(parameters.most, context.joints)
        self._correction, self._from, self._step, self._sent, self._sent_speed = np.zeros((5, count))
        """What is added now; what it fades in from; what it grew by; what was commanded in the last cycle."""
        self._fade_ns = self._faded_ns = 0
        self._playing: _Motion | None = None
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
        self._pupil: _Motion | None = None
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
        known = self._found(self._key)
        if known is None:
            self.context.say(f"motion {_name(self._key)} is not known: it is played without a correction")
        else:
            self._known.remove(known)
            self._known.append(known)
        self._play(known, time_ns)
        if self._rows > self._repetition.most_rows:
            self._spoil("it is longer than `longest`")

    def _found(self, key: tuple[float, float]) -> _Motion | None:
        return next((motion for motion in self._known if motion.key == key), None)

    def _play(self, motion: _Motion | None, time_ns: int) -> None:
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
            self.context.say(f"nothing is learned from this repetition of motion {_name(self._key)}: {why}")

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
        goals, part = self.context.goals, self._part
        np.abs(np.subtract(goals.position, self._sent, out=part), out=part)
        if self._interface == "posvel":
            part += np.abs(goals.velocity - self._sent_speed)
        return bool(part.max() > _SAME)

    def _correct(self, time_ns: int, row: int) -> None:
        """Add the correction of this row to what is commanded, inside of the limits."""
        commands, correction, step = self.context.commands, self._correction, self._step
        np.negative(correction, out=step)
        if not self._frozen:
            if self._playing is None:
                correction.fill(0.0)
            else:
                last = self._playing.rows - 1
                np.copyto(correction, self._tables[self._playing.place, :, min(max(row, 0), last)])
            if time_ns < self._faded_ns:
                share = (time_ns - self._fade_ns) / (self._faded_ns - self._fade_ns)
                correction -= self._from
                correction *= share * share * (3.0 - 2.0 * share)
                correction += self._from
        np.add(self._desired.position, correction, out=commands.position)
        np.clip(commands.position, self._lower, self._upper, out=commands.position)
        np.subtract(commands.position, self._desired.position, out=correction)
        np.copyto(self._sent, commands.position)
        if self._interface == "posvel":
            step += correction
            step /= self._period_s
            self._hurry()

    def _hurry(self) -> None:
        """Command the speed that belongs to the corrected position."""
        speed, step = self.context.commands.velocity, self._step
        if not self._to_servos:
            np.add(self._desired.velocity, step, out=speed)
            return
        if self._moving:
            step += self._desired.velocity
        np.abs(step, out=step)
        np.copyto(speed, step if self._moving else np.maximum(step, self._closing, out=step))
        np.minimum(speed, self._speed_limit, out=speed)
        np.copyto(self._sent_speed, speed)

    def _record(self) -> None:
        repetition, states = self._repetition, self.context.states
        judged = repetition.rows < self._judged
        repetition.record(self._desired.position, states.position, self._correction, judged)
        if judged:
            self._largest = max(self._largest, float(np.abs(self._correction, out=self._part).max()))
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
        motion = self._found(self._key)
        if motion is None:
            given, delay_s = self.parameters.delay, self._repetition.delay_s()
            if given is not None:
                delay_s.fill(given * 1e-9)
            motion = _Motion(self._key, self._rows, -1, 0, error, error, delay_s)
        best = motion.best = min(error, motion.best)
        name = _name(self._key)
        self.context.publish(
            "repetition",
            LearnedRepetition(Header(), name, motion.repetitions, error, best, self._largest),
        )
        worse = error > min(self.parameters.growth * best, WORSE * motion.first)
        motion.grown = motion.grown + 1 if worse else 0
        if motion.grown:
            self._doubt(motion, error)
        elif self.parameters.gain:
            self._pupil = motion
            self._learning = self._repetition.learn(
                None if motion.place < 0 else self._tables[motion.place, :, : motion.rows],
                self._tables[self._free[0], :, : motion.rows],
                self.parameters.gain,
                motion.delay_s,
                self._most,
            )

    def _doubt(self, motion: _Motion, error: float) -> None:
        """Leave out a repetition that was followed much worse than another; at the second one in a row drop
        what was learned: the servo is another one."""
        worse = (
            f"its error, {math.degrees(error):.3f} deg, is {error / motion.best:.1f} times the smallest one"
        )
        if motion.grown == 1:
            self.context.say(f"nothing is learned from this repetition of motion {motion.name}: {worse}")
            return
        self._forget(motion)
        self._keep()
        self.context.say(f"what was learned of motion {motion.name} is dropped: again {worse}")

    def _forget(self, motion: _Motion) -> None:
        self._known.remove(motion)
        self._free.append(motion.place)
        if motion is self._playing:
            self._frozen, self._playing = True, None  # until the next goal the joints stay where they are

    def _learn(self, time_ns: int) -> None:
        """Go on learning; afterwards play and keep what was learned."""
        for _ in range(self._steps):
            if next(self._learning, self) is self:
                break
        else:
            return
        motion, self._pupil = self._pupil, None
        if motion is None:
            return
        if motion.place >= 0:
            self._free.append(motion.place)
        else:
            if len(self._known) == self.parameters.motions:
                self.context.say(f"motion {self._known[0].name} is forgotten: {motion.name} takes its place")
                self._forget(self._known[0])
            self._known.append(motion)
        motion.place = self._free.pop(0)
        motion.repetitions += 1
        if self._key == motion.key and not self._frozen:
            self._play(motion, time_ns)
        self._keep()

    # Kept between runs

    def _keep(self) -> None:
        parts = [_HEAD.pack(_FORM, self.context.period_ns, len(self._most), len(self._known))]
        for motion in self._known:
            parts.append(_ENTRY.pack(*motion.key, motion.rows, motion.repetitions, motion.first, motion.best))
            parts.append(motion.delay_s.astype("<f8").tobytes())
            parts.append(self._tables[motion.place, :, : motion.rows].astype("<f4").tobytes())
        self.context.keep(b"".join(parts))

    def _take_kept(self, data: bytes) -> None:
        """Take what was kept, or say why it cannot be used."""
        if not data:
            return
        try:
            self._unpack(data)
        except (ValueError, struct.error) as error:
            self._known.clear()
            self._free = list(range(len(self._tables)))
            self.context.say(f"what was learned before cannot be used: {error}")

    def _unpack(self, data: bytes) -> None:
        """Take what was kept. Raises ValueError and struct.error for what is not of this controller."""
        form, period_ns, joints, count = _HEAD.unpack_from(data)
        if form != _FORM:
            raise ValueError("it is of another version")
        if period_ns != self.context.period_ns:
            raise ValueError(f"its period was {period_ns} ns and is {self.context.period_ns} ns")
        if joints != len(self._most):
            raise ValueError(f"it has {joints} joints")
        at = _HEAD.size
        for _ in range(count):
            low, high, rows, repetitions, first, best = _ENTRY.unpack_from(data, at)
            at += _ENTRY.size
            delay_s = np.frombuffer(data, "<f8", joints, at).copy()
            at += 8 * joints
            table = np.frombuffer(data, "<f4", joints * rows, at).reshape(joints, rows)
            at += 4 * joints * rows
            if not (
                np.isfinite(table).all() and 0 < best <= first and ((delay_s >= 0) & (delay_s <= 1)).all()
            ):
                raise ValueError("its numbers are none that are learned")
            if rows > self._repetition.most_rows or len(self._known) == self.parameters.motions:
                continue  # `longest` or `motions` are lower now
            place = self._free.pop(0)
            np.clip(table, -self._most[:, None], self._most[:, None], out=self._tables[place, :, :rows])
            self._known.append(_Motion((low, high), rows, place, repetitions, first, best, delay_s))
