"""joint_trajectory_controller: moves joints along a trajectory, sampled by time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, TypeAdapter

from dxlrun import Angle, CommandModel, Context, Controller, Duration, Floats, Interfaces, ParametersModel
from dxlrun_controllers.joints import JointNames, check_size, hold
from dxlrun_controllers.spline import CUBIC, LINEAR, QUINTIC, SplineSample, Trajectory, flatten

CLOSING_SPEED = 0.5
"""rad/s, posvel at the end of a trajectory: with its speed of 0 a servo that lags would creep the rest of its
way at one tick (0.012 rad/s)."""


class Tolerances(ParametersModel):
    """How far a joint may be off; a tolerance that is left out is not checked."""

    path: Angle | None = None
    """On the way: beyond it the trajectory is aborted and the joints hold the desired position of then."""
    goal: Angle | None = None
    """At the end: the goal counts as reached when every joint is nearer than this."""
    goal_time: Duration = 0
    """How long after the end the goal may still be reached."""


class TrajectoryParameters(ParametersModel):
    """Keys of a joint_trajectory_controller in the robot file."""

    joints: JointNames
    """The joints, in the order in which points name them."""
    command_interface: Literal["position", "posvel"] = "position"
    """`posvel` commands the magnitude of the desired velocity beside the position."""
    tolerances: Tolerances = Tolerances()


_DURATION: TypeAdapter[int] = TypeAdapter(Duration)


def _seconds(value: object) -> object:
    """Accept `500 ms` beside a bare number, which counts seconds."""
    return _DURATION.validate_python(value) * 1e-9 if isinstance(value, str) else value


Seconds = Annotated[float, BeforeValidator(_seconds), Field(ge=0)]


class TrajectoryPoint(CommandModel):
    """Where the joints are to be at a time."""

    time: Seconds
    """s since the trajectory's start"""
    positions: tuple[float, ...]
    """rad, shape (joints,)"""
    velocities: tuple[float, ...] | None = None
    """rad/s, shape (joints,)"""
    accelerations: tuple[float, ...] | None = None
    """rad/s^2, shape (joints,)"""


class TrajectoryCommand(CommandModel):
    """A trajectory: linear when only positions are given, cubic with velocities, quintic with accelerations.

    What only some points give is not used. The joints go from where they are to the first point in
    `start_in` and the first point's time; when both are 0, at once, as the last gate lets them.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    start_in: Seconds = 0.0
    """s until the trajectory's start, from the moment at which the command is taken"""


