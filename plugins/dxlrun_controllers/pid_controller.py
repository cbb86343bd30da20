"""pid_controller: PID control of joint positions or velocities, alone or below another controller."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from dxlrun import (
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Mistake,
)
from dxlrun.tooling.topics import messages
from dxlrun_controllers.group import PositionsCommand, VelocitiesCommand
from dxlrun_controllers.joint_parameters import (
    JointsParameters,
    NotNegative,
    PerJoint,
    Positive,
    finite_or,
    row_of,
    take_shorter_way,
)
from dxlrun_controllers.laws.pid import Gains, Pid, Slope, feed_velocities_forward


class PidParameters(JointsParameters):
    """Keys of a pid_controller in the robot file."""

    reference: Literal["position", "velocity"] = "position"
    """Controlled quantity."""
    command_interface: Literal["effort", "velocity", "pwm", "position"] = "effort"
    """Commanded interface. `position` adds the output of the law to the reference, which removes the error
    that the servo's own control leaves."""
    gains: Gains = Field(examples=["{p: 2.0}"])
    output_limit: PerJoint[Positive] | None = None
    """Largest magnitude of the command, in addition to the joint's own limits. With the interface `position`
    it limits the correction."""
    integral_limit: PerJoint[NotNegative] | None = None
    """Largest magnitude of the integral term, in units of the command."""
    derivative_filter: Duration = 0
    """Time constant of the low-pass filter on the rate of the error."""
    wrap: tuple[str, ...] = ()
    """Continuous joints that take the shorter way: their position error is wrapped to -pi..pi. Positions of
    all other joints count whole turns."""

    _own_velocity = model_validator(mode="before")(feed_velocities_forward)

    def mistakes(self) -> Iterator[Mistake]:
        """Yield a command interface or a `wrap` that does not fit the quantity `reference`."""
        yield from super().mistakes()
        if self.reference == "velocity" and self.command_interface == "position":
            what = "reference velocity does not fit command_interface position"
            yield ("command_interface",), f"{what}; write effort, velocity or pwm"
        if self.reference == "velocity" and self.wrap:
            yield ("wrap",), "velocities do not wrap; remove wrap, or use reference position"


_KIND: Final = {"position": "positions", "velocity": "velocities"}


STATE_NS: Final = 20_000_000
"""Time between two messages of the topic `state`, ns."""


@dataclass(slots=True)
class PidState:
    """Message of the topic `state`: inputs and outputs of the law, with one row per joint of the
    controller.
    """

    header: messages.Header
    reference: Floats
    """Reference in rad or rad/s; `measurement` and `error` have the same unit."""
    measurement: Floats
    error: Floats
    error_rate: Floats
    """Filtered rate of the error, rad/s or rad/s^2."""
    proportional: Floats
    """Proportional term, in units of the command, as are all fields that follow."""
    integral: Floats
    derivative: Floats
    feed_forward: Floats
    output: Floats
    """Command: the sum of the terms, clamped."""


