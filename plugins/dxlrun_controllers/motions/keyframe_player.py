"""keyframe_player: play named motions of poses, each pose with a time, a pause and torque limits.

Motions are structured like ROBOTIS' motion pages (e-Manual, RoboPlus Motion). A step has a pose, a play time
and a pause; a page has a number of repetitions, a speed, a next page and an exit page. The way between two
poses is a cubic: Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008),
section 2.1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StrictInt, StrictStr

from dxlrun import (
    LIVE,
    NAMED_POSE,
    Angle,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Goal,
    GoalTolerances,
    Interfaces,
    Mistake,
    Outcome,
    ParametersModel,
    Polynomial,
    RegisterChange,
    SpeedPeak,
    Tolerance,
    nearest_turn,
)
from dxlrun.tooling.files import suggestion
from dxlrun_controllers.joint_parameters import (
    JointNames,
    commanded_by,
    ends_unheard,
    finite_or,
    hold_joints,
    not_one_of,
    row_of,
    take_shorter_way,
    take_where_heard,
)
from dxlrun_controllers.laws.spline import (
    CUBIC,
    DECELERATION,
    LINEAR,
    SplineSample,
    StopTrajectory,
    peak_velocities,
    solve,
)
from dxlrun_controllers.laws.tracking_law import CLOSING_SPEED

HIGHEST_RATE = 10.0
"""Highest ratio of a motion's time to the loop's time, which bounds the number of steps in one period."""
PEAK = 1.5
"""Ratio of the peak speed to the mean speed of a cubic from rest to rest."""


class Step(ParametersModel):
    """Pose with the motion that leads to it and the pause after it"""

    time: Annotated[Duration, Field(ge=10_000_000)]
    """Time of the way to the pose."""
    pose: Annotated[dict[str, Angle], NAMED_POSE] = Field(examples=["{elbow: 30 deg}"])
    """Positions by joint, rad, the name of a pose of the robot file, or a pose of a link as in `poses`. A
    joint that is not named keeps its last goal."""
    pause: Duration = 0
    """Time at the pose."""
    torque: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    """Effort limits by joint from this step on, in the unit that the model measures (Nm, A or the fraction of
    its maximum)."""
    registers: dict[str, dict[str, StrictInt | StrictStr]] = Field(default_factory=dict)
    """Registers by joint and item from this step on, such as gains or compliance slopes. The end of the goal
    restores them."""
    interpolation: Literal["smooth", "linear"] = "smooth"
    """`smooth` starts and ends at rest; `linear` has a constant speed."""


class Motion(ParametersModel):
    """Sequence of steps, and optionally the motion that follows"""

    steps: Annotated[tuple[Step, ...], Field(min_length=1, examples=["[{time: 1 s, pose: home}]"])]
    """Steps of the motion."""
    repeat: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Number of times that the steps are played."""
    speed: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Divisor of all times and pauses."""
    next: str | None = None
    """Name of the motion that follows. Motions in a circle are played until a cancel."""
    exit: str | None = None
    """Name of the motion that is played once after the steps at a cancel, and then its own `exit`."""

    def duration_s(self, repeat: int) -> float:
        """Return the duration of the steps with `repeat` repetitions at the motion's own speed, s."""
        return repeat * sum(step.time * 1e-9 + step.pause * 1e-9 for step in self.steps) / self.speed


