"""Set-points: what publishers of ROS 2 send to controllers, each as a stream of its own."""

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
"""Of a lease, s."""
QUIET_S = 2.0
"""Between two warnings of a topic."""


class SetPoints:
    """One connection for the streams of all publishers; the log names the node of each."""

    def __init__(self, address: str, lease: float) -> None:
        """`lease`: for how long a set-point counts, s."""
        self.lease = lease
        self._address = address
        self._robot: RemoteRobot | None = None
        self._lock = threading.Lock()
        self._nodes: dict[bytes, str] = {}
        """Names of publishers' nodes by what the middleware identifies them with."""

    def close(self) -> None:
        """Close the connection; the leases run out."""
        with self._lock:
            if self._robot is not None:
                self._robot.close()

    def subscribe(
        self, node: Node, kind: type, topic: str, take: Callable[[Message, RemoteRobot], None]
    ) -> None:
        """Take the messages of a topic; `take` gets each with the robot, in the name of its publisher."""

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

    def send(
        self,
        robot: RemoteRobot,
        controller: str,
        kind: str,
        command: Mapping[str, object],
        more_s: float = 0.0,
    ) -> None:
        """Leave a set-point of the publisher that is being served; it counts for the lease and `more_s`."""
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
