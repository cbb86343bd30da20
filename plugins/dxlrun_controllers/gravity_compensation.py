"""gravity_compensation: add to references the torque that holds the weight of the links, from the URDF."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from dxlrun import (
    LINEAR,
    LIVE,
    ROTARY,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    JointUnit,
    Length,
    Mass,
    Mismatch,
    ParametersModel,
    RobotModel,
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
)
from dxlrun_controllers.laws.gravity import MOVABLE, TYPES, Bodies, bodies_of, gravity_law, up_of
from dxlrun_controllers.laws.inverse_model import NEEDED_FIGURES, Supply, output_per_need

STATE_NS: Final = 20_000_000
"""Time between two messages of the topic `state`, ns."""
_MOVE: Final[Mapping[JointUnit, str]] = {ROTARY: "turn", LINEAR: "slide"}


class PayloadParameters(ParametersModel):
    """Load that the robot carries and that its URDF does not include."""

    link: str = Field(examples=["gripper_link"])
    """Link that carries the payload."""
    mass: Annotated[Mass, Field(ge=0), LIVE]
    """Mass of the payload, kg."""
    position: Annotated[tuple[Length, ...], Field(min_length=3, max_length=3)] = (0.0, 0.0, 0.0)
    """Centre of mass of the payload in the axes of the link, m."""


class GravityParameters(JointsParameters):
    """Keys of a gravity_compensation in the robot file."""

    command_interface: Literal["position", "posvel", "effort", "pwm"] = "position"
    """`position` commands the reference plus an offset at which the servo's own control holds the weight;
    `posvel` also passes the velocity on. `effort` and `pwm` add the weight to the reference, or to 0."""
    scale: Annotated[PerJoint[Annotated[float, Field(ge=0, le=1)]], LIVE] = 1.0
    """Fraction of the weight that is compensated, 0..1."""
    most: PerJoint[Positive] | None = None
    """Largest magnitude that is added: rad, unit of the effort, or fraction of full voltage."""
    payload: PayloadParameters | None = None
    """Payload of the robot."""
    orientation: str | None = None
    """State with the orientation of the URDF's first link, such as `imu/orientation`. Without it, the link is
    assumed to be level."""
    voltage_filter: Duration = 2_000_000_000
    """Time constant of the filter on the measured supply voltage; 0 disables the filter."""


@dataclass(slots=True)
class GravityState:
    """Message of the topic `state`: the compensated weight, with one row per joint of the controller."""

    header: messages.Header
    torque: Floats
    """Torque that holds the weight, Nm."""
    output: Floats
    """Value that is added to the reference: rad, unit of the effort, or fraction of full voltage."""


class GravityCompensation(Controller[GravityParameters]):
    """Controller that compensates the weight of the links that its joints move (`laws.gravity`).

    Without it, a servo needs a position error to hold a weight. For `position`, the weight is computed at the
    desired positions, and a torque causes the same offset as in a feed_forward. For `effort` and `pwm`, the
    weight is computed at the measured positions. Without a reference, `position` holds the joints, while
    `effort` and `pwm` only carry the weight, so the arm floats. All other joints of the robot are taken into
    account at their measured positions.
    """

    Parameters = GravityParameters
    Topics: ClassVar = {"state": GravityState}

    @classmethod
    def interfaces(cls, parameters: GravityParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command and export the same interfaces; read the positions of all other joints, and the
        orientation.
        """
        interfaces = commanded_by(parameters.command_interface)
        source = parameters.orientation
        others = (f"{joint}/position" for joint in joints if joint not in parameters.joints)
        return Interfaces(
            parameters.joints,
            interfaces,
            reference=interfaces,
            reads=(*others, *(f"{source}.{axis}" for axis in "xyzw" if source is not None)),
            motors=NEEDED_FIGURES[interfaces[0]],
        )

    @classmethod
    def mismatches(cls, parameters: GravityParameters, robot: RobotModel) -> Iterator[Mismatch]:
        """Yield a missing requirement: MuJoCo, the URDF, a joint or a mass in it, or the link of the
        payload.
        """
        if importlib.util.find_spec("mujoco") is None:
            yield Mismatch(
                "needs MuJoCo, which is not installed", "`pip install 'dxlrun[physics]'` installs it"
            )
            return
        if robot.urdf is None:
            yield Mismatch("needs a URDF, but the robot file names none", "write `model: {urdf: NAME.urdf}`")
            return
        try:
            bodies = bodies_of(robot.urdf)
            found = [
                one
                for joint, unit in zip(robot.joints, robot.units, strict=True)
                for one in _of_joint(bodies, joint, unit)
            ]
            found += _of_payload(bodies, parameters, robot.joints)
            if not found:
                gravity_law(robot.urdf, robot.joints, 0, _hung(parameters))
        except ValueError as error:
            reason = " ".join(str(error).split())
            found = [Mismatch(f"cannot use the URDF: {reason}", "correct the URDF")]
        yield from found

    def on_configure(self, context: Context) -> None:
        """Build the gravity law of the URDF, and allocate all memory that the loop needs."""
        super().on_configure(context)
        parameters, joints, limits = self.parameters, context.joints, context.limits
        if context.urdf is None:
            raise ValueError("no URDF; write `model: {urdf: NAME.urdf}`")
        count, interface = len(joints), parameters.command_interface
        others = [name for name in context.read_names if name.endswith("/position")]
        self._others = len(others)
        names = (*joints, *(name.removesuffix("/position") for name in others))
        self._law = gravity_law(context.urdf, names, count, _hung(parameters))
        motors = [motor for motor in context.motors if motor is not None]
        self._supply = Supply(motors)
        self._filter_s = parameters.voltage_filter * 1e-9
        self._first = commanded_by(interface)[0]
        self._per_need = output_per_need(motors, self._first)
        self._most = row_of(parameters.most, joints)
        self._lower, self._upper = limits.lower, limits.upper
        self._command: Floats = getattr(context.commands, self._first)
        self._commanded: Floats = getattr(context.references, self._first)
        self._at = np.full(len(names), np.nan)
        """Positions at which the weight is computed, rad: the controller's joints, then all other joints."""
        self._up = np.array([0.0, 0.0, 1.0])
        self._reference, self._torque, self._output = np.zeros((3, count))
        # Velocity of `posvel` without a reference. A servo needs one above 0 to reach its goal position.
        self._rest = np.zeros(count) if context.into else finite_or(limits.velocity, 1.0)
        self._state = GravityState(messages.Header(), self._torque, self._output)
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Set the compensated fraction of the weight.

        A changed mass of the payload takes effect in the next update.
        """
        self._scale = row_of(self.parameters.scale, self.context.joints)

    def on_activate(self, time_ns: int) -> None:
        """Discard the past references, so that the joints are held where they are."""
        self._reference.fill(np.nan)
        self._supply.filter_voltage(self.context.states.voltage, 1.0)
        self._up[:] = (0.0, 0.0, 1.0)
        self._state_ns = time_ns

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the references plus the value that compensates the weight."""
        context, parameters, count = self.context, self.parameters, len(self._output)
        period_s = period_ns * 1e-9
        self._supply.filter_voltage(context.states.voltage, period_s / (self._filter_s + period_s))
        self._at[count:] = context.reads[: self._others]
        if parameters.orientation is not None:
            up_of(context.reads[self._others :], self._up)
        by_position = self._first == "position"
        if by_position:
            refer(self._reference, context)
            self._at[:count] = self._reference
        else:
            self._at[:count] = context.states.position
        payload = parameters.payload
        self._law(self._at, self._up, 0.0 if payload is None else payload.mass, self._torque)
        need = self._torque
        if self._first != "effort":
            need = clamped(self._supply.duty(need, 0.0), -1.0, 1.0)
        output = clamped(need * self._per_need * self._scale, -self._most, self._most)
        np.copyto(self._output, output)
        if by_position:
            self._command_positions()
        else:
            self._command_torques()
        if time_ns >= self._state_ns:
            self._state_ns = time_ns + STATE_NS
            context.publish("state", self._state)

    def _command_positions(self) -> None:
        context = self.context
        np.copyto(self._command, clamped(self._reference + self._output, self._lower, self._upper))
        if self.parameters.command_interface == "posvel":
            velocity = finite_or(context.references.velocity, self._rest)
            np.copyto(context.commands.velocity, velocity if context.into else np.abs(velocity))

    def _command_torques(self) -> None:
        self._output[np.isnan(self.context.states.position)] = 0.0  # no torque at an unknown position
        np.add(finite_or(self._commanded, 0.0), self._output, out=self._command)