class KeyframeParameters(ParametersModel):
    """Keys of a keyframe_player in the robot file."""

    joints: JointNames
    """Joints of the controller."""
    motions: Annotated[dict[str, Motion], Field(min_length=1)] = Field(
        examples=["{nod: {steps: [{time: 1 s, pose: home}]}}"]
    )
    """Motions by name."""
    command_interface: Literal["position", "posvel"] = "position"
    """`posvel` also commands the speed. Efforts are commanded as well if a step has torque limits."""
    approach: Annotated[AngularVelocity, Field(gt=0)] = 1.0
    """Highest speed of a joint on the way to the first pose, rad/s. The way takes longer if necessary."""
    tolerance: Tolerance | None = None
    """Position tolerance at the end; by default the joint's own."""
    settle: Duration | None = None
    """Time after the end in which the tolerance may still be reached; by default the joints' own."""
    wrap: tuple[str, ...] = ()
    """Continuous joints that take the shorter way, because whole turns do not matter. The default is all
    joints with `wrap: true`."""
    speed: Annotated[float, Field(gt=0, le=10), LIVE] = 1.0
    """Speed factor of all motions."""
    partial: bool = False
    """If true, joints without torque are skipped. If false, all joints must have torque."""
    start: str | None = None
    """Motion that starts whenever the controller is activated, as a goal, except after a joint has regained
    torque."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield unknown names of motions and joints, and motions whose exits form a circle."""
        yield from super().mistakes()
        known = f"the motions are {', '.join(self.motions)}"
        for index, joint in enumerate(self.wrap):
            if joint not in self.joints:
                yield ("wrap", index), f"{joint} is {not_one_of(self.joints)}"
        if self.start is not None and self.start not in self.motions:
            yield ("start",), f"motion {self.start} is not defined; {known}"
        for name, motion in self.motions.items():
            for number, step in enumerate(motion.steps):
                for key in ("pose", "torque", "registers"):
                    for joint in getattr(step, key):
                        if joint not in self.joints:
                            place = ("motions", name, "steps", number, key, joint)
                            yield place, f"{joint} is {not_one_of(self.joints)}"
            for key, other in (("next", motion.next), ("exit", motion.exit)):
                if other is not None and other not in self.motions:
                    yield ("motions", name, key), f"motion {other} is not defined; {known}"
        for circle in self._circles_of_exits():
            way = " -> ".join((*circle, circle[0]))
            yield (
                ("motions", circle[0], "exit"),
                f"exits follow each other in a circle, so a cancel never ends: {way}; remove one `exit`",
            )

    def _circles_of_exits(self) -> Iterator[list[str]]:
        """Yield the names of the motions of each circle of `exit`, starting with the first one in the
        file.
        """
        done: set[str] = set()
        for name in self.motions:
            way: list[str] = []
            after: str | None = name
            while after in self.motions and after not in done:
                way.append(after)
                done.add(after)
                after = self.motions[after].exit
            if after in way:
                yield way[way.index(after) :]

    def chain(self, name: str, rounds: int = 1) -> Iterator[str]:
        """Yield a motion's name and the names of the motions that follow it; those of a circle `rounds`
        times.
        """
        counts = dict.fromkeys(self.motions, 0)
        after: str | None = name
        while after is not None and counts[after] < rounds:
            counts[after] += 1
            yield after
            after = self.motions[after].next

    def exits(self, name: str) -> Iterator[str]:
        """Yield the names of the motions that are played after a motion when the goal is cancelled."""
        after = self.motions[name].exit
        while after is not None:
            yield after
            after = self.motions[after].exit

    def loops(self, name: str) -> bool:
        """Return True if a motion is followed by a circle of motions, or is part of one."""
        *_, last = self.chain(name)
        return self.motions[last].next is not None

    def length_s(self, name: str, repeat: int) -> float:
        """Return the duration of a motion and its followers at speed 1, s; infinite if they loop.

        `repeat` replaces the repetitions of the first motion.
        """
        if self.loops(name):
            return math.inf
        first, *others = [self.motions[one] for one in self.chain(name)]
        return first.duration_s(repeat) + sum(other.duration_s(other.repeat) for other in others)

    def first_torque(self) -> tuple[str | int, ...]:
        """Return the path in the parameters of the first `torque` with a limit; empty if there is none."""
        steps = (
            ("motions", name, "steps", number, "torque")
            for name, motion in self.motions.items()
            for number, step in enumerate(motion.steps)
            if step.torque
        )
        return next(steps, ())

    def register_changes(self) -> Iterator[RegisterChange]:
        """Yield each register value of the steps."""
        for name, motion in self.motions.items():
            for number, step in enumerate(motion.steps):
                path = ("motions", name, "steps", number, "registers")
                for joint, items in step.registers.items():
                    for item, value in items.items():
                        yield RegisterChange(joint, item, value, (*path, joint, item))


