"""gripper_controller: closes and opens a gripper by goals, with a limited effort, and reports what it holds.

A gripper that stands still short of its goal holds something: as in ROS 2's gripper controllers
(control.ros.org, gripper_controllers: stall_velocity_threshold, stall_timeout, allow_stalling).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from dxlrun import (
    LINEAR,
    LIVE,
    ROTARY,
    Angle,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Goal,
    GoalTolerances,
    Interfaces,
    JointUnit,
    Length,
    LinearVelocity,
    Mismatch,
    Mistake,
    Outcome,
    ParametersModel,
    RobotModel,
)
from dxlrun_controllers.group import PositionsCommand
from dxlrun_controllers.joints import hold, or_number, take_shorter_way_from_goals

STATE_NS = 50_000_000
"""Between two messages of the topic, ns."""
REST_NS = 1_000_000_000
"""After a cancel, how long the gripper may take to come to rest, ns."""


Way = Angle | Length
"""A position of the joint: of a linear one a length"""
Speed = AngularVelocity | LinearVelocity
_OF_LENGTHS: TypeAdapter[float] = TypeAdapter(Length | LinearVelocity)


def _is_length(value: object) -> bool:
    """Return whether a quantity is written with a unit of length, or of length a second."""
    try:
        return isinstance(value, str) and _OF_LENGTHS.validate_python(value) is not None
    except ValidationError:
        return False


class Width(ParametersModel):
    """How far the gripper is open at a position of its joint."""

    angle: Way
    """Position of the joint."""
    width: Length
    """How far the gripper is open there."""


class GripperParameters(ParametersModel):
    """Keys of a gripper_controller in the robot file."""

    _units: Mapping[str, JointUnit] = PrivateAttr({})
    """The joints that each key about the joint fits, as it is written"""
    joint: str
    """The joint that opens and closes it."""
    effort: Annotated[float, Field(gt=0)] | None = None
    """The most that the servo may exert, in the unit that the model measures (Nm, A or the fraction of its
    maximum), unless a goal has its own. Left out: the servo is in position mode, without such a limit."""
    speed: Annotated[Speed, Field(gt=0), LIVE] = 2.0
    """rad/s, of a linear joint m/s, at which it closes and opens"""
    tolerance: Annotated[Way, Field(gt=0)] = 0.02
    """rad, of a linear joint m; nearer to its goal, and at rest, it has reached it"""
    stall_speed: Annotated[Speed, Field(gt=0)] = 0.05
    """rad/s, of a linear joint m/s; slower ..."""
    stall_time: Annotated[Duration, Field(gt=0)] = 200_000_000
    """... for so long, ns, and short of its goal, it is stalled"""
    timeout: Annotated[Duration, Field(gt=0)] = 5_000_000_000
    """ns; a goal that has neither been reached nor stalled then is missed"""
    widths: tuple[Width, ...] = ()
    """At least two, in between linear; without them goals and results are angles."""

    @model_validator(mode="wrap")
    @classmethod
    def _noting_lengths(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        found = handler(data)
        if isinstance(data, Mapping):
            widths = data.get("widths")
            angles = [each.get("angle") for each in widths if isinstance(each, Mapping)] if widths else []
            written = [*((key, data.get(key)) for key in _OF_THE_WAY), *(("widths", one) for one in angles)]
            found._units = {key: LINEAR for key, value in written if _is_length(value)}
        return found

    def unit_of(self, key: str) -> JointUnit:
        """Return the unit of the joints that a key fits, as it is written or by its default."""
        return self._units.get(key, ROTARY)

    def mistakes(self) -> Iterator[Mistake]:
        """Yield what keeps the widths from following from the angle."""
        yield from super().mistakes()
        if len(self.widths) == 1:
            yield ("widths",), "one width makes no line; write at least two, such as open and closed"
            return
        ordered = sorted(self.widths, key=lambda point: point.angle)
        steps = (
            np.diff([[point.angle, point.width] for point in ordered], axis=0) if ordered else np.ones((1, 2))
        )
        if (steps[:, 0] == 0).any() or not ((steps[:, 1] > 0).all() or (steps[:, 1] < 0).all()):
            yield ("widths",), "widths must all grow, or all shrink, with the angle; each angle stands once"


_OF_THE_WAY = ("speed", "tolerance", "stall_speed")
"""Keys whose defaults are of a joint that turns"""
_FIXES: Mapping[JointUnit, Mapping[str, str]] = {
    ROTARY: {},
    LINEAR: {
        "speed": "lengths, such as 50 mm/s",
        "tolerance": "lengths, such as 0.5 mm",
        "stall_speed": "lengths, such as 50 mm/s",
        "widths": "lengths, such as {angle: 10 mm, width: 20 mm}",
    },
}
_POSITIONS: Mapping[JointUnit, str] = {
    ROTARY: "an angle, such as 20 deg",
    LINEAR: "a length, such as 10 mm: its joint is linear",
}


class GripCommand(CommandModel):
    """A goal: a position of the joint or a width, and perhaps the most effort on the way and at it."""

    _unit: JointUnit | None = PrivateAttr(None)
    """The joints that the position fits, as it is written; None: it is a number"""
    position: Annotated[float, or_number(TypeAdapter(Way))] | None = None
    """rad, of a linear joint m"""
    width: Annotated[float, or_number(TypeAdapter(Length))] | None = None
    """m"""
    effort: Annotated[float, Field(gt=0)] | None = None
    """In the unit that the model measures"""

    @model_validator(mode="wrap")
    @classmethod
    def _noting_length(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        found = handler(data)
        if isinstance(data, Mapping) and isinstance(position := data.get("position"), str):
            found._unit = LINEAR if _is_length(position) else ROTARY
        return found

    @model_validator(mode="after")
    def _one_goal(self) -> Self:
        if (self.position is None) == (self.width is None):
            raise ValueError("give either position or width")
        return self


@dataclass(frozen=True, slots=True)
class GripperState:
    """What the gripper does."""

    position: float
    """rad, of a linear joint m"""
    width: float
    """m; NaN without a table of widths"""
    effort: float
    """In the unit that the model measures"""
    moving: bool
    """True while it works on a goal"""
    stalled: bool
    """True from a stall until the next goal: it holds something"""


class GripperController(Controller[GripperParameters]):
    """Moves one joint to goals; a stall ends a goal as reached, and the gripper keeps its grip.

    With a limit of effort it goes on pressing with it; without one, it holds the angle at which it stalled.
    The command `positions`, of streams and motion files, moves it without a result.
    """

    Parameters = GripperParameters
    Commands: ClassVar = {
        "grip": GripCommand,
        "positions": PositionsCommand,
    }
    Goals: ClassVar = frozenset({"grip"})
    Topics: ClassVar = {"state": GripperState}

    @classmethod
    def mismatches(cls, parameters: GripperParameters, robot: RobotModel) -> Iterator[Mismatch]:
        """Yield each key whose unit is not that of the joint; the defaults are of one that turns."""
        needed = (*_OF_THE_WAY, *(["widths"] if parameters.widths else []))
        for key in needed:
            unit, written = robot.units[0], parameters.unit_of(key)
            if written is not unit:
                what = f"moves {parameters.joint}, which {unit.verb}, but its {key} is of {written.quantity}"
                yield Mismatch(what, f"write {key} as {_FIXES[unit].get(key, 'angles')}", key)

    @classmethod
    def interfaces(cls, parameters: GripperParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position and velocity of the joint, and its effort where that is limited."""
        if parameters.effort is None:
            return Interfaces((parameters.joint,), ("position", "velocity"))
        return Interfaces(
            (parameters.joint,), ("position", "velocity", "effort"), asked_by={"effort": ("effort",)}
        )

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GripperParameters) -> NDArray[np.float64]:
        """Return angle, rad, and effort. Raises ValueError for a width, or an effort, that it cannot have."""
        if not isinstance(command, GripCommand):
            return super().prepare(kind, command, parameters)
        if command.effort is not None and parameters.effort is None:
            raise ValueError("its joint has no limit of effort; write one as `effort` in the robot file")
        unit = parameters.unit_of("speed")
        if command._unit is not None and command._unit is not unit:
            raise ValueError(f"the position must be {_POSITIONS[unit]}")
        effort = command.effort or parameters.effort or np.nan
        if command.width is None:
            return np.array([command.position, effort])
        if not parameters.widths:
            raise ValueError("it has no widths; give a position, or write `widths` in the robot file")
        angles, widths = _table(parameters)
        if not widths.min() <= command.width <= widths.max():
            raise ValueError(
                f"width {command.width:g} m is not between {widths.min():g} m and {widths.max():g} m"
            )
        order = np.argsort(widths)
        return np.array([np.interp(command.width, widths[order], angles[order]), effort])

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        self._angles, self._widths = _table(self.parameters)
        self._lower, self._upper = context.limits.lower.item(0), context.limits.upper.item(0)
        self._goal: Goal | None = None
        self._target = self._way = 0.0
        self._began_ns = self._published_ns = 0
        self._still, self._still_ns, self._heard_ns = np.nan, 0, 0
        """Where the gripper has been since, nearer than it may go in `stall_time`; and the last reply."""
        self._cancelled = self._stalled = False
        self._unit = self.parameters.unit_of("speed").value

    def on_activate(self, time_ns: int) -> None:
        """Hold where the gripper is."""
        hold(self.context)
        commands = self.context.commands
        self.on_parameters(time_ns)
        if self.parameters.effort is not None:
            commands.effort.fill(self.parameters.effort)
        self._goal, self._stalled = None, False
        self._published_ns = time_ns - STATE_NS

    def on_parameters(self, time_ns: int) -> None:
        """Take another speed; beside a reference of another controller it would be a velocity, so 0."""
        self.context.commands.velocity.fill(0.0 if self.context.into else self.parameters.speed)

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Begin to close or open; an angle beyond the joint's limits is refused."""
        self._goal, self._cancelled, self._stalled = None, False, False
        angle, effort = float(take_shorter_way_from_goals(data[:1], self.context)[0]), float(data[1])
        if not self._lower <= angle <= self._upper:
            limits = f"{self._lower:.4g}..{self._upper:.4g} {self._unit}"
            text = f"{angle:.4g} {self._unit} is outside its limits {limits}"
            goal.end(Outcome.ABORTED, text, self.parameters.joint)
            return
        commands = self.context.commands
        commands.position.fill(angle)
        if not np.isnan(effort):
            commands.effort.fill(effort)
        self._goal, self._target, self._began_ns, self._still = goal, angle, time_ns, np.nan
        self._way = abs(angle - float(self.context.states.position[0]))

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Go to another angle; a goal that is pursued ends."""
        self._end(Outcome.PREEMPTED, "positions came")
        self._cancelled, self._stalled = False, False
        self.on_parameters(time_ns)
        np.copyto(self.context.commands.position, take_shorter_way_from_goals(data, self.context))

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Hold where the gripper is now; the goal has ended when it is at rest."""
        self._cancelled, self._began_ns = True, time_ns
        self._stay()

    def on_deactivate(self, time_ns: int) -> None:
        """Leave the goal: the runtime ends it."""
        self._goal = None

    def update(self, time_ns: int, period_ns: int) -> None:
        """Watch the gripper until it has reached its goal, stands still short of it, or takes too long."""
        states = self.context.states
        if self._goal is not None:
            if self._cancelled:
                still = bool(states.valid[0]) and abs(states.velocity[0]) <= self.parameters.stall_speed
                if still or time_ns - self._began_ns >= REST_NS:
                    self._end(Outcome.CANCELLED, "stopped")
            else:
                self._watch(self._goal, time_ns)
        if time_ns - self._published_ns >= STATE_NS:
            self._published_ns = max(self._published_ns + STATE_NS, time_ns - STATE_NS)
            moving = self._goal is not None
            position, effort = float(states.position[0]), float(states.effort[0])
            message = GripperState(position, self._width(position), effort, moving, self._stalled)
            self.context.publish("state", message)

    def _watch(self, goal: Goal, time_ns: int) -> None:
        """Look at a goal that is pursued; without a reply nothing is known but the time."""
        if not self.context.states.valid[0]:
            if time_ns - self._began_ns >= self.parameters.timeout:
                self._end(Outcome.MISSED, "no reply of its servo")
            return
        position = float(self.context.states.position[0])
        error = abs(self._target - position)
        if error <= self.parameters.tolerance:
            left_ns = self.parameters.timeout - (time_ns - self._began_ns)
            self._hand_over(f"at {self._place(position)}", self.parameters.tolerance, np.nan, left_ns)
            return
        if self._stands_still(position, time_ns):
            self._stalled = True
            if self.parameters.effort is None:
                self._stay()
            self._hand_over(f"stalled, holds something at {self._place(position)}", np.inf, np.inf, 0)
            return
        if time_ns - self._began_ns >= self.parameters.timeout:
            self._end(Outcome.MISSED, f"not there after {self.parameters.timeout * 1e-9:g} s")
            return
        goal.feedback(max(0.0, 1.0 - error / self._way) if self._way else 0.0, error)

    def _stands_still(self, position: float, time_ns: int) -> bool:
        """Check whether it was slower than `stall_speed` for `stall_time`, by its way.

        A measured velocity is noisy near 0, and a lost reply must not begin the time anew; a silence as long
        does.
        """
        parameters = self.parameters
        silent_ns, self._heard_ns = time_ns - self._heard_ns, time_ns
        reach = parameters.stall_speed * parameters.stall_time * 1e-9
        if silent_ns > parameters.stall_time or not abs(position - self._still) < reach:
            self._still, self._still_ns = position, time_ns
        return time_ns - self._still_ns >= parameters.stall_time

    def _stay(self) -> None:
        """Command the angle that was measured, within the limits; without one, the goal of before counts."""
        position = float(self.context.states.position[0])
        if not np.isnan(position):
            self.context.commands.position.fill(min(max(position, self._lower), self._upper))

    def _end(self, outcome: Outcome, text: str) -> None:
        goal, self._goal = self._goal, None
        if goal is None:
            return
        position = float(self.context.states.position[0])
        error = abs(self._target - position)
        goal.end(outcome, f"{text} at {self._place(position)}", self.parameters.joint, error)

    def _hand_over(self, text: str, tolerance: float, rest_speed: float, settle_ns: int) -> None:
        """Let the goal be judged: by its position as it was asked, or as a stall."""
        goal, self._goal = self._goal, None
        if goal is not None:
            tolerances = GoalTolerances(np.array([tolerance]), np.array([rest_speed]), settle_ns)
            goal.judge(np.array([self._target]), tolerances=tolerances, text=text)

    def _place(self, position: float) -> str:
        """Return a position of the joint, and how far the gripper is open there."""
        width = self._width(position)
        place = f"{position:.4g} {self._unit}"
        return place if np.isnan(width) else f"{place}, {width * 1e3:.4g} mm"

    def _width(self, angle: float) -> float:
        return float(np.interp(angle, self._angles, self._widths)) if self._angles.size else float("nan")


def _table(parameters: GripperParameters) -> tuple[Floats, Floats]:
    """Return angles, rad, growing, and their widths, m."""
    ordered = sorted(parameters.widths, key=lambda point: point.angle)
    return np.array([point.angle for point in ordered]), np.array([point.width for point in ordered])
