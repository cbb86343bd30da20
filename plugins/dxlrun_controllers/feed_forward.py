"""feed_forward: add to a desired motion the torque that it needs, from the models of the servos' motors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from dxlrun import (
    LIVE,
    AngularVelocity,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Mistake,
)
from dxlrun.tooling.topics import messages
from dxlrun_controllers.joint_parameters import (
    JointsParameters,
    PerJoint,
    Positive,
    clamped,
    finite_or,
    refer,
    row_of,
)
from dxlrun_controllers.laws.inverse_model import NEEDED_FIGURES, InverseServo, MotionAhead, output_per_need

STATE_NS: Final = 20_000_000
"""Time between two messages of the topic `state`, ns."""


class FeedForwardParameters(JointsParameters):
    """Keys of a feed_forward in the robot file."""

    command_interface: Literal["position", "effort", "pwm"] = "position"
    """`position` commands the reference plus an offset, at which the servo's own control outputs the needed
    duty. `effort` and `pwm` command only the torque, in the unit of the servo's effort, or the duty."""
    pass_on: bool = False
    """With `effort` and `pwm`: also command position and velocity of the reference, for a pid_controller
    below."""
    scale: Annotated[PerJoint[Annotated[float, Field(ge=0, le=1)]], LIVE] = 1.0
    """Factor on the feed-forward, 0..1. With 0, `position` commands the unchanged reference."""
    most: PerJoint[Positive] | None = None
    """Largest magnitude of the offset (rad) or of the command (unit of the effort, fraction of full
    voltage)."""
    friction_speed: Annotated[AngularVelocity, Field(gt=0)] = 0.1
    """Desired speed at which 3/4 of the friction is compensated, rad/s. At rest, none is."""
    lead: Duration = 0
    """Time from the start of a cycle until its goals arrive at the servos; `dxlrun check` shows it as
    `waits`."""
    voltage_filter: Duration = 2_000_000_000
    """Time constant of the filter on the measured supply voltage; 0 disables the filter."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield the mistake of `pass_on` together with a command interface that commands positions anyway."""
        yield from super().mistakes()
        if self.pass_on and self.command_interface == "position":
            yield (
                ("pass_on",),
                "pass_on does not fit command_interface position; remove pass_on, or set command_interface "
                "to effort or pwm",
            )


@dataclass(slots=True)
class FeedForwardState:
    """Message of the topic `state`: the feed-forward, with one row per joint of the controller."""

    header: messages.Header
    velocity: Floats
    """Desired velocity, rad/s. Like all fields that follow, it is predicted for the time when the goal acts.
    """
    acceleration: Floats
    """Desired acceleration, rad/s^2."""
    torque: Floats
    """Torque of the motor that the motion needs, Nm."""
    duty: Floats
    """Duty that the motion needs, fraction of the supply voltage, -1..1."""
    supply: Floats
    """Filtered supply voltage, V."""
    output: Floats
    """Added offset of the position (rad), or command (unit of the effort, or fraction of full voltage)."""


