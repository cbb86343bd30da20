"""Controller node: topics, actions, parameters and torque services of a controller, as in ros2_control."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from control_msgs.msg import JointTrajectoryControllerState
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from dxlrun import DxlrunError, InputError, RemoteRobot, connect
from dxlrun.tooling.live import ControllerInfo, Executed
from dxlrun_ros2 import CLIENT
from dxlrun_ros2.action_servers import FollowTrajectory, Gripper, stopped
from dxlrun_ros2.published_run import STATE, PublishedRun
from dxlrun_ros2.set_points import LONGEST_S, SetPoints
from dxlrun_ros2.trajectories import point, wanted

GROUP = ("positions", "posvel", "poseffort", "velocities", "efforts", "pwm")
"""Kinds of commands with one number per joint and field; the topic CONTROLLER/commands sends the first
one that the controller accepts"""
STATE_NS = 20_000_000
"""Shortest time between two messages of a trajectory controller's topic controller_state, ns"""


class ControllerNode:
    """ROS 2 interface of one controller. Its topics and actions depend on the commands that it accepts."""

    def __init__(
        self, node: Node, robot: RemoteRobot, run: PublishedRun, controller: ControllerInfo, points: SetPoints
    ) -> None:
        """Open topics, actions, services and parameters of a controller in its node.

        Args:
            node: Node of the controller.
            robot: Connection to the robot.
            run: Publisher of the run, whose cycles the node reports.
            controller: Description of the controller.
            points: Connection for the setpoints of publishers.

        Raises:
            DxlrunError: The run has ended.
        """
        self.node, self._run, self._controller, self._points = node, run, controller, points
        name, takes = controller.name, controller.takes
        if "trajectory" in takes:
            self._action: object = FollowTrajectory(node, run, controller)
            points.subscribe(node, JointTrajectory, f"{name}/joint_trajectory", self._trajectory)
            topic = f"{name}/controller_state"
            self._state = node.create_publisher(JointTrajectoryControllerState, topic, STATE)
            self._state_ns = 0
            run.seen.add(self._show)
        if "grip" in takes:
            self._action = Gripper(node, run, controller)
        if "velocity" in takes:
            points.subscribe(node, TwistStamped, f"{name}/cmd_vel", self._stamped)
            points.subscribe(node, Twist, f"{name}/cmd_vel_unstamped", self._twist)
        if kinds := [kind for kind in GROUP if kind in takes]:
            self._kind = kinds[0]
            points.subscribe(node, Float64MultiArray, f"{name}/commands", self._send_command)
        self._live: dict[str, object] = {}
        self._declare(robot)
        if controller.command:
            offer_torque(node, run.address, controller.name, name)

    def close(self) -> None:
        """Stop publishing controller_state. The node itself is closed by the bridge."""
        self._run.seen.discard(getattr(self, "_show", None))

    # Topics

    def _trajectory(self, message: JointTrajectory, robot: RemoteRobot) -> None:
        """Send a published trajectory to the controller, as a chunk with a lease if it accepts chunks. A
        trajectory without points stops the joints."""
        name = self._controller.name
        if not message.points:
            stopped(robot, self._run, self._controller)
            return
        plan = wanted(message, self._controller.joints, self.node.get_clock().now().nanoseconds * 1e-9)
        if "chunk" in self._controller.takes and self._points.lease + plan.seconds <= LONGEST_S:
            self._points.send_set_point(robot, name, "chunk", plan.chunk(time.monotonic()), plan.seconds)
        else:
            robot.send(name, "trajectory", plan.build_command())

    def _send_command(self, message: Float64MultiArray, robot: RemoteRobot) -> None:
        fields = fields_of(self._controller, self._kind)
        if len(message.data) != len(fields) * len(self._controller.joints):
            many = f"{len(message.data)} numbers for {' and '.join(fields)}"
            raise InputError(f"{many} of {len(self._controller.joints)} joints")
        values = np.split(np.array(message.data), len(fields))
        self._points.send_set_point(
            robot, self._controller.name, self._kind, dict(zip(fields, values, strict=True))
        )

    def _stamped(self, message: TwistStamped, robot: RemoteRobot) -> None:
        self._twist(message.twist, robot)

    def _twist(self, twist: Twist, robot: RemoteRobot) -> None:
        command = {"linear": twist.linear.x, "angular": twist.angular.z}
        self._points.send_set_point(robot, self._controller.name, "velocity", command)

    def _show(self, record: np.void) -> None:
        """Publish controller_state from a cycle's record, at most every STATE_NS, if it has a subscriber."""
        t_ns = int(record["read_ns"])
        if t_ns < self._state_ns + STATE_NS or not self._state.get_subscription_count():
            return
        self._state_ns, rows = t_ns, self._run.rows(self._controller.joints)
        desired = np.array([record["goal_position"][rows], record["goal_velocity"][rows]])
        actual = np.array([record["position"][rows], record["velocity"][rows]])
        message = JointTrajectoryControllerState(
            joint_names=list(self._controller.joints), speed_scaling_factor=1.0
        )
        stamp = t_ns + self._run.header.epoch_offset_ns
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        message.reference, message.output = point(desired, 0.0), point(desired, 0.0)
        message.feedback, message.error = point(actual, 0.0), point(desired - actual, 0.0)
        self._state.publish(message)

    # Parameters

    def _declare(self, robot: RemoteRobot) -> None:
        """Declare the controller's parameters in its node. Only those that can change in a run can be set."""
        for one in robot.parameter_table(self._controller.name):
            value = list(one.value) if isinstance(one.value, tuple) else one.value
            if not _is_parameter(value):
                continue
            about = ParameterDescriptor(
                description=one.description,
                additional_constraints=one.range,
                read_only=not one.live,
                dynamic_typing=True,
            )
            self.node.declare_parameter(one.name, value, about)
            if one.live:
                self._live[one.name] = value
        also = {"joints": self._controller.joints, "command_interfaces": self._controller.command}
        for name, values in also.items():
            if not self.node.has_parameter(name):
                about = ParameterDescriptor(read_only=True, dynamic_typing=True)
                self.node.declare_parameter(name, list(values), about)
        self.node.add_on_set_parameters_callback(self._set)

    def refresh(self, robot: RemoteRobot) -> None:
        """Update the node's parameters that another client of the robot has changed."""
        now = {one.name: one.value for one in robot.parameter_table(self._controller.name) if one.live}
        changed = [name for name, value in now.items() if self._live.get(name) != value]
        self._live |= now
        self.node.set_parameters([Parameter(name, value=now[name]) for name in changed])

    def _set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        values = {one.name: one.value for one in parameters if self._live.get(one.name) != one.value}
        if values and values.keys() <= self._live.keys():
            try:
                with connect(self._run.address, CLIENT) as robot:
                    robot.set_parameters(self._controller.name, values)
            except DxlrunError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._live |= values
        return SetParametersResult(successful=True)


