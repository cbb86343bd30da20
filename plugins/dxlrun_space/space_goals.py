"""Goals: poses and twists as clients write them, and as flat arrays for the loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final, Literal, Self

import msgspec
import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, model_validator

from dxlrun import Angle, AngularVelocity, CommandModel, Floats, Length, LinearVelocity
from dxlrun_space.chain import (
    Pose,
    Quaternion,
    Rotation,
    Vector,
    compose,
    inverted,
    rotation_of,
    times,
    turned,
)

NORM: Final = 1e-3
"""Largest difference of a quaternion's length from 1: three decimals of each number."""
_LONGEST_NAME: Final = 200
_CENTRE: Final[Vector] = (0.0, 0.0, 0.0)


def _number(adapter: TypeAdapter[float]) -> BeforeValidator:
    """Return a validator that converts a text with a unit to SI; a number is SI already."""
    return BeforeValidator(lambda value: adapter.validate_python(value) if isinstance(value, str) else value)


_angle: Final = TypeAdapter(Angle)


def _angles(value: object) -> object:
    """Convert three angles, as a list or as `0, 90 deg, 0`, to rad; 0 needs no unit."""
    parts = value.split(",") if isinstance(value, str) else value
    if not isinstance(parts, list | tuple):
        return value
    return tuple(_rad(part.strip() if isinstance(part, str) else part) for part in parts)


def _floats(value: object) -> object:
    """Convert numbers with commas between them, and a list."""
    try:
        return tuple(map(float, value.split(","))) if isinstance(value, str) else _tuple(value)
    except ValueError:
        return value


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _rad(value: object) -> object:
    if isinstance(value, str):
        value = 0.0 if value in ("0", "0.0") else _angle.validate_python(value)
    if isinstance(value, int | float) and abs(value) > 2 * math.pi:
        raise ValueError(f"{value:g} rad is more than a turn; write the unit, such as {value:g}deg")
    return value


_range = Field(ge=-100, le=100)  # beyond, products overflow to infinity and then to NaN
_Metres = Annotated[float, _number(TypeAdapter(Length)), _range]
_Speed = Annotated[float, _number(TypeAdapter(LinearVelocity)), _range]
_Turn = Annotated[float, _number(TypeAdapter(AngularVelocity)), _range]
_Angles = Annotated[tuple[float, float, float], BeforeValidator(_angles)]
_Frame = Annotated[str, Field(max_length=_LONGEST_NAME)]


