"""pid_controller: leads joints to positions or velocities by a PID law, alone or below another controller."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dxlrun import (
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Mistake,
)
from dxlrun.messages import Header
from dxlrun_controllers.group import PositionsCommand, VelocitiesCommand
from dxlrun_controllers.joints import (
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
    """What the joints are led to."""
    command_interface: Literal["effort", "velocity", "pwm", "position"] = "effort"
    """What is commanded. `position` adds the law to the reference: it removes what a servo's own control
    leaves."""
    gains: Gains
    output_limit: PerJoint[Positive] | None = None
    """Largest magnitude of the command, beside the joint's own limits; with `position` of the correction."""
    integral_limit: PerJoint[NotNegative] | None = None
    """Largest magnitude of the integral term, in units of the command."""
    derivative_filter: Duration = 0
    """Time constant of the filter on the error's rate."""
    wrap: tuple[str, ...] = ()
    """Joints whose position error is taken the shorter way round, -pi..pi: continuous joints that shall face
    a direction. Without it one turn more is one turn more."""

    _own_velocity = model_validator(mode="before")(feed_velocities_forward)

    def mistakes(self) -> Iterator[Mistake]:
        """Yield references that the command interface or `wrap` does not fit."""
        yield from super().mistakes()
        if self.reference == "velocity" and self.command_interface == "position":
            what = "a velocity reference cannot be commanded as positions"
            yield ("command_interface",), f"{what}; command effort, velocity or pwm"
        if self.reference == "velocity" and self.wrap:
            yield ("wrap",), "velocities do not wrap; take wrap out, or take the reference position"


_KIND: Final = {"position": "positions", "velocity": "velocities"}


STATE_NS: Final = 20_000_000
"""Between two messages of the state, ns."""


@dataclass(slots=True)
class PidState:
    """What the law sees and does; rows in the order of the controller's joints."""

    header: Header
    reference: Floats
    """rad or rad/s, as the measurement and the error"""
    measurement: Floats
    error: Floats
    error_rate: Floats
    """Filtered: rad/s or rad/s^2"""
    proportional: Floats
    """In units of the command, as all that follow"""
    integral: Floats
    derivative: Floats
    feed_forward: Floats
    output: Floats
    """What is commanded"""


class PidController(Controller[PidParameters]):
    """Commands by a PID law on the error of a reference (`pid.Pid`), once each period, with its true length.

    - References: what controllers that are `into` this one command (`position` with `velocity` as its rate,
      or `velocity`; `effort` and `pwm` are added to a commanded one), else the newest `positions` or
      `velocities` command, else the positions at which the joints were when it became active or the last
      reference ended, or the velocity 0.
    - The derivative is that of the error: reference velocity minus measured velocity. A position reference
      without a velocity counts as one at rest, so a step in it makes no kick. Of a velocity reference only
      the measured rate counts: the difference of the measured velocities.
    - The output stays inside the joint's own limit of what is commanded (effort, velocity, position, full
      voltage), so the law knows when the last gate would cut it, and its integral does not wind up.
    - A joint without a new measurement keeps its last command, see `Pid`, with `position` its last
      correction of the reference; one that was never measured gets
      none of its own (0; no position).
    - While a joint is lost, the others are held where the last reference was, or at rest.

    Behaves like pid_controller of ros2_controllers (control.ros.org, pid_controller) where that has the
    same; it is also the joint_position_controller.
    """

    Parameters = PidParameters
    Commands: ClassVar = {
        "positions": PositionsCommand,
        "velocities": VelocitiesCommand,
    }
    Topics: ClassVar = {"state": PidState}

    @classmethod
    def interfaces(cls, parameters: PidParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command one interface; export the reference, its rate, and an effort or PWM to add."""
        position = ("position", "velocity") if parameters.reference == "position" else ("velocity",)
        added = (parameters.command_interface,) if parameters.command_interface in {"effort", "pwm"} else ()
        return Interfaces(parameters.joints, (parameters.command_interface,), reference=(*position, *added))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: PidParameters) -> NDArray[np.float64]:
        """Return the set-points, shape (joints,). Raises ValueError for the other kind or a wrong size."""
        if kind != (own := _KIND[parameters.reference]):
            raise ValueError(f"its reference is the {parameters.reference}, so it takes {own}, not {kind}")
        return super().prepare(kind, command, parameters)

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
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
            Header(),
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
        """Take the gains."""
        gains, joints = self.parameters.gains, self.context.joints
        self._pid.take(gains, joints)
        self._feed_forward = row_of(gains.feed_forward, joints, 0.0)

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints where they are; what was commanded before stays the output, but for the mode."""
        goals, pid = self.context.goals, self._pid
        self._setpoint.fill(np.nan if self._by_position else 0.0)
        self._reference.fill(np.nan)
        self._state_ns = time_ns
        self._slope.reset()
        self._refer()
        if self.parameters.command_interface == "position":
            # the servo's goal is above where its load lets it be: that much is the correction
            before = goals.position - self._reference
            self._output.fill(np.nan)
        else:
            before = getattr(goals, self.parameters.command_interface)
            self._output.fill(0.0)
        pid.reset(finite_or(before, 0.0), self._error, self._bias)

    def on_hold(self, time_ns: int) -> None:
        """Hold the joints where they are."""
        self.on_activate(time_ns)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take new set-points."""
        np.copyto(self._setpoint, data)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command by the law."""
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
        """Command the reference and its correction, which ends where the position limits do."""
        pid, reference = self._pid, self._reference
        pid.upper = np.minimum(self._upper - reference, self._most)
        pid.lower = np.maximum(self._lower - reference, -self._most)
        correction = pid.output
        if not self.context.states.has_lost:  # its goals are held then: an integral would only wind up
            correction = pid.update(self._error, self._rate, self._bias, self._measured, period_s)
        # a joint without a measurement keeps its correction, not the reference of then
        np.add(reference, correction, out=self._output, where=np.isfinite(reference))

    def _refer(self) -> None:
        """Set the reference, its error, the error's rate, and the feed-forward."""
        setpoint, error = self._setpoint, self._error
        states, references = self.context.states, self.context.references
        free = np.isnan(self._commanded)
        setpoint[free & self._chained] = np.nan if self._by_position else 0.0
        self._chained = ~free
        if self._by_position:
            np.copyto(setpoint, self._measurement, where=np.isnan(setpoint) & states.valid)
        wanted = np.where(free, setpoint, self._commanded)
        if states.has_lost:  # the joints are held where the last reference was
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
