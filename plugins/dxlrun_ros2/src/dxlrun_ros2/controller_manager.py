"""Controller manager: services with which ros2_control tools list, load and switch controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec
import yaml
from controller_manager_msgs.msg import (
    ChainConnection,
    ControllerState,
    HardwareComponentState,
    HardwareInterface,
)
from controller_manager_msgs.srv import (
    ConfigureController,
    ListControllers,
    ListControllerTypes,
    ListHardwareComponents,
    ListHardwareInterfaces,
    LoadController,
    SwitchController,
    UnloadController,
)
from lifecycle_msgs.msg import State
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from dxlrun import DxlrunError, InputError, RemoteRobot, connect
from dxlrun.tooling.live import ControllerInfo, RobotInfo
from dxlrun_ros2 import CLIENT

TYPES = {
    "diff_drive_controller": "diff_drive_controller/DiffDriveController",
    "gripper_controller": "position_controllers/GripperActionController",
    "imu_sensor_broadcaster": "imu_sensor_broadcaster/IMUSensorBroadcaster",
    "joint_group_effort_controller": "effort_controllers/JointGroupEffortController",
    "joint_group_position_controller": "position_controllers/JointGroupPositionController",
    "joint_group_velocity_controller": "velocity_controllers/JointGroupVelocityController",
    "joint_state_broadcaster": "joint_state_broadcaster/JointStateBroadcaster",
    "joint_trajectory_controller": "joint_trajectory_controller/JointTrajectoryController",
    "pid_controller": "pid_controller/PidController",
}
"""Controller types of ros2_control by dxlrun's type. All other types are reported as dxlrun/TYPE."""
STATES = ("position", "velocity", "effort")  # State interfaces of each joint


AnyRequest = TypeVar("AnyRequest")
AnyResponse = TypeVar("AnyResponse")


class ControllerManagerServices:
    """Services of ros2_control's controller_manager for a running robot"""

    def __init__(self, node: Node, address: str) -> None:
        self._node, self._address = node, address
        self._unloaded: dict[str, dict[str, object]] = {}
        """Robot file entries of controllers that were unloaded here, so that they can be loaded again"""
        group = ReentrantCallbackGroup()
        for kind, name, answer in (
            (ListControllers, "list_controllers", self._list),
            (ListControllerTypes, "list_controller_types", self._types),
            (ListHardwareInterfaces, "list_hardware_interfaces", self._interfaces),
            (ListHardwareComponents, "list_hardware_components", self._components),
            (SwitchController, "switch_controller", self._switch),
            (LoadController, "load_controller", self._load),
            (ConfigureController, "configure_controller", self._configure),
            (UnloadController, "unload_controller", self._unload),
        ):
            node.create_service(kind, f"~/{name}", partial(self._asked, answer), callback_group=group)

    def _asked(
        self,
        answer: Callable[[RemoteRobot, AnyRequest, AnyResponse], None],
        request: AnyRequest,
        response: AnyResponse,
    ) -> AnyResponse:
        """Fill the response of a service with `answer` and a new connection to the robot; return it. If the
        request is refused, `ok` stays false and the reason is logged in ROS."""
        try:
            with connect(self._address, CLIENT) as robot:
                answer(robot, request, response)
                if hasattr(response, "ok"):
                    response.ok = True
        except DxlrunError as error:
            self._node.get_logger().error(str(error))
            if hasattr(response, "message"):
                response.message = str(error)
        return response

    # Queries

    def _list(
        self, robot: RemoteRobot, _: ListControllers.Request, response: ListControllers.Response
    ) -> None:
        known = info_of(robot).controllers
        response.controller = [_state(one, known) for one in known]

    def _types(
        self, robot: RemoteRobot, _: ListControllerTypes.Request, response: ListControllerTypes.Response
    ) -> None:
        types = sorted({ros_type(one.type) for one in info_of(robot).controllers} | {*TYPES.values()})
        response.types = types
        response.base_classes = ["controller_interface::ControllerInterface"] * len(types)

    def _interfaces(
        self, robot: RemoteRobot, _: ListHardwareInterfaces.Request, response: ListHardwareInterfaces.Response
    ) -> None:
        found = _hardware(robot)
        response.command_interfaces = found.command_interfaces
        response.state_interfaces = found.state_interfaces

    def _components(
        self, robot: RemoteRobot, _: ListHardwareComponents.Request, response: ListHardwareComponents.Response
    ) -> None:
        response.component = [_hardware(robot)]

    # Changes

    def _switch(
        self, robot: RemoteRobot, request: SwitchController.Request, response: SwitchController.Response
    ) -> None:
        entering, leaving = list(request.activate_controllers), list(request.deactivate_controllers)
        if request.strictness == SwitchController.Request.BEST_EFFORT:
            active = {one.name: one.active for one in info_of(robot).controllers}
            entering = [name for name in entering if active.get(name) is False]
            leaving = [name for name in leaving if active.get(name)]
        if entering or leaving:
            robot.switch(entering, leaving)

    def _load(self, robot: RemoteRobot, request: LoadController.Request, _: LoadController.Response) -> None:
        """Load a controller while the run is paused. If it is loaded already, nothing changes."""
        if request.name in {one.name for one in info_of(robot).controllers}:
            return
        entry = self._entry(request.name)
        with _paused(robot):
            robot.load(request.name, entry)

    def _unload(
        self, robot: RemoteRobot, request: UnloadController.Request, _: UnloadController.Response
    ) -> None:
        entry = _written(_known(robot, request.name), robot)
        with _paused(robot):
            robot.unload(request.name)
        self._unloaded[request.name] = entry

    def _configure(
        self, robot: RemoteRobot, request: ConfigureController.Request, _: ConfigureController.Response
    ) -> None:
        """Check that the controller is loaded. There is nothing to do, because loading also configures it."""
        _known(robot, request.name)

    def _entry(self, name: str) -> dict[str, object]:
        """Return the robot file entry for a controller that is to be loaded.

        In rising priority: the entry with which it was unloaded, files of the parameter NAME.params_file,
        and parameters NAME.* of this node. Raises InputError without a type.
        """
        given = {key: one.value for key, one in self._node.get_parameters_by_prefix(name).items()}
        files = given.pop("params_file", [])
        entry = dict(self._unloaded.get(name, {}))
        for path in [files] if isinstance(files, str) else files:
            entry |= _parameters(Path(path), name)
        entry |= given
        if "type" not in entry:
            raise InputError(
                f"{name} has no type; set the parameter {name}.type of controller_manager, "
                "or give a parameter file"
            )
        for own, other in TYPES.items():
            if entry["type"] == other:
                entry["type"] = own
        return entry