def fields_of(controller: ControllerInfo, kind: str) -> tuple[str, ...]:
    """Return the field names of a kind of command, such as positions and velocities, one number per joint."""
    schema = controller.takes[kind]
    properties = schema.get("properties", {}) if isinstance(schema, dict) else {}
    return tuple(properties)


def offer_torque(node: Node, robot: str, joints: str, place: str) -> None:
    """Create the services PLACE/torque and PLACE/reboot of joints, a group, a controller or `all`.

    Torque off and reboot deactivate the controllers that command the joints.
    """

    def switch(connected: RemoteRobot, request: SetBool.Request) -> Executed:
        return connected.torque(joints, request.data, release=not request.data)

    def reboot(connected: RemoteRobot, request: Trigger.Request) -> Executed:
        return connected.reboot(joints, release=True)

    for kind, name, ask in ((SetBool, "torque", switch), (Trigger, "reboot", reboot)):
        offer(node, robot, kind, f"{place}/{name}", ask)


def offer(
    node: Node, robot: str, kind: type, name: str, ask: Callable[[RemoteRobot, SetBool.Request], Executed]
) -> None:
    """Create a service of std_srvs that calls `ask` with a new connection to the robot.

    Its response has the cycle in which the request was executed, or the reason of the refusal.
    """

    def asked(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        try:
            with connect(robot, CLIENT) as connected:
                done = ask(connected, request)
            response.success = True
            left = f"; deactivated: {', '.join(done.deactivated)}" if done.deactivated else ""
            response.message = f"done in cycle {done.cycle}{left}"
        except DxlrunError as error:
            response.success, response.message = False, str(error)
        return response

    node.create_service(kind, name, asked, callback_group=ReentrantCallbackGroup())


def _is_parameter(value: object) -> bool:
    """Return True if ROS 2 has a parameter type for a value: a scalar, or a list of one type of scalars."""
    if isinstance(value, list):
        return len({type(one) for one in value}) == 1 and isinstance(value[0], bool | int | float | str)
    return isinstance(value, bool | int | float | str)