class PoseCommand(CommandModel):
    """Goal pose of the tip. A coordinate that is not given keeps its value at the start"""

    x: _Metres | None = None
    """Goal position in the frame, m"""
    y: _Metres | None = None
    z: _Metres | None = None
    dx: _Metres | None = None
    """Distance from the position at the start, along the axes of the frame, m"""
    dy: _Metres | None = None
    dz: _Metres | None = None
    rpy: _Angles | None = None
    """Goal orientation in the frame: roll, pitch and yaw about its x, y and z axes, in this order, rad.
    Without an orientation the tip keeps the present one as far as the arm can"""
    drpy: _Angles | None = None
    """Turn from the orientation at the start about the axes of the frame, rad"""
    quaternion: Annotated[tuple[float, float, float, float], BeforeValidator(_floats)] | None = None
    """Goal orientation in the frame: x, y, z, w"""
    frame: _Frame = ""
    """Link in whose axes, at the start, all values are; empty: the base of the controller"""
    path: Literal["line", "joints"] = "line"
    """`line` moves the tip on a straight line, `joints` turns all joints evenly"""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """Duration of the motion, s; without one it is the shortest within the limits"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for axis in "xyz":
            if getattr(self, axis) is not None and getattr(self, f"d{axis}") is not None:
                raise ValueError(f"give either {axis} or d{axis}")
        turns = (self.rpy, self.drpy, self.quaternion)
        if sum(each is not None for each in turns) > 1:
            raise ValueError("give only one of rpy, drpy and quaternion")
        if all(each is None for each in (self.x, self.y, self.z, self.dx, self.dy, self.dz, *turns)):
            raise ValueError("give a coordinate or an orientation, such as dz=5cm")
        if self.quaternion is not None and abs(math.hypot(*self.quaternion) - 1) > NORM:
            raise ValueError(
                f"the quaternion has length {math.hypot(*self.quaternion):.4g}; scale it to length 1"
            )
        return self


class TwistCommand(CommandModel):
    """Velocity of the tip, valid until `timeout` of the controller"""

    vx: _Speed = 0.0
    """Velocity along the axes of the frame, m/s"""
    vy: _Speed = 0.0
    vz: _Speed = 0.0
    wx: _Turn = 0.0
    """Angular velocity about the axes of the frame, rad/s"""
    wy: _Turn = 0.0
    wz: _Turn = 0.0
    frame: _Frame = ""
    """Link whose axes are meant; those of the tip turn with it. Empty: the base of the controller"""


class PoseGoal(msgspec.Struct, frozen=True):
    """A prepared pose: values in the axes of a frame; NaN: not given."""

    place: Vector
    way: Vector
    rotation: Quaternion | None
    turn: Quaternion
    by_line: bool
    seconds: float
    frame: str

    @property
    def asks_orientation(self) -> bool:
        """True if the goal has an orientation, absolute or relative."""
        return self.rotation is not None or self.turn[3] != 1.0

    def target(self, frame: Pose, tip: Pose) -> Pose:
        """Return the goal pose in the base from the poses of the frame and of the tip at the start."""
        back = inverted(frame[0])
        x, y, z = (a - b for a, b in zip(tip[1], frame[1], strict=True))
        present = turned(back, (x, y, z))
        place = tuple(
            (now if math.isnan(goal) else goal) + way
            for now, goal, way in zip(present, self.place, self.way, strict=True)
        )
        rotation = times(back, tip[0]) if self.rotation is None else rotation_of(self.rotation)
        a, b, c = place
        return compose(frame, (times(rotation_of(self.turn), rotation), (a, b, c)))


def flat_pose(command: PoseCommand) -> Floats:
    """Return a pose command as an array: numbers, then the bytes of the frame's name."""
    place = [math.nan if each is None else each for each in (command.x, command.y, command.z)]
    way = [each or 0.0 for each in (command.dx, command.dy, command.dz)]
    rotation = [math.nan] * 4
    if command.rpy is not None:
        rotation = [*_quaternion(command.rpy)]
    elif command.quaternion is not None:
        length = math.hypot(*command.quaternion)
        rotation = [each / length for each in command.quaternion]
    turn = _quaternion(command.drpy or _CENTRE)
    more = [float(command.path == "line"), math.nan if command.seconds is None else command.seconds]
    return np.array([*place, *way, *rotation, *turn, *more, *command.frame.encode()], dtype=np.float64)


def read_pose(data: Floats) -> PoseGoal:
    """Return the goal of an array of `flat_pose`."""
    a, b, c, d, e, f, x, y, z, w, i, j, k, r, line, seconds = data[:16].tolist()
    rotation = None if math.isnan(w) else (x, y, z, w)
    return PoseGoal((a, b, c), (d, e, f), rotation, (i, j, k, r), line != 0, seconds, _name(data[16:]))


def flat_twist(command: TwistCommand) -> Floats:
    """Return a twist command as an array: linear and angular velocity, then the frame's name."""
    linear, angular = (command.vx, command.vy, command.vz), (command.wx, command.wy, command.wz)
    return np.array([*linear, *angular, *command.frame.encode()], dtype=np.float64)


def read_twist(data: Floats) -> tuple[Vector, Vector, str]:
    """Return linear velocity, angular velocity and frame of an array of `flat_twist`."""
    a, b, c, d, e, f = data[:6].tolist()
    return (a, b, c), (d, e, f), _name(data[6:])


def _name(codes: Floats) -> str:
    return bytes(map(int, codes.tolist())).decode()


def _quaternion(rpy: Sequence[float]) -> Quaternion:
    from dxlrun.tooling.robots import from_rpy

    roll, pitch, yaw = rpy
    return from_rpy((roll, pitch, yaw))


def in_axes(rotation: Rotation, linear: Vector, angular: Vector) -> tuple[Vector, Vector]:
    """Return a twist, given in the axes of a frame, in the base."""
    return turned(rotation, linear), turned(rotation, angular)
