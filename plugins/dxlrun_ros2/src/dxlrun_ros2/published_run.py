"""Published run: messages of a running robot as topics of ROS 2, with the same bytes as in the log."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_rosout_default

from dxlrun import DxlrunError, Floats, RemoteRobot, TopicMessage, connect
from dxlrun.tooling.live import LiveMessages
from dxlrun.tooling.topics import BUS_PREFIX, LogTopic, MessageType
from dxlrun_ros2 import CLIENT

STATE = QoSProfile(depth=1)
"""Quality of service of ros2_control's broadcasters: reliable, depth 1, volatile"""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Quality of service of topics whose last message a later subscriber also receives, such as /tf_static"""
QUALITIES: Mapping[str, QoSProfile] = {
    LogTopic.FRAMES: QoSProfile(depth=100),
    LogTopic.ROSOUT: qos_profile_rosout_default,
}
GLOBAL = {
    LogTopic.FRAMES,
    LogTopic.STILL_FRAMES,
    LogTopic.ROSOUT,
    LogTopic.DIAGNOSTICS,
}
"""Topics that keep their leading slash. All others are in the namespace of the bridge's node."""
LOGGED = {LogTopic.CYCLE, LogTopic.ACTIVATION, LogTopic.COMMANDS, LogTopic.EVENT, LogTopic.MACHINE}
"""Topics, besides those of buses, for which no message type is expected: no warning if it is missing"""


class PublishedRun(LiveMessages):
    """Publisher of one run: all topics of its log whose ROS 2 message type is installed.

    It also gives the other nodes the record of each cycle, in `newest` and to the functions in `seen`.
    """

    def __init__(self, node: Node, robot: RemoteRobot, address: str) -> None:
        """Create the publishers of the topics that every run has.

        Args:
            node: Node that publishes.
            robot: Connection to the robot.
            address: Name or address under which the robot can be connected to.

        Raises:
            DxlrunError: The run has ended.
        """
        super().__init__(robot.log_header())
        self.address, self._node = address, node
        self.ended = threading.Event()
        """Set when the run has ended or a thread that receives messages has failed"""
        self.why = ""
        """Reason why the run has ended; empty before"""
        self.seen: set[Callable[[np.void], None]] = set()
        """Functions that are called with the record of each cycle"""
        self.newest: np.void | None = None
        """Record of the newest cycle; None before the first"""
        self.changed: set[str] = set()
        """Controllers whose parameters changed and whose nodes are not updated yet"""
        self.on_changed = self.changed.add
        self._publishers_of: list[Publisher | None] = []
        self._heard: set[str] = set()
        self._lock = threading.Lock()
        self._open_channels()

    def _channel(self, topic: str, message: MessageType, *, latched: bool = False) -> int:
        quality = LATCHED if latched else QUALITIES.get(topic, STATE)
        name = topic if topic in GLOBAL else topic.removeprefix("/")
        kind = message_class(message.name)
        if kind is None and topic not in LOGGED and not topic.startswith(BUS_PREFIX):
            self._node.get_logger().warning(
                f"{topic} is not published: its type {message.name} is not installed"
            )
        opened = None if kind is None else self._node.create_publisher(kind, name, quality)
        self._publishers_of.append(opened)
        return len(self._publishers_of) - 1

    def _put(self, channel: int, t_ns: int, wall_ns: int, data: bytes) -> None:
        if (publisher := self._publishers_of[channel]) is not None:
            publisher.publish(data)

    def subscribe_new(self, robot: RemoteRobot) -> None:
        """Receive and publish the run's topics that were opened since the last call. Raises DxlrunError."""
        if new := self.heard(robot.topics()) - self._heard:
            self._heard |= new
            threading.Thread(target=self._listen, args=(new,), daemon=True).start()

    def _listen(self, topics: set[str]) -> None:
        """Publish the messages of topics until the run ends; then set `why` and `ended`."""
        try:
            with connect(self.address, CLIENT) as robot:
                for message in robot.listen(*topics):
                    with self._lock:
                        self.handle_message(message)
            self.why = f"the run of {self.header.robot} has ended"
        except DxlrunError as error:
            self.why = str(error)
        except Exception as error:  # without this, the topics would stop without a reason
            if not self.ended.is_set():
                self.why = f"{type(error).__name__}: {error}"
        self.ended.set()

    def handle_message(self, message: TopicMessage) -> None:
        """Publish a message of the run. Store the record of a cycle, and call the functions in `seen`."""
        super().handle_message(message)
        if message.topic == LogTopic.CYCLE:
            self.newest = self.read_cycle(message)
            for see in tuple(self.seen):
                see(self.newest)

    # The newest cycle

    @property
    def time_s(self) -> float:
        """Time of the newest cycle on the clock of the run, s; 0 before the first"""
        return 0.0 if self.newest is None else int(self.newest["read_ns"]) * 1e-9

    def rows(self, joints: Sequence[str]) -> NDArray[np.int_]:
        """Return the indices of joints in the fields of a cycle's record."""
        return np.array([self.header.joints.index(joint) for joint in joints], int)

    @property
    def desired(self) -> Floats:
        """Goal position of each joint in the newest cycle, or its measured position without a goal.

        rad or m, shape (joints,); NaN if unknown.
        """
        if self.newest is None:
            return np.full(len(self.header.joints), np.nan)
        goal, position = self.newest["goal_position"], self.newest["position"]
        found: Floats = np.where(np.isfinite(goal), goal, position)
        return found


def message_class(name: str) -> type | None:
    """Return the Python class of a ROS 2 message such as `nav_msgs/msg/Odometry`; None if not installed."""
    package, folder, kind = name.split("/")
    package = "dxlrun_msgs" if package == "dxlrun" else package  # `dxlrun` is the Python package
    try:
        found = getattr(import_module(f"{package}.{folder}"), kind, None)
    except ImportError:
        return None
    return found if isinstance(found, type) else None
