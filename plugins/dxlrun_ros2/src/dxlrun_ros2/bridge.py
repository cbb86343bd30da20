"""Bridge: the nodes of one run of a robot, from its beginning to its end."""

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
from dxlrun_ros2.controller_node import ControllerNode, offer, offer_torque
from dxlrun_ros2.manager import Manager, info_of
from dxlrun_ros2.published_run import PublishedRun
from dxlrun_ros2.set_points import SetPoints

LOOK_S = 1.0
"""Between two looks for topics and controllers that are new."""
THREADS = 32
"""A goal has one until it ends; they are started when they are needed."""
LAST_S = 1.0
"""At the end, for the results of goals."""


class Bridge:
    """One run in ROS 2, in a context of its own: what a run had is gone with it."""

    def __init__(self, robot: RemoteRobot, address: str, lease: float) -> None:
        """Open nodes and topics; `address`: what the robot is connected to by. Raises DxlrunError."""
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
            Manager(self.node("controller_manager", **loads), address)
        except BaseException:
            self.close()
            raise

    def node(self, name: str, **more: bool) -> Node:
        """Return a new node of the bridge."""
        node = Node(name, context=self._context, **more)
        self._nodes[name] = node
        self._executor.add_node(node)
        return node

    def spin(self, stopped: threading.Event) -> None:
        """Serve until the run has ended, or the event is set. Raises DxlrunError."""
        looked = 0.0
        while not (stopped.is_set() or self.run.ended.is_set()):
            if time.monotonic() > looked + LOOK_S:
                looked = time.monotonic()
                self.run.hear(self._robot)
                self._look()
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
        except Exception as error:  # the last resort: one request that goes wrong ends nothing else
            self._nodes["dxlrun"].get_logger().error(f"{type(error).__name__}: {error}")

    def _look(self) -> None:
        """Open a node for each new controller, and close those that are unloaded. Raises DxlrunError."""
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
        """End all nodes."""
        self._points.close()
        self._executor.shutdown(timeout_sec=1.0)
        for node in self._nodes.values():
            node.destroy_node()
        self._context.try_shutdown()