def _parameters(path: Path, name: str) -> dict[str, object]:
    """Read a controller's `ros__parameters` from a ROS 2 parameter file; empty if the file lacks it. Raises
    InputError."""
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
        return dict(found[name]["ros__parameters"]) if name in found else {}
    except (OSError, yaml.YAMLError, TypeError, KeyError) as error:
        raise InputError(f"{path} has no parameters for {name}: {error}") from error


@contextmanager
def _paused(robot: RemoteRobot) -> Iterator[None]:
    """Pause the run, which holds all joints, while a controller is loaded or unloaded."""
    robot.pause()
    try:
        yield
    finally:
        robot.resume()


def info_of(robot: RemoteRobot) -> RobotInfo:
    """Request `RemoteRobot.info` and convert it: names of joints, rate, controllers. Raises DxlrunError."""
    return msgspec.convert(robot.info(), RobotInfo)


def ros_type(kind: str) -> str:
    """Return the ros2_control type for a controller type of dxlrun, or dxlrun/TYPE if there is none."""
    return TYPES.get(kind, f"dxlrun/{kind}")


def _known(robot: RemoteRobot, name: str) -> ControllerInfo:
    """Return the description of a loaded controller. Raises InputError if it is not loaded."""
    known = {one.name: one for one in info_of(robot).controllers}
    if name not in known:
        raise InputError(f"controller {name} is not loaded; loaded controllers: {', '.join(known)}")
    return known[name]


def _written(one: ControllerInfo, robot: RemoteRobot) -> dict[str, object]:
    """Return the robot file entry that loads a controller again, inactive and with its current parameters."""
    entry: dict[str, object] = {"type": one.type, "active": False}
    entry |= {"into": list(one.into)} if one.into else {}
    entry |= {"fallback": one.fallback} if one.fallback else {}
    for parameter in robot.parameter_table(one.name):
        *above, last = parameter.name.split(".")
        place: dict[str, object] = entry
        for key in above:
            inner = place.setdefault(key, {})
            place = inner if isinstance(inner, dict) else {}
        if parameter.value is not None:
            place[last] = parameter.value
    return entry


def _state(one: ControllerInfo, known: Sequence[ControllerInfo]) -> ControllerState:
    commanded = [f"{joint}/{kind}" for joint in one.joints for kind in one.command]
    if one.into:
        commanded = [f"{below}/{name}" for below in one.into for name in commanded]
    measured = [f"{joint}/{kind}" for joint in one.joints for kind in ("position", "velocity")]
    references = [f"{joint}/{kind}" for joint in one.joints for kind in one.reference]
    return ControllerState(
        name=one.name,
        state="active" if one.active else "inactive",
        type=ros_type(one.type),
        update_rate=round(one.rate),
        claimed_interfaces=commanded if one.active else [],
        required_command_interfaces=commanded,
        required_state_interfaces=[*measured, *one.reads],
        is_chainable=bool(one.reference),
        is_chained=any(upper.active and one.name in upper.into for upper in known),
        reference_interfaces=references,
        chain_connections=[
            ChainConnection(
                name=below, reference_interfaces=[name for name in commanded if name.startswith(f"{below}/")]
            )
            for below in one.into
        ],
    )


def _hardware(robot: RemoteRobot) -> HardwareComponentState:
    """Describe the robot as one hardware component of ros2_control, with all command and state interfaces."""
    info = info_of(robot)
    direct = [one for one in info.controllers if not one.into]
    commanded = sorted({f"{joint}/{kind}" for one in direct for joint in one.joints for kind in one.command})
    claimed = {
        f"{joint}/{kind}" for one in direct if one.active for joint in one.joints for kind in one.command
    }
    states = [f"{joint}/{kind}" for joint in info.joints for kind in STATES]
    return HardwareComponentState(
        name=info.robot,
        type="system",
        plugin_name="dxlrun",
        rw_rate=round(info.rate),
        state=State(id=State.PRIMARY_STATE_ACTIVE, label="active"),
        command_interfaces=[_interface(name, claimed=name in claimed) for name in commanded],
        state_interfaces=[_interface(name, claimed=False) for name in states],
    )


def _interface(name: str, *, claimed: bool) -> HardwareInterface:
    return HardwareInterface(name=name, data_type="double", is_available=True, is_claimed=claimed)
