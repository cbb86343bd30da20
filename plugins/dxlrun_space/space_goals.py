"""Goals: poses and twists as clients write them, and as the loop gets them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self, TypeVar

import msgspec
import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, model_validator

from dxlrun import Angle, AngularVelocity, CommandModel, Floats, GoalPose, Length, LinearVelocity
from dxlrun.tooling.robots import Transform, product
from dxlrun_space.chain import Quaternion, Vector
from dxlrun_space.pose_form import at_most_a_turn, rotation_of

S = TypeVar("S", bound=msgspec.Struct)


class TipGoal(msgspec.Struct, frozen=True, array_like=True):
    """Goal pose of the tip in the axes of a frame, prepared for the loop."""

    place: tuple[float | None, float | None, float | None]
    """Position, m; None: the one at the start."""
    way: Vector
    """Distance from `place`, m."""
    rotation: Quaternion | None
    """Orientation, or a turn from the one at the start; None: the one at the start as far as the arm can."""
    is_turn: bool
    frame: str
    path: Literal["line", "joints"]
    seconds: float | None
    """Duration, s; None: the shortest."""
    positions: tuple[float, ...]
    """Positions of the joints, rad or m, in place of all above; empty: not given."""
    remark: str = ""
    """Part of the pose that these positions do not reach; empty: none."""

    def target(self, frame: Transform, tip: Transform) -> Transform:
        """Return the goal pose in the base from the poses of the frame and of the tip at the start."""
        present = frame.inverse @ tip
        x, y, z = (
            (now if goal is None else goal) + way
            for now, goal, way in zip(present.translation, self.place, self.way, strict=True)
        )
        turned = product(self.rotation, present.rotation) if self.rotation and self.is_turn else self.rotation
        return frame @ Transform((x, y, z), turned or present.rotation)


class TipTwist(msgspec.Struct, frozen=True, array_like=True):
    """Velocity of the tip in the axes of a frame, prepared for the loop."""

    linear: Vector  # m/s
    angular: Vector  # rad/s
    frame: str


def _si(adapter: TypeAdapter[float]) -> BeforeValidator:
    """Return a validator that converts a text to SI by its unit; a number is SI already."""
    return BeforeValidator(lambda value: adapter.validate_python(value) if isinstance(value, str) else value)


def _rad(value: object) -> object:
    """Convert an angle; 0 needs no unit, and more than a turn is deg without its unit."""
    if isinstance(value, str):
        value = 0.0 if value.strip() in ("0", "0.0") else TypeAdapter(Angle).validate_python(value)
    return at_most_a_turn(value) if isinstance(value, int | float) else value


def _items(value: object) -> object:
    """Split a text such as `0, 90 deg, 0` at its commas."""
    value = value.split(",") if isinstance(value, str) else value
    return tuple(value) if isinstance(value, list) else value


_range = Field(ge=-100, le=100)  # beyond, products overflow to infinity and then to NaN
_Metres = Annotated[float, _si(TypeAdapter(Length)), _range]
_Speed = Annotated[float, _si(TypeAdapter(LinearVelocity)), _range]
_Turn = Annotated[float, _si(TypeAdapter(AngularVelocity)), _range]
_Rad = Annotated[float, BeforeValidator(_rad)]
_Angles = Annotated[tuple[_Rad, _Rad, _Rad], BeforeValidator(_items)]
_Real = Annotated[float, _si(TypeAdapter(float))]
_Four = Annotated[tuple[_Real, _Real, _Real, _Real], BeforeValidator(_items)]
_Frame = Annotated[str, Field(max_length=200)]


class PoseCommand(CommandModel):
    """Goal pose of the tip. A coordinate that is not given keeps its value at the start"""

    pose: GoalPose | None = None
    """Name of a pose of the robot file, in place of the coordinates; all joints turn evenly to it"""
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
    quaternion: _Four | None = None
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
                raise ValueError(f"{axis} and d{axis} exclude each other; omit one of them")
        turns = (self.rpy, self.drpy, self.quaternion)
        given = any(each is not None for each in (self.x, self.y, self.z, self.dx, self.dy, self.dz, *turns))
        if self.pose is not None:
            if given or self.frame or "path" in self.model_fields_set:
                raise ValueError("a pose by name has no other coordinates, frame or path; remove them")
            return self
        if not given:
            raise ValueError("the pose is empty; give a coordinate or an orientation, for example dz=5cm")
        rotation_of(self.quaternion, self.rpy, self.drpy)
        return self

    def prepared(self, joints: Sequence[str]) -> TipGoal:
        """Return the goal of an arm with these joints; raise ValueError if the named pose lacks one."""
        named = None if self.pose is None else self.pose.positions
        if named is not None and (lacking := [joint for joint in joints if joint not in named]):
            raise ValueError(f"the pose has no position of {', '.join(lacking)}; name a pose of this arm")
        return TipGoal(
            place=(self.x, self.y, self.z),
            way=(self.dx or 0.0, self.dy or 0.0, self.dz or 0.0),
            rotation=rotation_of(self.quaternion, self.rpy, self.drpy),
            is_turn=self.drpy is not None,
            frame=self.frame,
            path=self.path,
            seconds=self.seconds,
            positions=() if named is None else tuple(named[joint] for joint in joints),
            remark=self.pose.remark if self.pose else "",
        )


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

    def prepared(self, joints: Sequence[str]) -> TipTwist:
        """Return the twist for the loop."""
        return TipTwist((self.vx, self.vy, self.vz), (self.wx, self.wy, self.wz), self.frame)


def packed(prepared: TipGoal | TipTwist) -> Floats:
    """Return a goal or twist as an array for the loop: one number per byte of its MessagePack."""
    return np.frombuffer(msgspec.msgpack.encode(prepared), np.uint8).astype(np.float64)


def unpacked(data: Floats, kind: type[S]) -> S:
    """Return the goal or twist in an array of `packed`."""
    return msgspec.msgpack.decode(data.astype(np.uint8).tobytes(), type=kind)