def _hung(parameters: GravityParameters) -> tuple[str, tuple[float, ...]] | None:
    payload = parameters.payload
    return None if payload is None else (payload.link, payload.position)


def _of_joint(bodies: Bodies, joint: str, unit: JointUnit) -> Iterator[Mismatch]:
    """Yield the first problem of the URDF with a joint: missing, of the wrong type, or without a mass."""
    if joint not in bodies.joints:
        yield Mismatch(
            f"needs {joint}, but the URDF lacks it",
            "use the same joint names in both files",
            joint,
        )
        return
    if (kind := bodies.joints[joint].get("type")) not in MOVABLE:
        yield Mismatch(f"needs {joint} to move, but it is {kind} in the URDF", "make it revolute", joint)
        return
    if kind not in TYPES[unit]:
        yield Mismatch(
            f"needs {joint} to {_MOVE[unit]}, but it is {kind} in the URDF",
            f"make it {TYPES[unit][0]}",
            joint,
        )
        return
    unknown = [link for link in bodies.moved(joint) if link in bodies.shaped and bodies.masses[link] is None]
    if unknown:
        yield Mismatch(
            f"needs the mass of {', '.join(unknown)}, moved by {joint}, but the URDF has no <inertial> there",
            "write <inertial> with origin, mass and inertia into the link",
            joint,
        )
    elif not bodies.mass(joint):
        yield Mismatch(
            f"has nothing to hold at {joint}: it moves no mass in the URDF",
            "write <inertial> into the links after it, or remove the joint",
            joint,
        )


def _of_payload(bodies: Bodies, parameters: GravityParameters, joints: Sequence[str]) -> Iterator[Mismatch]:
    if parameters.payload is None:
        return
    link, at = parameters.payload.link, "payload.link"
    if link not in bodies.masses:
        known = ", ".join(bodies.masses)
        yield Mismatch(f"has its payload on {link}, but the URDF has no such link", f"use one of {known}", at)
    elif not any(link in bodies.moved(joint) for joint in joints if joint in bodies.joints):
        yield Mismatch(
            f"has its payload on {link}, but none of its joints moves {link}",
            "name a link after one of its joints",
            at,
        )
