"""Setpoints: messages that ROS 2 publishers send to controllers, each valid for a limited time (lease)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TypeVar

from rclpy.node import Node
from rclpy.subscription import MessageInfo

from dxlrun import DxlrunError, RemoteRobot, connect
from dxlrun.tooling.live import SocketLink
from dxlrun_ros2 import CLIENT

Message = TypeVar("Message")
LONGEST_S = 60.0
"""Longest lease that the run accepts, s"""
QUIET_S = 2.0
"""Shortest time between two warnings about refused messages of a topic, s"""


class SetPoints:
    """Connection that sends the messages of all publishers. The robot's log names each publisher's node."""

    def __init__(self, address: str, lease: float) -> None:
        """Prepare the connection to a robot, which the first message opens.

        Args:
            address: Name or address of the robot.
            lease: Time for which a setpoint is valid; then the joints are held, s.
        """
        self.lease = lease
        self._address = address
        self._robot: RemoteRobot | None = None
        self._lock = threading.Lock()
        self._nodes: dict[bytes, str] = {}
        """Names of the publishers' nodes by the GID of the publisher"""

    def close(self) -> None:
        """Close the connection. The leases then expire."""
        with self._lock:
            if self._robot is not None:
                self._robot.close()

    def subscribe(
        self, node: Node, kind: type, topic: str, take: Callable[[Message, RemoteRobot], None]
    ) -> None:
        """Subscribe to a ROS 2 topic. A message that the robot refuses is reported as a warning in ROS.

        Args:
            node: Node that subscribes.
            kind: Type of the messages.
            topic: Name of the topic.
            take: Called with each message and a connection that identifies itself as the publisher.
        """

        def received(message: Message, info: MessageInfo) -> None:
            try:
                with self._lock:
                    robot = self._connected()
                    if isinstance(robot.link, SocketLink):
                        robot.link.client = f"{CLIENT} {self._publisher(node, topic, info)}"
                    take(message, robot)
            except DxlrunError as error:
                node.get_logger().warning(f"{topic}: {error}", throttle_duration_sec=QUIET_S)

        node.create_subscription(kind, topic, received, 10)

    def send_set_point(
        self,
        robot: RemoteRobot,
        controller: str,
        kind: str,
        command: Mapping[str, object],
        more_s: float = 0.0,
    ) -> None:
        """Send a setpoint to a controller, from within `take`. It is valid for the lease plus `more_s`, s."""
        robot.stream(controller, kind, self.lease + more_s).send(command)

    def _connected(self) -> RemoteRobot:
        if self._robot is None:
            self._robot = connect(self._address, CLIENT)
        return self._robot

    def _publisher(self, node: Node, topic: str, info: MessageInfo) -> str:
        """Return the name of the node that published a message."""
        gid = bytes((info.get("publisher_gid") or {}).get("data", b""))
        if gid not in self._nodes:
            found = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            self._nodes |= {bytes(one.endpoint_gid): one.node_name for one in found}
        return self._nodes.get(gid, "publisher")
