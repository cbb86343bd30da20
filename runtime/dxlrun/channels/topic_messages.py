"""Messages of topics: encoded when they are published, and forwarded unchanged to the log and to clients.

A topic is announced once, with its definition, before its first message. The announcement assigns a number,
which its messages contain and which is never used again, because controllers that are loaded later announce
topics too. Messages are numbered by topic name, so a reader can count missing ones.
"""

from __future__ import annotations

import msgspec

from dxlrun.channels.ring import RING_SECONDS, Appender, RecordKind, record_size
from dxlrun.messages.definition import MessageType

LONGEST_MESSAGE = 64 * 1024
"""Longest message as CDR, bytes. The state of a trajectory of a hundred joints has a fifth of that."""
LEAST_CAPACITY = 1 << 20
"""Smallest ring for topic messages, bytes: for topics of the runtime, and of controllers loaded in the run.
"""
MOST_CAPACITY = 64 << 20


class PublishedTopic(msgspec.Struct, frozen=True):
    """A topic that the loop publishes. `joints` are the names for the rows of its arrays."""

    name: str
    """`/CONTROLLER/TOPIC`, or `/goals` of the runtime."""
    type: MessageType
    joints: tuple[str, ...] = ()


class OpenedTopic(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=3):
    """Record that announces a topic, with its definition, before its messages."""

    number: int
    """Number of the topic in its messages, in the order of announcement."""
    before: int
    """Number of messages that earlier topics of the same name had."""
    topic: PublishedTopic


class TopicRecord(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=4):
    """Record of one message that the loop published on a topic."""

    t_ns: int
    """Wake-up time of the cycle that published it, ns of the run's clock."""
    topic: int
    """Number of its topic, from the announcement."""
    number: int
    """Number of the message among those with the same topic name, from 1."""
    data: bytes
    """Payload of the message, encoded as CDR."""


class MessageSink:
    """Destination of topics and messages. Never blocks and never raises. This base class drops them."""

    __slots__ = ()

    def announce(self, topic: PublishedTopic) -> int:
        """Announce a topic before its first message; return the number that its messages use."""
        return 0

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Publish a message of an announced topic: its time, ns, and at most LONGEST_MESSAGE bytes."""


class MessageRing(MessageSink):
    """Message sink that appends topics and messages to a ring, for the recorder and clients."""

    __slots__ = ("_counts", "_numbers", "_writer")

    def __init__(self, writer: Appender) -> None:
        self._writer = writer
        self._counts: list[int] = []
        """Number of messages so far, by topic number."""
        self._numbers: dict[str, int] = {}
        """Number of the newest topic with each name."""

    def announce(self, topic: PublishedTopic) -> int:
        """Append the announcement of a topic; return its number. Messages of its name are counted on."""
        number, before = len(self._counts), self._numbers.get(topic.name)
        count = 0 if before is None else self._counts[before]
        self._counts.append(count)
        self._numbers[topic.name] = number
        opened = OpenedTopic(number, count, topic)
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(opened))
        return number

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Append a message of an announced topic, with its count."""
        self._counts[topic] = number = self._counts[topic] + 1
        message = TopicRecord(t_ns, topic, number, data)
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(message))


LONGEST_RECORD = LONGEST_MESSAGE + 64
"""Longest record of a message, bytes. A topic's definition is far shorter."""


def usual_message(joints: int) -> int:
    """Return the typical size of a message for a number of joints, bytes: eight rows, and names."""
    return 256 + joints * (8 * 8 + 24)


def message_capacity(bytes_per_second: float) -> int:
    """Return the size of a ring for 10 s of messages, bytes, from LEAST_CAPACITY to MOST_CAPACITY."""
    wanted = RING_SECONDS * int(bytes_per_second) + 2 * record_size(LONGEST_RECORD)
    return -(-min(max(LEAST_CAPACITY, wanted), MOST_CAPACITY) // 8) * 8