class FeedForward(Controller[FeedForwardParameters]):
    """Controller that adds feed-forward to a motion by inverse models of the servos (`laws.feed_forward`).

    - References are `position` and the signed `velocity`. Without a reference, the joints rest at the last
      one, or where they were when the controller became active.
    - The motion is predicted for the time when a goal acts: after `lead`, the motor's `delay`, and half a
      period, because a goal is held for one. Acceleration and prediction are computed from differences of the
      references. The controller above should therefore also command the velocity, and run at the same rate.
    - The voltage is the filtered measurement, or that of the motor file until there is one.

    The method, in which the servo's own position control produces the torque, is from M. Schwarz, S. Behnke,
    "Compliant Robot Behavior using Servo Actuator Models identified by Iterative Learning Control",
    RoboCup 2013.
    """

    Parameters = FeedForwardParameters
    Topics: ClassVar = {"state": FeedForwardState}

    @classmethod
    def interfaces(cls, parameters: FeedForwardParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command one interface, with `pass_on` also the references. Export position and velocity."""
        passed = ("position", "velocity") if parameters.pass_on else ()
        return Interfaces(
            parameters.joints,
            (*passed, parameters.command_interface),
            reference=("position", "velocity"),
            motors=NEEDED_FIGURES[parameters.command_interface],
        )

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs. Raises ValueError for a joint without a motor file."""
        super().on_configure(context)
        parameters, joints, limits = self.parameters, context.joints, context.limits
        motors = [motor for motor in context.motors if motor is not None]
        if len(motors) < len(joints):
            lacking = [name for name, motor in zip(joints, context.motors, strict=True) if motor is None]
            raise ValueError(f"no motor file for {', '.join(lacking)}; write one with `dxlrun identify`")
        if parameters.pass_on and not context.into:
            raise ValueError("pass_on needs the key `into`; write `into`, or remove pass_on")
        count, interface = len(joints), parameters.command_interface
        self._ahead = MotionAhead(
            count, finite_or(limits.velocity, np.inf), finite_or(limits.acceleration, np.inf)
        )
        self._inverse = InverseServo(motors, np.full(count, parameters.friction_speed))
        acting_ns = [parameters.lead + motor.delay_ns + context.period_ns / 2 for motor in motors]
        np.multiply(acting_ns, 1e-9, out=self._ahead.ahead_s)
        self._filter_s = parameters.voltage_filter * 1e-9
        most = row_of(parameters.most, joints)
        self._per_need = output_per_need(motors, interface)
        if interface == "effort":
            most = np.minimum(most, finite_or(limits.effort, np.inf))
        self._most = most
        self._lower, self._upper = limits.lower, limits.upper
        self._need = self._inverse.torque if interface == "effort" else self._inverse.duty
        self._position_mode = interface == "position"
        self._command: Floats = getattr(context.commands, interface)
        self._reference, self._output = np.zeros((2, count))
        ahead, inverse = self._ahead, self._inverse
        self._state = FeedForwardState(
            messages.Header(),
            ahead.velocity,
            ahead.acceleration,
            inverse.torque,
            inverse.duty,
            inverse.supply.voltage,
            self._output,
        )
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Set the factor on the feed-forward, which may have changed in the run."""
        self._scale = row_of(self.parameters.scale, self.context.joints)

    def on_activate(self, time_ns: int) -> None:
        """Discard the past motion, so that the joints rest where they are until a reference is commanded."""
        self._reference.fill(np.nan)
        self._ahead.reset()
        self._inverse.supply.filter_voltage(self.context.states.voltage, 1.0)
        self._state_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Predict the reference motion, and command its feed-forward with or without the reference."""
        context, ahead, inverse, output = self.context, self._ahead, self._inverse, self._output
        period_s = period_ns * 1e-9
        refer(self._reference, context)
        velocity = np.where(np.isfinite(context.references.position), context.references.velocity, 0.0)
        inverse.supply.filter_voltage(context.states.voltage, period_s / (self._filter_s + period_s))
        ahead.update(self._reference, velocity, period_s)
        inverse.update(ahead.position, ahead.velocity, ahead.acceleration)
        np.copyto(inverse.duty, clamped(inverse.duty, -1.0, 1.0))
        added = self._need * self._per_need
        if self._position_mode:
            added = added + ahead.position - self._reference
        np.copyto(output, clamped(added * self._scale, -self._most, self._most))
        if self._position_mode:
            np.copyto(self._command, clamped(self._reference + output, self._lower, self._upper))
        else:  # 0 until the first position was read
            np.copyto(self._command, finite_or(output, 0.0))
        if self.parameters.pass_on:
            np.copyto(context.commands.position, self._reference)
            np.copyto(context.commands.velocity, finite_or(velocity, 0.0))  # 0: at rest
        if time_ns >= self._state_ns:
            self._state_ns = time_ns + STATE_NS
            context.publish("state", self._state)