class JointTrajectoryController(Controller[TrajectoryParameters]):
    """Plays one trajectory at a time; a new one begins at the desired state of then, without a jump.

    Time decides the desired state, never the number of updates: a late cycle shortens nothing.
    """

    Parameters = TrajectoryParameters
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {"trajectory": TrajectoryCommand}

    @classmethod
    def interfaces(cls, parameters: TrajectoryParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position, or position and velocity, of the parameters' joints."""
        if parameters.command_interface == "position":
            return Interfaces(parameters.joints, ("position",))
        return Interfaces(parameters.joints, ("position", "velocity"))

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: TrajectoryParameters
    ) -> NDArray[np.float64]:
        """Return the trajectory's splines as one flat array (spline.flatten).

        Raises ValueError for a wrong size or times that do not grow.
        """
        if not isinstance(command, TrajectoryCommand):
            return super().prepare(kind, command, parameters)
        return flat_trajectory(command, parameters.joints)

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        joints = len(context.joints)
        self._desired = SplineSample(joints)
        self._trajectory = Trajectory(joints)
        self._error = np.zeros(joints)
        self._start_ns = 0
        self._moving = False
        self._settling = False
        speed = context.limits.velocity
        self._closing = np.where(np.isfinite(speed), np.minimum(speed, CLOSING_SPEED), CLOSING_SPEED)

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are."""
        hold(self.context)
        self._moving = self._settling = False
        self._rest(self.context.commands.position)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Begin a trajectory from the desired state."""
        if self._moving:
            self._trajectory.sample(self._elapsed(time_ns), self._desired)
            self.context.say(f"trajectory preempted after {self._elapsed(time_ns):.3f} s")
        self._trajectory.load(data, self._desired)
        self._start_ns = time_ns
        self._moving, self._settling = True, False

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the trajectory's state at `time_ns`; hold when there is none."""
        if self._moving:
            self._follow(self._elapsed(time_ns))
        elif self._settling:
            self._settle(self._elapsed(time_ns))

    def _elapsed(self, time_ns: int) -> float:
        return (time_ns - self._start_ns) * 1e-9

    def _follow(self, elapsed: float) -> None:
        commands, desired, trajectory = self.context.commands, self._desired, self._trajectory
        if elapsed >= trajectory.duration_s:
            trajectory.sample(elapsed, desired)
            np.copyto(commands.position, desired.position)
            self._moving, self._settling = False, True
            self._close_in()
            self._settle(elapsed)
            return
        if self.parameters.command_interface == "posvel":
            trajectory.sample(elapsed, desired)
            np.copyto(commands.position, desired.position)
            np.abs(desired.velocity, out=commands.velocity)
        else:
            trajectory.position(elapsed, commands.position)
        path = self.parameters.tolerances.path
        if path is not None and self._worst(silent=0.0) > path:
            self._moving = False
            self._rest(commands.position)
            self._close_in()
            self.context.say(f"trajectory aborted after {elapsed:.3f} s: {self._off()}, holding")

    def _settle(self, elapsed: float) -> None:
        """Log whether the goal was reached, once."""
        tolerances = self.parameters.tolerances
        if tolerances.goal is None or self._worst(silent=np.inf) <= tolerances.goal:
            self._settling = False
            self.context.say(f"trajectory reached its goal after {elapsed:.3f} s")
        elif elapsed >= self._trajectory.duration_s + tolerances.goal_time * 1e-9:
            self._settling = False
            self.context.say(f"trajectory missed its goal after {elapsed:.3f} s: {self._off()}, holding")

    def _rest(self, position: Floats) -> None:
        """Make `position`, at rest, the desired state."""
        np.copyto(self._desired.position, position)
        self._desired.velocity.fill(0.0)
        self._desired.acceleration.fill(0.0)

    def _close_in(self) -> None:
        """Give servos that lag a speed for the rest of their way."""
        if self.parameters.command_interface == "posvel":
            np.copyto(self.context.commands.velocity, self._closing)

    def _worst(self, silent: float) -> float:
        """Return the largest distance from the commands, rad; `silent` for a joint without a reply."""
        states, error = self.context.states, self._error
        np.subtract(states.position, self.context.commands.position, out=error)
        np.abs(error, out=error)
        np.copyto(error, silent, where=~states.valid)
        return float(error.max())

    def _off(self) -> str:
        row = int(self._error.argmax())
        if np.isinf(self._error[row]):
            return f"joint {self.context.joints[row]} does not answer"
        return f"joint {self.context.joints[row]} is {self._error[row]:.4f} rad off"


def flat_trajectory(command: TrajectoryCommand, joints: tuple[str, ...]) -> Floats:
    """Return the command as a flat array. Raises ValueError for a wrong size or times that do not grow."""
    times = np.array([point.time for point in command.points])
    stalled = np.flatnonzero(np.diff(times) <= 0)
    if len(stalled):
        index = int(stalled[0]) + 1
        raise ValueError(
            f"the times of a trajectory must grow: point {index + 1} is at {times[index]:g} s, "
            f"the one before at {times[index - 1]:g} s"
        )
    points = np.zeros((len(times), 3, len(joints)))
    given = [True, True]
    for index, point in enumerate(command.points):
        check_size(f"positions in point {index + 1}", len(point.positions), joints)
        points[index, 0] = point.positions
        for derivative, (what, values) in enumerate(
            (("velocities", point.velocities), ("accelerations", point.accelerations))
        ):
            if values is None:
                given[derivative] = False
                continue
            check_size(f"{what} in point {index + 1}", len(values), joints)
            points[index, derivative + 1] = values
    velocities, accelerations = given
    order = LINEAR if not velocities else QUINTIC if accelerations else CUBIC
    return flatten(order, times, points, command.start_in)
