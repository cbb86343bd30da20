"""Messages of ROS 2: types for the topics of controllers, and parts for custom messages.

    from dataclasses import dataclass

    from dxlrun import Floats
    from dxlrun.tooling.topics import messages

    @dataclass
    class WaveState:
        header: messages.Header      # its stamp is set to the time of the cycle when it is published
        amplitude: float
        error: Floats

    class Wave(dxlrun.Controller[WaveParameters]):
        Topics = {"state": WaveState}

Each type has the fields of the published definition (common_interfaces, control_msgs); units: REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.messages.declared import Length as Length
from dxlrun.messages.declared import Number as Number

Floats = NDArray[np.float64]
Covariance = Annotated[Floats, Length(36)]
"""Covariance matrix of a pose or twist, 6 x 6 in row-major order: x, y, z, and rotation about X, Y, Z."""
Covariance3 = Annotated[Floats, Length(9)]
"""Covariance matrix, 3 x 3 in row-major order, about x, y, z. All 0: unknown; first element -1: the quantity
is not measured."""
Float32 = Annotated[float, Number("float32")]
Unsigned8 = Annotated[int, Number("uint8")]
Signed32 = Annotated[int, Number("int32")]
Unsigned32 = Annotated[int, Number("uint32")]


def _zeros(count: int) -> Callable[[], Floats]:
    return lambda: np.zeros(count)


def _no_cells() -> NDArray[np.float32]:
    return np.zeros(0, np.float32)


class Time(msgspec.Struct):
    """ROS 2 message with a point in time: seconds since 1970 and the remaining nanoseconds."""

    ros_type: ClassVar[str] = "builtin_interfaces/msg/Time"
    sec: Signed32 = 0
    nanosec: Unsigned32 = 0


class Duration(msgspec.Struct):
    """ROS 2 message with a span of time: seconds and the remaining nanoseconds."""

    ros_type: ClassVar[str] = "builtin_interfaces/msg/Duration"
    sec: Signed32 = 0
    nanosec: Unsigned32 = 0


class Header(msgspec.Struct):
    """ROS 2 message header: time and frame. The runtime sets the stamp of a first field `header`."""

    ros_type: ClassVar[str] = "std_msgs/msg/Header"
    stamp: Time = msgspec.field(default_factory=Time)
    frame_id: str = ""


# std_msgs


class Bool(msgspec.Struct):
    """ROS 2 message with a truth value."""

    ros_type: ClassVar[str] = "std_msgs/msg/Bool"
    data: bool = False


class Float64(msgspec.Struct):
    """ROS 2 message with a number of 64 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/Float64"
    data: float = 0.0


class Int32(msgspec.Struct):
    """ROS 2 message with a signed integer of 32 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/Int32"
    data: Signed32 = 0


class UInt32(msgspec.Struct):
    """ROS 2 message with an unsigned integer of 32 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/UInt32"
    data: Unsigned32 = 0


class Int64(msgspec.Struct):
    """ROS 2 message with a signed integer of 64 bits."""

    ros_type: ClassVar[str] = "std_msgs/msg/Int64"
    data: int = 0


class String(msgspec.Struct):
    """ROS 2 message with a text."""

    ros_type: ClassVar[str] = "std_msgs/msg/String"
    data: str = ""


class MultiArrayDimension(msgspec.Struct):
    """Name, size and stride of one dimension of a ROS 2 array message."""

    ros_type: ClassVar[str] = "std_msgs/msg/MultiArrayDimension"
    label: str = ""
    size: Unsigned32 = 0
    stride: Unsigned32 = 0


class MultiArrayLayout(msgspec.Struct):
    """Dimensions of a ROS 2 array message, and where its data begin."""

    ros_type: ClassVar[str] = "std_msgs/msg/MultiArrayLayout"
    dim: tuple[MultiArrayDimension, ...] = ()
    data_offset: Unsigned32 = 0


class Float64MultiArray(msgspec.Struct):
    """ROS 2 message with an array of several dimensions; `data` has the numbers, `layout` the dimensions."""

    ros_type: ClassVar[str] = "std_msgs/msg/Float64MultiArray"
    layout: MultiArrayLayout = msgspec.field(default_factory=MultiArrayLayout)
    data: Floats = msgspec.field(default_factory=_zeros(0))


# geometry_msgs


class Vector3(msgspec.Struct):
    """A vector in m, m/s, N or the unit of the enclosing message."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Vector3"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Point(msgspec.Struct):
    """A position, m."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Point"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(msgspec.Struct):
    """A rotation as a unit quaternion."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Quaternion"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Pose(msgspec.Struct):
    """A position, m, and a rotation."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Pose"
    position: Point = msgspec.field(default_factory=Point)
    orientation: Quaternion = msgspec.field(default_factory=Quaternion)


class PoseWithCovariance(msgspec.Struct):
    """A pose and its covariance."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose = msgspec.field(default_factory=Pose)
    covariance: Covariance = msgspec.field(default_factory=_zeros(36))


class Twist(msgspec.Struct):
    """Linear and angular velocity: m/s and rad/s."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Twist"
    linear: Vector3 = msgspec.field(default_factory=Vector3)
    angular: Vector3 = msgspec.field(default_factory=Vector3)


