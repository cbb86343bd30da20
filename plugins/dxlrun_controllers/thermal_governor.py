"""thermal_governor: reduce the torque of hot servos before they shut down."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    Angle,
    Context,
    Controller,
    Floats,
    Interfaces,
    Mismatch,
    MotorModel,
    RobotModel,
    ServoModel,
)
from dxlrun.tooling.topics import messages
from dxlrun_controllers.joint_parameters import (
    JointsParameters,
    PerJoint,
    Positive,
    clamped,
    commanded_by,
    finite_or,
    refer,
    row_of,
    value_for,
)

STATE_NS: Final = 100_000_000
"""Time between two messages of the topic `state`, ns."""
WARN_BELOW, LIMIT_BELOW = 15.0, 5.0
"""Defaults of `warn` and `limit`, K below the servo's own temperature limit [i]."""
SMOOTHING_S: Final = 2.0
"""Time constant of the low-pass filter on temperatures, s: servos report whole degrees, about once a
second [i].
"""
_FULL_DUTY: Final = 1.0


class ThermalParameters(JointsParameters):
    """Keys of a thermal_governor in the robot file."""

    command_interface: Literal["position", "poseffort", "effort", "pwm"] = "position"
    """`position` keeps the goal so close to the position that the servo's own control exceeds no torque
    limit; `poseffort` commands the reference and the effort limit; `effort` and `pwm` command the clamped
    reference."""
    warn: PerJoint[float] | None = None
    """Temperature above which the torque is reduced, degrees C; by default 15 below the servo's own limit."""
    limit: PerJoint[float] | None = None
    """Temperature from which the torque is 0, degrees C; by default 5 below the servo's own limit."""
    hysteresis: Annotated[float, Field(ge=0)] = 2.0
    """Difference below a threshold at which a servo counts as cooled down, K."""
    most: PerJoint[Positive] | None = None
    """Highest effort of a cool servo, in its unit; by default the joint's limit, else the stall effort."""
    reach: PerJoint[Annotated[Angle, Field(gt=0)]] | None = None
    """With `position`: error at which the servo's own control gives full torque; by default from the motor
    file."""


@dataclass(slots=True)
class ThermalState:
    """Message of the topic `state`: temperatures and limits, with one row per joint of the controller."""

    header: messages.Header
    temperature: Floats
    """Measured temperature, degrees C; NaN until first read."""
    scale: Floats
    """Fraction of its torque that the servo may exert, 0..1."""


