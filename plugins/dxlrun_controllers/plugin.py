"""Plug-in of the standard controllers and sensors, with the hooks that any other package uses."""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun import CONTRACT_VERSION, hookimpl

_MOTIONS = "dxlrun_controllers.motions"
_SENSING = "dxlrun_controllers.sensing"


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version. These controllers are released together with it."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers() -> Mapping[str, str]:
    """Return the import path of each standard controller, by its type in the robot file."""
    return {
        "battery_state_broadcaster": f"{_SENSING}.battery_state_broadcaster:BatteryStateBroadcaster",
        "device_command_controller": f"{_SENSING}.device_command_controller:DeviceCommandController",
        "diff_drive_controller": "dxlrun_controllers.diff_drive_controller:DiffDriveController",
        "fall_reflex": f"{_SENSING}.fall_reflex:FallReflex",
        "feed_forward": "dxlrun_controllers.feed_forward:FeedForward",
        "gravity_compensation": "dxlrun_controllers.gravity_compensation:GravityCompensation",
        "gripper_controller": "dxlrun_controllers.gripper_controller:GripperController",
        "ilc_controller": f"{_MOTIONS}.ilc_controller:IlcController",
        "imu_sensor_broadcaster": f"{_SENSING}.imu_sensor_broadcaster:ImuSensorBroadcaster",
        "joint_group_effort_controller": "dxlrun_controllers.group:JointGroupEffortController",
        "joint_group_poseffort_controller": "dxlrun_controllers.group:JointGroupPosEffortController",
        "joint_group_position_controller": "dxlrun_controllers.group:JointGroupPositionController",
        "joint_group_posvel_controller": "dxlrun_controllers.group:JointGroupPosVelController",
        "joint_group_pwm_controller": "dxlrun_controllers.group:JointGroupPwmController",
        "joint_group_velocity_controller": "dxlrun_controllers.group:JointGroupVelocityController",
        "joint_position_controller": "dxlrun_controllers.pid_controller:PidController",
        "joint_state_broadcaster": "dxlrun_controllers.joint_state_broadcaster:JointStateBroadcaster",
        "joint_trajectory_controller": f"{_MOTIONS}.joint_trajectory_controller:JointTrajectoryController",
        "keyframe_player": f"{_MOTIONS}.keyframe_player:KeyframePlayer",
        "leader_follower": "dxlrun_controllers.leader_follower:LeaderFollower",
        "pid_controller": "dxlrun_controllers.pid_controller:PidController",
        "sample_player": f"{_MOTIONS}.sample_player:SamplePlayer",
        "sensor_broadcaster": f"{_SENSING}.sensor_broadcaster:SensorBroadcaster",
        "thermal_governor": "dxlrun_controllers.thermal_governor:ThermalGovernor",
    }


@hookimpl
def dxlrun_sensors() -> Mapping[str, str]:
    """Return the import path of each standard sensor, by its type in the robot file."""
    return {
        "serial_imu": "dxlrun_controllers.sensors.serial_imu:SerialImu",
        "simulated_imu": "dxlrun_controllers.sensors.simulated_imu:SimulatedImu",
    }
