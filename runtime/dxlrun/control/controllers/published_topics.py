"""Topics: messages that controllers and the runtime publish from the loop to the log and to clients.

The loop's process checks and encodes a message when it is published, and keeps no reference to it.
"""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.topic_messages import LONGEST_MESSAGE, MessageSink, PublishedTopic
from dxlrun.errors import ControllerFault
from dxlrun.messages.declared import DeclaredMessage, WrongMessage, declared_message, package_of

MOST_PER_CYCLE = 16
"""Messages that one controller may publish in a cycle. The limit catches runaway controllers."""
OWN_PACKAGE = "dxlrun_msgs"
"""ROS package name of the runtime's own message types."""


class Publisher:
    """Publishes messages on one topic, stamped with the wake-up time of the cycle."""

    def __init__(
        self,
        topic: PublishedTopic,
        message: DeclaredMessage,
        sink: MessageSink,
        record: CycleRecord,
        epoch_offset_ns: int,
    ) -> None:
        self.topic = topic
        self._message = message
        self._sink = sink
        self._number = sink.announce(topic)
        self._record = record
        self._epoch_offset_ns = epoch_offset_ns

    def publish(self, message: object) -> None:
        """Publish a message. Raises WrongMessage if it does not fit the topic."""
        t_ns = self._record.woken_ns
        data = self._message.pack(message, divmod(max(0, t_ns + self._epoch_offset_ns), 1_000_000_000))
        if len(data) > LONGEST_MESSAGE:
            raise WrongMessage(f"{len(data)} bytes, more than {LONGEST_MESSAGE}")
        self._sink.message(self._number, t_ns, data)


class TopicLog:
    """Opens the topics that a loop publishes, and gives their messages to a sink."""

    def __init__(
        self, record: CycleRecord, sink: MessageSink | None = None, epoch_offset_ns: int = 0
    ) -> None:
        self._record = record
        self._sink = sink or MessageSink()
        self._epoch_offset_ns = epoch_offset_ns

    def open(
        self, name: str, message: type, package: str = OWN_PACKAGE, joints: tuple[str, ...] = ()
    ) -> Publisher:
        """Announce a topic whose messages are instances of a dataclass. Allocates.

        Raises:
            WrongMessage: `message` is not a valid message class.
        """
        declared = declared_message(message, package)
        topic = PublishedTopic(name, declared.type, joints)
        return Publisher(topic, declared, self._sink, self._record, self._epoch_offset_ns)

    def of_controller(self, name: str, bit: int) -> ControllerTopics:
        """Return the object by which a controller publishes. Its topics are opened later, by `open`."""
        return ControllerTopics(self, self._record, name, bit)


class ControllerTopics:
    """Topics of one controller, `/CONTROLLER/TOPIC`. Implements `Context.publish`."""

    def __init__(self, log: TopicLog, record: CycleRecord, name: str, bit: int) -> None:
        self._log = log
        self._record = record
        self._name = name
        self._bit = bit
        self._publishers: dict[str, Publisher] = {}
        self._cycle = -2
        self._left = 0

    def open_topics(self, topics: Mapping[str, type], distribution: str, joints: tuple[str, ...]) -> None:
        """Announce the controller's topics, so that it can publish.

        Args:
            topics: Message classes by topic.
            distribution: Distribution that offers the controller; names the package of the messages.
            joints: Joints of the controller.

        Raises:
            ControllerFault: A message class is not valid.
        """
        package = package_of(distribution)
        for topic, message in topics.items():
            try:
                name = f"/{self._name}/{topic}"
                self._publishers[topic] = self._log.open(name, message, package, joints)
            except WrongMessage as error:
                raise ControllerFault(f"controller {self._name}: topic {topic}: {error}") from None

    def publish(self, topic: str = "", message: object = None) -> None:
        """Publish a message on a topic; without arguments, mark this cycle for the topics of `publishes`.

        Raises:
            ControllerFault: The topic is not declared, the message does not fit, or the controller published
                more than MOST_PER_CYCLE messages.
        """
        record = self._record
        if not topic:
            record.published |= self._bit
            return
        publisher = self._publishers.get(topic)
        if publisher is None:
            known = ", ".join(self._publishers) or "none"
            raise ControllerFault(f"published on {topic}, but its Topics are {known}")
        if not record.woken_ns:
            raise ControllerFault(f"published on {topic} before it was activated")
        cycle = record.cycle
        if cycle != self._cycle:
            self._cycle, self._left = cycle, MOST_PER_CYCLE
        self._left -= 1
        if self._left < 0:
            raise ControllerFault(f"published more than {MOST_PER_CYCLE} messages in a cycle")
        try:
            publisher.publish(message)
        except WrongMessage as error:
            raise ControllerFault(f"published an invalid message on topic {topic}: {error}") from None
