"""gripper_controller: close and open a gripper by goals with a limited effort, and detect a grip.

A gripper that stalls before its goal is assumed to hold something, as in ROS 2's gripper controllers
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
from dxlrun_controllers.joint_parameters import hold_joints, or_number, take_shorter_way_from_goals

STATE_NS = 50_000_000
"""Time between two messages of the topic `state`, ns."""
REST_NS = 1_000_000_000
"""Timeout for the gripper to come to rest after a cancel, ns."""


Way = Angle | Length
"""Position of the joint: an angle, or a length for a linear joint"""
Speed = AngularVelocity | LinearVelocity
_OF_LENGTHS: TypeAdapter[float] = TypeAdapter(Length | LinearVelocity)


def _is_length(value: object) -> bool:
    """Return True if a quantity is a text with a unit of length or of linear velocity."""
    try:
        return isinstance(value, str) and _OF_LENGTHS.validate_python(value) is not None
    except ValidationError:
        return False


class Width(ParametersModel):
    """Opening of the gripper at a position of its joint"""

    angle: Way
    """Position of the joint."""
    width: Length
    """Opening at this position."""


class GripperParameters(ParametersModel):
    """Keys of a gripper_controller in the robot file."""

    _units: Mapping[str, JointUnit] = PrivateAttr({})
    """Key of the parameters -> LINEAR if it was written as a length; keys for a joint that turns are not
    in it.
    """
    joint: str = Field(examples=["gripper"])
    """Joint that opens and closes the gripper."""
    effort: Annotated[float, Field(gt=0)] | None = None
    """Effort limit of the servo, in the unit that the model measures (Nm, A or the fraction of its maximum).
    A goal can have its own. Without this key the servo is in position mode, which has no effort limit."""
    speed: Annotated[Speed, Field(gt=0), LIVE] = 2.0
    """Speed of the joint, rad/s, or m/s for a linear joint."""
    tolerance: Annotated[Way, Field(gt=0)] = 0.02
    """Distance within which a goal is reached once the joint is at rest, rad, or m for a linear joint."""
    stall_speed: Annotated[Speed, Field(gt=0)] = 0.05
    """Speed below which the joint may be stalled, rad/s, or m/s for a linear joint."""
    stall_time: Annotated[Duration, Field(gt=0)] = 200_000_000
    """Time below `stall_speed`, short of the goal, after which the joint is stalled."""
    timeout: Annotated[Duration, Field(gt=0)] = 5_000_000_000
    """Time after which a goal that is neither reached nor stalled is missed."""
    widths: tuple[Width, ...] = ()
    """Table of at least two openings, with linear interpolation. Without it, goals and results are positions
    of the joint."""

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
        """Return the joint unit for which a key was written; ROTARY for its default."""
        return self._units.get(key, ROTARY)

    def mistakes(self) -> Iterator[Mistake]:
        """Yield a table `widths` with one row, or whose widths do not all rise or all fall with the
        position.
        """
        yield from super().mistakes()
        if len(self.widths) == 1:
            yield ("widths",), "one width is not enough; write at least two, such as open and closed"
            return
        ordered = sorted(self.widths, key=lambda point: point.angle)
        steps = (
            np.diff([[point.angle, point.width] for point in ordered], axis=0) if ordered else np.ones((1, 2))
        )
        if (steps[:, 0] == 0).any() or not ((steps[:, 1] > 0).all() or (steps[:, 1] < 0).all()):
            yield ("widths",), "widths must all grow, or all shrink, with the angle; write each angle once"


_OF_THE_WAY = ("speed", "tolerance", "stall_speed")
"""Keys of the parameters whose defaults are for a joint that turns."""
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
    LINEAR: "a length, such as 10 mm: the joint is linear",
}


class GripCommand(CommandModel):
    """Goal of the gripper: a position of the joint or an opening, and optionally an effort limit."""

    _unit: JointUnit | None = PrivateAttr(None)
    """Unit of the joint that the position was written for; None for a bare number"""
    position: Annotated[float, or_number(Way)] | None = None
    """Goal position of the joint, rad, or m for a linear joint"""
    width: Annotated[float, or_number(Length)] | None = None
    """Goal opening, m"""
    effort: Annotated[float, Field(gt=0)] | None = None
    """Effort limit on the way and at the goal, in the unit that the model measures"""

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
            raise ValueError("give either position or width; write for example width=5cm")
        return self


@dataclass(frozen=True, slots=True)
class GripperState:
    """Message of the topic `state`: position, opening and effort of the gripper."""

    position: float
    """Measured position of the joint, rad, or m for a linear joint."""
    width: float
    """Opening at this position, m; NaN without a table of widths."""
    effort: float
    """Measured effort, in the unit that the model measures."""
    moving: bool
    """True while a goal is active."""
    stalled: bool
    """True from a stall until the next command: the gripper holds something."""


class GripperController(Controller[GripperParameters]):
    """Controller of a gripper with one joint. A stall ends a goal as reached, and the gripper keeps its grip.

    With an effort limit the gripper continues to press with that effort. Without one, it holds the position
    at which it stalled. The command `positions` of streams and motion files moves the gripper without a
    result.
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
        """Yield each key that is written as an angle for a linear joint, or as a length for a joint that
        turns.
        """
        needed = (*_OF_THE_WAY, *(["widths"] if parameters.widths else []))
        for key in needed:
            unit, written = robot.units[0], parameters.unit_of(key)
            if written is not unit:
                what = f"has {key} as {written.quantity}, but {parameters.joint} {unit.verb}"
                yield Mismatch(what, f"write {key} as {_FIXES[unit].get(key, 'angles')}", key)

    @classmethod
    def interfaces(cls, parameters: GripperParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim position and velocity of the joint, and the effort if it is limited."""
        if parameters.effort is None:
            return Interfaces((parameters.joint,), ("position", "velocity"))
        return Interfaces(
            (parameters.joint,), ("position", "velocity", "effort"), asked_by={"effort": ("effort",)}
        )

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: GripperParameters) -> NDArray[np.float64]:
        """Return the goal position of the joint (rad or m) and the effort limit (NaN without one) of a
        command.

        Raises:
            ValueError: The width is out of range, or the parameters do not allow a width or an effort.
        """
        if not isinstance(command, GripCommand):
            return super().prepare(kind, command, parameters)
        if command.effort is not None and parameters.effort is None:
            raise ValueError("the gripper has no effort limit; write `effort` in the robot file")
        unit = parameters.unit_of("speed")
        if command._unit is not None and command._unit is not unit:
            raise ValueError(f"the position must be {_POSITIONS[unit]}")
        effort = command.effort or parameters.effort or np.nan
        if command.width is None:
            return np.array([command.position, effort])
        if not parameters.widths:
            raise ValueError(
                "the gripper has no widths; give a position, or write `widths` in the robot file"
            )
        angles, widths = _table(parameters)
        if not widths.min() <= command.width <= widths.max():
            raise ValueError(
                f"width {command.width:g} m is not between {widths.min():g} m and {widths.max():g} m; "
                "write a width in this range, with its unit"
            )
        order = np.argsort(widths)
        return np.array([np.interp(command.width, widths[order], angles[order]), effort])

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        self._angles, self._widths = _table(self.parameters)
        self._lower, self._upper = context.limits.lower.item(0), context.limits.upper.item(0)
        self._goal: Goal | None = None
        self._target = self._way = 0.0
        self._began_ns = self._published_ns = 0
        self._still, self._still_ns, self._heard_ns = np.nan, 0, 0
        """Position near which the gripper has stayed, since when, and the time of the last reply, ns."""
        self._cancelled = self._stalled = False
        self._unit = self.parameters.unit_of("speed").value

    def on_activate(self, time_ns: int) -> None:
        """Hold where the gripper is."""
        hold_joints(self.context)
        commands = self.context.commands
        self.on_parameters(time_ns)
        if self.parameters.effort is not None:
            commands.effort.fill(self.parameters.effort)
        self._goal, self._stalled = None, False
        self._published_ns = time_ns - STATE_NS

    def on_parameters(self, time_ns: int) -> None:
        """Set the speed of the joint. A controller below would take it as a signed velocity, so it gets 0."""
        self.context.commands.velocity.fill(0.0 if self.context.into else self.parameters.speed)

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Start to move to the goal position. A position beyond the joint's limits aborts the goal."""
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
        """Set another goal position without a result; an active goal ends as preempted."""
        self._end_goal(Outcome.PREEMPTED, "positions came")
        self._cancelled, self._stalled = False, False
        self.on_parameters(time_ns)
        np.copyto(self.context.commands.position, take_shorter_way_from_goals(data, self.context))

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Hold the gripper at its present position. The goal ends when it is at rest."""
        self._cancelled, self._began_ns = True, time_ns
        self._stay()

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime ends."""
        self._goal = None

    def update(self, time_ns: int, period_ns: int) -> None:
        """Monitor the active goal until it is reached, stalled or timed out, and publish the state."""
        states = self.context.states
        if self._goal is not None:
            if self._cancelled:
                still = bool(states.valid[0]) and abs(states.velocity[0]) <= self.parameters.stall_speed
                if still or time_ns - self._began_ns >= REST_NS:
                    self._end_goal(Outcome.CANCELLED, "stopped")
            else:
                self._watch(self._goal, time_ns)
        if time_ns - self._published_ns >= STATE_NS:
            self._published_ns = max(self._published_ns + STATE_NS, time_ns - STATE_NS)
            moving = self._goal is not None
            position, effort = float(states.position[0]), float(states.effort[0])
            message = GripperState(position, self._width(position), effort, moving, self._stalled)
            self.context.publish("state", message)

    def _watch(self, goal: Goal, time_ns: int) -> None:
        """End or report an active goal by the measured position; without a reply, only by the timeout."""
        if not self.context.states.valid[0]:
            if time_ns - self._began_ns >= self.parameters.timeout:
                self._end_goal(Outcome.MISSED, "no reply from its servo")
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
            self._end_goal(Outcome.MISSED, f"goal not reached after {self.parameters.timeout * 1e-9:g} s")
            return
        goal.feedback(max(0.0, 1.0 - error / self._way) if self._way else 0.0, error)

    def _stands_still(self, position: float, time_ns: int) -> bool:
        """Return True if the gripper was slower than `stall_speed` for `stall_time`; called once a cycle.

        The check compares positions, because a measured velocity is noisy near 0. A lost reply does not
        restart the
        time, but a gap longer than `stall_time` does.
        """
        parameters = self.parameters
        silent_ns, self._heard_ns = time_ns - self._heard_ns, time_ns
        reach = parameters.stall_speed * parameters.stall_time * 1e-9
        if silent_ns > parameters.stall_time or not abs(position - self._still) < reach:
            self._still, self._still_ns = position, time_ns
        return time_ns - self._still_ns >= parameters.stall_time

    def _stay(self) -> None:
        """Command the measured position, clamped to the limits; without one, the last command stays."""
        position = float(self.context.states.position[0])
        if not np.isnan(position):
            self.context.commands.position.fill(min(max(position, self._lower), self._upper))

    def _end_goal(self, outcome: Outcome, text: str) -> None:
        goal, self._goal = self._goal, None
        if goal is None:
            return
        position = float(self.context.states.position[0])
        error = abs(self._target - position)
        goal.end(outcome, f"{text} at {self._place(position)}", self.parameters.joint, error)

    def _hand_over(self, text: str, tolerance: float, rest_speed: float, settle_ns: int) -> None:
        """Pass the active goal to the runtime, which judges it by these tolerances; a stall has infinite
        ones.
        """
        goal, self._goal = self._goal, None
        if goal is not None:
            tolerances = GoalTolerances(np.array([tolerance]), np.array([rest_speed]), settle_ns)
            goal.judge(np.array([self._target]), tolerances=tolerances, text=text)

    def _place(self, position: float) -> str:
        """Return a joint position as text, with the opening there if there is a table of widths."""
        width = self._width(position)
        place = f"{position:.4g} {self._unit}"
        return place if np.isnan(width) else f"{place}, {width * 1e3:.4g} mm"

    def _width(self, angle: float) -> float:
        return float(np.interp(angle, self._angles, self._widths)) if self._angles.size else float("nan")


def _table(parameters: GripperParameters) -> tuple[Floats, Floats]:
    """Return the positions of the joint in increasing order (rad or m), and their widths (m)."""
    ordered = sorted(parameters.widths, key=lambda point: point.angle)
    return np.array([point.angle for point in ordered]), np.array([point.width for point in ordered])
