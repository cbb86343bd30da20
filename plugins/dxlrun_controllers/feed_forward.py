"""feed_forward: adds to a motion what its servos need for it, by the models of their motors."""

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
from dxlrun.messages import Header
from dxlrun_controllers.joints import (
    JointsParameters,
    PerJoint,
    Positive,
    clamped,
    finite_or,
    refer,
    row_of,
)
from dxlrun_controllers.laws.feed_forward import NEEDED_FIGURES, InverseServo, MotionAhead, output_per_need

STATE_NS: Final = 20_000_000
"""Between two messages of the state, ns."""


class FeedForwardParameters(JointsParameters):
    """Keys of a feed_forward in the robot file."""

    command_interface: Literal["position", "effort", "pwm"] = "position"
    """`position`: the reference, and as much beside it that the servo's own control gives the duty that is
    needed; `effort`, `pwm`: the torque in the unit of the servo's effort, or the duty, and nothing else."""
    pass_on: bool = False
    """With `effort` and `pwm` command the reference's position and velocity, too, of a pid_controller."""
    scale: Annotated[PerJoint[Annotated[float, Field(ge=0, le=1)]], LIVE] = 1.0
    """Part of the feed-forward that is commanded; 0: `position` is the reference as it is."""
    most: PerJoint[Positive] | None = None
    """Largest magnitude of what is added (rad) or commanded (unit of the effort, part of full voltage)."""
    friction_speed: Annotated[AngularVelocity, Field(gt=0)] = 0.1
    """At this desired speed 3/4 of the friction is compensated, at rest nothing of it."""
    lead: Duration = 0
    """From the begin of a cycle to its goals' arrival at the servos: what `dxlrun check` shows as `waits`."""
    voltage_filter: Duration = 2_000_000_000
    """Time constant of the filter on the measured supply; 0: none."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield references that are passed on although they are commanded."""
        yield from super().mistakes()
        if self.pass_on and self.command_interface == "position":
            yield (
                ("pass_on",),
                "positions are commanded already; take pass_on out, or command effort or pwm",
            )


@dataclass(slots=True)
class FeedForwardState:
    """What the motion needs; rows in the order of the controller's joints."""

    header: Header
    velocity: Floats
    """rad/s, desired, as far ahead as goals take to act; so is what follows"""
    acceleration: Floats
    """rad/s^2"""
    torque: Floats
    """Nm of the motor"""
    duty: Floats
    """Part of the supply's voltage"""
    supply: Floats
    """V"""
    output: Floats
    """What is added (rad) or commanded"""


class FeedForward(Controller[FeedForwardParameters]):
    """Commands what a motion needs by the inverse of the servos' models (`laws.feed_forward`).

    - References: `position`, and `velocity` with its sign. Where none is commanded, the joints are at rest
      where the last reference was, or where they were when it became active.
    - It looks ahead by what a goal takes to act: `lead`, the motor's `delay`, and half a period for which the
      goal stays. Acceleration and look-ahead follow from the references' own differences: the one above
      should command the velocity too, and have the same rate.
    - The voltage is the measured one, filtered, or the motor file's until there is one.

    After M. Schwarz, S. Behnke, "Compliant Robot Behavior using Servo Actuator Models identified by Iterative
    Learning Control", RoboCup 2013: the servo's own position control is made to give the torque.
    """

    Parameters = FeedForwardParameters
    Topics: ClassVar = {"state": FeedForwardState}

    @classmethod
    def interfaces(cls, parameters: FeedForwardParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command one interface, perhaps the references beside it; export position and velocity."""
        passed = ("position", "velocity") if parameters.pass_on else ()
        return Interfaces(
            parameters.joints,
            (*passed, parameters.command_interface),
            reference=("position", "velocity"),
            motors=NEEDED_FIGURES[parameters.command_interface],
        )

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        parameters, joints, limits = self.parameters, context.joints, context.limits
        motors = [motor for motor in context.motors if motor is not None]
        if len(motors) < len(joints):
            raise ValueError("there is a joint without a motor file; `dxlrun identify` writes one")
        if parameters.pass_on and not context.into:
            raise ValueError("pass_on is for a controller below: write `into`, or take pass_on out")
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
            Header(),
            ahead.velocity,
            ahead.acceleration,
            inverse.torque,
            inverse.duty,
            inverse.supply.voltage,
            self._output,
        )
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Take the scale."""
        self._scale = row_of(self.parameters.scale, self.context.joints)

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints where they are."""
        self._reference.fill(np.nan)
        self._ahead.reset()
        self._inverse.supply.take(self.context.states.voltage, 1.0)
        self._state_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command what the reference needs."""
        context, ahead, inverse, output = self.context, self._ahead, self._inverse, self._output
        period_s = period_ns * 1e-9
        refer(self._reference, context)
        velocity = np.where(np.isfinite(context.references.position), context.references.velocity, 0.0)
        inverse.supply.take(context.states.voltage, period_s / (self._filter_s + period_s))
        ahead.update(self._reference, velocity, period_s)
        inverse.update(ahead.position, ahead.velocity, ahead.acceleration)
        np.copyto(inverse.duty, clamped(inverse.duty, -1.0, 1.0))
        added = self._need * self._per_need
        if self._position_mode:
            added = added + ahead.position - self._reference
        np.copyto(output, clamped(added * self._scale, -self._most, self._most))
        if self._position_mode:
            np.copyto(self._command, clamped(self._reference + output, self._lower, self._upper))
        else:  # without any position that was read there is nothing to hold
            np.copyto(self._command, finite_or(output, 0.0))
        if self.parameters.pass_on:
            np.copyto(context.commands.position, self._reference)
            np.copyto(context.commands.velocity, finite_or(velocity, 0.0))  # below it counts as at rest
        if time_ns >= self._state_ns:
            self._state_ns = time_ns + STATE_NS
            context.publish("state", self._state)