class PidController(Controller[PidParameters]):
    """PID controller of joint positions or velocities. It runs once per period and uses its measured length.

    - The reference of a joint is, in this order: the command of a controller that is `into` this one; the
      newest command `positions` or `velocities`; the position at which the joint was when the controller
      became active or the last reference ended, or the velocity 0. A controller that is `into` this one
      commands `position` and its rate `velocity`, or only `velocity`. Its `effort` or `pwm` is added to the
      same interface.
    - The derivative acts on the error: reference velocity minus measured velocity. A position reference
      without a velocity counts as at rest, so a step in it causes no derivative kick. With a velocity
      reference only the rate of the measured velocity counts.
    - The output is clamped to the joint's limit of the commanded interface (effort, velocity, position, full
      voltage). The gate therefore does not cut it, and the integral does not wind up.
    - A joint without a new measurement keeps its last command, or its last correction with the interface
      `position` (see `Pid`). A joint that was never measured gets the output 0, or no position.
    - While a joint is lost, all other joints are held at their last reference, or at rest.

    The controller follows pid_controller of ros2_controllers (control.ros.org, pid_controller) where both
    have the same feature. It is also available as joint_position_controller.
    """

    Parameters = PidParameters
    Commands: ClassVar = {
        "positions": PositionsCommand,
        "velocities": VelocitiesCommand,
    }
    Topics: ClassVar = {"state": PidState}

    @classmethod
    def interfaces(cls, parameters: PidParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command one interface; export the reference, its rate, and an effort or PWM that is added."""
        position = ("position", "velocity") if parameters.reference == "position" else ("velocity",)
        added = (parameters.command_interface,) if parameters.command_interface in {"effort", "pwm"} else ()
        return Interfaces(parameters.joints, (parameters.command_interface,), reference=(*position, *added))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: PidParameters) -> NDArray[np.float64]:
        """Return the setpoints of a command, shape (joints,).

        Raises:
            ValueError: The command does not fit the reference, or the number of values is wrong.
        """
        if kind != (own := _KIND[parameters.reference]):
            raise ValueError(f"its reference is the {parameters.reference}; send {own} instead of {kind}")
        return super().prepare(kind, command, parameters)

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        count, limits, parameters = len(context.joints), context.limits, self.parameters
        self._pid = Pid(count)
        self._slope = Slope(count)
        self._pid.filter_s = parameters.derivative_filter * 1e-9
        self._pid.integral_limit = row_of(parameters.integral_limit, context.joints)
        most = row_of(parameters.output_limit, context.joints)
        own = {"effort": limits.effort, "velocity": limits.velocity, "pwm": np.ones(count)}
        if parameters.command_interface in own:
            most = np.minimum(most, finite_or(own[parameters.command_interface], np.inf))
        self._most = most
        self._pid.lower, self._pid.upper = -most, most
        self._lower, self._upper = limits.lower, limits.upper
        self._wrap = np.array([joint in parameters.wrap for joint in context.joints])
        states, references, commands = context.states, context.references, context.commands
        self._by_position = parameters.reference == "position"
        self._measurement: Floats = states.position if self._by_position else states.velocity
        self._commanded: Floats = references.position if self._by_position else references.velocity
        self._output: Floats = getattr(commands, parameters.command_interface)
        self._added: Floats | None = {"effort": references.effort, "pwm": references.pwm}.get(
            parameters.command_interface
        )
        self._setpoint, self._reference, self._error, self._rate, self._bias = np.zeros((5, count))
        self._chained = np.zeros(count, dtype=np.bool_)
        law = self._pid
        self._state = PidState(
            messages.Header(),
            self._reference,
            self._measurement,
            self._error,
            law.rate,
            law.proportional,
            law.integral,
            law.derivative,
            self._bias,
            self._output,
        )
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Set the gains of the law, which may have changed in the run."""
        gains, joints = self.parameters.gains, self.context.joints
        self._pid.set_gains(gains, joints)
        self._feed_forward = row_of(gains.feed_forward, joints, 0.0)

    def on_activate(self, time_ns: int) -> None:
        """Take the present positions, or velocity 0, as reference; the output continues from the last
        command.
        """
        goals, pid = self.context.goals, self._pid
        self._setpoint.fill(np.nan if self._by_position else 0.0)
        self._reference.fill(np.nan)
        self._state_ns = time_ns
        self._slope.reset()
        self._refer()
        if self.parameters.command_interface == "position":
            # Under load, the last goal differs from the position. This offset becomes the first correction.
            before = goals.position - self._reference
            self._output.fill(np.nan)
        else:
            before = getattr(goals, self.parameters.command_interface)
            self._output.fill(0.0)
        pid.reset(finite_or(before, 0.0), self._error, self._bias)

    def on_hold(self, time_ns: int) -> None:
        """Take the present positions, or velocity 0, as reference again."""
        self.on_activate(time_ns)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Set new setpoints, used for joints that no other controller commands."""
        np.copyto(self._setpoint, data)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Compute the output of the law and command it; publish the state."""
        period_s = period_ns * 1e-9
        self._refer()
        if not self._by_position:
            measured_rate = self._slope.update(self._measurement, self._measured, period_s)
            np.negative(measured_rate, out=self._rate)
        if self.parameters.command_interface == "position":
            self._correct(period_s)
        else:
            output = self._pid.update(self._error, self._rate, self._bias, self._measured, period_s)
            np.copyto(self._output, output)
        if time_ns >= self._state_ns:
            self._state_ns = time_ns + STATE_NS
            self.context.publish("state", self._state)

    def _correct(self, period_s: float) -> None:
        """Command the reference plus the law's output, clamped to the position limits."""
        pid, reference = self._pid, self._reference
        pid.upper = np.minimum(self._upper - reference, self._most)
        pid.lower = np.maximum(self._lower - reference, -self._most)
        correction = pid.output
        # The goals are held while a joint is lost, so the integral would wind up.
        if not self.context.states.has_lost:
            correction = pid.update(self._error, self._rate, self._bias, self._measured, period_s)
        # A joint without a measurement keeps its correction, but follows the present reference.
        np.add(reference, correction, out=self._output, where=np.isfinite(reference))

    def _refer(self) -> None:
        """Compute reference, error, rate of the error and feed-forward of this cycle."""
        setpoint, error = self._setpoint, self._error
        states, references = self.context.states, self.context.references
        free = np.isnan(self._commanded)
        setpoint[free & self._chained] = np.nan if self._by_position else 0.0
        self._chained = ~free
        if self._by_position:
            np.copyto(setpoint, self._measurement, where=np.isnan(setpoint) & states.valid)
        wanted = np.where(free, setpoint, self._commanded)
        if states.has_lost:  # hold the joints at their last reference
            held = self._reference if self._by_position else np.zeros_like(wanted)
            np.copyto(wanted, held, where=free & np.isfinite(held))
        np.copyto(self._reference, take_shorter_way(wanted, self._measurement, self._wrap))
        np.subtract(self._reference, self._measurement, out=error)
        self._measured = np.isfinite(error) & states.valid
        velocity = self._reference
        if self._by_position:
            velocity = finite_or(references.velocity, 0.0)
            np.subtract(velocity, states.velocity, out=self._rate)
        np.multiply(velocity, self._feed_forward, out=self._bias)
        if self._added is not None:
            self._bias += finite_or(self._added, 0.0)