class TwistWithCovariance(msgspec.Struct):
    """Linear and angular velocity and their covariance."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/TwistWithCovariance"
    twist: Twist = msgspec.field(default_factory=Twist)
    covariance: Covariance = msgspec.field(default_factory=_zeros(36))


class Wrench(msgspec.Struct):
    """A force, N, and a torque, Nm."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/Wrench"
    force: Vector3 = msgspec.field(default_factory=Vector3)
    torque: Vector3 = msgspec.field(default_factory=Vector3)


class WrenchStamped(msgspec.Struct):
    """A force, N, and a torque, Nm, at the origin of the header's frame."""

    ros_type: ClassVar[str] = "geometry_msgs/msg/WrenchStamped"
    header: Header = msgspec.field(default_factory=Header)
    wrench: Wrench = msgspec.field(default_factory=Wrench)


# nav_msgs, sensor_msgs, trajectory_msgs


class Odometry(msgspec.Struct):
    """Pose in the frame of the header, and velocities in the child frame."""

    ros_type: ClassVar[str] = "nav_msgs/msg/Odometry"
    header: Header = msgspec.field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = msgspec.field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = msgspec.field(default_factory=TwistWithCovariance)


class JointState(msgspec.Struct):
    """States of joints by `name`: rad, rad/s, Nm; an element per joint in each array, or an empty array."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/JointState"
    header: Header = msgspec.field(default_factory=Header)
    name: tuple[str, ...] = ()
    position: Floats = msgspec.field(default_factory=_zeros(0))
    velocity: Floats = msgspec.field(default_factory=_zeros(0))
    effort: Floats = msgspec.field(default_factory=_zeros(0))


class Imu(msgspec.Struct):
    """Orientation in a fixed frame; rad/s and m/s^2 (at rest +9.81 upwards) in the frame of the header."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/Imu"
    header: Header = msgspec.field(default_factory=Header)
    orientation: Quaternion = msgspec.field(default_factory=Quaternion)
    orientation_covariance: Covariance3 = msgspec.field(default_factory=_zeros(9))
    angular_velocity: Vector3 = msgspec.field(default_factory=Vector3)
    angular_velocity_covariance: Covariance3 = msgspec.field(default_factory=_zeros(9))
    linear_acceleration: Vector3 = msgspec.field(default_factory=Vector3)
    linear_acceleration_covariance: Covariance3 = msgspec.field(default_factory=_zeros(9))


class MagneticField(msgspec.Struct):
    """A magnetic field, T, in the frame of the header."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/MagneticField"
    header: Header = msgspec.field(default_factory=Header)
    magnetic_field: Vector3 = msgspec.field(default_factory=Vector3)
    magnetic_field_covariance: Covariance3 = msgspec.field(default_factory=_zeros(9))


class Range(msgspec.Struct):
    """A distance, m, within a cone of `field_of_view` rad; as in ROS 2 Humble, without a variance."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/Range"
    header: Header = msgspec.field(default_factory=Header)
    radiation_type: Unsigned8 = 0
    """Kind of sensor. 0: ultrasound, 1: infrared"""
    field_of_view: Float32 = 0.0
    min_range: Float32 = 0.0
    max_range: Float32 = 0.0
    range: Float32 = 0.0


class FluidPressure(msgspec.Struct):
    """An absolute pressure, Pa; variance 0 is unknown."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/FluidPressure"
    header: Header = msgspec.field(default_factory=Header)
    fluid_pressure: float = 0.0
    variance: float = 0.0


class Temperature(msgspec.Struct):
    """A temperature, degC; variance 0 is unknown."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/Temperature"
    header: Header = msgspec.field(default_factory=Header)
    temperature: float = 0.0
    variance: float = 0.0


class BatteryState(msgspec.Struct):
    """A battery: V, degC, A (negative: discharging), Ah, and 0..1; NaN: not measured."""

    ros_type: ClassVar[str] = "sensor_msgs/msg/BatteryState"
    header: Header = msgspec.field(default_factory=Header)
    voltage: Float32 = math.nan
    temperature: Float32 = math.nan
    current: Float32 = math.nan
    charge: Float32 = math.nan
    capacity: Float32 = math.nan
    design_capacity: Float32 = math.nan
    percentage: Float32 = math.nan
    power_supply_status: Unsigned8 = 0
    """State of charging. 0: unknown, 1: charging, 2: discharging, 3: not charging, 4: full"""
    power_supply_health: Unsigned8 = 0
    """Health of the battery. 0: unknown, 1: good, 2: overheat, 3: dead, 4: overvoltage"""
    power_supply_technology: Unsigned8 = 0
    """Battery type. 0: unknown, 1: NiMH, 2: Li-ion, 3: LiPo, 4: LiFe, 5: NiCd, 6: LiMn"""
    present: bool = True
    cell_voltage: NDArray[np.float32] = msgspec.field(default_factory=_no_cells)
    cell_temperature: NDArray[np.float32] = msgspec.field(default_factory=_no_cells)
    location: str = ""
    serial_number: str = ""


class JointTrajectoryPoint(msgspec.Struct):
    """Point of a joint trajectory, with its time: one element per joint in each array, or an empty array."""

    ros_type: ClassVar[str] = "trajectory_msgs/msg/JointTrajectoryPoint"
    positions: Floats = msgspec.field(default_factory=_zeros(0))
    velocities: Floats = msgspec.field(default_factory=_zeros(0))
    accelerations: Floats = msgspec.field(default_factory=_zeros(0))
    effort: Floats = msgspec.field(default_factory=_zeros(0))
    time_from_start: Duration = msgspec.field(default_factory=Duration)
