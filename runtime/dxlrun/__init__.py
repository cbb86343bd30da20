"""dxlrun: the names for authors of plug-ins and for programs that steer a running robot; nothing else.

`import dxlrun` is light: each name is imported when it is first used, so that neither numpy nor pydantic is
loaded for a command line that only prints its help.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dxlrun.channels.cycle import Commands, Floats, States
    from dxlrun.contract.body import Body, LinkMotion
    from dxlrun.contract.controller import (
        LIVE,
        CommandModel,
        Context,
        Controller,
        Goal,
        Interfaces,
        JointLimits,
        Mismatch,
        Outcome,
        RobotModel,
    )
    from dxlrun.contract.hookspecs import CONTRACT_VERSION, Command, hookimpl
    from dxlrun.contract.joint_controller import JointController, reading
    from dxlrun.contract.sensor import Sensor, SensorContext
    from dxlrun.description.form import ParametersModel
    from dxlrun.description.joints.motor import MotorLoad, MotorModel, Stribeck
    from dxlrun.description.joints.servo import ServoModel
    from dxlrun.description.units import (
        Angle,
        AngularAcceleration,
        AngularJerk,
        AngularVelocity,
        Duration,
        Frequency,
        Length,
        LinearAcceleration,
        LinearJerk,
        LinearVelocity,
        Mass,
        Time,
        Voltage,
    )
    from dxlrun.errors import (
        ControllerFault,
        DxlrunError,
        GoalTimeout,
        InputError,
        LogError,
        PlugInError,
        PortError,
        ProcessFault,
        Refused,
        StartUpError,
    )
    from dxlrun.log.reader import Log, LogReader, Topic, open_log
    from dxlrun.remote.client import (
        GoalState,
        RemoteGoal,
        RemoteRobot,
        Stream,
        TopicMessage,
        TopicState,
        connect,
        running,
    )

__all__ = [
    "CONTRACT_VERSION",
    "LIVE",
    "Angle",
    "AngularAcceleration",
    "AngularJerk",
    "AngularVelocity",
    "Body",
    "Command",
    "CommandModel",
    "Commands",
    "Context",
    "Controller",
    "ControllerFault",
    "Duration",
    "DxlrunError",
    "Floats",
    "Frequency",
    "Goal",
    "GoalState",
    "GoalTimeout",
    "InputError",
    "Interfaces",
    "JointController",
    "JointLimits",
    "Length",
    "LinearAcceleration",
    "LinearJerk",
    "LinearVelocity",
    "LinkMotion",
    "Log",
    "LogError",
    "LogReader",
    "Mass",
    "Mismatch",
    "MotorLoad",
    "MotorModel",
    "Outcome",
    "ParametersModel",
    "PlugInError",
    "PortError",
    "ProcessFault",
    "Refused",
    "RemoteGoal",
    "RemoteRobot",
    "RobotModel",
    "Sensor",
    "SensorContext",
    "ServoModel",
    "StartUpError",
    "States",
    "Stream",
    "Stribeck",
    "Time",
    "Topic",
    "TopicMessage",
    "TopicState",
    "Voltage",
    "connect",
    "hookimpl",
    "open_log",
    "reading",
    "running",
]

_ROOMS = {
    "dxlrun.contract.controller": (
        "LIVE",
        "CommandModel",
        "Context",
        "Controller",
        "Goal",
        "Interfaces",
        "JointLimits",
        "Mismatch",
        "Outcome",
        "RobotModel",
    ),
    "dxlrun.contract.hookspecs": ("CONTRACT_VERSION", "Command", "hookimpl"),
    "dxlrun.contract.joint_controller": ("JointController", "reading"),
    "dxlrun.contract.sensor": ("Sensor", "SensorContext"),
    "dxlrun.description.form": ("ParametersModel",),
    "dxlrun.description.joints.motor": ("MotorLoad", "MotorModel", "Stribeck"),
    "dxlrun.description.joints.servo": ("ServoModel",),
    "dxlrun.description.units": (
        "Angle",
        "AngularAcceleration",
        "AngularJerk",
        "AngularVelocity",
        "Duration",
        "Frequency",
        "Length",
        "LinearAcceleration",
        "LinearJerk",
        "LinearVelocity",
        "Mass",
        "Time",
        "Voltage",
    ),
    "dxlrun.errors": (
        "ControllerFault",
        "DxlrunError",
        "GoalTimeout",
        "InputError",
        "LogError",
        "PlugInError",
        "PortError",
        "ProcessFault",
        "Refused",
        "StartUpError",
    ),
    "dxlrun.log.reader": ("Log", "LogReader", "Topic", "open_log"),
    "dxlrun.contract.body": ("Body", "LinkMotion"),
    "dxlrun.channels.cycle": ("Commands", "Floats", "States"),
    "dxlrun.remote.client": (
        "GoalState",
        "RemoteGoal",
        "RemoteRobot",
        "Stream",
        "TopicMessage",
        "TopicState",
        "connect",
        "running",
    ),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'dxlrun' has no attribute {name!r}")
    value: object = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