class ThermalGovernor(Controller[ThermalParameters]):
    """Controller that passes references on and reduces the torque of hot servos.

    The torque falls linearly from all at `warn` to none at `limit`. An overloaded joint therefore sinks
    slowly instead of falling when its servo shuts down. The controller belongs at the lower end of a chain,
    because only the commands that reach the servos determine their currents. It provides the states
    JOINT.scale, the remaining fraction of the torque.
    """

    Parameters = ThermalParameters
    Topics: ClassVar = {"state": ThermalState}

    @classmethod
    def interfaces(cls, parameters: ThermalParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command and export the same interfaces, and provide the scale of each joint."""
        interfaces = commanded_by(parameters.command_interface)
        return Interfaces(
            parameters.joints,
            interfaces,
            reference=interfaces,
            provides=tuple(f"{joint}.scale" for joint in parameters.joints),
        )

    @classmethod
    def mismatches(cls, parameters: ThermalParameters, robot: RobotModel) -> Iterator[Mismatch]:
        """Yield joints with several servos, figures of servos that are unknown, and thresholds in a wrong
        order.
        """
        for joint, servo, motor in zip(robot.joints, robot.servos, robot.motors, strict=True):
            if servo is None:
                yield Mismatch(
                    f"cannot limit the temperature of {joint}: it has several servos",
                    "remove the joint; its servos have their own limits",
                    joint,
                )
                continue
            yield from _of_thresholds(parameters, joint, servo)
            yield from _of_figures(parameters, joint, servo, motor)

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        parameters, joints, limits = self.parameters, context.joints, context.limits
        count, interface = len(joints), parameters.command_interface
        servos = [servo for servo in context.servos if servo is not None]
        if len(servos) < count:
            wrong = [name for name, servo in zip(joints, context.servos, strict=True) if servo is None]
            raise ValueError(f"several servos, or an unknown one, at {', '.join(wrong)}")
        rows = list(zip(joints, servos, context.motors, strict=True))
        thresholds = [_thresholds(parameters, joint, servo) for joint, servo, _ in rows]
        self._warn, self._limit = (np.array(each, dtype=np.float64) for each in zip(*thresholds, strict=True))
        self._labels = [f"{joint} ({servo.label})" for joint, servo, _ in rows]
        stall = np.array([_FULL_DUTY if interface == "pwm" else _stall(servo) for servo in servos])
        own = finite_or(row_of(parameters.most, joints, np.nan), np.fmin(limits.effort, stall))
        self._most = np.ones(count) if interface == "position" else own
        reaches = [_reach(parameters, joint, motor) for joint, _, motor in rows]
        self._reach = np.array([np.nan if each is None else each for each in reaches])
        self._lower, self._upper = limits.lower, limits.upper
        self._by_position = "position" in commanded_by(interface)
        self._temperature = np.full(count, np.nan)
        self._reference, self._scale = np.zeros((2, count))
        self._is_hot, self._is_spent = np.zeros((2, count), dtype=np.bool_)
        self._state = ThermalState(messages.Header(), context.states.temperature, self._scale)

    def on_activate(self, time_ns: int) -> None:
        """Start from the measured temperatures, and discard references, so that joints hold where they
        are.
        """
        self._reference.fill(np.nan)
        np.copyto(self._temperature, self.context.states.temperature)
        self._is_hot.fill(False)
        self._is_spent.fill(False)
        self._state_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the references, limited by the temperatures of the servos, and publish the state."""
        context = self.context
        self._smooth(context.states.temperature, period_ns * 1e-9)
        np.copyto(self._scale, torque_scale(self._temperature, self._warn, self._limit))
        context.provided[:] = self._scale
        self._report_crossings(self._is_hot, self._warn, "it gets less torque")
        self._report_crossings(self._is_spent, self._limit, "it gets no torque")
        commands, references, most = context.commands, context.references, self._most * self._scale
        if self._by_position:
            refer(self._reference, context)
            np.copyto(commands.position, self._reference)
        match self.parameters.command_interface:
            case "position":
                self._hold_back()
            case "poseffort":  # fmin ignores NaN, which marks an effort that is not commanded
                np.maximum(np.fmin(references.effort, most), 0.0, out=commands.effort)
            case "effort" | "pwm" as torque:
                reference = finite_or(getattr(references, torque), 0.0)
                np.maximum(np.minimum(reference, most), -most, out=getattr(commands, torque))
        if time_ns >= self._state_ns:
            self._state_ns = time_ns + STATE_NS
            context.publish("state", self._state)

    def _smooth(self, measured: Floats, period_s: float) -> None:
        """Low-pass filter the measured temperatures, degrees C.

        A servo without a reading keeps its last value.
        """
        before = finite_or(self._temperature, measured)  # start from the first reading
        step = (measured - before) * (period_s / (SMOOTHING_S + period_s))
        self._temperature = before + np.where(np.isfinite(step), step, 0.0)

    def _hold_back(self) -> None:
        """Clamp the goals of hot servos to a distance from their positions that keeps the torque limit.

        The states keep the last position of a servo that was not read, so a lost packet causes no jump.
        """
        position, goal = self.context.states.position, self.context.commands.position
        reach = self._scale * self._reach
        held = clamped(clamped(goal - position, -reach, reach) + position, self._lower, self._upper)
        was_read = np.isfinite(position)
        np.copyto(goal, held, where=(self._scale < 1.0) & was_read)

    def _report_crossings(self, beyond: NDArray[np.bool_], threshold: Floats, what: str) -> None:
        temperature = self._temperature
        now = temperature >= threshold - self.parameters.hysteresis * beyond
        for row in np.flatnonzero(now != beyond):
            beyond[row] = now[row]
            name, celsius, at = self._labels[row], temperature[row], threshold[row]
            if beyond[row]:
                self.context.warn(f"{name} is at {celsius:.1f} deg C (threshold {at:g}): {what}")
            else:
                self.context.say(f"{name} has cooled down to {celsius:.1f} deg C, below {at:g}")


def torque_scale(temperature: Floats, warn: Floats, limit: Floats) -> Floats:
    """Return the fraction of its torque that each servo may exert, from its temperature and thresholds,
    degrees C.

    It is 1 below `warn` and while the temperature is unknown (NaN), and 0 from `limit` on.
    """
    scale: Floats = np.maximum(np.fmin((limit - temperature) / (limit - warn), 1.0), 0.0)
    return scale


def _thresholds(parameters: ThermalParameters, joint: str, servo: ServoModel) -> tuple[float, float]:
    """Return the temperatures of a joint above which torque is reduced, and from which it is 0; NaN if
    unknown.
    """
    own = np.nan if servo.temperature_limit is None else servo.temperature_limit
    warn, limit = value_for(parameters.warn, joint), value_for(parameters.limit, joint)
    return own - WARN_BELOW if warn is None else warn, own - LIMIT_BELOW if limit is None else limit


def _reach(parameters: ThermalParameters, joint: str, motor: MotorModel | None) -> float | None:
    """Return the position error at which a joint's servo gives full torque, rad; None if unknown."""
    stiffness = None if motor is None else motor.stiffness
    return value_for(parameters.reach, joint) or (1.0 / stiffness if stiffness else None)


def _stall(servo: ServoModel) -> float:
    """Return the stall effort of a servo in its unit; NaN if unknown."""
    stall = {"A": servo.stall_current, "Nm": servo.stall_torque, "1": 1.0}[servo.effort_unit]
    return np.nan if stall is None else stall


def _of_thresholds(parameters: ThermalParameters, joint: str, servo: ServoModel) -> Iterator[Mismatch]:
    warn, limit = _thresholds(parameters, joint, servo)
    own = servo.temperature_limit
    if np.isnan(warn) or np.isnan(limit):
        yield Mismatch(
            f"needs the temperature limit of {joint} ({servo.model})", "write warn and limit", joint
        )
    elif own is not None and limit >= own:
        yield Mismatch(
            f"has {limit:g} deg C as limit of {joint}, but the {servo.model} cuts torque beyond {own:g}",
            f"write limit: {own - LIMIT_BELOW:g} or less",
            _key("limit", parameters.limit),
        )
    elif warn >= limit:
        yield Mismatch(
            f"has warn of {joint} at {warn:g} deg C, not below its limit of {limit:g}",
            f"write warn: {limit - 10:g} for a smooth reduction of the torque",
            _key("warn", parameters.warn) if parameters.warn is not None else _key("limit", parameters.limit),
        )


def _of_figures(
    parameters: ThermalParameters, joint: str, servo: ServoModel, motor: MotorModel | None
) -> Iterator[Mismatch]:
    interface = parameters.command_interface
    if interface == "position" and _reach(parameters, joint, motor) is None:
        yield Mismatch(
            f"needs the position error of {joint} at full torque",
            "write reach: 15 deg, name a motor file with a position_gain, or command poseffort",
            joint,
        )
    if (
        interface in {"poseffort", "effort"}
        and value_for(parameters.most, joint) is None
        and np.isnan(_stall(servo))
    ):
        yield Mismatch(f"needs the highest effort of {joint}", "write most, in the unit of its effort", joint)


def _key(name: str, value: object) -> str:
    return name if value is not None else ""
