"""Bridge: the nodes of one run of a robot, from its beginning to its end."""

from __future__ import annotations

import threading
import time

import rclpy
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dxlrun import RemoteRobot
from dxlrun_ros2.published_run import PublishedRun

LOOK_S = 1.0
"""Between two looks for topics and controllers that are new."""
THREADS = 8
LAST_S = 0.3
"""At the end, for the results of goals."""


class Bridge:
    """One run in ROS 2, in a context of its own: what a run had is gone with it."""

    def __init__(self, robot: RemoteRobot, lease: float) -> None:
        """Open nodes and topics. Raises DxlrunError."""
        self._robot = robot
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._executor = MultiThreadedExecutor(THREADS, context=self._context)
        self._nodes: dict[str, Node] = {}
        try:
            self.run = PublishedRun(self.node("dxlrun"), robot)
        except BaseException:
            self.close()
            raise

    def node(self, name: str) -> Node:
        """Return a new node of the bridge."""
        node = Node(name, context=self._context)
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
            self._executor.spin_once(0.1)
        self.run.ended.set()
        until = time.monotonic() + LAST_S
        while time.monotonic() < until:
            self._executor.spin_once(0.05)
        if not stopped.is_set():
            print(self.run.why, flush=True)

    def close(self) -> None:
        """End all nodes."""
        self._executor.shutdown(timeout_sec=1.0)
        for node in self._nodes.values():
            node.destroy_node()
        self._context.try_shutdown()
