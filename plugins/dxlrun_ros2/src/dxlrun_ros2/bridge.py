"""Bridge: the ROS 2 nodes `dxlrun`, `controller_manager` and one per controller, for one run of a robot."""

from __future__ import annotations

import threading
import time

import rclpy
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from dxlrun import RemoteRobot
from dxlrun_ros2.controller_manager import ControllerManagerServices, info_of
from dxlrun_ros2.controller_node import ControllerNode, offer, offer_torque
from dxlrun_ros2.published_run import PublishedRun
from dxlrun_ros2.set_points import SetPoints

LOOK_S = 1.0
"""Period of polling the run for new topics and controllers, s"""
THREADS = 32
"""Largest number of threads that serve requests. Each action goal occupies one until it ends."""
LAST_S = 1.0
"""Time for which requests are still served after the end of the run, so that goals get results, s"""


class Bridge:
    """ROS 2 nodes of one run. They have a context of their own, so that they all end with the run."""

    def __init__(self, robot: RemoteRobot, address: str, lease: float) -> None:
        """Open the nodes `dxlrun` and `controller_manager`, and the topics that every run has.

        Args:
            robot: Connection to the robot.
            address: Name or address under which the robot can be connected to.
            lease: Time after which the joints of a silent publisher are held, s.

        Raises:
            DxlrunError: The run has ended, or refuses a request.
        """
        self._robot = robot
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._executor = MultiThreadedExecutor(THREADS, context=self._context)
        self._nodes: dict[str, Node] = {}
        self._controllers: dict[str, ControllerNode] = {}
        self._points = SetPoints(address, lease)
        try:
            own = self.node("dxlrun")
            self.run = PublishedRun(own, robot, address)
            offer(own, address, Trigger, "~/halt", lambda connected, _: connected.halt())
            offer_torque(own, address, "all", "~")
            loads = {
                "allow_undeclared_parameters": True,
                "automatically_declare_parameters_from_overrides": True,
            }
            ControllerManagerServices(self.node("controller_manager", **loads), address)
        except BaseException:
            self.close()
            raise

    def node(self, name: str, **more: bool) -> Node:
        """Create a ROS 2 node, which `spin` serves; `more` are keyword arguments of rclpy's Node."""
        node = Node(name, context=self._context, **more)
        self._nodes[name] = node
        self._executor.add_node(node)
        return node

    def spin(self, stopped: threading.Event) -> None:
        """Serve ROS 2 requests and new controllers until the run has ended or the event is set.

        Requests are served for LAST_S more. Raises DxlrunError if polling the run fails.
        """
        looked = 0.0
        while not (stopped.is_set() or self.run.ended.is_set()):
            if time.monotonic() > looked + LOOK_S:
                looked = time.monotonic()
                self.run.subscribe_new(self._robot)
                self._update_nodes()
            self._serve(0.1)
        self.run.ended.set()
        until = time.monotonic() + LAST_S
        while time.monotonic() < until:
            self._serve(0.05)
        if not stopped.is_set():
            print(self.run.why, flush=True)

    def _serve(self, timeout_s: float) -> None:
        try:
            self._executor.spin_once(timeout_s)
        except Exception as error:  # an error in one request must not end the bridge
            self._nodes["dxlrun"].get_logger().error(f"{type(error).__name__}: {error}")

    def _update_nodes(self) -> None:
        """Open a node for each new controller of the run, close the nodes of unloaded controllers, and update
        changed parameters. Raises DxlrunError."""
        found = {one.name: one for one in info_of(self._robot).controllers}
        for name in [name for name in self._controllers if name not in found]:
            self._controllers.pop(name).close()
            node = self._nodes.pop(name)
            self._executor.remove_node(node)
            node.destroy_node()
        for name, one in found.items():
            if name not in self._controllers:
                node = self.node(name)
                self._controllers[name] = ControllerNode(node, self._robot, self.run, one, self._points)
        while self.run.changed:
            if (name := self.run.changed.pop()) in self._controllers:
                self._controllers[name].refresh(self._robot)

    def close(self) -> None:
        """Close all nodes and the connection of the publishers' setpoints."""
        self._points.close()
        self._executor.shutdown(timeout_sec=1.0)
        for node in self._nodes.values():
            node.destroy_node()
        self._context.try_shutdown()
