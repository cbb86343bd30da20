"""The standard controllers and sensors as a plug-in: the same hooks as any other package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dxlrun import CONTRACT_VERSION, Controller, Sensor, hookimpl
from dxlrun_controllers.diff_drive_controller import DiffDriveController
from dxlrun_controllers.feed_forward import FeedForward
from dxlrun_controllers.gravity_compensation import GravityCompensation
from dxlrun_controllers.gripper_controller import GripperController
from dxlrun_controllers.group import (
    JointGroupEffortController,
    JointGroupPosEffortController,
    JointGroupPositionController,
    JointGroupPosVelController,
    JointGroupPwmController,
    JointGroupVelocityController,
)
from dxlrun_controllers.joint_limiter import JointLimiter
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster
from dxlrun_controllers.leader_follower import LeaderFollower
from dxlrun_controllers.motions.ilc_controller import IlcController
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController
from dxlrun_controllers.motions.keyframe_player import KeyframePlayer
from dxlrun_controllers.motions.sample_player import SamplePlayer
from dxlrun_controllers.pid_controller import PidController
from dxlrun_controllers.sensing.battery_state_broadcaster import BatteryStateBroadcaster
from dxlrun_controllers.sensing.device_command_controller import DeviceCommandController
from dxlrun_controllers.sensing.fall_reflex import FallReflex
from dxlrun_controllers.sensing.imu_sensor_broadcaster import ImuSensorBroadcaster
from dxlrun_controllers.sensing.sensor_broadcaster import SensorBroadcaster
from dxlrun_controllers.sensors.serial_imu import SerialImu
from dxlrun_controllers.sensors.simulated_imu import SimulatedImu
from dxlrun_controllers.thermal_governor import ThermalGovernor


@hookimpl
def dxlrun_contract() -> int:
    """Return the contract that these controllers were written for: the one they are published with."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers() -> Mapping[str, type[Controller[Any]]]:
    """Return the standard controllers by their type in the robot file."""
    return {
        "battery_state_broadcaster": BatteryStateBroadcaster,
        "device_command_controller": DeviceCommandController,
        "diff_drive_controller": DiffDriveController,
        "fall_reflex": FallReflex,
        "feed_forward": FeedForward,
        "gravity_compensation": GravityCompensation,
        "gripper_controller": GripperController,
        "ilc_controller": IlcController,
        "imu_sensor_broadcaster": ImuSensorBroadcaster,
        "joint_group_effort_controller": JointGroupEffortController,
        "joint_group_poseffort_controller": JointGroupPosEffortController,
        "joint_group_position_controller": JointGroupPositionController,
        "joint_group_posvel_controller": JointGroupPosVelController,
        "joint_group_pwm_controller": JointGroupPwmController,
        "joint_group_velocity_controller": JointGroupVelocityController,
        "joint_limiter": JointLimiter,
        "joint_position_controller": PidController,
        "joint_state_broadcaster": JointStateBroadcaster,
        "joint_trajectory_controller": JointTrajectoryController,
        "keyframe_player": KeyframePlayer,
        "leader_follower": LeaderFollower,
        "pid_controller": PidController,
        "sample_player": SamplePlayer,
        "sensor_broadcaster": SensorBroadcaster,
        "thermal_governor": ThermalGovernor,
    }


@hookimpl
def dxlrun_sensors() -> Mapping[str, type[Sensor[Any]]]:
    """Return the standard sensors by their type in the robot file."""
    return {"serial_imu": SerialImu, "simulated_imu": SimulatedImu}
