"""Messages of ROS 2 for the topics of controllers, and what own messages are made of.

    from dataclasses import dataclass

    from dxlrun import Floats
    from dxlrun.messages import Header

    @dataclass
    class WaveState:
        header: Header      # its stamp is set to the time of the cycle when it is published
        amplitude: float
        error: Floats

    class Wave(dxlrun.Controller[WaveParameters]):
        Topics = {"state": WaveState}

Each is the published definition, field by field (common_interfaces, control_msgs); units: REP 103.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from dxlrun.messages.declared import Length, Number

__all__ = [
    "Bool",
    "Float64",
    "Float64MultiArray",
    "Header",
    "Int32",
    "Int64",
    "JointState",
    "JointTrajectoryPoint",
    "Length",
    "MultiArrayDimension",
    "MultiArrayLayout",
    "Number",
    "Odometry",
    "Point",
    "Pose",
    "PoseWithCovariance",
    "Quaternion",
    "String",
    "Time",
    "Twist",
    "TwistWithCovariance",
    "UInt32",
    "Vector3",
    "Wrench",
]

Floats = NDArray[np.float64]
Covariance = Annotated[Floats, Length(36)]
"""6 x 6, row by row: x, y, z, and rotation about X, Y, Z."""
Signed32 = Annotated[int, Number("int32")]
Unsigned32 = Annotated[int, Number("uint32")]


def _none() -> Floats:
    return np.zeros(0)


def _zeros() -> Floats:
    return np.zeros(36)


@dataclass(slots=True)
class Time:
    """A point in time: seconds since 1970 and the nanoseconds behind them."""

    ros_type: ClassVar[str] = "builtin_interfaces/msg/Time"
    sec: Signed32 = 0
    nanosec: Unsigned32 = 0


@dataclass(slots=True)
class Duration:
    """A span of time."""

    ros_type: ClassVar[str] = "builtin_interfaces/msg/Duration"
    sec: Signed32 = 0
    nanosec: Unsigned32 = 0


@dataclass(slots=True)
class Header:
    """Time and frame of a message; as its first field `header`, the runtime sets the stamp."""

    ros_type: ClassVar[str] = "std_msgs/msg/Header"
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


# std_msgs


@dataclass(slots=True)
class Bool:
    """A truth value."""

    ros_type: ClassVar[str] = "std_msgs/msg/Bool"
    data: bool = False


@dataclass(slots=True)
class Float64:
    """A number."""

    ros_type: ClassVar[str] = "std_msgs/msg/Float64"
    data: float = 0.0


@dataclass(slots=True)
class Int32:
    """A whole number of 32 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/Int32"
    data: Signed32 = 0


@dataclass(slots=True)
class UInt32:
    """A whole number of 32 bits without a sign."""

    ros_type: ClassVar[str] = "std_msgs/msg/UInt32"
    data: Unsigned32 = 0


@dataclass(slots=True)
class Int64:
    """A whole number of 64 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/Int64"
    data: int = 0


@dataclass(slots=True)
class String:
    """A text."""

    ros_type: ClassVar[str] = "std_msgs/msg/String"
    data: str = ""


@dataclass(slots=True)
class MultiArrayDimension:
    """One dimension of an array."""

    ros_type: ClassVar[str] = "std_msgs/msg/MultiArrayDimension"
    label: str = ""
    size: Unsigned32 = 0
    stride: Unsigned32 = 0


@dataclass(slots=True)
class MultiArrayLayout:
    """How the dimensions of an array lie in its numbers."""

    ros_type: ClassVar[str] = "std_msgs/msg/MultiArrayLayout"
    dim: tuple[MultiArrayDimension, ...] = ()
    data_offset: Unsigned32 = 0


@dataclass(slots=True)
class Float64MultiArray:
    """Numbers."""

    ros_type: ClassVar[str] = "std_msgs/msg/Float64MultiArray"
    layout: MultiArrayLayout = field(default_factory=MultiArrayLayout)
    data: Floats = field(default_factory=_none)


# geometry_msgs


@dataclass(slots=True)
class Vector3:
    """A vector; m, m/s, N or what the message around it says."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Vector3"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True)
class Point:
    """A position, m."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Point"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True)
class Quaternion:
    """A rotation as a unit quaternion."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Quaternion"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(slots=True)
class Pose:
    """A position, m, and a rotation."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Pose"
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(slots=True)
class PoseWithCovariance:
    """A pose and how sure it is."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose = field(default_factory=Pose)
    covariance: Covariance = field(default_factory=_zeros)


@dataclass(slots=True)
class Twist:
    """Velocities: m/s and rad/s."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Twist"
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass(slots=True)
class TwistWithCovariance:
    """Velocities and how sure they are."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/TwistWithCovariance"
    twist: Twist = field(default_factory=Twist)
    covariance: Covariance = field(default_factory=_zeros)


@dataclass(slots=True)
class Wrench:
    """A force, N, and a torque, Nm."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Wrench"
    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


# nav_msgs, sensor_msgs, trajectory_msgs


@dataclass(slots=True)
class Odometry:
    """Pose in the frame of the header, and velocities in that of the child."""

    ros_type: ClassVar[str] = "nav_msgs/msg/Odometry"
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass(slots=True)
class JointState:
    """States of joints: rad, rad/s, Nm; one row a name, or an empty array."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/JointState"
    header: Header = field(default_factory=Header)
    name: tuple[str, ...] = ()
    position: Floats = field(default_factory=_none)
    velocity: Floats = field(default_factory=_none)
    effort: Floats = field(default_factory=_none)


@dataclass(slots=True)
class JointTrajectoryPoint:
    """A point of a trajectory: one row a joint, or an empty array."""

    ros_type: ClassVar[str] = "trajectory_msgs/msg/JointTrajectoryPoint"
    positions: Floats = field(default_factory=_none)
    velocities: Floats = field(default_factory=_none)
    accelerations: Floats = field(default_factory=_none)
    effort: Floats = field(default_factory=_none)
    time_from_start: Duration = field(default_factory=Duration)