class PlayCommand(CommandModel):
    """Goal of a keyframe_player: a motion, its speed and its repetitions."""

    motion: str = Field(examples=["nod"])
    speed: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Divisor of all times and pauses, in addition to the motion's own speed"""
    repeat: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Number of repetitions in place of the motion's own. Motions that follow keep theirs."""


class KeyframePlayer(Controller[KeyframeParameters]):
    """Controller that plays one motion at a time and holds the last pose.

    A motion starts from the last goals of the joints and their present speed, also when a new goal replaces
    an active one. A cancelled motion that loops or has an exit completes its steps and plays the exit. After
    a second cancel, or a cancel of any other motion, each joint decelerates to a stop at its acceleration
    limit.
    """

    Parameters = KeyframeParameters
    Commands: ClassVar = {"play": PlayCommand}
    Goals: ClassVar = frozenset({"play"})
    graceful = True

    @classmethod
    def interfaces(cls, parameters: KeyframeParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position, velocity for `posvel`, and effort if a step has torque limits."""
        command = commanded_by(parameters.command_interface)
        key = parameters.first_torque()
        return Interfaces(
            parameters.joints,
            (*command, "effort") if key else command,
            asked_by={"effort": key} if key else {},
            partial=parameters.partial,
            registers=tuple(parameters.register_changes()),
        )

    @classmethod
    def motions(cls, parameters: KeyframeParameters) -> Mapping[str, float]:
        """Return motion -> duration at speed 1, including the motions that follow, s."""
        known = parameters.motions
        return {name: parameters.length_s(name, motion.repeat) for name, motion in known.items()}

    @classmethod
    def speed_peaks(
        cls, kind: str, data: NDArray[np.float64], parameters: KeyframeParameters
    ) -> Iterator[SpeedPeak]:
        """Yield the peak speed of each joint between poses.

        The way of a joint to its first pose is not included, because its start is unknown.
        """
        names = list(parameters.motions)
        first, speed, repeat = names[int(data[0])], float(data[1]), int(data[2])
        at: dict[str, float] = {}
        highest: dict[str, SpeedPeak] = {}
        begin_s = 0.0

        def add_peaks(name: str, rounds: int) -> None:
            nonlocal begin_s
            motion = parameters.motions[name]
            rate = min(speed * motion.speed * parameters.speed, HIGHEST_RATE)
            for number, step in [*enumerate(motion.steps, 1)] * rounds:
                moved = [joint for joint in step.pose if joint in at]
                time_s = step.time * 1e-9 / rate
                ends = np.zeros((2, 2, len(moved)))
                pose = {
                    joint: nearest_turn(end, at[joint]) if joint in parameters.wrap and joint in at else end
                    for joint, end in step.pose.items()
                }
                ends[:, 0] = [at[joint] for joint in moved], [pose[joint] for joint in moved]
                order = LINEAR if step.interpolation == "linear" else CUBIC
                piece = np.zeros((order, len(moved)))
                solve(order, time_s, ends[0], ends[1], piece)
                peaks, times = peak_velocities(piece, time_s)
                where, key = f"on the way to step {number} of {name}", f"motions.{name}"
                for joint, peak, time in zip(moved, peaks.tolist(), times.tolist(), strict=True):
                    if joint not in highest or abs(peak) > abs(highest[joint].speed):
                        highest[joint] = SpeedPeak(joint, peak, begin_s + time, where, key)
                at.update(pose)
                begin_s += time_s + step.pause * 1e-9 / rate

        # From the second repetition of a motion or a circle on, all repetitions are the same.
        for index, name in enumerate(parameters.chain(first, 2)):
            add_peaks(name, min(repeat if index == 0 else parameters.motions[name].repeat, 2))
            before, before_s = at.copy(), begin_s
            for left in parameters.exits(name):
                add_peaks(left, 1)
            at, begin_s = before, before_s
        yield from highest.values()

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: KeyframeParameters) -> NDArray[np.float64]:
        """Return index, speed and repetitions of the motion of a command; raises ValueError for an unknown
        motion.
        """
        if not isinstance(command, PlayCommand):
            return super().prepare(kind, command, parameters)
        names = list(parameters.motions)
        if command.motion not in names:
            raise ValueError(f"motion {command.motion!r} not found; {suggestion(command.motion, names)}")
        repeat = command.repeat or parameters.motions[command.motion].repeat
        return np.array([names.index(command.motion), command.speed, repeat])

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        parameters, count = self.parameters, len(context.joints)
        self._lower, self._upper = context.limits.lower, context.limits.upper
        self._speeds = finite_or(context.limits.velocity, np.inf)
        self._closing = np.minimum(self._speeds, CLOSING_SPEED)
        self._posvel = parameters.command_interface == "posvel"
        self._wrap = np.array([joint in parameters.wrap for joint in context.joints])
        self._now = SplineSample(count)
        """Present goals, rad, and velocities by the motion's own time, rad/s."""
        self._piece, self._way = np.zeros((CUBIC, count)), Polynomial(CUBIC, count)
        self._ends = np.zeros((2, 2, count))
        """Position and velocity at the start and at the end of the present step."""
        self._stop = StopTrajectory(count)
        self._deceleration = finite_or(context.limits.acceleration, DECELERATION)
        self._limp = np.zeros(count, dtype=np.bool_)
        """True for each joint that has no torque now; only used with `partial`."""
        self._out = np.zeros(count, dtype=np.bool_)
        """True for each joint that is skipped until the next step. It holds where it last had no torque."""
        self._asked = np.full(count, np.nan)
        """Newest requested pose of each joint before clamping, rad; NaN without one."""
        self._missed = np.zeros(count, dtype=np.bool_)
        """True for each joint that was skipped in a part of the goal."""
        self._stand = np.zeros(count)
        """Last measured position of each joint while it had no torque, rad."""
        self._registers: dict[str, dict[str, int | str]] = {}
        """Registers that the steps of this goal have set, by joint and item."""
        self._rate = 1.0

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals; the motion `start` starts in the next update."""
        hold_joints(self.context)
        self._now.rest_at(self.context.commands.position)
        self._limp.fill(False)
        self._out.fill(False)
        self._goal: Goal | None = None
        self._registers.clear()
        self._playing = self._stopping = self._leaving = False
        self._unknown = True
        self._starting = self.parameters.start is not None

    def on_restart(self, time_ns: int) -> None:
        """Hold the joints where they are. The motion `start` does not start again; a client can play it."""
        self.on_activate(time_ns)
        self._starting = False

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime ends."""
        self._goal = None

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Start the goal's motion from the present goals and velocities."""
        if self._unknown:
            self._hold_where_heard()
        if ends_unheard(goal, self._now.position, self.context.joints):
            return
        self._goal = goal
        self._begin_motion(list(self.parameters.motions)[int(data[0])], float(data[1]), int(data[2]))

    def _begin_motion(self, motion: str, speed: float, repeat: int) -> None:
        """Start a motion by name from the present goals and velocities, first slowly to its first pose."""
        self._now.velocity *= self._rate if self._playing or self._stopping else 0.0
        self._playing, self._stopping, self._leaving, self._starting = True, False, False, False
        self._asked.fill(np.nan)
        parameters = self.parameters
        self._name, self._goal_speed = motion, speed
        self._number, self._left = 0, repeat
        self._motions = [parameters.motions[name] for name in parameters.chain(motion)]
        self._total_s = parameters.length_s(motion, repeat)
        self._done_s = self._time_s = self._step_s = self._pause_s = 0.0
        self._rate = self._wanted_rate()
        np.copyto(self._missed, self._limp)
        self._now.velocity /= self._rate
        replaced = bool(self._registers)
        self._registers.clear()
        self._next_step(softly=True)
        if replaced:
            self.context.set_registers(self._registers)

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Decelerate each joint to rest, or first complete a motion that loops or has an exit. The goal ends
        then. A goal whose motion is over is not changed.
        """
        if self._stopping:
            return
        if not self._playing:  # the motion is over, and the runtime is judging its goal
            return
        if not self._leaving and (self._motion.exit is not None or self.parameters.loops(self._name)):
            self._leaving = True
            return
        self._now.velocity *= self._rate
        self._rate = 1.0
        self._stop.load(self._now, self._deceleration, self._lower, self._upper)
        self._playing, self._stopping, self._time_s = False, True, 0.0

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the pose of this cycle, and hold the last one after the end."""
        dt = period_ns * 1e-9
        if self.parameters.partial:
            self._leave_out()
        if self._starting:
            self._start()
        if self._playing:
            self._play(dt)
        elif self._stopping:
            self._decelerate(dt)
        elif self._unknown:
            self._hold_where_heard()

    def _leave_out(self) -> None:
        """Skip joints without torque: their goals become their measured positions until the next step."""
        states = self.context.states
        if states.has_lost:  # the torque state of a lost servo is unknown until it returns
            return
        for row in range(self._limp.size):
            self._limp[row] = states.unable((row,)) is not None
        np.copyto(self._stand, states.position, where=self._limp & np.isfinite(states.position))
        self._out |= self._limp
        self._missed |= self._limp
        if not (self._playing or self._stopping) and self._out.any():
            self._write_commands()
            np.copyto(self._out, self._limp)

    def _stay_out(self) -> None:
        np.copyto(self._now.position, self._stand, where=self._out)
        self._now.velocity[self._out] = 0.0

    def _start(self) -> None:
        """Start the motion `start` once all joints have answered."""
        if self._unknown:
            self._hold_where_heard()
        name = self.parameters.start
        if not self._unknown and name is not None:
            self._goal = self.context.begin_goal("play")
            self._begin_motion(name, 1.0, self.parameters.motions[name].repeat)

    def _hold_where_heard(self) -> None:
        """Hold joints that had not answered at the activation at their first measured positions."""
        self._unknown = take_where_heard(self._now.position, self.context.states)
        np.copyto(self.context.commands.position, self._now.position)

    # Playing

    @property
    def _motion(self) -> Motion:
        return self.parameters.motions[self._name]

    def _wanted_rate(self) -> float:
        return min(self._goal_speed * self._motion.speed * self.parameters.speed, HIGHEST_RATE)

    def _play(self, dt: float) -> None:
        self._rate = self._wanted_rate()
        self._time_s += dt * self._rate
        self._done_s += dt * self._rate / self._motion.speed
        while self._time_s >= self._step_s + self._pause_s:
            self._time_s -= self._step_s + self._pause_s
            self._reach()
            if not self._next_step():
                self._playing = False
                self._write_commands()
                self._hand_over()
                return
        if self._time_s < self._step_s:
            np.copyto(self._now.rows, self._way.evaluate(self._time_s))
        else:
            self._reach()
        self._write_commands()
        if self._goal is not None:
            self._goal.feedback(min(self._done_s / self._total_s, 1.0), self._worst()[0])

    def _reach(self) -> None:
        """Set the present state to the end of the step, at rest."""
        self._now.rest_at(self._ends[1, 0])

    def _next_step(self, softly: bool = False) -> bool:
        """Compute the way of the next step from the present state.

        Args:
            softly: Limit the speed to `approach`.

        Returns:
            False if there are no more steps.
        """
        name = self._name_of_next_step()
        if name is None:
            return False
        step = self.parameters.motions[name].steps[self._number - 1]
        if name != self._name:
            before, self._name = self._rate, name
            self._rate = self._wanted_rate()
            self._time_s *= self._rate / before  # the rest of the period passes at the new rate
        start, end = self._ends
        joints = self.context.joints
        pose, torque = row_of(step.pose, joints, np.nan), row_of(step.torque, joints, np.nan)
        self._stay_out()
        np.copyto(self._out, self._limp)
        np.copyto(start[0], self._now.position)
        np.copyto(start[1], self._now.velocity)
        np.copyto(end[0], start[0])
        pose = take_shorter_way(pose, start[0], self._wrap)
        posed = np.isfinite(pose) & ~self._out
        np.copyto(self._asked, pose, where=posed)
        np.copyto(end[0], pose, where=posed)
        np.clip(end[0], self._lower, self._upper, out=end[0])
        self._step_s, self._pause_s = step.time * 1e-9, step.pause * 1e-9
        if softly:
            slowest = np.minimum(self._speeds, self.parameters.approach)
            needed = PEAK * float((np.abs(end[0] - start[0]) / slowest).max()) * self._rate
            if needed > self._step_s:
                self._total_s += (needed - self._step_s) / self._motion.speed
                self._step_s = needed
        order = LINEAR if step.interpolation == "linear" and not softly else CUBIC
        solve(order, self._step_s, start, end, self._piece[:order])
        self._way.set_piece(self._piece[:order])
        np.copyto(self.context.commands.effort, torque, where=np.isfinite(torque))
        if step.registers:
            for joint, items in step.registers.items():
                self._registers.setdefault(joint, {}).update(items)
            self.context.set_registers(self._registers)
        return True

    def _restore_registers(self) -> None:
        if self._registers:
            self._registers.clear()
            self.context.set_registers(self._registers)

    def _name_of_next_step(self) -> str | None:
        """Count the steps and repetitions, and return the motion of the next step; None after the last one.

        After a cancel, a motion is not repeated, and its exit follows.
        """
        motion = self._motion
        self._number += 1
        if self._number <= len(motion.steps):
            return self._name
        self._number, self._left = 1, self._left - 1
        if self._left > 0 and not self._leaving:
            return self._name
        name = motion.exit if self._leaving else motion.next
        self._left = 1 if name is None else self.parameters.motions[name].repeat
        return name

    def _decelerate(self, dt: float) -> None:
        self._time_s += dt
        self._stop.sample(self._time_s, self._now)
        self._write_commands()
        if self._time_s >= self._stop.duration_s:
            self._stopping = False
            self._restore_registers()
            self._finish(Outcome.CANCELLED, f"stopped in step {self._number} of {self._name}")

    def _write_commands(self) -> None:
        commands, now = self.context.commands, self._now
        self._stay_out()
        np.copyto(commands.position, now.position)
        if not self._posvel:
            return
        velocity = now.velocity * self._rate
        if not self.context.into:  # a reference is signed, but a servo gets the magnitude
            velocity = np.maximum(np.abs(velocity), self._closing)
        np.copyto(commands.velocity, velocity)

    # The end

    def _hand_over(self) -> None:
        """Pass the goal to the runtime, which judges it by the last requested pose of each joint.

        A cancelled goal ends without judgement.
        """
        self._restore_registers()
        if self._leaving:
            self._finish(Outcome.CANCELLED, f"played {self._name}")
            return
        moved, text = self._moved_joints(f"played {self._name}")
        if not moved:
            self._finish(Outcome.ABORTED, f"played {self._name}")
            return
        goal, self._goal = self._goal, None
        if goal is None:
            return
        parameters, count = self.parameters, len(self._asked)
        near = np.nan if parameters.tolerance is None else float(parameters.tolerance)
        tolerances = GoalTolerances(np.full(count, near), np.full(count, np.nan), parameters.settle)
        goal.judge(self._asked.copy(), joints=moved, tolerances=tolerances, text=text)

    def _worst(self) -> tuple[float, str]:
        """Return the largest position error, rad, and its joint; the error is infinite without a reply."""
        states = self.context.states
        error = np.where(states.valid, np.abs(states.position - self.context.commands.position), np.inf)
        row = int(error.argmax())
        return float(error[row]), self.context.joints[row]

    def _finish(self, outcome: Outcome, text: str) -> None:
        """End the active goal with an outcome, without judgement of the positions."""
        goal, self._goal = self._goal, None
        if goal is not None:
            (worst, joint), (_, text) = self._worst(), self._moved_joints(text)
            goal.end(outcome, text, joint, worst)

    def _moved_joints(self, text: str) -> tuple[list[str], str]:
        """Return the joints that the goal moves now, and the text with the joints that were skipped
        appended.
        """
        joints = self.context.joints
        named = {joint for motion in self._motions for step in motion.steps for joint in step.pose}
        moved = [each for each, out in zip(joints, self._out, strict=True) if each in named and not out]
        missed = [each for each, was in zip(joints, self._missed, strict=True) if each in named and was]
        return moved, f"{text}, without {', '.join(missed)} (no torque)" if missed else text
